"""Poses that a planner keeps: a file of sites in the scenario's folder, which ``sites.file`` can name.

A file of that name that this program did not write is a user's own: it stays as it is.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection
from itertools import count
from pathlib import Path

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.sensing.sites import Site

KEPT = "kept_sites.csv"
"""In the scenario's folder."""

_COLUMNS = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor")


def keep(path: Path, site: Site, candidates: Collection[str]) -> str:
    """Add a pose to a file of kept sites, or begin one; the name that it has there.

    Parameters
    ----------
    path
        Of the file.
    site
        The candidate whose sensor it is, as it stands now.
    candidates
        Names that are taken.

    Raises
    ------
    InputError
        Where the file is another one than this program's own: it stays as it is.
    """
    rows = _rows(path)
    taken = {row[0] for row in rows} | set(candidates)
    name = next(new for n in range(1, len(taken) + 2) if (new := f"{site.name[:72]}-{n}") not in taken)
    pose = site.pose
    rows.append([name, *(repr(float(value)) for value in (*pose.position_m, *pose.angles_deg)), site.sensor])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_COLUMNS, *rows])
    files.write_text(path, text.getvalue())
    return name


def free_name(folder: Path) -> str:
    """The name of a file that is not there yet, for somebody whose own file has the usual one."""
    stem, suffix = KEPT.split(".")
    return next(name for n in count(2) if not (folder / (name := f"{stem}-{n}.{suffix}")).exists())


def _rows(path: Path) -> list[list[str]]:
    """The rows of a file of kept sites; none where there is no file yet."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        header, *rows = [row for row in csv.reader(file) if row] or [[]]
    if tuple(header) != _COLUMNS or any(len(row) != len(_COLUMNS) for row in rows):
        raise InputError(path, "was not written by egvs explore, and stays as it is", "another name to keep poses in")
    return rows
