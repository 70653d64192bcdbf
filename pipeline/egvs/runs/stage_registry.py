"""The registered stages, running one of them, and the digests of their artefacts."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core import files
from egvs.core.digests import use_digests
from egvs.core.errors import InputError, with_relative_paths
from egvs.core.resource_usage import ResourceUsage, measure_usage
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary

STAGE_MODULES = {
    "check": "egvs.stages.check",
    "statics": "egvs.stages.statics",
    "scan": "egvs.stages.scan",
    "traffic": "egvs.stages.traffic",
    "tpog": "egvs.stages.tpog",
    "score": "egvs.stages.score",
    "report": "egvs.report.page",
}
"""Stage -> module with its declaration, ``STAGE``. Names, because runs do not know who presents them."""

AHEAD_STAGES = frozenset({"tpog"})
"""The stages that work ahead, by name: to load the others now would delay SUMO."""

RANKING_STAGES = STAGE_NAMES[1:-1]
"""The stages that a ranking needs: all but the check and the report."""


@dataclass(frozen=True)
class StageResult:
    """Result of a stage.

    Attributes
    ----------
    artefacts
        Name -> sha256 of each file that the stage wrote.
    companions
        Path in the run folder -> sha256 of further files, such as those that open in sumo-gui.
    summary
        Outcome in numbers, a JSON value.
    cost
        Resources that the stage used.
    """

    artefacts: dict[str, str]
    companions: dict[str, str]
    summary: Summary
    cost: ResourceUsage

    @property
    def files(self) -> dict[str, str]:
        """Name -> sha256 of artefacts and companions."""
        return self.artefacts | self.companions


def stage(name: str) -> Stage:
    """Return a stage; its module is imported only now, so that ``--help`` stays quick."""
    if name not in STAGE_MODULES:
        raise ValueError(f"expected a stage ({', '.join(STAGE_NAMES)}), got {name!r}")
    described: Stage = import_module(STAGE_MODULES[name]).STAGE
    return described


def written_by(name: str) -> tuple[str, ...]:
    """Return the files that a stage can write, and the folders that it writes beside them."""
    return tuple(file.name for file in RunFolder.written_by(name))


def recorded_digests(record: RunRecord) -> dict[str, str]:
    """Return the sha256 of every artefact and companion file as a run recorded it, "" for an unknown artefact."""
    digests: dict[str, str] = {}
    for stage_record in record.stages.values():
        digests |= stage_record.companions
    known = record.digests
    for name in STAGE_NAMES:
        for artefact in stage(name).artefacts:
            digests[artefact] = known.get(artefact, "")
    return digests


def run_stage(name: str, context: StageContext, dependencies: StageDependencies, **options: Any) -> StageResult:
    """Run a stage in a folder that contains the artefacts of the stages before it.

    Raises
    ------
    InputError
        When the input is wrong, or a file that the stage depends on was changed or replaced while it ran.
    """
    running, folder, digests = stage(name), context.folder.path, context.inputs.digests
    stamps_before = _sidecar_stat(running, folder)
    context.forget(*written_by(name))
    with measure_usage() as cost, use_digests(digests), files.hash_written_files(folder) as written:
        with parquet.share_open_files():
            summary = with_relative_paths(context.scenario.folder, running.run(context, dependencies, **options))
        digests.check_unchanged(dependencies.paths)

    artefacts = {name: written[name] for name in running.artefacts if name in written and context.path(name).exists()}
    context.expect(artefacts)
    companions = {}
    for companion, stamp in sorted(_sidecar_stat(running, folder).items()):
        if stamps_before.get(companion) == stamp:
            continue
        companions[companion] = files.hash_file(context.path(companion))
        if companions[companion] != written.get(companion, companions[companion]):
            raise InputError(context.path(companion), "was changed while it was in use", "Repeat the command.")
    return StageResult(artefacts, companions, summary, cost)


def _sidecar_stat(stage: Stage, folder: Path) -> dict[str, tuple[int, int, int]]:
    """Files beside the artefacts of a stage, each with numbers that change when the file is written."""
    stamps = {}
    for name in stage.companions:
        for path in (folder / name).rglob("*"):
            if path.is_file() and not path.is_symlink():
                status = path.stat()
                stamps[path.relative_to(folder).as_posix()] = (status.st_mtime_ns, status.st_ino, status.st_size)
    return stamps
