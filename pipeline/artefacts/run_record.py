"""The record of a run, ``run.json``: written anew after each stage, so that an interrupted run goes on from there."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.core import files
from pipeline.core.cost import Cost
from pipeline.core.errors import InputError
from pipeline.core.reading import documents
from pipeline.core.reading.seals import SEAL, is_sealed, sealed

RECORD = "run.json"
_RIGHT = "remove it and run again"

STAGES = ("check", "statics", "scan", "traffic", "tpog", "score", "report")
"""In the order of running: what can be refused is refused first; the quick branch comes before SUMO runs."""


@dataclass(frozen=True)
class StageRecord:
    """The last run of one stage.

    Attributes
    ----------
    inputs
        Hash of everything that its artefacts depend on.
    files, artefacts
        Name -> sha256 of what it read and of what it wrote.
    summary
        What the stage says of it.
    cost
        Of the run that made it, which may be another one where it came from the store.
    companions
        Name -> sha256 of what it wrote beside its artefacts, by the path in the run's folder: ``sumo/run.sumocfg``.
    """

    inputs: str
    files: dict[str, str]
    artefacts: dict[str, str]
    summary: dict[str, Any]
    cost: Cost
    companions: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As ``run.json`` holds it."""
        return {**self.__dict__, "cost": self.cost.to_json()}

    @classmethod
    def from_json(cls, value: Any) -> StageRecord | None:
        """From ``run.json``; None for what another version of this program wrote: the stage is not known then."""
        match value:
            case {
                "inputs": str(inputs),
                "files": dict(read),
                "artefacts": dict(artefacts),
                "summary": dict(summary),
                "cost": {"seconds": int() | float() as seconds, "peak_mb": int() | float() as peak_mb},
            } if _are_digests(read, artefacts, beside := value.get("companions", {})):
                return cls(inputs, read, artefacts, summary, Cost(seconds=seconds, peak_mb=peak_mb), beside)
        return None


def _are_digests(*tables: Any) -> bool:
    return all(isinstance(table, dict) and all(isinstance(its, str) for its in table.values()) for table in tables)


@dataclass(frozen=True)
class RunRecord:
    """What ``run.json`` holds.

    Attributes
    ----------
    egvs
        This program's version.
    scenario, scenario_folder
        As resolved, and where its files are, seen from the run's folder.
    stages
        Those that are done, in the order of running.
    """

    egvs: str
    seed: int
    scenario: dict[str, Any]
    scenario_folder: str
    stages: dict[str, StageRecord]

    @classmethod
    def read(cls, folder: Path) -> RunRecord:
        """From ``folder / "run.json"``; InputError when it is none."""
        path = folder / RECORD
        if not path.is_file():
            raise InputError(path, "no such file", "a folder that egvs run has written")
        value = documents.read_json(path, _RIGHT)
        if isinstance(value, dict) and SEAL in value and not is_sealed(value):
            raise InputError(path, "was altered after the run: its own_sha256 is of other content", _RIGHT)
        kinds = {"egvs": str, "seed": int, "scenario": dict, "scenario_folder": str, "stages": dict}
        for key, kind in kinds.items():
            found = value.get(key) if isinstance(value, dict) else value
            if not isinstance(found, kind):
                raise InputError(path, f"is not a run's record ({key!r} is {found!r})", _RIGHT)
        stages = value["stages"] if SEAL in value else {}  # without a seal: of another version of this program
        known = {n: stage for n in STAGES if (stage := StageRecord.from_json(stages.get(n))) is not None}
        return cls(value["egvs"], value["seed"], value["scenario"], value["scenario_folder"], known)

    @property
    def digests(self) -> dict[str, str]:
        """Name -> sha256 of what stages wrote; of what they read, where the stage that wrote it is not known any more:
        settings were others then.
        """
        read = [stage.files for stage in self.stages.values()]
        written = [stage.artefacts | stage.companions for stage in self.stages.values()]
        return {name: digest for part in (*read, *written) for name, digest in part.items()}

    def having(self, name: str, stage: StageRecord | None) -> RunRecord:
        """With a stage as it is now; without it for None."""
        stages = {**self.stages, name: stage}
        return replace(self, stages={n: known for n in STAGES if (known := stages.get(n)) is not None})

    def write(self, folder: Path) -> None:
        """Write ``folder / "run.json"``."""
        value = {**self.__dict__, "stages": {name: stage.to_json() for name, stage in self.stages.items()}}
        files.write_text(folder / RECORD, files.json_text(sealed(value), indent=2) + "\n")
