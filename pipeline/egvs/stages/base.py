"""What a stage is: its declaration, its context, and what its artefacts depend on.

A stage is one verb of the command line. Its module declares a :class:`Stage`: the files that it reads, a function that
says what its artefacts depend on, and a function that makes them. Two runs with equal dependencies write equal bytes,
so a stage whose dependencies did not change is skipped. No stage imports another stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Concatenate, TypeVar

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFile, RunFolder
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import thread_count
from egvs.scenario.model import Scenario

if TYPE_CHECKING:
    from pathlib import Path

    from egvs.sensors.scene import Scene
    from egvs.stages.inputs import Inputs
    from egvs.world.mesh import World

T = TypeVar("T")
Json = Mapping[str, Any]
Summary = dict[str, Any]
"""Outcome of a stage, for ``run.json`` and the terminal."""


@dataclass(frozen=True)
class StageDependencies:
    """Everything that the artefacts of a stage depend on, apart from the program.

    Attributes
    ----------
    settings
        Settings by value.
    files
        Files by sha256.
    more
        Further dependencies, for example the version of SUMO.
    modules
        Modules that are loaded by name and whose source counts: active effects, readers of measured scans.
    """

    settings: Json
    files: Mapping[str, str]
    more: Json = field(default_factory=dict)
    modules: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the JSON value that is hashed."""
        return {"settings": self.settings, "files": self.files, **self.more}


@dataclass(frozen=True)
class Stage:
    """Declaration of a stage.

    Attributes
    ----------
    name
        Verb of the command line.
    module
        Name of the module that declares the stage; its source is part of the key of the artefacts.
    dependencies
        Returns what the artefacts depend on, in a given context.
    run
        Reads files and writes the artefacts; some stages take further options.
    reads
        Artefacts that the stage may read.
    effect_stages
        Stages whose effects act here or are named in the summary; the stage itself if empty.
    code
        Further modules that determine the artefacts although the stage does not import them: they make the
        :class:`egvs.stages.inputs.Inputs` that it is given.
    neutral_options
        Keyword arguments of ``run`` that change no artefact, for example where the work is done.
    reads_traffic
        Whether the stage reads files of recorded traffic that the scenario names.
    is_view
        Whether the stage presents a run to people: no result depends on it, and it is made again when one changes.
    prepare
        Functions that load what ``run`` calls, for example by calling kernels with made-up arguments, which compiles
        them in the first run; the function that takes longest comes first.
    """

    name: str
    module: str
    dependencies: Callable[[StageContext], StageDependencies]
    run: Callable[Concatenate[StageContext, StageDependencies, ...], Summary]
    reads: tuple[RunFile, ...] = ()
    effect_stages: tuple[str, ...] = ()
    code: tuple[str, ...] = ()
    neutral_options: tuple[str, ...] = ()
    reads_traffic: bool = False
    is_view: bool = False
    prepare: tuple[Callable[[], None], ...] = ()

    @property
    def artefacts(self) -> tuple[str, ...]:
        """Names of the files that the stage can write."""
        return tuple(file.name for file in RunFolder.written_by(self.name) if not file.is_folder)

    @property
    def companions(self) -> tuple[str, ...]:
        """Names of the folders that the stage writes beside its artefacts."""
        return tuple(file.name for file in RunFolder.written_by(self.name) if file.is_folder)


class StageContext:
    """A run folder while stages work in it.

    Parameters
    ----------
    inputs
        The scenario and what it names, resolved once.
    folder
        Where artefacts are read and written.
    jobs
        Number of threads; one per core when None. Results do not depend on it.
    recorded
        Digests in ``run.json`` by artefact, "" for an artefact that no stage recorded. An artefact with another digest
        is refused. None where nothing is recorded, as in a notebook.
    """

    def __init__(
        self,
        inputs: Inputs,
        folder: RunFolder,
        *,
        jobs: int | None = None,
        progress: ProgressCallback = no_progress,
        recorded: Mapping[str, str] | None = None,
    ) -> None:
        self.inputs = inputs
        self.scenario: Scenario = inputs.scenario
        self.folder = folder
        self.progress = progress
        self.threads = thread_count(jobs)
        self._recorded = dict(recorded or {})
        self._digests: dict[str, str] = {}
        self._remembered: dict[str, tuple[tuple[str, ...], Any]] = {}

    @property
    def world(self) -> World:
        """The static world, after the statics stage; InputError when ``statics.ply`` is missing or was changed."""
        self.digest(RunFolder.statics.name)
        return self.inputs.world

    @property
    def scene(self) -> Scene:
        """The sites, sensors and effects in the static world; InputError as for :attr:`world`."""
        self.digest(RunFolder.statics.name)
        return self.inputs.scene

    def path(self, artefact: str) -> Path:
        """Return the path of an artefact."""
        return self.folder.path / artefact

    def digest(self, artefact: str) -> str:
        """Return the sha256 of an artefact, which is computed once until :meth:`forget`.

        Raises
        ------
        InputError
            When the artefact is missing, or differs from the one in ``run.json``.
        """
        if artefact in self._digests:
            return self._digests[artefact]

        digest = files.hash_file(self.path(artefact))
        recorded = self._recorded.get(artefact, digest)
        hint = 'Repeat "egvs run" to create it.'
        if recorded == "":
            raise InputError(self.path(artefact), "was not created by any stage recorded in run.json", hint)
        if recorded != digest:
            problem = f"was altered or replaced (sha256 {digest[:12]}, in run.json {recorded[:12]})"
            raise InputError(self.path(artefact), problem, hint)
        self._digests[artefact] = digest
        return digest

    def digests(self, *artefacts: str) -> dict[str, str]:
        """Return the sha256 of some artefacts, by name."""
        return {name: self.digest(name) for name in artefacts}

    def forget(self, *names: str) -> None:
        """Forget the digests of artefacts, or of all files in a folder, that are about to be written."""
        for digests in (self._digests, self._recorded):
            for artefact in list(digests):
                folder = artefact.partition("/")[0]
                if artefact in names or folder in names:
                    del digests[artefact]

    def remember(self, what: str, artefacts: tuple[str, ...], make: Callable[[], T]) -> T:
        """Return the value of ``make``, which is called again only after one of the artefacts has changed."""
        digests = tuple(self.digest(name) for name in artefacts)
        if what not in self._remembered or self._remembered[what][0] != digests:
            self._remembered[what] = digests, make()
        value: T = self._remembered[what][1]
        return value

    def metadata(self, dependencies: StageDependencies, *, seeded: bool = True, **more: Any) -> dict[str, Any]:
        """Return the metadata that every artefact contains.

        ``scenario.hash`` covers the settings that the artefact depends on, ``inputs`` the files as well: a setting that
        the stage does not read changes no byte. Artefacts without random numbers are not ``seeded``.
        """
        return {
            "schema": parquet.SCHEMA_VERSION,
            "scenario": {"name": self.scenario.name, "hash": files.hash_json(dependencies.settings)},
            "inputs": files.hash_json(dependencies.to_json()),
            "seed": self.scenario.seed if seeded else None,
            **more,
        }
