"""Gaps in recorded tracks: counts that a person can check, and a slow twin for the voxels on the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from egvs.artefacts.frame_boxes import UNKNOWN_BOXES_KEY
from egvs.core.grid import Grid
from egvs.scoring.unknown_occupancy import UnknownOccupancy

GRID = Grid((10.0, -5.0, 0.0), 1.0, (20, 10, 3))


def gap(frames: list[int], start_m: list[float], end_m: list[float], **values: Any) -> dict[str, Any]:
    return {"frames": frames, "start_m": start_m, "end_m": end_m, "yaw_rad": 0.0, "size_m": [4.0, 1.8]} | values


def unknown(*gaps: dict[str, Any]) -> UnknownOccupancy:
    return UnknownOccupancy.from_metadata({UNKNOWN_BOXES_KEY: list(gaps)}, GRID)


def block(count: int) -> np.ndarray:
    return np.full(GRID.shape, count, dtype=np.int32)


def test_voxels_on_the_way() -> None:
    """From x = 14 to 18 m, 4 m long: x from 12 to 20 m. 1.8 m wide about y = -0.5 m: from -1.4 to 0.4 m."""
    (swept,) = unknown(gap([0, 5], [14.0, -0.5], [18.0, -0.5])).gaps
    ix, iy, iz = np.unravel_index(swept.cells, GRID.shape)
    assert (sorted(set(ix.tolist())), sorted(set(iy.tolist()))) == (list(range(2, 10)), [3, 4, 5])
    assert set(iz.tolist()) == {0, 1, 2}


def test_gap_that_leads_far_away_is_cut_at_the_grid() -> None:
    """A wrong row at the origin of UTM: 5,600 km away."""
    near, far = (unknown(gap([0, 5], [14.0, -0.5], [end_m, -0.5])).gaps[0] for end_m in (60.0, 5.6e6))
    np.testing.assert_array_equal(far.cells, near.cells)
    assert unknown(gap([0, 5], [500.0, 0.0], [5.6e6, 0.0])).gaps[0].cells.size == 0
    standing = unknown(gap([0, 5], [14.0, -0.5], [14.0, -0.5])).gaps[0]
    assert standing.cells.size == 4 * 3 * 3


def test_share_is_that_of_the_known_frames() -> None:
    """Unknown in 20 of 100 frames, occupied in 40 of the 80 others: 50 % of 100 frames."""
    counts = block(40)
    gaps = unknown(gap([30, 50], [14.0, -0.5], [18.0, -0.5]))
    gaps.adjust(counts, 0, 100)
    assert counts[5, 4, 1] == 50
    assert counts[15, 4, 1] == 40
    assert gaps.summary() == {"unknown_gaps": 1, "scaled_voxels": 8 * 3 * 3, "unknown_voxels": 0}


def test_empty_voxel_stays_empty() -> None:
    counts = block(0)
    unknown(gap([30, 50], [14.0, -0.5], [18.0, -0.5])).adjust(counts, 0, 100)
    assert not counts.any()


def test_voxel_that_is_mostly_unknown_is_left_out() -> None:
    counts = block(10)
    gaps = unknown(gap([0, 51], [14.0, -0.5], [18.0, -0.5]))
    gaps.adjust(counts, 0, 100)
    assert counts[5, 4, 1] == 0
    assert gaps.left_out == 8 * 3 * 3


def test_count_never_exceeds_the_frames() -> None:
    """Occupied by others in 90 frames, some of which are frames of the gap."""
    counts = block(90)
    unknown(gap([0, 40], [14.0, -0.5], [18.0, -0.5])).adjust(counts, 0, 100)
    assert counts.max() == 100


def test_only_the_frames_in_the_block_count() -> None:
    """Ten of the gap's frames are in the first block of 100, thirty in the second one, none in the third."""
    gaps = unknown(gap([90, 130], [14.0, -0.5], [18.0, -0.5]))
    results = []
    for first_frame in (0, 100, 200):
        counts = block(36)
        gaps.adjust(counts, first_frame, 100)
        results.append(int(counts[5, 4, 1]))
    assert results == [40, 51, 36]


def test_traffic_without_gaps_is_unchanged() -> None:
    counts = block(7)
    gaps = UnknownOccupancy.from_metadata({}, GRID)
    gaps.adjust(counts, 0, 100)
    assert (counts == 7).all()
    assert gaps.summary() == {}


@pytest.mark.slow
@given(
    st.tuples(st.floats(5, 35), st.floats(-8, 8)),
    st.tuples(st.floats(5, 35), st.floats(-8, 8)),
    st.floats(-3.1, 3.1),
)
def test_agrees_with_slow_twin(start_m: tuple[float, float], end_m: tuple[float, float], yaw_rad: float) -> None:
    """The exact sweep of a box that does not turn is the convex hull of its two ends; only thin slivers may differ."""
    (swept,) = unknown(gap([0, 5], list(start_m), list(end_m), yaw_rad=yaw_rad)).gaps
    turn = np.array([[np.cos(yaw_rad), np.sin(yaw_rad)], [-np.sin(yaw_rad), np.cos(yaw_rad)]])
    corners = np.array([[2.0, 0.9], [2.0, -0.9], [-2.0, -0.9], [-2.0, 0.9]]) @ turn
    hull = shapely.MultiPoint(np.concatenate([corners + start_m, corners + end_m])).convex_hull
    expected = np.zeros(GRID.shape[:2])
    for ix in range(GRID.shape[0]):
        for iy in range(GRID.shape[1]):
            cell = shapely.box(10.0 + ix, -5.0 + iy, 11.0 + ix, -4.0 + iy)
            expected[ix, iy] = shapely.intersection(hull, cell).area
    actual = np.zeros(GRID.shape, dtype=bool)
    actual.reshape(-1)[swept.cells] = True
    plan = actual[:, :, 0]
    assert (actual == plan[:, :, None]).all()
    assert not plan[expected == 0].any()
    assert plan[expected > 0.15].all()
