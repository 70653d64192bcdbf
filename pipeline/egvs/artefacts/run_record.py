"""The record of a run, ``run.json``: what each stage read, wrote and reported.

It is written again after each stage, so that an interrupted run continues from there.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from egvs.artefacts.checksums import CHECKSUM_KEY, add_checksum, has_valid_checksum
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.core import files, reading
from egvs.core.errors import InputError
from egvs.core.resource_usage import ResourceUsage
from egvs.core.wording import list_first


@dataclass(frozen=True)
class StageRecord:
    """The last run of one stage.

    Attributes
    ----------
    inputs
        Hash of everything that its artefacts depend on.
    files, artefacts
        File name -> sha256 of the files that it read and of those that it wrote.
    summary
        Outcome in numbers, a JSON value.
    cost
        Resources used when the artefacts were made, possibly in another run whose results were cached.
    companions
        Path in the run folder -> sha256 of files written beside the artefacts, for example ``sumo/run.sumocfg``.
    """

    inputs: str
    files: dict[str, str]
    artefacts: dict[str, str]
    summary: dict[str, Any]
    cost: ResourceUsage
    companions: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that ``run.json`` contains."""
        return {**self.__dict__, "cost": self.cost.to_json()}

    @classmethod
    def from_json(cls, value: Any) -> StageRecord | None:
        """Read the JSON object of ``run.json``; None if another version of this program wrote it."""
        match value:
            case {
                "inputs": str(inputs),
                "files": dict(files_read),
                "artefacts": dict(artefacts),
                "summary": dict(summary),
                "cost": {"seconds": int() | float() as seconds, "peak_mb": int() | float() as peak_mb},
            }:
                companions = value.get("companions", {})
            case _:
                return None
        if not all(_is_digest_table(table) for table in (files_read, artefacts, companions)):
            return None
        cost = ResourceUsage(seconds=seconds, peak_mb=peak_mb)
        return cls(inputs, files_read, artefacts, summary, cost, companions)


def _is_digest_table(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(digest, str) for digest in value.values())


def traffic_summary(stages: Mapping[str, StageRecord]) -> Mapping[str, Any]:
    """Return the summary of the stage traffic among ``stages``; empty before it has run."""
    return stages["traffic"].summary if "traffic" in stages else {}


_RECORD_TYPES = {
    "egvs": str, "seed": int, "scenario": dict, "scenario_folder": str, "stages": dict, "overrides": dict,
}  # fmt: skip
_RERUN_HINT = "Remove it and run again."


def have_inputs(stages: Mapping[str, StageRecord], keys: Mapping[str, str]) -> bool:
    """Whether recorded stages have these keys, so that what was computed from those inputs belongs to the run."""
    return all(name in stages and stages[name].inputs == key for name, key in keys.items())


def _missing_record_error(folder: Path) -> InputError:
    """Return the error for a folder without ``run.json``: what it is, and what to do."""
    if not folder.is_dir():
        return InputError(folder, "no such folder", suggest_runs(folder) or "Give a folder written by egvs run.")
    if RunFolder(folder).lock.is_file():
        return InputError(folder, "the run in this folder never finished", "Leave it out, or repeat its egvs run.")
    if (folder / "scenario.toml").is_file():
        return InputError(folder, "this is a scenario; expected a run folder", _suggest_run(folder))
    return InputError(RunFolder(folder).run_record, "no such file", "Give a folder written by egvs run.")


def _suggest_run(scenario_folder: Path) -> str:
    """Return a hint at the default run folder of a scenario, or at the command that makes one."""
    run = Path("runs") / scenario_folder.resolve().name
    if RunFolder(run).has_record:
        return f"Did you mean {run}?"
    return suggest_runs(run) or f"First run egvs run {shlex.quote(str(scenario_folder))}, then give its run folder."


