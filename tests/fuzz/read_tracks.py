"""Reads a file of recorded tracks in place of a verb, for the fuzzer: the readers alone take far less than a run.

A file is read by the reader that accepts it, or, with the word ``mapping``, by :data:`MAPPING`,
or with a TOML file, by the columns that it names.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egvs.cli import exit
from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks import user_table
from egvs.extensions.tracks.new.files import read_track_columns
from egvs.scenario.track_columns import TrackColumns

VERB = "read-tracks"
RESULT = "boxes.parquet"
MAPPING = TrackColumns(
    time="time", id="id", x="x", y="y", z="z", yaw="yaw", length="length", width="width", height="height", type="type",
    types={"PKW": "car"}, time_unit="ms", yaw_unit="deg", yaw_convention="cw_from_north", reference="front",
    z_reference="bottom",
)  # fmt: skip
"""The mapping of a user's table."""

_COLUMNS = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")


def main(arguments: Sequence[str]) -> None:
    """Read the first argument and write its boxes; an error ends the process as on the command line."""
    path = Path(arguments[0])
    with exit.report_errors():
        if arguments[-1].endswith(".toml"):
            tracks = user_table.read(path, read_track_columns(Path(arguments[-1])))
        elif "mapping" in arguments:
            tracks = user_table.read(path, MAPPING)
        else:
            reader = track_readers.find_reader(path)
            reader.companions(path)
            tracks = reader.read(path)
        columns = {key: getattr(tracks, key) for key in _COLUMNS}
        for key in ("time_s", "x_m", "y_m"):
            if not np.isfinite(columns[key]).all():
                raise AssertionError(f"{key} is not finite")
        names = {"name": np.array(tracks.names)[tracks.track], "class": np.array(tracks.classes)[tracks.track]}
        frame = np.full(tracks.n_rows, repr(tracks.frame))
        pq.write_table(pa.table({**columns, **names, "frame": frame}), RESULT)
