"""A stage in the background: SUMO simulates while the stages before it run.

SUMO is another process, and its stage reads nothing of the stages before it. So that stage starts first, in a thread of
its own, and the scene is checked, built and scanned beside it. Its turn still comes after theirs: what goes wrong there
is reported first, and ends it.

Until its turn the stage works in ``.pending`` in the run folder, so that a run that is rejected or interrupted leaves
the other files as they were. A killed run may leave ``.pending``; the next run removes it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent import futures
from contextlib import ExitStack, contextmanager
from contextvars import copy_context
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from egvs.artefacts.run_folder import RunFolder
from egvs.core import threads
from egvs.core.errors import InputError
from egvs.runs import stage_registry
from egvs.runs.stage_keys import StageKey
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store
from egvs.stages.base import StageContext, WorkAhead

if TYPE_CHECKING:
    import pyarrow as pa


class BackgroundStage:
    """A stage at work in a thread; made by :func:`run_in_background`.

    Parameters
    ----------
    name, key
        The stage, and what its artefacts depend on.
    context
        The run folder and the inputs.
    ahead
        Work of other stages on the trajectories, by stage.
    """

    def __init__(self, name: str, key: StageKey, context: StageContext, ahead: Mapping[str, WorkAhead]) -> None:
        self.key = key.key
        self._name = name
        self.ahead = ahead
        self._dependencies = key.dependencies
        self._context = context
        self._pending = RunFolder(context.folder.pending)
        self._is_awaited = False
        self._can_go_on, self._is_cancelled = Event(), Event()
        self._stack = ExitStack()
        self._future: futures.Future[StageResult] | None = None

    def start(self, store: Store) -> bool:
        """Start the stage, and return once it waits for a program, or has ended.

        Until then it computes in Python, as the other stages do: both at once would only delay SUMO.

        Returns
        -------
        bool
            False, and nothing is started, where the store has the artefacts or another process makes them.
        """
        if not self._stack.enter_context(store.maker(self._name, self.key, wait=False)):
            return False
        store.fetch(self._name, self.key)
        if store.has(self._name, self.key):
            return False
        self._stack.callback(shutil.rmtree, self._pending.path, ignore_errors=True)
        self._pending.path.mkdir()
        pool = self._stack.enter_context(futures.ThreadPoolExecutor(1, "background"))
        self._stack.callback(self._is_cancelled.set)
        self._future = pool.submit(copy_context().run, self._run)
        self._future.add_done_callback(lambda _: self._can_go_on.set())
        self._can_go_on.wait()
        return True

    def _run(self) -> StageResult:
        context = self._context.with_folder(self._pending, self._report_progress)
        context = replace(context, follow=self._follow)
        with threads.at_checkpoints(self._check_in):
            return stage_registry.run_stage(self._name, context, self._dependencies)

    def _follow(self, rows: pa.Table) -> None:
        for work in self.ahead.values():
            work.add(rows)

    def _check_in(self) -> None:
        self._can_go_on.set()
        if self._is_cancelled.is_set():
            raise futures.CancelledError

    def _report_progress(self, what: str, done: int, total: int) -> None:
        """Pass progress on when the stage is the one that the run waits for."""
        if self._is_cancelled.is_set():
            raise futures.CancelledError
        if self._is_awaited:
            self._context.progress(what, done, total)

    def result(self, meanwhile: Iterable[Callable[[], None]] = ()) -> StageResult:
        """Wait for the end of the stage, and move its files to their places, also where it failed.

        Parameters
        ----------
        meanwhile
            Called one after another as long as the stage works.

        Raises
        ------
        EgvsError, OSError
            The error of the stage.
        """
        assert self._future is not None, "the stage was started"
        self._is_awaited = True
        for work in meanwhile:
            if self._future.done():
                break
            work()
        futures.wait([self._future])
        self._context.forget(*stage_registry.written_by(self._name))
        for file in RunFolder.written_by(self._name):
            if (self._pending / file.name).exists():
                _move(self._pending / file.name, self._context.path(file.name))
        error = self._future.exception()
        if error is not None:
            _replace_path(error, self._pending.path, self._context.folder.path)
        result = self._future.result()
        self._context.expect(result.artefacts)
        return result

    def close(self) -> None:
        """End the stage if it still works, remove its folder, and let other processes make its artefacts."""
        self._stack.close()


@contextmanager
def run_in_background(
    name: str, key: StageKey | None, context: StageContext, store: Store, ahead: Mapping[str, WorkAhead]
) -> Iterator[BackgroundStage | None]:
    """Run a stage in the background during the block; nothing of it is left but what its ``result`` has moved.

    Parameters
    ----------
    name, key
        The stage, and what its artefacts depend on; no stage if None.
    context
        The run folder and the inputs.
    ahead
        Work of other stages on the trajectories, by stage: it gets each row group.
    store
        Where results are cached; the entry of the stage is reserved until :meth:`BackgroundStage.close`.

    Yields
    ------
    BackgroundStage or None
        The stage; None where there is no need to run it.
    """
    pending = context.folder.pending  # of a killed run
    if pending.is_symlink():
        pending.unlink()
    shutil.rmtree(pending, ignore_errors=True)
    if key is None:
        yield None
        return
    stage = BackgroundStage(name, key, context, ahead)
    try:
        is_started = stage.start(store)
        if not is_started:
            stage.close()
        yield stage if is_started else None
    finally:
        stage.close()


def _move(path: Path, target: Path) -> None:
    """Move a file or a folder; it takes the place of the file or folder of that name."""
    if target.is_dir() and not target.is_symlink():
        shutil.rmtree(target)
    else:
        target.unlink(missing_ok=True)
    path.rename(target)


def _replace_path(error: BaseException, path: Path, by: Path) -> None:
    """Name another path wherever an error names a path: files have been moved."""

    def replaced(value: Any) -> Any:
        return value.replace(str(path), str(by)) if isinstance(value, str) else value

    error.args = tuple(replaced(value) for value in error.args)
    if isinstance(error, InputError):
        error.where, error.problem = replaced(error.where), replaced(error.problem)
    if isinstance(error, OSError):
        error.filename = replaced(error.filename)
