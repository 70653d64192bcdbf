"""Cleaning of recorded tracks: each rule on a few rows that a person can check."""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.extensions.tracks.cleaning import CleanTracks, clean_tracks
from egvs.extensions.tracks.model import Tracks
from egvs.traffic.class_sizes import CLASS_SIZES
from tests.extensions.tracks.rows import make_tracks, straight


def clean(tracks: Tracks) -> CleanTracks:
    return clean_tracks(tracks, CLASS_SIZES)


def test_rows_are_sorted_by_track_and_time() -> None:
    tracks = make_tracks(("b", "car", 1.0, 1, 0), ("a", "car", 2.0, 2, 0), ("a", "car", 1.0, 1, 0))
    cleaned = clean(tracks)
    assert cleaned.names == ("a", "b")
    np.testing.assert_array_equal(cleaned.track, [0, 0, 1])
    np.testing.assert_array_equal(cleaned.time_s, [1.0, 2.0, 1.0])


def test_rows_without_time_or_position_are_dropped_and_counted() -> None:
    rows = [*straight("a", "car", [0.0, 0.1], 10.0), ("a", "car", math.nan, 0.0, 0.0), ("a", "car", 0.2, math.nan, 0.0)]
    cleaned = clean(make_tracks(*rows))
    assert cleaned.track.size == 2
    assert (cleaned.report.rows, cleaned.report.dropped_rows) == (4, 2)


def test_drops_second_row_at_same_time() -> None:
    cleaned = clean(make_tracks(("a", "car", 0.0, 0.0, 0.0), ("a", "car", 0.0, 9.0, 0.0), ("a", "car", 0.1, 1.0, 0.0)))
    np.testing.assert_array_equal(cleaned.x_m, [0.0, 1.0])
    assert cleaned.report.duplicates == 1


def test_track_is_cut_where_it_jumps() -> None:
    """50 m in 0.1 s are 500 m/s; 5 m in 0.1 s are 50 m/s, which a fast car drives."""
    cleaned = clean(make_tracks(*[("a", "car", 0.1 * k, x_m, 0.0) for k, x_m in enumerate([0.0, 5.0, 55.0, 60.0])]))
    np.testing.assert_array_equal(cleaned.part, [0, 0, 1, 1])
    assert cleaned.report.jumps == 1


def test_size_is_the_median_of_the_track() -> None:
    rows = straight("a", "car", [0.0, 0.1, 0.2], 10.0)
    cleaned = clean(make_tracks(*rows, length_m=[4.0, 4.2, 9.0], width_m=[1.8, 1.8, 1.8], height_m=[1.4, 1.4, 1.4]))
    np.testing.assert_allclose(cleaned.size_m, [[4.2, 1.8, 1.4]])
    assert cleaned.report.filled_sizes == {}


@pytest.mark.parametrize("missing", [0.0, math.nan, -1.0])
def test_missing_size_is_that_of_the_class(missing: float) -> None:
    rows = straight("walker", "pedestrian", [0.0, 0.1], 1.0)
    cleaned = clean(make_tracks(*rows, length_m=[missing] * 2, width_m=[missing] * 2))
    np.testing.assert_allclose(cleaned.size_m, [[0.8, 0.6, 1.73]])
    assert cleaned.report.filled_sizes == {f"pedestrian: {key}": 1 for key in ("length_m", "width_m", "height_m")}


def test_heading_comes_from_the_motion() -> None:
    """A vehicle drives 10 m to the north, and waits: it still faces north."""
    y_m = [*np.arange(0.0, 11.0), *[10.0] * 10]
    cleaned = clean(make_tracks(*[("a", "car", 0.2 * k, 3.0, y) for k, y in enumerate(y_m)]))
    np.testing.assert_allclose(cleaned.yaw_rad, np.pi / 2, atol=1e-12)
    assert cleaned.report.headings_from_motion == len(y_m)


def test_noise_of_a_standing_road_user_gives_no_heading() -> None:
    rng = np.random.default_rng(1)
    noise_m = rng.normal(scale=0.05, size=(200, 2))
    waits = [("a", "car", 0.1 * k, 20.0 + x, y) for k, (x, y) in enumerate(noise_m)]
    drives = [("a", "car", 20.0 + 0.1 * k, 20.0 + k, 0.0) for k in range(20)]
    cleaned = clean(make_tracks(*waits, *drives))
    off_rad = np.abs(np.angle(np.exp(1j * cleaned.yaw_rad)))
    assert np.median(off_rad) < 0.1


def test_road_user_that_never_moves_points_east_and_is_counted() -> None:
    cleaned = clean(make_tracks(*straight("parked", "car", [0.0, 0.1, 0.2], 0.0)))
    np.testing.assert_array_equal(cleaned.yaw_rad, 0.0)
    assert cleaned.report.headings_unknown == 3


def test_heading_against_the_motion_is_turned() -> None:
    """At 10 m/s a heading of 170 degrees is wrong by more than 90 degrees; at 1 m/s a car may reverse."""
    times_s = [0.1 * k for k in range(21)]
    yaw_rad = [math.radians(170.0)] * len(times_s)
    fast = clean(make_tracks(*straight("a", "car", times_s, 10.0), yaw_rad=yaw_rad))
    slow = clean(make_tracks(*straight("a", "car", times_s, 1.0), yaw_rad=yaw_rad))
    turned = np.rad2deg(np.angle(np.exp(1j * fast.yaw_rad)))
    assert fast.report.flipped_headings == (np.isclose(turned, -10.0)).sum() >= 19
    assert slow.report.flipped_headings == 0


def test_recorded_headings_are_unchanged() -> None:
    cleaned = clean(make_tracks(*straight("a", "car", [0.0, 0.1], 10.0), yaw_rad=[0.2, 0.3]))
    np.testing.assert_array_equal(cleaned.yaw_rad, [0.2, 0.3])
    assert cleaned.report.headings_given == 2


def test_recorded_heights_are_reported() -> None:
    """Centres at 100.75 m, and one 1 m higher, of boxes of 1.5 m: bottoms at 100 m; the median deviation is 0."""
    rows = straight("a", "car", [0.0, 0.1, 0.2], 10.0)
    tracks = make_tracks(*rows, z_m=[100.75, 100.75, 101.75], height_m=[1.5] * 3)
    report = clean(tracks).report
    assert (report.rows_with_height, report.bottom_height_m, report.height_scatter_m) == (3, 100.0, 0.0)
    report = clean(make_tracks(*rows, z_m=[100.75, 100.95, 100.55], height_m=[1.5] * 3)).report
    assert report.height_scatter_m == pytest.approx(1.4826 * 0.2, abs=1e-3)
    assert clean(make_tracks(*rows)).report.rows_with_height == 0


def test_usual_step_is_the_median() -> None:
    cleaned = clean(make_tracks(*straight("a", "car", [0.0, 0.1, 0.2, 0.3, 5.0], 1.0)))
    assert cleaned.report.step_s == 0.1


def test_class_of_a_track_is_that_of_most_rows() -> None:
    tracks = make_tracks(("a", "van", 0.0, 0, 0), ("a", "car", 0.1, 0, 0), ("a", "van", 0.2, 0, 0))
    assert tracks.classes == ("van",)
