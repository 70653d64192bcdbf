"""Calls the stages, which nothing else does: what a stage depends on, and what came of it when it was made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.artefacts import schemas
from pipeline.artefacts.run_record import STAGES, StageRecord
from pipeline.core import files, source
from pipeline.core.cost import Cost, measured
from pipeline.effects import registry
from pipeline.scenario.models import Scenario
from pipeline.stages.base import StageInputs, Summary, Workspace

RANKING = STAGES[:-1]
"""What a ranking takes; the report is left out."""


@dataclass(frozen=True)
class Inputs:
    """What a stage's artefacts depend on.

    Attributes
    ----------
    key
        Hash of all of it: settings by value, files by hash, the program by the digest of its source, libraries by
        version.
    read
        What the stage reads, as it named it.
    """

    key: str
    read: StageInputs


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

    def record(self, inputs: Inputs) -> StageRecord:
        """What ``run.json`` holds of it."""
        return StageRecord(inputs.key, dict(inputs.read.files), self.artefacts, self.summary, self.cost)


def module_of(stage: str) -> ModuleType:
    """A stage's module, imported when it is needed (``--help`` stays quick)."""
    module: ModuleType
    match stage:
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


def inputs(stage: str, work: Workspace) -> Inputs:
    """Everything that a stage's artefacts depend on; ``work`` holds those of the stages before."""
    read: StageInputs = module_of(stage).inputs(work)
    about = {"stage": stage, "inputs": read.to_json(), "program": program(stage, work.scenario, read.modules)}
    return Inputs(files.hash_of(about), read)


def make(stage: str, work: Workspace, inputs: Inputs, **options: Any) -> Made:
    """Run a stage in a workspace, where the artefacts of the stages before lie."""
    module, out = module_of(stage), work.folder
    before = _companions(module, out)
    work.forget(*module.ARTEFACTS)
    with measured() as cost:
        summary = module.run(work, inputs.read, **options)
    artefacts = work.digests(*(name for name in module.ARTEFACTS if (out / name).exists()))
    written = sorted(name for name, stamp in _companions(module, out).items() if before.get(name) != stamp)
    return Made(artefacts, {name: files.sha256_of(out / name) for name in written}, summary, cost)


def _companions(module: ModuleType, out: Path) -> dict[str, tuple[int, int, int]]:
    """What lies in the folders that a stage writes beside its artefacts, with a stamp that writing changes."""
    folders = [out / name for name in getattr(module, "COMPANIONS", ())]
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    stats = {path.relative_to(out).as_posix(): path.stat() for path in paths}
    return {name: (stat.st_mtime_ns, stat.st_ino, stat.st_size) for name, stat in stats.items()}


def program(stage: str, scenario: Scenario, loaded: tuple[str, ...] = ()) -> dict[str, Any]:
    """What a stage's artefacts depend on beside its inputs.

    Its source, that of the modules that it loads by name (effects that act in it and, since its summary names them,
    those that turn out to change nothing; readers of files), its schemas and templates, and the libraries.
    """
    named = registry.named(scenario, *_ASKS.get(stage, (stage,)))
    modules = sorted({*loaded, *registry.modules(named)})
    own, theirs = source.of(module_of(stage).__name__), [source.of(module) for module in modules]
    libraries = own.libraries.union(*(part.libraries for part in theirs))
    return {
        "source": own.digest,
        "loaded": [part.digest for part in theirs],
        "named": registry.settings(named),
        "files": {path.name: files.sha256_of(path) for path in _data(stage)},
        "libraries": source.versions(libraries),
    }


_ASKS = {"score": ("scan", "score"), "report": ("scan", "score")}
"""Score casts, and the report marches, what the scan does: both ask its effects as well."""


def _data(stage: str) -> list[Path]:
    """Files of the program that are no source: the schemas of a stage's artefacts, the templates beside its module."""
    tables = (schemas.folder() / f"{Path(name).stem}.schema.json" for name in artefacts_of(stage))
    templates = Path(str(module_of(stage).__file__)).parent / "templates"
    return [path for path in (*tables, *sorted(templates.rglob("*"))) if path.is_file()]
