"""Calls the stages, which nothing else does, and says what came of one when it was made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.artefacts.run_record import STAGES, RunRecord
from pipeline.core import files
from pipeline.core.cost import Cost, measured
from pipeline.core.findings import seen_from
from pipeline.stages.base import StageInputs, Summary, Workspace

RANKING = STAGES[1:-1]
"""What a ranking takes; the check and the report are left out."""


@dataclass(frozen=True)
class Made:
    """What came of a stage.

    Attributes
    ----------
    artefacts
        Name -> sha256 of each file that it wrote.
    companions
        The same of further files that belong to them, by their path in the run's folder: those that open in sumo-gui.
    summary
        What the stage says of it, a JSON value.
    """

    artefacts: dict[str, str]
    companions: dict[str, str]
    summary: Summary
    cost: Cost

    @property
    def files(self) -> dict[str, str]:
        """Name -> sha256 of all of them."""
        return self.artefacts | self.companions


def module_of(stage: str) -> ModuleType:
    """A stage's module, imported when it is needed (``--help`` stays quick)."""
    module: ModuleType
    match stage:
        case "check":
            from pipeline.stages import check as module
        case "statics":
            from pipeline.stages import statics as module
        case "scan":
            from pipeline.stages import scan as module
        case "traffic":
            from pipeline.stages import traffic as module
        case "tpog":
            from pipeline.stages import tpog as module
        case "score":
            from pipeline.stages import score as module
        case "report":
            from pipeline.report import page as module
        case _:
            raise ValueError(f"no stage {stage!r}; one of {', '.join(STAGES)}")
    return module


def artefacts_of(stage: str) -> tuple[str, ...]:
    """The files that a stage may write."""
    return tuple(module_of(stage).ARTEFACTS)


def written_by(stage: str) -> tuple[str, ...]:
    """The files that a stage may write, and the folders that it writes beside them."""
    return (*artefacts_of(stage), *getattr(module_of(stage), "COMPANIONS", ()))


def recorded(record: RunRecord) -> dict[str, str]:
    """The sha256 of every artefact as a run's record has it, "" where nothing is known of it; and of what the record
    has beside them."""
    known = record.digests
    beside = {name: digest for stage in record.stages.values() for name, digest in stage.companions.items()}
    return beside | {name: known.get(name, "") for stage in STAGES for name in artefacts_of(stage)}


def make(stage: str, work: Workspace, inputs: StageInputs, **options: Any) -> Made:
    """Run a stage in a workspace, where the artefacts of the stages before lie."""
    module, out = module_of(stage), work.folder
    before = _companions(module, out)
    work.forget(*written_by(stage))
    with measured() as cost:
        summary = seen_from(work.scenario.folder, module.run(work, inputs, **options))
    artefacts = work.digests(*(name for name in module.ARTEFACTS if (out / name).exists()))
    written = sorted(name for name, stamp in _companions(module, out).items() if before.get(name) != stamp)
    return Made(artefacts, {name: files.sha256_of(out / name) for name in written}, summary, cost)


def _companions(module: ModuleType, out: Path) -> dict[str, tuple[int, int, int]]:
    """What lies in the folders that a stage writes beside its artefacts, with a stamp that writing changes."""
    folders = [out / name for name in getattr(module, "COMPANIONS", ())]
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    stats = {path.relative_to(out).as_posix(): path.stat() for path in paths}
    return {name: (stat.st_mtime_ns, stat.st_ino, stat.st_size) for name, stat in stats.items()}
