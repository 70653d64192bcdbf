"""What a stage is: its declaration, its context, and what its artefacts depend on.

A stage is one verb of the command line. Its module declares a :class:`Stage`: the files that it reads, a function that
says what its artefacts depend on, and a function that makes them. Two runs with equal dependencies write equal bytes,
so a stage whose dependencies did not change is skipped. No stage imports another stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Concatenate, Protocol

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFile, RunFolder
from egvs.core import files
from egvs.core.progress import ProgressCallback, no_progress
from egvs.scenario.model import Scenario

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa

    from egvs.sensors.scene import Scene
    from egvs.stages.inputs import Inputs
    from egvs.world.mesh import World

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
    paths
        The files by real path, to check after the stage that they did not change while it ran.
    """

    settings: Json
    files: Mapping[str, str]
    more: Json = field(default_factory=dict)
    modules: tuple[str, ...] = ()
    paths: Mapping[str, Path] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON value that is hashed."""
        return {"settings": self.settings, "files": self.files, **self.more}


class WorkAhead(Protocol):
    """Work on trajectories that are still being made."""

    def add(self, rows: pa.Table) -> None:
        """Take the next row group."""


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
    ahead
        Begins to work on the trajectories while they are made, during a block; what it yields gets each row group and
        is the option ``ahead`` of ``run`` then. It yields None where there is nothing to do ahead.
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
    ahead: Callable[[StageContext], AbstractContextManager[WorkAhead | None]] | None = None

    @property
    def artefacts(self) -> tuple[str, ...]:
        """Names of the files that the stage can write."""
        return tuple(file.name for file in RunFolder.written_by(self.name) if not file.is_folder)

    @property
    def companions(self) -> tuple[str, ...]:
        """Names of the folders that the stage writes beside its artefacts."""
        return tuple(file.name for file in RunFolder.written_by(self.name) if file.is_folder)


@dataclass(frozen=True, eq=False)
class StageContext:
    """A run folder while stages work in it; see :func:`egvs.runs.run_context.open_folder`.

    Attributes
    ----------
    scenario
        The scenario.
    inputs
        What the scenario names, resolved once.
    folder
        Where artefacts are read and written.
    threads
        Number of threads. Results do not depend on it.
    progress
        Called as the work proceeds.
    follow
        Called with each row group of the trajectories that is written, as long as they are made.
    """

    scenario: Scenario
    inputs: Inputs
    folder: RunFolder
    threads: int
    progress: ProgressCallback = no_progress
    follow: parquet.Follow | None = None

    def with_scenario(self, scenario: Scenario) -> StageContext:
        """Return the context of a scenario with other [score], [placement] or [scan]; both share the scene.

        Raises
        ------
        ValueError
            When the scenarios differ in more.
        """
        free = {name: getattr(scenario, name) for name in ("score", "placement", "scan")}
        if self.scenario.model_copy(update=free) != scenario:
            raise ValueError("expected a scenario that differs in score, placement and scan only")
        return replace(self, scenario=scenario)

    def with_folder(self, folder: RunFolder, progress: ProgressCallback) -> StageContext:
        """Return the context of the same scenario in another folder."""
        return replace(self, folder=folder, progress=progress)

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
        """Return the sha256 of an artefact; InputError as of :meth:`egvs.core.digests.Digests.of`."""
        return self.inputs.digests.of(self.path(artefact))

    def digests(self, *artefacts: str) -> dict[str, str]:
        """Return the sha256 of some artefacts, by name."""
        return {name: self.digest(name) for name in artefacts}

    def expect(self, digests: Mapping[str, str]) -> None:
        """Note the sha256 of artefacts that were just written or restored, by name."""
        self.inputs.digests.expect({self.path(name): digest for name, digest in digests.items()})

    def forget(self, *names: str) -> None:
        """Forget the digests of artefacts, or of all files in a folder, that are about to be written."""
        self.inputs.digests.forget(*map(self.path, names))

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
