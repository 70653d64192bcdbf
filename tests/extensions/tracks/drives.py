"""Vehicles that drive through :mod:`tests.traffic.crossing` along lines that a person can follow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.tracks.resampling import ResampledTracks, UnknownBoxes

PERIOD_S = 0.5


@dataclass(frozen=True)
class Drive:
    """A vehicle: its distance along its way at a time, and the corners of the way."""

    at_m: Callable[[FloatArray], FloatArray]
    begin_s: float
    end_s: float
    way_m: Sequence[tuple[float, float]] = ((-110.0, 0.0), (110.0, 0.0))


LEFT = ((-110.0, 0.0), (0.0, 0.0), (0.0, 110.0))


def constant(speed_m_s: float, begin_s: float = 0.0, start_m: float = 0.0) -> Callable[[FloatArray], FloatArray]:
    """Return a motion at constant speed."""
    return lambda time_s: start_m + speed_m_s * (time_s - begin_s)


def boxes_of(drives: Sequence[Drive]) -> ResampledTracks:
    """Return the boxes of vehicles, in the order of ``drives``, as if they had been resampled."""
    frames, tracks, rows = [], [], []
    for number, drive in enumerate(drives):
        frame = np.arange(round(drive.begin_s / PERIOD_S), round(drive.end_s / PERIOD_S) + 1)
        corners = np.array(drive.way_m)
        step = np.diff(corners, axis=0)
        along_m = np.append(0.0, np.cumsum(np.hypot(*step.T)))
        at_m = drive.at_m(frame * PERIOD_S)
        piece = np.clip(np.searchsorted(along_m, at_m, side="right") - 1, 0, len(step) - 1)
        xy_m = [np.interp(at_m, along_m, corners[:, axis]) for axis in (0, 1)]
        rows.append(np.column_stack([*xy_m, np.arctan2(step[piece, 1], step[piece, 0])]))
        frames.append(frame)
        tracks.append(np.full(frame.size, number))
    x_m, y_m, yaw_rad = np.concatenate(rows).T
    frame, track = np.concatenate(frames), np.concatenate(tracks)
    order = np.lexsort((track, frame))
    none = UnknownBoxes(
        np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 2)), np.empty(0)
    )
    return ResampledTracks(
        frame[order], track[order], x_m[order], y_m[order], yaw_rad[order], np.zeros(order.size), 0, 0, none
    )
