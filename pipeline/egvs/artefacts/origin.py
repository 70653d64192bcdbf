"""Tells the files that runs and studies wrote into a folder from files of the user that have the same names.

Parquet files and ``statics.ply`` carry metadata of this program; so a file of a killed run is recognised. A file that
was damaged since is recognised by its name in ``run.json``, or in the checksums of a study. Reports, pictures and lists
of checksums carry no metadata: they belong to a run where one has left its lock or its record in the folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from egvs.artefacts.run_folder import RunFile, RunFolder
from egvs.artefacts.run_record import RunRecord

_PARQUET_KEY = b"egvs"
_PLY_START = b"ply\nformat binary_little_endian 1.0\ncomment egvs "


def foreign_files(folder: Path) -> Iterator[str]:
    """Yield the names of files and folders that a run would replace although no run or study wrote them.

    Links are not among them: a run replaces the link and not the file that it leads to.

    Raises
    ------
    InputError
        When ``run.json`` is damaged, or is not a run record.
    """
    run_folder = RunFolder(folder)
    written = _recorded_names(run_folder)
    is_run_folder = run_folder.has_record or run_folder.lock.exists()
    for file in RunFolder.all_files():
        path = folder / file.name
        if path.is_symlink() or not path.exists() or file.name in written:
            continue
        if not _is_written_by_run(path, file, is_run_folder):
            yield file.name


def _recorded_names(folder: RunFolder) -> set[str]:
    names = {RunFolder.run_record.name, RunFolder.lock.name}
    if folder.has_record:
        for stage in RunRecord.read(folder.path).stages.values():
            names |= stage.artefacts.keys()
    for path in (folder.accuracy_checksums, folder.validation_checksums, folder.placement_checksums):
        if path.is_file():
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            names.update(line.partition("  ")[2] for line in lines)
    return names


def _is_written_by_run(path: Path, file: RunFile, is_run_folder: bool) -> bool:
    if file.is_folder:
        return is_run_folder or not path.is_dir() or not any(path.iterdir())
    if not path.is_file():
        return True  # a folder of this name is rejected where the file is written
    if path.suffix == ".parquet":
        return _has_parquet_metadata(path)
    if path.suffix == ".ply":
        with path.open("rb") as content:
            return content.read(len(_PLY_START)) == _PLY_START
    return is_run_folder


def _has_parquet_metadata(path: Path) -> bool:
    try:
        return _PARQUET_KEY in (pq.read_metadata(path).metadata or {})
    except pa.ArrowInvalid:  # no Parquet file
        return False