def suggest_runs(folder: Path) -> str:
    """Return a hint at the runs with other settings of a run folder that does not exist; empty without such runs.

    Parameters
    ----------
    folder
        The missing folder, e.g. ``runs/crossing``, where ``runs/crossing@frames=300`` exists.
    """
    if not folder.parent.is_dir():
        return ""
    start = f"{folder.name}@"
    runs = [path for path in folder.parent.iterdir() if path.name.startswith(start) and RunFolder(path).has_record]
    runs.sort(key=lambda path: (-RunFolder(path).run_record.stat().st_mtime, path.name))
    if not runs:
        return ""
    if len(runs) == 1:
        return f"Did you mean {runs[0]}?"
    return f"Runs with other settings are {list_first([str(path) for path in runs], _MAX_RUNS)}; egvs runs lists them."


_MAX_RUNS = 3


@dataclass(frozen=True, repr=False)
class RunRecord:
    """Contents of ``run.json``.

    Attributes
    ----------
    egvs
        Version of this program.
    seed
        Seed of the scenario.
    scenario, scenario_folder
        The resolved scenario, and the folder of its files relative to the run folder.
    stages
        The completed stages, in the order of execution.
    overrides
        The settings in which ``scenario`` differed from the scenario file, by full key. Empty for the scenario as it
        was written, and for a record of an older version.
    """

    egvs: str
    seed: int
    scenario: dict[str, Any]
    scenario_folder: str
    stages: dict[str, StageRecord]
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def traffic_summary(self) -> Mapping[str, Any]:
        """The summary of the stage traffic; empty before it has run."""
        return traffic_summary(self.stages)

    def __repr__(self) -> str:
        return f"RunRecord({self.scenario.get('name', '?')}; stages {', '.join(self.stages)})"

    @classmethod
    def read(cls, folder: Path) -> RunRecord:
        """Read ``run.json`` of a folder.

        Raises
        ------
        InputError
            When there is no such file, or it is damaged or was changed.
        """
        path = RunFolder(folder).run_record
        if not path.is_file():
            raise _missing_record_error(folder)
        value = reading.read_json(path, _RERUN_HINT)
        has_checksum = isinstance(value, dict) and CHECKSUM_KEY in value
        if has_checksum and not has_valid_checksum(value):
            raise InputError(path, f"was changed after the run: {CHECKSUM_KEY} does not match the content", _RERUN_HINT)

        if isinstance(value, dict):
            value = {"overrides": {}, **value}  # which older versions did not record
        for key, expected_type in _RECORD_TYPES.items():
            actual = value.get(key) if isinstance(value, dict) else value
            if not isinstance(actual, expected_type):
                raise InputError(path, f"is not a run record ({key!r} is {actual!r})", _RERUN_HINT)

        stages = {}
        if has_checksum:  # a file without a checksum comes from another version of this program
            for name in STAGE_NAMES:
                stage = StageRecord.from_json(value["stages"].get(name))
                if stage is not None:
                    stages[name] = stage
        values = {name: value[name] for name in _RECORD_TYPES if name != "stages"}
        return cls(**values, stages=stages)

    @property
    def digests(self) -> dict[str, str]:
        """File name -> sha256 of the files that stages wrote, and of those that they read.

        A file that was read counts where the stage that wrote it is no longer recorded, because settings changed.
        """
        digests: dict[str, str] = {}
        for stage in self.stages.values():
            digests |= stage.files
        for stage in self.stages.values():
            digests |= stage.artefacts | stage.companions
        return digests

    def having(self, name: str, stage: StageRecord | None) -> RunRecord:
        """Return the record with another entry for a stage; without the stage if ``stage`` is None."""
        changed = {**self.stages, name: stage}
        stages = {}
        for stage_name in STAGE_NAMES:
            entry = changed.get(stage_name)
            if entry is not None:
                stages[stage_name] = entry
        return replace(self, stages=stages)

    def write(self, folder: Path) -> None:
        """Write ``run.json`` into a folder."""
        value = {**self.__dict__, "stages": {name: stage.to_json() for name, stage in self.stages.items()}}
        files.write_text(RunFolder(folder).run_record, files.to_json_text(add_checksum(value), indent=2) + "\n")
