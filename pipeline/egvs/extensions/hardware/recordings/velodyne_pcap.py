"""Read network captures of Velodyne sensors with velodyne-decoder (``pip install 'egvs[sweeps]'``).

The decoder has the beam tables of VLP-16, VLP-32, HDL-32E, HDL-64E and Alpha Prime. Its axes are x ahead and y left
(the maker's manual has y ahead and x right, so azimuth 0 of the packets is the x axis here). A sweep is a turn; the
last one of a capture is incomplete and is left out.

Packets tell when lasers fired, also where nothing was returned. A turn is therefore returned as an organised sweep: one
slot for each laser of each firing, NaN without a return; except in dual return mode, which gives the list of returns.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import limits, plugins
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.formats.reader_process import Block, serve
from egvs.formats.recording_options import RecordingOptions
from egvs.formats.recordings import (
    RecordedSweep,
    Recording,
    chosen_sweeps,
    header_block,
    process_options,
    read_recording,
    sweep_blocks,
)

_CANNOT_READ = "cannot be read as a capture of a Velodyne sensor"
_TIME, _COLUMN, _RING = 4, 5, 6
"""Columns of the decoder's points."""
_MIN_FILLED = 0.2
_MIN_FIRINGS = 10
_MAX_JITTER, _MIN_REGULAR = 0.25, 0.98
"""Firings are at regular times if this share of the gaps deviates by less than a quarter of the interval."""
_MAX_SLOTS = 3_000_000


def read(path: Path, where: str, options: RecordingOptions) -> tuple[Recording, list[RecordedSweep]]:
    """Return the turns of a capture.

    Raises
    ------
    InputError
        If the file is damaged, or has no complete turn.
    MissingExtraError
        If velodyne-decoder is not installed.
    """
    plugins.require_libraries(f"{where}: reading a capture of a Velodyne sensor", "sweeps", "velodyne_decoder")
    limits.checked_size(path, limits.FILE, where)
    return read_recording(__name__, path, where, _CANNOT_READ, options)


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    options = process_options()
    stamps_s = [_seconds(stamp) for stamp, _ in _turns(path, options.range_m)]
    if len(stamps_s) < 2:
        actual = "no packets of a Velodyne sensor" if not stamps_s else "less than one"
        hint = "Save UDP packets of at least two turns (port 2368) as .pcap, not .pcapng."
        raise InputError("", f"expected a complete turn, got {actual}", hint)
    complete = len(stamps_s) - 1
    selected = set(chosen_sweeps(complete, options.max_sweeps).tolist())
    blocks: list[Block] = []
    for number, (_, points) in enumerate(_turns(path, options.range_m)):
        if number in selected:
            points_m, time_s = organise(points)
            blocks += sweep_blocks(f"turn {number + 1}", points_m, time_s)
    notes = ["the last turn is incomplete and left out"]
    yield header_block(f"Velodyne packets, returns up to {options.range_m:g} m", stamps_s[:complete], notes)
    yield from blocks


def _turns(path: Path, range_m: float) -> Iterator[tuple[Any, FloatArray]]:
    import velodyne_decoder

    # The decoder's default drops returns beyond 200 m. Without a cut angle, the first turn is complete.
    yield from velodyne_decoder.read_pcap(str(path), velodyne_decoder.Config(max_range=range_m))


def _seconds(stamp: Any) -> float:
    """Return the device's time of a turn's last packet; it is free of the network's delays."""
    return float(stamp.device)


def organise(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (slots, 3) and times (slots,), seconds, with a slot for each laser of each firing, laser fastest.

    The decoder does not number the firings of packets without any return, so firings are counted by their times.

    Parameters
    ----------
    points
        Rows of the decoder: x, y, z, intensity, time, column, ring, return type.

    Returns
    -------
    points_m, time_s
        NaN in slots without a return. Where a slot has two returns, few slots have one, or firings are not at regular
        times, the list of returns.
    """
    points_m = points[:, :3].astype(np.float64)
    time_s = points[:, _TIME].astype(np.float64)
    ring = points[:, _RING].astype(np.int64)
    rings = int(ring.max(initial=0)) + 1
    firing = _count_firings(points[:, _COLUMN].astype(np.int64), ring, time_s)
    if firing is None:
        return points_m, time_s
    slot = firing * rings + ring
    slots = (int(firing.max()) + 1) * rings
    if slots > _MAX_SLOTS or len(points) < _MIN_FILLED * slots or len(np.unique(slot)) < len(slot):
        return points_m, time_s
    organised = np.full((slots, 3), np.nan)
    organised[slot] = points_m
    times = np.full(slots, np.nan)
    times[slot] = time_s
    return organised, times


def _count_firings(column: IntArray, ring: IntArray, time_s: FloatArray) -> IntArray | None:
    """Return the number of the firing that each return is of, from 0; None if firings are not at regular times."""
    columns, index = np.unique(column, return_inverse=True)
    if len(columns) < _MIN_FIRINGS:
        return None
    first_s = np.full(len(columns), np.inf)
    np.minimum.at(first_s, index, time_s)
    # A laser fires at this time after the first one, which gave a return in some column.
    delay_s = np.zeros(int(ring.max()) + 1)
    np.maximum.at(delay_s, ring, time_s - first_s[index])
    start_s = np.full(len(columns), np.inf)
    np.minimum.at(start_s, index, time_s - delay_s[ring])
    gaps = np.diff(start_s)
    interval_s = float(np.median(gaps))
    if not interval_s > 0.0:
        return None
    steps = np.round(gaps / interval_s)
    is_regular = (np.abs(gaps / interval_s - steps) < _MAX_JITTER) & (steps >= 1)
    if np.mean(is_regular) < _MIN_REGULAR or steps.sum() > _MAX_SLOTS:
        return None
    firing = np.concatenate([[0], np.cumsum(np.maximum(steps, 1.0))]).astype(np.int64)
    return firing[index]


if __name__ == "__main__":
    serve(_read_file)
