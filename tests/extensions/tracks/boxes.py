"""Boxes of moving road users for round trips through formats of tracks, and their comparison with tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.tracks.model import Tracks
from tests.extensions.tracks.writers import TrackRows

SIZES_M = {
    "car": (4.5, 1.8, 1.5), "van": (5.2, 2.0, 2.1), "truck": (9.4, 2.5, 3.4), "bus": (12.0, 2.55, 3.1),
    "trailer": (7.1, 2.4, 2.9), "tram": (32.0, 2.4, 3.5), "motorcycle": (2.1, 0.8, 1.4), "bicycle": (1.8, 0.6, 1.7),
    "pedestrian": (0.5, 0.6, 1.7), "other": (2.4, 1.1, 1.6),
}  # fmt: skip


def moving_boxes(
    classes: Sequence[str], n_frames: int = 500, period_s: float = 0.1, straight: bool = False
) -> TrackRows:
    """Return two road users of each class that drive round circles or, alternately to the left and right, straight on.

    They appear and disappear one after another, and stand still for a while in the middle.
    """
    names = [f"{number + 1}" for number in range(2 * len(classes))]
    rows: list[tuple[float, str, str, float, float, float, float]] = []
    for frame in range(n_frames):
        time_s = frame * period_s
        moving_s = time_s - min(max(time_s - 10.0, 0.0), 3.0)
        for number, name in enumerate(names):
            if not 3 * number <= frame < n_frames - 2 * number:
                continue
            cls = classes[number % len(classes)]
            if straight:
                sign = 1.0 if number % 2 == 0 else -1.0
                x, y, yaw = sign * (4.0 * moving_s - 100.0), -4.0 * number, math.pi * (number % 2)
            else:
                radius_m = 12.0 + 5.0 * number
                turn = 5.0 / radius_m * moving_s + number
                x, y, yaw = radius_m * math.cos(turn), radius_m * math.sin(turn), turn + math.pi / 2
            rows.append((time_s, name, cls, x, y, math.atan2(math.sin(yaw), math.cos(yaw)), 0.01 * number))
    sizes_m = np.array([SIZES_M[row[2]] for row in rows])
    numbers = np.array([(row[0], *row[3:]) for row in rows])
    return TrackRows(
        time_s=numbers[:, 0], name=[row[1] for row in rows], cls=[row[2] for row in rows],
        x_m=numbers[:, 1], y_m=numbers[:, 2], z_m=numbers[:, 4] + sizes_m[:, 2] / 2, yaw_rad=numbers[:, 3],
        length_m=sizes_m[:, 0], width_m=sizes_m[:, 1], height_m=sizes_m[:, 2],
    )  # fmt: skip


def assert_same_boxes(
    tracks: Tracks,
    boxes: TrackRows,
    missing: Sequence[str] = (),
    position_m: float = 1e-6,
    yaw_rad: float = 1e-6,
    shift_m: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Assert that tracks are these boxes.

    Parameters
    ----------
    tracks
        What a reader returned.
    boxes
        What was written.
    missing
        Attributes that the format does not have, which must be NaN.
    position_m, yaw_rad
        Tolerances.
    shift_m
        Added to x and y of the boxes.
    """
    assert tracks.n_rows == len(boxes.name)
    name_of = np.array(tracks.names)[tracks.track]
    mine, other = np.lexsort((name_of, tracks.time_s.round(6))), np.lexsort((boxes.name, boxes.time_s.round(6)))
    assert name_of[mine].tolist() == np.array(boxes.name)[other].tolist()
    assert np.array(tracks.classes)[tracks.track][mine].tolist() == np.array(boxes.cls)[other].tolist()
    assert np.abs(tracks.time_s[mine] - boxes.time_s[other]).max() < 1e-6
    expected = {key: getattr(boxes, key)[other] for key in ("z_m", "length_m", "width_m", "height_m")}
    expected |= {"x_m": boxes.x_m[other] + shift_m[0], "y_m": boxes.y_m[other] + shift_m[1]}
    for key, values in expected.items():
        _assert_close(key, getattr(tracks, key)[mine], values, key in missing, position_m)
    turn_rad = tracks.yaw_rad[mine] - boxes.yaw_rad[other]
    _assert_close(
        "yaw_rad", np.arctan2(np.sin(turn_rad), np.cos(turn_rad)), 0 * turn_rad, "yaw_rad" in missing, yaw_rad
    )


def _assert_close(key: str, actual: FloatArray, expected: FloatArray, is_missing: bool, tolerance: float) -> None:
    if is_missing:
        assert np.isnan(actual).all(), key
    else:
        assert np.array_equal(np.isnan(actual), np.isnan(expected)), key
        assert np.nanmax(np.abs(actual - expected)) <= tolerance, key
