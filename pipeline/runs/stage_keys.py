"""The key of a stage: a hash of everything that its artefacts depend on. A stage runs again when its key is another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artefacts import schemas
from pipeline.artefacts.run_record import StageRecord
from pipeline.core import code_digest, files
from pipeline.effects import registry
from pipeline.runs.stages import Made, artefacts_of, module_of
from pipeline.scenario.models import Scenario
from pipeline.stages.base import StageInputs, Workspace


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

    def record(self, made: Made) -> StageRecord:
        """What ``run.json`` holds of the stage once it is made."""
        return StageRecord(self.key, dict(self.read.files), made.artefacts, made.summary, made.cost, made.companions)


def inputs(stage: str, work: Workspace) -> Inputs:
    """Everything that a stage's artefacts depend on; ``work`` holds those of the stages before."""
    read: StageInputs = module_of(stage).inputs(work)
    about = {"stage": stage, "inputs": read.to_json(), "program": program(stage, work.scenario, read.modules)}
    return Inputs(files.hash_of(about), read)


def program(stage: str, scenario: Scenario, loaded: tuple[str, ...] = ()) -> dict[str, Any]:
    """What a stage's artefacts depend on beside its inputs.

    Its source, that of the modules that it loads by name (effects that act in it and, since its summary names them,
    those that turn out to change nothing; readers of files), its schemas and templates, and the libraries.
    """
    named = registry.named(scenario, *_ASKS.get(stage, (stage,)))
    modules = sorted({*loaded, *registry.modules(named)})
    own, theirs = code_digest.of(module_of(stage).__name__), [code_digest.of(module) for module in modules]
    libraries = own.libraries.union(*(part.libraries for part in theirs))
    return {
        "source": own.digest,
        "loaded": [part.digest for part in theirs],
        "named": registry.settings(named),
        "files": {path.name: files.sha256_of(path) for path in _data(stage)},
        "libraries": code_digest.versions(libraries),
    }


_ASKS = {"check": ("traffic", "scan", "score"), "score": ("scan", "score"), "report": ("scan", "score")}
"""Score casts, and the report marches, what the scan does: both ask its effects as well. The check asks all."""


def _data(stage: str) -> list[Path]:
    """Files of the program that are no source: the schemas of a stage's artefacts, the templates beside its module."""
    tables = (schemas.folder() / f"{Path(name).stem}.schema.json" for name in artefacts_of(stage))
    templates = Path(str(module_of(stage).__file__)).parent / "templates"
    return [path for path in (*tables, *sorted(templates.rglob("*"))) if path.is_file()]
