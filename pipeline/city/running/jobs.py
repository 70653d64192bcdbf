"""What is sent to workers and what comes back: paths, names and numbers, never meshes or grids."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from pipeline.core import code_digest
from pipeline.core.errors import EgvsError, RunError
from pipeline.core.version import __version__
from pipeline.runs import store_settings
from pipeline.scenario.loading import load
from pipeline.scenario.models import Scenario

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Order:
    """What holds for every task of one city run.

    Attributes
    ----------
    token
        No two runs have the same: what a worker keeps between tasks is of one run.
    program
        Of who gave the order, see :func:`program`.
    store
        As ``EGVS_STORE`` would say it there: an absolute path, or a URL.
    store_bytes
        How much the store may hold.
    """

    token: str
    program: str
    store: str
    store_bytes: float

    @contextmanager
    def obeyed(self) -> Iterator[None]:
        """Use its store within the block; RunError where this is another version of the program."""
        if self.program != program():
            found = f"this worker's egvs is not the one that gave the work ({program()}, not {self.program})"
            raise RunError(f"{found}; install the same on every machine")
        with store_settings.using(self.store, self.store_bytes):
            yield


@dataclass(frozen=True)
class Job:
    """One junction: its scenario's folder, what is laid over it, and the folder of its run; absolute paths."""

    junction: str
    folder: Path
    out: Path
    sets: tuple[str, ...] = ()

    def scenario(self) -> Scenario:
        """Its scenario; InputError where that is wrong."""
        return load(self.folder, self.sets)


@dataclass(frozen=True)
class Done:
    """A junction whose run is whole: how many sites it has, what the task took, and which stages were made in it."""

    junction: str
    sites: int
    seconds: float
    made: tuple[str, ...]


@dataclass(frozen=True)
class Failed:
    """A junction whose run cannot be: what :class:`EgvsError` said, and its exit code."""

    junction: str
    message: str
    exit_code: int


def program() -> str:
    """This program as a short text; it is the same where the same bytes would be made."""
    source = code_digest.of("pipeline.runs.workflow", "pipeline.report.page", *_STAGES)
    libraries = sorted(code_digest.versions(source.libraries).items())
    return f"{__version__}, source {source.digest[:12]}, {', '.join(' '.join(pair) for pair in libraries)}"


_STAGES = tuple(f"pipeline.stages.{name}" for name in ("check", "statics", "scan", "traffic", "tpog", "score"))


def told(task: Callable[P, T]) -> Callable[P, T | Failed]:
    """A task whose first argument is a :class:`Job` answers :class:`Failed` where the input is wrong or a run cannot
    keep its promise: that another attempt would end alike."""

    @wraps(task)
    def telling(*args: P.args, **kwargs: P.kwargs) -> T | Failed:
        try:
            return task(*args, **kwargs)
        except EgvsError as error:
            job = args[0]
            assert isinstance(job, Job)
            return Failed(job.junction, str(error), error.exit_code)

    return telling
