"""Files that hold several sweeps of a LiDAR: recordings of ROS, and network captures.

A reader runs in a process of its own (:mod:`egvs.formats.reader_process`). It yields one block of values about the
recording, then two for each sweep: the points, and their times and rings.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from egvs.core import limits
from egvs.core.grid import FloatArray, IntArray
from egvs.formats.reader_process import Block, read_blocks
from egvs.formats.recording_options import RecordingOptions

TIME_FIELDS = ("time", "timestamp", "t", "offset_time", "time_stamp")
"""Names of the field with the time of each point."""

RING_FIELDS = ("ring", "channel", "laser_id")
"""Names of the field that says which ring a point is from; the first that a file has counts."""

_MAX_RING = 1 << 16
_SPANS_S = (0.002, 5.0)
"""The points of one sweep are recorded in between; times with another span are not in the expected unit."""


@dataclass(frozen=True)
class Recording:
    """A file with several sweeps.

    Attributes
    ----------
    name
        The file.
    source
        The topic and its frame, or the model of the sensor.
    sweeps
        Complete sweeps in the file.
    stamps_s
        Time of each of them, seconds, (sweeps,) float64.
    notes
        What was dropped, for the user.
    """

    name: str
    source: str
    sweeps: int
    stamps_s: FloatArray
    notes: tuple[str, ...] = ()


class RecordedSweep(NamedTuple):
    """Points of a sweep, (n, 3) float64, NaN for missing returns; their times (seconds) and rings, (n,), or None."""

    label: str
    points_m: FloatArray
    time_s: FloatArray | None
    ring: IntArray | None = None


def chosen_sweeps(count: int, most: int) -> IntArray:
    """Return the numbers of at most ``most`` of ``count`` sweeps, spread evenly; the first and the last are chosen."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.round(np.linspace(0, count - 1, most)).astype(np.int64))


def read_recording(
    module: str, path: Path, where: str, doing: str, options: RecordingOptions
) -> tuple[Recording, list[RecordedSweep]]:
    """Return a recording and its sweeps.

    Parameters
    ----------
    module
        Module of the reader.
    path, where, doing
        As of :func:`egvs.formats.reader_process.read_blocks`.
    options
        What is read.

    Raises
    ------
    InputError
        If the file cannot be read, or holds no sweep.
    """
    arguments = [json.dumps([options.topic, options.max_sweeps, options.range_m])]
    blocks = read_blocks(module, path, where, doing, arguments)
    header: dict[str, Any] = {}
    sweeps: list[RecordedSweep] = []
    count = 0
    try:
        for block in blocks:
            values = block.values
            if "stamps_s" in values:
                header = values
            elif "label" in values:
                count += len(block.points_m)
                limits.POINTS.check(where, count)
                sweeps.append(RecordedSweep(values["label"], block.points_m, None))
            else:
                time_s, ring, _ = block.points_m.T
                sweeps[-1] = sweeps[-1]._replace(time_s=_plausible_times(time_s), ring=ring_numbers(ring))
    finally:
        blocks.close()
    stamps_s = np.array(header["stamps_s"], dtype=np.float64)
    return Recording(where, header["source"], len(stamps_s), stamps_s, tuple(header["notes"])), sweeps


def _plausible_times(time_s: FloatArray) -> FloatArray | None:
    """Return times from the earliest; None if they do not span one sweep."""
    if not np.isfinite(time_s).any():
        return None
    relative = time_s - np.nanmin(time_s)
    return relative if _SPANS_S[0] <= np.nanmax(relative) <= _SPANS_S[1] else None


def times_of_field(field: FloatArray) -> FloatArray | None:
    """Return times in seconds, from the earliest, of a field in seconds or nanoseconds; None for other values."""
    for unit_s in (1.0, 1e-9):
        time_s = _plausible_times((field - np.nanmin(field, initial=np.inf)) * unit_s)
        if time_s is not None:
            return time_s
    return None


def ring_numbers(field: FloatArray) -> IntArray | None:
    """Return the values of a field as ring numbers, (n,) int64; None unless all are whole numbers below 65,536."""
    with np.errstate(invalid="ignore"):
        is_number = (field >= 0) & (field < _MAX_RING) & (field == np.floor(field))
    return field.astype(np.int64) if is_number.all() else None


# --- in the other process ---


def process_options() -> RecordingOptions:
    """Return the options that this process was started with."""
    topic, max_sweeps, range_m = json.loads(sys.argv[2])
    return RecordingOptions(topic, max_sweeps, range_m)


def header_block(source: str, stamps_s: Sequence[float], notes: Sequence[str] = ()) -> Block:
    """Return the first block of a recording."""
    return Block({"source": source, "stamps_s": list(stamps_s), "notes": list(notes)})


def sweep_blocks(
    label: str, points_m: FloatArray, time_s: FloatArray | None, ring: FloatArray | None = None
) -> Iterator[Block]:
    """Yield the blocks of a sweep."""
    yield Block.of_points({"label": label}, points_m)
    if time_s is not None or ring is not None:
        columns = np.full((len(points_m), 3), np.nan)
        if time_s is not None:
            columns[:, 0] = time_s
        if ring is not None:
            columns[:, 1] = ring
        yield Block.of_points({}, columns)
