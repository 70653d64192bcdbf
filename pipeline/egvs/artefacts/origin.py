"""Tells the files that runs and studies wrote into a folder from files of the user that have the same names.

Parquet files and ``statics.ply`` carry metadata of this program; so a file of a killed run is recognised. A file that
was damaged since is recognised by its name in ``run.json``, or in the checksums of a study. Reports, pictures and lists
of checksums carry no metadata, nor do SUMO's files: they belong to a run where one has left its lock, its record or a
file with metadata in the folder.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord

_CHECKSUM_LINE = re.compile(r"[0-9a-f]{64}  (.+)")
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
    unmarked = []
    for file in RunFolder.all_files():
        path = folder / file.name
        if path.is_symlink() or not path.exists():
            continue
        if path.is_dir():  # in place of a file, it is rejected where the file is written
            if file.is_folder and any(path.iterdir()):
                unmarked.append(file)
        elif file.name in written or _has_metadata(path):
            written.add(file.name)
        else:
            unmarked.append(file)

    for file in unmarked:
        if file.name.endswith((".parquet", ".ply")) or not written:  # of the others, none has metadata
            yield file.name


def _recorded_names(folder: RunFolder) -> set[str]:
    """The names in ``run.json`` and in the checksums of studies; also those of the files that every run writes."""
    run_files = (RunFolder.run_record, RunFolder.lock, RunFolder.digests)
    names = {file.name for file in run_files if (folder / file.name).exists()}
    if folder.has_record:
        for stage in RunRecord.read(folder.path).stages.values():
            names |= stage.artefacts.keys()
    for file in RunFolder.checksum_files():
        path = folder / file.name
        if path.is_file():
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            names.update(match[1] for match in map(_CHECKSUM_LINE.fullmatch, lines) if match)
    return names


def _has_metadata(path: Path) -> bool:
    """Whether a file carries metadata of this program."""
    if path.suffix == ".parquet":
        try:
            return _PARQUET_KEY in (pq.read_metadata(path).metadata or {})
        except pa.ArrowInvalid:  # no Parquet file
            return False
    if path.suffix == ".ply":
        with path.open("rb") as content:
            return content.read(len(_PLY_START)) == _PLY_START
    return False
