"""The folder of a run: the name of each file in it, its record ``run.json``, and the checksums of studies.

:class:`RunFolder` is the only place where file names are written. ``run.json`` (:class:`RunRecord`) is written again
after each stage, so that an interrupted run continues from there. Studies (accuracy, validation, placement) can be made
where there is no run; they leave lists of checksums instead, in the format of ``sha256sum --check``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

from egvs.core import files, reading
from egvs.core.errors import InputError
from egvs.core.files import CHECKSUM_KEY, add_checksum, has_valid_checksum
from egvs.core.runtime import ResourceUsage

STAGE_NAMES = ("check", "statics", "scan", "traffic", "tpog", "score", "report")
"""In the order of execution: checks come first, and the fast stages come before SUMO runs."""


@dataclass(frozen=True)
class RunFile:
    """A file, or a folder, that a run folder can contain.

    Read from a :class:`RunFolder` instance, it is the path of the file there.

    Attributes
    ----------
    name
        File name.
    writer
        Name of the stage or command that writes it.
    is_folder
        Whether it is a folder with files that belong to an artefact.
    """

    name: str
    writer: str
    is_folder: bool = False

    @overload
    def __get__(self, folder: None, owner: type[RunFolder]) -> RunFile: ...
    @overload
    def __get__(self, folder: RunFolder, owner: type[RunFolder]) -> Path: ...
    def __get__(self, folder: RunFolder | None, owner: type[RunFolder]) -> RunFile | Path:
        return self if folder is None else folder.path / self.name


@dataclass(frozen=True)
class RunFolder:
    """A folder that holds the artefacts of a run and of the studies made of it.

    ``folder.scores`` is the path of ``scores.parquet`` in the folder, ``RunFolder.scores.name`` the file name.

    Attributes
    ----------
    path
        Path of the folder.
    """

    path: Path

    run_record = RunFile("run.json", "run")
    lock = RunFile(".lock", "run")

    statics = RunFile("statics.ply", "statics")
    scans = RunFile("scans.parquet", "scan")
    trajectories = RunFile("trajectories.parquet", "traffic")
    sumo = RunFile("sumo", "traffic", is_folder=True)
    tpog = RunFile("tpog.parquet", "tpog")
    scores = RunFile("scores.parquet", "score")
    visibility = RunFile("visibility.parquet", "score")
    scores_by_period = RunFile("scores_by_period.parquet", "score")
    blindspots = RunFile("blindspots.parquet", "score")
    report = RunFile("report.html", "report")

    accuracy = RunFile("accuracy.parquet", "accuracy")
    accuracy_figure = RunFile("accuracy.png", "accuracy")
    accuracy_checksums = RunFile("accuracy.sha256", "accuracy")
    detection = RunFile("detection.parquet", "validate")
    correlation = RunFile("correlation.parquet", "validate")
    validation_figure = RunFile("validation.png", "validate")
    surrogates = RunFile("surrogates.parquet", "validate")
    fused = RunFile("fused.parquet", "validate")
    validation_checksums = RunFile("validation.sha256", "validate")
    placement = RunFile("placement.parquet", "place")
    curve = RunFile("curve.parquet", "place")
    placement_checksums = RunFile("placement.sha256", "place")

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def all_files(cls) -> tuple[RunFile, ...]:
        """Every file that a run or a study can write, in the order of the declarations above."""
        return tuple(value for value in vars(cls).values() if isinstance(value, RunFile))

    @classmethod
    def written_by(cls, writer: str) -> tuple[RunFile, ...]:
        """Return the files, and the folders, that a stage or a command can write."""
        return tuple(file for file in cls.all_files() if file.writer == writer)

    @property
    def has_record(self) -> bool:
        """Whether a run left its record in the folder."""
        return self.run_record.is_file()

    def record(self) -> RunRecord:
        """Read ``run.json``; InputError when there is none, or it is damaged."""
        return RunRecord.read(self.path)

    def digest(self, name: str) -> str:
        """Return the sha256 of a file in the folder; InputError when it is not there."""
        return files.hash_file(self.path / name)


ACCURACY_FILES = (RunFolder.accuracy.name, RunFolder.accuracy_figure.name)
"""The report shows them where the study belongs to the same settings and files as the run."""

VALIDATION_FILES = (RunFolder.detection.name, RunFolder.correlation.name, RunFolder.validation_figure.name)
"""The report shows them where the validation belongs to the same settings and files as the run."""

PLACEMENT_FILES = (RunFolder.placement.name, RunFolder.curve.name)
"""The report shows them where the plan belongs to the same settings and files as the run."""


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


_RECORD_TYPES = {"egvs": str, "seed": int, "scenario": dict, "scenario_folder": str, "stages": dict}
_RERUN_HINT = "Remove it and run again."


@dataclass(frozen=True)
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
    """

    egvs: str
    seed: int
    scenario: dict[str, Any]
    scenario_folder: str
    stages: dict[str, StageRecord]

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
            raise InputError(path, "no such file", "Name a folder that egvs run has written.")
        value = reading.read_json(path, _RERUN_HINT)
        has_checksum = isinstance(value, dict) and CHECKSUM_KEY in value
        if has_checksum and not has_valid_checksum(value):
            raise InputError(path, f"was changed after the run: {CHECKSUM_KEY} does not match the content", _RERUN_HINT)

        for key, expected_type in _RECORD_TYPES.items():
            actual = value.get(key) if isinstance(value, dict) else value
            if not isinstance(actual, expected_type):
                raise InputError(path, f"is not the record of a run ({key!r} is {actual!r})", _RERUN_HINT)

        stages = {}
        if has_checksum:  # a file without a checksum comes from another version of this program
            for name in STAGE_NAMES:
                stage = StageRecord.from_json(value["stages"].get(name))
                if stage is not None:
                    stages[name] = stage
        return cls(value["egvs"], value["seed"], value["scenario"], value["scenario_folder"], stages)

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


_CHECKSUM_LINE = re.compile(r"([0-9a-f]{64})  ([^/\\\0]+)")


def write_checksums(path: Path, written: Iterable[Path]) -> None:
    """Write the checksums of files in the same folder to ``path``."""
    files.write_text(path, "".join(f"{files.hash_file(file)}  {file.name}\n" for file in written))


def verify_checksums(path: Path, hint: str) -> None:
    """Check the files listed in ``path``; nothing happens where there is no list, as in folders of old versions.

    Raises
    ------
    InputError
        When a listed file exists and its checksum is another one; ``hint`` says what to do.
    """
    for name in changed_files(path, hint):
        raise InputError(path.with_name(name), f"does not match its checksum in {path.name}", hint)


def changed_files(path: Path, hint: str) -> list[str]:
    """Return the names of the existing files whose checksum differs from the list in ``path``."""
    if not path.is_file():
        return []
    changed = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        entry = _CHECKSUM_LINE.fullmatch(line)
        if entry is None:
            raise InputError(path, "is not a list of checksums", hint)
        file = path.with_name(entry[2])
        if file.is_file() and files.hash_file(file) != entry[1]:
            changed.append(file.name)
    return changed
