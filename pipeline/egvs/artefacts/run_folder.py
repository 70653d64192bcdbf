"""The folder of a run: the name of each file in it.

:class:`RunFolder` declares the files of the core. Extensions declare theirs as tuples of :class:`RunFile`, entry points
of the group ``egvs.files``, so that no run overwrites a user's file of the same name, and ``egvs verify`` finds their
checksums.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import overload

from egvs.core import files, plugins

GROUP = "egvs.files"
"""The group of entry points."""

STAGE_NAMES = ("check", "statics", "scan", "traffic", "tpog", "score", "report")
"""In the order of execution. Errors are reported in this order as well, although SUMO starts before the check ends."""


CHECKSUM_SUFFIX = ".sha256"
"""Suffix of files with checksums; each study has one."""

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

    run_record = RunFile(files.RUN_RECORD, "run")
    lock = RunFile(files.RUN_LOCK, "run")
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
    levels = RunFile("levels.parquet", "score")
    blindspots = RunFile("blindspots.parquet", "score")
    zones = RunFile("zones.parquet", "score")
    report = RunFile("report.html", "report")

    accuracy = RunFile("accuracy.parquet", "accuracy")
    accuracy_figure = RunFile("accuracy.png", "accuracy")
    accuracy_checksums = RunFile("accuracy.sha256", "accuracy")
    placement = RunFile("placement.parquet", "place")
    curve = RunFile("curve.parquet", "place")
    plan_zones = RunFile("plan_zones.parquet", "place")
    placement_checksums = RunFile("placement.sha256", "place")
    what_if = RunFile("what_if.json", "what-if")

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def core_files(cls) -> tuple[RunFile, ...]:
        """Every file that a run or a study of the core can write, in the order of the declarations above."""
        return tuple(value for value in vars(cls).values() if isinstance(value, RunFile))

    @classmethod
    def all_files(cls) -> tuple[RunFile, ...]:
        """Every file that the core or an extension can write."""
        return cls.core_files() + extension_files()

    @classmethod
    def checksum_files(cls) -> tuple[RunFile, ...]:
        """Return the files with checksums of studies."""
        return tuple(file for file in cls.all_files() if file.name.endswith(CHECKSUM_SUFFIX))

    @classmethod
    def written_by(cls, stage: str) -> tuple[RunFile, ...]:
        """Return the files, and the folders, that a stage can write."""
        return tuple(file for file in cls.core_files() if file.writer == stage)

    @property
    def has_record(self) -> bool:
        """Whether a run left its record in the folder."""
        return self.run_record.is_file()


ACCURACY_FILES = (RunFolder.accuracy.name, RunFolder.accuracy_figure.name)
"""Files of an accuracy study. The report shows them if their settings and inputs are those of the run."""

PLACEMENT_FILES = (RunFolder.placement.name, RunFolder.curve.name)
"""Files of a plan, shown likewise."""


@cache
def extension_files() -> tuple[RunFile, ...]:
    """Return the files of all extensions, in the order of their entry points.

    Raises
    ------
    MissingBackendError
        When an entry point cannot be loaded, is no tuple of :class:`RunFile`, or has a name twice or one of the core.
    """
    files: list[RunFile] = []
    names = {file.name for file in RunFolder.core_files()}
    for extension in plugins.plugin_names(GROUP):
        for file in plugins.load_rows(GROUP, extension, RunFile):
            if file.name in names:
                raise plugins.plugin_error(GROUP, extension, f"{file.name} is a file of another part of the program")
            names.add(file.name)
            files.append(file)
    return tuple(files)
