"""The stages, and the only place that calls them: what a stage depends on, and what came of it when it was made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.artefacts import schemas
from pipeline.artefacts.run_record import STAGES
from pipeline.core import files, source
from pipeline.core.cost import Cost, measured
from pipeline.effects import registry
from pipeline.scenario.models import Scenario
from pipeline.stages.base import StageInputs, Workspace

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
    files
        The files among it: name -> sha256.
    read
        As the stage named it.
    """

    key: str
    files: dict[str, str]
    read: StageInputs


@dataclass(frozen=True)
class Made:
    """What came of a stage.

    Attributes
    ----------
    artefacts
        Name -> sha256 of each file that it wrote.
    companions
        Further files that belong to them, as paths in the run's folder: those that open in sumo-gui.
    summary
        What the stage says of it, a JSON value.
    """

    artefacts: dict[str, str]
    companions: tuple[str, ...]
    summary: dict[str, Any]
    cost: Cost


def module_of(stage: str) -> ModuleType:
    """A stage's module, imported when it is needed (``--help`` stays quick)."""
    match stage:
        case "statics":
            from pipeline.stages import statics

            return statics
        case "scan":
            from pipeline.stages import scan

            return scan
        case "traffic":
            from pipeline.stages import traffic

            return traffic
        case "tpog":
            from pipeline.stages import tpog

            return tpog
        case "score":
            from pipeline.stages import score

            return score
        case "report":
            from pipeline.report import page

            return page
    raise ValueError(f"no stage {stage!r}; one of {', '.join(STAGES)}")


def artefacts_of(stage: str) -> tuple[str, ...]:
    """The files that a stage may write."""
    return tuple(module_of(stage).ARTEFACTS)


def inputs(stage: str, work: Workspace) -> Inputs:
    """Everything that a stage's artefacts depend on; ``work`` holds those of the stages before."""
    read: StageInputs = module_of(stage).inputs(work)
    about = {"stage": stage, "inputs": read.to_json(), "program": program(stage, work.scenario, read.code)}
    return Inputs(files.hash_of(about), dict(read.files), read)


def make(stage: str, work: Workspace, inputs: Inputs, **options: Any) -> Made:
    """Run a stage in a workspace, where the artefacts of the stages before lie."""
    module, out = module_of(stage), work.folder
    before = _companions(module, out)
    work.forget(*module.ARTEFACTS)
    with measured() as cost:
        summary = module.run(work, inputs.read, **options)
    artefacts = work.digests(*(name for name in module.ARTEFACTS if (out / name).exists()))
    written = (name for name, stamp in _companions(module, out).items() if before.get(name) != stamp)
    return Made(artefacts, tuple(sorted(written)), summary, cost)


def _companions(module: ModuleType, out: Path) -> dict[str, tuple[int, int, int]]:
    """What lies in the folders that a stage writes beside its artefacts, with a stamp that writing changes."""
    found = {}
    for name in getattr(module, "COMPANIONS", ()):
        for path in (out / name).rglob("*"):
            if path.is_file() and not path.is_symlink():
                about = path.stat()
                stamp = (about.st_mtime_ns, about.st_ino, about.st_size)
                found[path.relative_to(out).as_posix()] = stamp
    return found


def program(stage: str, scenario: Scenario, acting: tuple[type, ...] = ()) -> dict[str, Any]:
    """What a stage's artefacts depend on beside its inputs: its source, that of the effects that act in it (and, since
    its summary names them, of those that turn out to change nothing), its schemas and templates, and the libraries."""
    named = registry.named(scenario, *_ASKS.get(stage, (stage,)))
    effects = sorted({*acting, *(type(effect) for effect in named)}, key=lambda effect: effect.__module__)
    own, theirs = source.of(module_of(stage).__name__), [source.of_object(effect) for effect in effects]
    libraries = own.libraries.union(*(effect.libraries for effect in theirs))
    return {
        "source": own.digest,
        "effects": [effect.digest for effect in theirs],
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
