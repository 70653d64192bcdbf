"""Scenes that a worker has built, kept for its next tasks: the last few, each in a folder for work of its own."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path

from pipeline.city.running.jobs import Job
from pipeline.core import files
from pipeline.runs import stage_keys, workflow
from pipeline.stages.base import Workspace
from pipeline.stages.shared.site_scoring import SiteScoring

MOST = 2
"""Scenes that a worker keeps; a large one takes some hundred MB."""

BEFORE_SCORE = ("statics", "scan", "traffic", "tpog")
"""The stages whose artefacts sites are scored from."""


class Built:
    """What the sites of one junction are scored from: artefacts in a folder for work, and what was built of them."""

    def __init__(self, job: Job, folder: Path) -> None:
        self._job, self._lock = job, threading.Lock()
        self.work = Workspace(job.scenario(), folder, jobs=1)
        self.users = 0

    def bring(self) -> None:
        """Have the artefacts, from the store or made."""
        with self._lock:
            workflow.bring(self.work, *BEFORE_SCORE)

    def ready(self) -> SiteScoring:
        """What scores its sites."""
        with self._lock:
            return self._scoring

    @cached_property
    def _scoring(self) -> SiteScoring:
        workflow.bring(self.work, *BEFORE_SCORE)
        return SiteScoring(self.work)

    @cached_property
    def score_key(self) -> str:
        """The key of its score stage."""
        return stage_keys.inputs("score", self.work).key


class Kept:
    """The scenes of one process; threads share it."""

    def __init__(self, most: int = MOST) -> None:
        self._most, self._lock = most, threading.Lock()
        self._kept: OrderedDict[tuple[str, Job], tuple[Built, ExitStack]] = OrderedDict()

    @contextmanager
    def lent(self, token: str, job: Job) -> Iterator[Built]:
        """The scene of a junction in one city run; while it is lent, its folder stays."""
        with self._lock:
            built = self._take((token, job))
            built.users += 1
        try:
            yield built
        finally:
            with self._lock:
                built.users -= 1
                self._drop_oldest()

    def drop(self, token: str, job: Job) -> None:
        """Nobody here will ask for the scene of a junction again; one that is lent stays."""
        with self._lock:
            built, stack = self._kept.get((token, job), (None, None))
            if built is not None and stack is not None and not built.users:
                del self._kept[token, job]
                stack.close()

    def _take(self, key: tuple[str, Job]) -> Built:
        if key not in self._kept:
            stack = ExitStack()
            self._kept[key] = Built(key[1], stack.enter_context(files.scratch())), stack
        self._kept.move_to_end(key)
        return self._kept[key][0]

    def _drop_oldest(self) -> None:
        idle = [key for key, (built, _) in self._kept.items() if not built.users]
        for key in idle[: max(0, len(self._kept) - self._most)]:
            _, stack = self._kept.pop(key)
            stack.close()


KEPT = Kept()
