"""How large the things that a user's files ask for may be: every bound, once.

A bound is held before memory is taken, so that no file, however small, can ask for more than the machine has. Each can
be set by an environment variable of its name, to a whole number of its unit. The defaults hold what a program of 2 GB
can take; :attr:`Limit.right` says in every message which bound it was and how to raise it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.errors import InputError

MB = 1_000_000
"""Bytes."""


@dataclass(frozen=True)
class Limit:
    """A bound.

    Attributes
    ----------
    name
        Of the environment variable that sets it.
    default
        Where that is not set.
    unit
        What is counted: "MB", "points".
    of
        What it holds for, in words.
    """

    name: str
    default: int
    unit: str
    of: str

    @property
    def most(self) -> int:
        """The bound; InputError where the environment says what is none."""
        text = os.environ.get(self.name)
        if text is None:
            return self.default
        if not (text.isascii() and text.isdecimal() and 0 < len(text) <= 18 and int(text) > 0):
            raise InputError(
                self.name, repr(text), f"how many {self.unit} {self.of} may take, for example {self.default}"
            )
        return int(text)

    @property
    def right(self) -> str:
        """What would be right, for a message."""
        return f"at most {self.most:,} {self.unit}; {self.name}=... raises that"

    def check(self, place: object, amount: float, found: str = "") -> None:
        """InputError at ``place`` where an ``amount`` (in the limit's unit) is beyond; ``found`` says it in words."""
        if not amount <= self.most:
            raise InputError(place, found or f"takes {amount:,.0f} {self.unit}", self.right)

    def check_bytes(self, place: object, size: float, found: str = "") -> None:
        """:meth:`check` for a limit in MB, of a size in bytes."""
        self.check(place, size / MB, found)


DOCUMENT = Limit("EGVS_MAX_DOCUMENT_MB", 64, "MB", "a TOML, JSON, GeoJSON or CSV file that is read as a whole")
FILE = Limit("EGVS_MAX_FILE_MB", 1000, "MB", "a mesh or a point cloud")
UNPACKED = Limit("EGVS_MAX_UNPACKED_MB", 1000, "MB", "what a packed file (gzip, 3MF, Parquet) holds")
ELEMENT = Limit("EGVS_MAX_ELEMENT_MB", 16, "MB", "one element below the root of an XML file, or a line of a text")
POINTS = Limit("EGVS_MAX_POINTS", 30_000_000, "points", "a point cloud")
TRIANGLES = Limit("EGVS_MAX_TRIANGLES", 5_000_000, "triangles", "a mesh")
SITES = Limit("EGVS_MAX_SITES", 100_000, "candidates", "a scenario's sites")
BEAMS = Limit("EGVS_MAX_BEAMS", 3_000_000, "beams", "one turn of a sensor")
VOXELS = Limit("EGVS_MAX_VOXELS", 2**30, "voxels", "a region of interest")
ROWS = Limit("EGVS_MAX_ROWS", 3_000_000, "rows", "the frames of an FCD file that are held at a time")
OBJECTS = Limit("EGVS_MAX_MAP_OBJECTS", 5_000_000, "objects", "a map of OpenStreetMap")
GROUND = Limit("EGVS_MAX_GROUND_POINTS", 2_000_000, "points", "the ground that is laid through a network")
CHILD = Limit("EGVS_MAX_READER_MB", 2000, "MB", "the program that unpacks a LAZ file")

ALL = (DOCUMENT, FILE, UNPACKED, ELEMENT, POINTS, TRIANGLES, SITES, BEAMS, VOXELS, ROWS, OBJECTS, GROUND, CHILD)


def size_of(path: Path, limit: Limit, place: object = "") -> int:
    """A file's size in bytes; InputError where it is beyond a limit in MB, or the file cannot be reached."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(place or path, f"cannot be read ({error.strerror})", "a file that may be read") from None
    limit.check_bytes(place or path, size, f"is a file of {size / MB:,.0f} MB")
    return size


def read_bytes(path: Path, limit: Limit, place: object = "") -> bytes:
    """The bytes of a file that is read whole; InputError where it is beyond a limit in MB, or cannot be read."""
    size_of(path, limit, place)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(place or path, f"cannot be read ({error.strerror})", "a file that may be read") from None
