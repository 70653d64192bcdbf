"""Upper limits of what a user's files may ask for: file sizes, points, triangles, voxels.

A limit is checked before memory is allocated, so that no file, however small, can ask for more than the machine has.
Each can be set by an environment variable of its name, to a whole number of its unit. The defaults fit a program of 2
GB; :attr:`Limit.hint` names the limit in every message, and the variable that raises it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from egvs.core.digests import open_input
from egvs.core.errors import InputError

MB = 1_000_000
"""Bytes."""


@dataclass(frozen=True)
class Limit:
    """An upper limit.

    Attributes
    ----------
    name
        Name of the environment variable that sets it.
    default
        Value when the variable is not set.
    unit
        What is counted: "MB", "points".
    what
        What is limited, in words.
    """

    name: str
    default: int
    unit: str
    what: str

    @property
    def maximum(self) -> int:
        """The limit; InputError when the environment variable is not a whole number above 0."""
        text = os.environ.get(self.name)
        if text is None:
            return self.default
        if not (text.isascii() and text.isdecimal() and 0 < len(text) <= 18 and int(text) > 0):
            problem = f"expected the maximum number of {self.unit} of {self.what}, got {text!r}"
            raise InputError(self.name, problem, f"Set a whole number above 0, for example {self.default}.")
        return int(text)

    @property
    def hint(self) -> str:
        """The limit and how to raise it, as a sentence."""
        return f"The limit is {self.maximum:,} {self.unit}; set {self.name} to raise it."

    def check(self, where: object, amount: float, actual: str = "") -> None:
        """Raise an InputError when an amount exceeds the limit.

        Parameters
        ----------
        where
            File and key, for the message.
        amount
            In the limit's unit.
        actual
            The amount in words, for the message.
        """
        if not amount <= self.maximum:
            raise InputError(where, actual or f"has {amount:,.0f} {self.unit}", self.hint)

    def check_bytes(self, where: object, size: float, actual: str = "") -> None:
        """:meth:`check` for a size in bytes and a limit in MB."""
        self.check(where, size / MB, actual)


DOCUMENT = Limit("EGVS_MAX_DOCUMENT_MB", 64, "MB", "a TOML, JSON, GeoJSON or CSV file that is read as a whole")
FILE = Limit("EGVS_MAX_FILE_MB", 1000, "MB", "a mesh or a point cloud")
UNPACKED = Limit("EGVS_MAX_UNPACKED_MB", 1000, "MB", "the unpacked content of a file (gzip, Parquet, PCD, glTF)")
ELEMENT = Limit("EGVS_MAX_ELEMENT_MB", 16, "MB", "one element below the root of an XML file, or a line of a text file")
XML_ELEMENTS = Limit("EGVS_MAX_XML_ELEMENTS", 10_000_000, "elements", "an XML file")
POINTS = Limit("EGVS_MAX_POINTS", 30_000_000, "points", "a point cloud")
TRIANGLES = Limit("EGVS_MAX_TRIANGLES", 5_000_000, "triangles", "a mesh")
CORNERS = Limit(
    "EGVS_MAX_CORNERS", 3000, "corners", "one polygon with its holes: the time to cut it can grow with their cube"
)
EDGE_PAIRS = Limit(
    "EGVS_MAX_EDGE_PAIRS",
    100_000,
    "pairs of edges",
    "the geometries of a file that cross themselves or are widened, side by side, beyond a few for each edge",
)
SITES = Limit("EGVS_MAX_SITES", 100_000, "candidates", "a scenario's sites")
BEAMS = Limit("EGVS_MAX_BEAMS", 3_000_000, "beams", "one turn of a sensor")
VOXELS = Limit("EGVS_MAX_VOXELS", 2**30, "voxels", "a region of interest")
ROWS = Limit("EGVS_MAX_ROWS", 3_000_000, "rows", "the frames of an FCD file held in memory, or recorded tracks")
BOXES = Limit("EGVS_MAX_BOXES", 10_000_000, "boxes", "recorded tracks, summed over frames")
MAP_OBJECTS = Limit("EGVS_MAX_MAP_OBJECTS", 5_000_000, "objects", "an OpenStreetMap extract")
GROUND_POINTS = Limit("EGVS_MAX_GROUND_POINTS", 2_000_000, "points", "the ground surface built from a network")
DOWNLOAD = Limit("EGVS_MAX_DOWNLOAD_MB", 200, "MB", "a downloaded map")
DOWNLOAD_TIME = Limit("EGVS_MAX_DOWNLOAD_S", 120, "s", "the download of a map")
VEHICLES = Limit("EGVS_MAX_VEHICLES", 1_000_000, "vehicles", "the vehicles and people that route files let depart")
ROUTE_EDGES = Limit("EGVS_MAX_ROUTE_EDGES", 1_000_000, "edges", "one route of a route file, with its repetitions")
SUMO_MEMORY = Limit("EGVS_MAX_SUMO_MB", 2000, "MB", "a program of SUMO, beside 20 MB for each MB of its input")
SUMO_TIME = Limit(
    "EGVS_MAX_SUMO_S", 600, "s", "work of such a program, beside 10 s for each MB of its input and 1 s for a time step"
)
SUMO_IDLE = Limit("EGVS_MAX_SUMO_IDLE_S", 600, "s", "waiting for such a program, while it neither works nor writes")
READER_MEMORY = Limit("EGVS_MAX_READER_MB", 2000, "MB", "a process that reads a file with another library")
READER_TIME = Limit("EGVS_MAX_READER_S", 120, "s", "work of such a process, beside 1 s for each MB of the file")


def checked_size(path: Path, limit: Limit, where: object = "") -> int:
    """Return a file's size in bytes; InputError when it exceeds a limit in MB, or the file cannot be read."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise _unreadable_error(where or path, error) from None
    limit.check_bytes(where or path, size, f"is a file of {size / MB:,.0f} MB")
    return size


def read_bytes(path: Path, limit: Limit, where: object = "") -> bytes:
    """Return the content of a file; InputError when it exceeds a limit in MB, or cannot be read."""
    checked_size(path, limit, where)
    try:
        with open_input(path) as file:
            return file.read()
    except OSError as error:
        raise _unreadable_error(where or path, error) from None


def _unreadable_error(where: object, error: OSError) -> InputError:
    return InputError(where, f"cannot be read ({error.strerror})", "Check the path and the permissions.")
