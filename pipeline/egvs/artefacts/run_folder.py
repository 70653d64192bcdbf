"""The folder of a run: the name of each file in it.

:class:`RunFolder` is the only place where file names are written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import overload

STAGE_NAMES = ("check", "statics", "scan", "traffic", "tpog", "score", "report")
"""In the order of execution. Errors are reported in this order as well, although SUMO starts before the check ends."""


RUNS = Path("runs")
"""The folder of all runs for which no other is given."""


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
    """A folder with the artefacts of a run and of its studies.

    ``folder.scores`` is the path of ``scores.parquet`` in the folder, ``RunFolder.scores.name`` the file name.

    Attributes
    ----------
    path
        Path of the folder.
    """

    path: Path

    run_record = RunFile("run.json", "run")
    lock = RunFile(".lock", "run")
    digests = RunFile(".digests.json", "run")
    pending = RunFile(".pending", "run", is_folder=True)

    statics = RunFile("statics.ply", "statics")
    scans = RunFile("scans.parquet", "scan")
    trajectories = RunFile("trajectories.parquet", "traffic")
    sumo = RunFile("sumo", "traffic", is_folder=True)
    tpog = RunFile("tpog.parquet", "tpog")
    scores = RunFile("scores.parquet", "score")
    visibility = RunFile("visibility.parquet", "score")
    scores_by_period = RunFile("scores_by_period.parquet", "score")
    blindspots = RunFile("blindspots.parquet", "score")
    zones = RunFile("zones.parquet", "score")
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
    plan_zones = RunFile("plan_zones.parquet", "place")
    placement_checksums = RunFile("placement.sha256", "place")
    what_if = RunFile("what_if.json", "what-if")
    sheets = RunFile("sheets.json", "sheets")
    acceptance = RunFile("acceptance.json", "accept")
    sensor_design = RunFile("sensor_design.json", "sensor design")

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


ACCURACY_FILES = (RunFolder.accuracy.name, RunFolder.accuracy_figure.name)
"""Files of an accuracy study. The report shows them if their settings and inputs are those of the run."""

VALIDATION_FILES = (RunFolder.detection.name, RunFolder.correlation.name, RunFolder.validation_figure.name)
"""Files of a validation, shown likewise."""

PLACEMENT_FILES = (RunFolder.placement.name, RunFolder.curve.name)
"""Files of a plan, shown likewise."""

COMMAND_RESULTS = (RunFolder.what_if, RunFolder.sheets, RunFolder.acceptance, RunFolder.sensor_design)
"""Results of commands that work on a finished run (:mod:`egvs.artefacts.command_results`), shown likewise."""
