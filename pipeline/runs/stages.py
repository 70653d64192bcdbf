"""The stages, and the only place that calls them: what a stage depends on, and what came of it when it was made."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.artefacts import schemas
from pipeline.core import files, source
from pipeline.core.cost import Cost, measured
from pipeline.core.progress import Progress
from pipeline.core.version import __version__
from pipeline.scenario.models import Scenario

STAGES = ("statics", "scan", "traffic", "tpog", "score", "report")
"""In the order of running. The two branches do not know each other; the quick one comes first, so that a site in a wall
is told before traffic is simulated."""

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
    """

    key: str
    files: dict[str, str]


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


def module_name(stage: str) -> str:
    """Where a stage lives."""
    return "pipeline.report.page" if stage == "report" else f"pipeline.stages.{stage}"


def module_of(stage: str) -> ModuleType:
    """A stage's module, imported when it is needed (``--help`` stays quick)."""
    return importlib.import_module(module_name(stage))


def artefacts_of(stage: str) -> tuple[str, ...]:
    """The files that a stage may write."""
    return tuple(module_of(stage).ARTEFACTS)


def inputs(stage: str, scenario: Scenario, out: Path) -> Inputs:
    """Everything that a stage's artefacts depend on; ``out`` holds those of the stages before."""
    read: dict[str, Any] = module_of(stage).inputs(scenario, out)
    about = {"stage": stage, "inputs": read, "program": program(stage, scenario)}
    return Inputs(files.hash_of(about), dict(read["files"]))


def make(stage: str, scenario: Scenario, out: Path, *, jobs: int | None, progress: Progress, **options: Any) -> Made:
    """Run a stage in ``out``, where the artefacts of the stages before lie."""
    module = module_of(stage)
    before = _companions(module, out)
    with measured() as cost:
        summary = module.run(scenario, out, jobs=jobs, progress=progress, **options)
    artefacts = {name: files.sha256_of(out / name) for name in module.ARTEFACTS if (out / name).exists()}
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


def program(stage: str, scenario: Scenario) -> dict[str, Any]:
    """What a stage's artefacts depend on beside its inputs: its source, that of the effects that the scenario names for
    it, its schemas and templates, and the versions of this program and of the libraries."""
    own, effects = source.of(module_name(stage)), _effects(stage, scenario)
    libraries = own.libraries.union(*(effect.libraries for _, effect in effects.values()))
    return {
        "egvs": __version__,
        "source": own.digest,
        "effects": {name: (parameters, effect.digest) for name, (parameters, effect) in effects.items()},
        "files": {path.name: files.sha256_of(path) for path in _data(stage)},
        "libraries": source.versions(libraries),
    }


def _effects(stage: str, scenario: Scenario) -> dict[str, tuple[dict[str, Any], source.Source]]:
    """Named effects that a stage may ask, those that turn out to change nothing too: the stage's summary names them.

    Score casts, and the report marches, what the scan does: both ask its effects as well."""
    if not scenario.effects:
        return {}
    from pipeline.effects import registry

    asked = ("scan", "score") if stage in ("score", "report") else (stage,)
    return {
        effect.NAME: (effect.parameters.model_dump(mode="json"), source.of_object(type(effect)))
        for acts_in in asked
        for effect in registry.of(scenario, acts_in)
    }


def _data(stage: str) -> list[Path]:
    """Files of the program that are no source: the schemas of a stage's artefacts, the templates beside its module."""
    tables = (schemas.folder() / f"{Path(name).stem}.schema.json" for name in artefacts_of(stage))
    templates = Path(str(module_of(stage).__file__)).parent / "templates"
    return [path for path in (*tables, *sorted(templates.rglob("*"))) if path.is_file()]
