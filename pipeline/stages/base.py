"""What every stage promises, and the folder that stages work in.

A stage is a module = a verb of the command line = an artefact. It has

- ``NAME`` and ``ARTEFACTS``: the verb, and the files that it may write into the run's folder; ``COMPANIONS`` where it
  leaves more beside them;
- ``inputs(work)``: everything that the stage reads (settings by value, files by sha256). Two runs with equal inputs
  write equal bytes, so a stage whose inputs did not change is skipped;
- ``run(work, inputs, ...)``: reads files, writes files, returns a small JSON value that says what came out.

A stage imports no other stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pipeline.artefacts import schemas
from pipeline.core import files, parallel
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.scenario.models import Scenario

T = TypeVar("T")
Json = Mapping[str, Any]
Summary = dict[str, Any]
"""What came out of a stage, for ``run.json`` and the terminal."""


@dataclass(frozen=True)
class StageInputs:
    """Everything that a stage's artefacts depend on.

    Attributes
    ----------
    settings
        Settings by value.
    files
        Files by sha256.
    more
        What else counts, e.g. SUMO's version.
    modules
        Modules whose source counts too, being loaded by name: those of effects that act, of readers of measured scans.
    """

    settings: Json
    files: Mapping[str, str]
    more: Json = field(default_factory=dict)
    modules: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As it is hashed."""
        return {"settings": self.settings, "files": self.files, **self.more}


class Stage(Protocol):
    """A stage's module."""

    NAME: str
    ARTEFACTS: tuple[str, ...]

    def inputs(self, work: Workspace) -> StageInputs:
        """Everything that the stage reads."""
        raise NotImplementedError

    def run(self, work: Workspace, inputs: StageInputs, **options: Any) -> Summary:
        """Read files, write files."""
        raise NotImplementedError


class Workspace:
    """A run's folder while stages work there: what is read, resolved or hashed once is kept for the next stage.

    Parameters
    ----------
    scenario, folder
        What is run, and where its artefacts are.
    jobs
        Threads; one a core when None. Results do not depend on it.
    recorded
        The sha256 of artefacts as ``run.json`` has it, "" where it has none: an artefact with other bytes is refused.
        None where nothing is recorded, as in a notebook.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        *,
        jobs: int | None = None,
        progress: Progress = silent,
        recorded: Mapping[str, str] | None = None,
    ) -> None:
        self.scenario, self.folder, self.progress = scenario, folder, progress
        self._recorded = dict(recorded or {})
        self.threads = parallel.threads(jobs)
        self._digests: dict[str, str] = {}
        self._remembered: dict[str, tuple[tuple[str, ...], Any]] = {}

    def path(self, artefact: str) -> Path:
        """Where an artefact is."""
        return self.folder / artefact

    def digest(self, artefact: str) -> str:
        """The sha256 of an artefact, hashed once until :meth:`forget`.

        InputError when it is not there, or is not the one that ``run.json`` names.
        """
        if artefact not in self._digests:
            digest, right = files.sha256_of(self.path(artefact)), "egvs run makes it again"
            match self._recorded.get(artefact, digest):
                case "":
                    raise InputError(self.path(artefact), "no stage that run.json knows of made it here", right)
                case known if known != digest:
                    found = f"was altered or replaced (sha256 {digest[:12]}, in run.json {known[:12]})"
                    raise InputError(self.path(artefact), found, right)
            self._digests[artefact] = digest
        return self._digests[artefact]

    def digests(self, *artefacts: str) -> dict[str, str]:
        """The sha256 of some artefacts, by name."""
        return {name: self.digest(name) for name in artefacts}

    def forget(self, *names: str) -> None:
        """Some artefacts, or folders with what lies in them, are about to be written anew."""
        for known in (self._digests, self._recorded):
            for name in [its for its in known if its in names or its.partition("/")[0] in names]:
                del known[name]

    def remember(self, what: str, artefacts: tuple[str, ...], make: Callable[[], T]) -> T:
        """What ``make`` gives, made once for as long as the artefacts that it is made from stay what they are."""
        made_from = tuple(self.digest(name) for name in artefacts)
        if what not in self._remembered or self._remembered[what][0] != made_from:
            self._remembered[what] = made_from, make()
        value: T = self._remembered[what][1]
        return value

    def metadata(self, inputs: StageInputs, *, seeded: bool = True, **more: Any) -> dict[str, Any]:
        """The metadata that every artefact carries.

        ``scenario.hash`` covers the settings that this artefact depends on, ``inputs`` also the files: a setting that
        the stage does not read changes no byte. So those in which nothing is random are not ``seeded``.
        """
        return {
            "schema": schemas.VERSION,
            "scenario": {"name": self.scenario.name, "hash": files.hash_of(inputs.settings)},
            "inputs": files.hash_of(inputs.to_json()),
            "seed": self.scenario.seed if seeded else None,
            **more,
        }
