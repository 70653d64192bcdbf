"""Positions of recorded tracks at frames, compared with a slow twin that looks at one frame at a time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.extensions.tracks.cleaning import CleanTracks, clean_tracks
from egvs.extensions.tracks.resampling import resample
from egvs.traffic.class_sizes import CLASS_SIZES
from tests.extensions.tracks.rows import make_tracks, straight


def cleaned(*rows: tuple[str, str, float, float, float], **columns: list[float]) -> CleanTracks:
    return clean_tracks(make_tracks(*rows, **columns), CLASS_SIZES)


def test_position_between_two_rows() -> None:
    """10 m/s: at 0.25 s the vehicle is at x = 2.5 m."""
    boxes = resample(cleaned(*straight("a", "car", [0.0, 0.1, 0.2, 0.3], 10.0)), 0.0, 0.25, 2, 2.0)
    np.testing.assert_array_equal(boxes.frame, [0, 1])
    np.testing.assert_allclose(boxes.x_m, [0.0, 2.5])
    np.testing.assert_allclose(boxes.speed_m_s, 10.0)


def test_last_row_is_a_frame() -> None:
    boxes = resample(cleaned(*straight("a", "car", [0.0, 0.1, 0.2], 10.0)), 0.0, 0.1, 5, 2.0)
    np.testing.assert_array_equal(boxes.frame, [0, 1, 2])
    np.testing.assert_allclose(boxes.x_m, [0.0, 1.0, 2.0])


def test_heading_turns_along_the_shorter_arc() -> None:
    rows = [("a", "car", 0.0, 0.0, 0.0), ("a", "car", 0.2, 0.1, 0.0)]
    tracks = cleaned(*rows, yaw_rad=[math.radians(170.0), math.radians(-170.0)])
    boxes = resample(tracks, 0.0, 0.1, 3, 2.0)
    np.testing.assert_allclose(np.rad2deg(boxes.yaw_rad) % 360.0, [170.0, 180.0, 190.0])


def test_short_gap_is_interpolated_and_counted() -> None:
    times_s = [0.0, 0.1, 0.2, 1.2, 1.3, 1.4]
    boxes = resample(cleaned(*straight("a", "car", times_s, 5.0)), 0.0, 0.1, 15, 1.0)
    assert (boxes.interpolated_gaps, boxes.unknown_gaps) == (1, 0)
    np.testing.assert_allclose(boxes.x_m, 0.5 * np.arange(15))


def test_position_in_a_long_gap_is_unknown() -> None:
    """From 0.2 s to 1.2 s nobody knows; the frames 3 to 11 are between (1.2 s is a row)."""
    times_s = [0.0, 0.1, 0.2, 1.2, 1.3, 1.4]
    boxes = resample(cleaned(*straight("a", "car", times_s, 5.0)), 0.0, 0.1, 15, 0.9)
    np.testing.assert_array_equal(boxes.frame, [0, 1, 2, 12, 13, 14])
    assert (boxes.interpolated_gaps, boxes.unknown_gaps) == (0, 1)
    np.testing.assert_array_equal(boxes.unknown.frames, [[3, 12]])
    np.testing.assert_allclose(boxes.unknown.start_m, [[1.0, 0.0]])
    np.testing.assert_allclose(boxes.unknown.end_m, [[6.0, 0.0]])


def test_nothing_is_interpolated_over_a_jump() -> None:
    rows = [("a", "car", 0.1 * k, x_m, 0.0) for k, x_m in enumerate([0.0, 1.0, 90.0, 91.0])]
    boxes = resample(cleaned(*rows), 0.05, 0.1, 3, 2.0)
    np.testing.assert_array_equal(boxes.frame, [0, 2])


def test_boxes_are_sorted_by_frame_and_track() -> None:
    rows = [*straight("b", "car", [0.0, 0.1, 0.2], 1.0), *straight("a", "car", [0.1, 0.2], 1.0, y_m=5.0)]
    boxes = resample(cleaned(*rows), 0.0, 0.1, 3, 2.0)
    np.testing.assert_array_equal(boxes.frame, [0, 1, 1, 2, 2])
    np.testing.assert_array_equal(boxes.track, [1, 0, 1, 0, 1])


def slow_positions(
    tracks: CleanTracks, first_s: float, period_s: float, n_frames: int, max_gap_s: float
) -> dict[tuple[int, int], float]:
    """Return x of each (frame, track), one frame and one pair of rows at a time."""
    positions = {}
    for frame in range(n_frames):
        time_s = first_s + frame * period_s
        for i in range(tracks.time_s.size):
            if abs(tracks.time_s[i] - time_s) <= 1e-6:
                positions[frame, int(tracks.track[i])] = float(tracks.x_m[i])
        for i in range(tracks.time_s.size - 1):
            before_s, after_s = tracks.time_s[i], tracks.time_s[i + 1]
            if tracks.track[i] != tracks.track[i + 1] or tracks.part[i] != tracks.part[i + 1]:
                continue
            if after_s - before_s > max_gap_s + 1e-6:
                continue
            if before_s + 1e-6 < time_s < after_s - 1e-6:
                share = (time_s - before_s) / (after_s - before_s)
                x_m = tracks.x_m[i] + share * (tracks.x_m[i + 1] - tracks.x_m[i])
                positions[frame, int(tracks.track[i])] = float(x_m)
    return positions


@pytest.mark.slow
@given(
    st.lists(st.integers(0, 60), min_size=2, max_size=25, unique=True),
    st.lists(st.integers(0, 60), min_size=1, max_size=25, unique=True),
    st.sampled_from([0.1, 0.25, 0.3, 1.0]),
    st.sampled_from([0.0, 0.05, 1.0]),
    st.sampled_from([0.2, 0.5, 2.0]),
)
def test_agrees_with_slow_twin(
    first: list[int], second: list[int], period_s: float, first_s: float, max_gap_s: float
) -> None:
    rows = [("a", "car", 0.1 * tick, 1.7 * tick, 0.0) for tick in first]
    rows += [("b", "car", 0.1 * tick, 300.0 - tick, 0.0) for tick in second]
    tracks = cleaned(*rows)
    n_frames = int((5.9 - first_s) / period_s) + 1
    boxes = resample(tracks, first_s, period_s, n_frames, max_gap_s)
    expected = slow_positions(tracks, first_s, period_s, n_frames, max_gap_s)
    actual = dict(zip(zip(boxes.frame.tolist(), boxes.track.tolist(), strict=True), boxes.x_m.tolist(), strict=True))
    assert actual.keys() == expected.keys()
    assert actual == pytest.approx(expected, abs=1e-4)
