"""Is what is left of each voxel's hits what the function of range says, asked voxel by voxel?"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

from egvs.core.grid import Grid
from egvs.kernels import hits as hit_kernels
from egvs.scoring.visibility import TOLERANCE, ByRange, RangeTable

GRID = Grid((0.0, 0.0, 0.0), 0.5, (30, 20, 6))
WHOLE = 2**32
ALL = np.arange(math.prod(GRID.shape))

FUNCTIONS: dict[str, ByRange] = {
    "nothing is lost": np.ones_like,
    "everything is lost": np.zeros_like,
    "a constant": lambda r: np.full(len(r), 0.3),
    "rain": lambda r: np.exp(-0.02 * r),
    "thick fog": lambda r: np.exp(-3.0 * r),
    "a soft limit nearby": lambda r: ndtr(2 * np.log(2.5 / np.maximum(r, 1e-300)) / 0.05),
    "a hard limit": lambda r: (r <= 7.25).astype(float),
    "a blind zone": lambda r: np.where(r < 1.5, 0.0, 1.0),
    "a kink": lambda r: np.minimum(1.0, 4.0 / np.maximum(r, 1e-300)),
    "narrow bands": lambda r: 0.5 + 0.5 * np.sin(700 * r) ** 2,
}
SENSORS = {
    "inside": (7.1, 3.3, 1.2),
    "in the middle of a voxel": (7.25, 3.25, 1.25),
    "on a corner of the grid": (0.0, 0.0, 0.0),
    "beside and above": (-3.0, 12.5, 6.0),
    "far away": (4e5, -3e6, 20.0),
}


def asked(function: ByRange, sensor_m: tuple[float, float, float]) -> np.ndarray:
    """The function at the centre of every voxel, one by one."""
    found = []
    for index in np.ndindex(GRID.shape):
        centre = [(i + 0.5) * GRID.voxel_m for i in index]
        found.append(float(function(np.array([math.dist(centre, sensor_m)]))[0]))
    return np.array(found)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_voxel_is_thinned_by_its_range(name: str, sensor: str) -> None:
    o_m, hits = np.array(SENSORS[sensor]), np.random.default_rng(1).integers(0, 9, math.prod(GRID.shape))
    hits[:3] = 0, 2**20, 1
    table, thinned = RangeTable.over(FUNCTIONS[name], o_m, GRID), np.empty(len(hits), dtype=np.int64)
    table.thin(hits.astype(np.uint32), WHOLE, o_m / GRID.voxel_m, GRID, ALL, thinned)
    # From afar a rounding of the range is 1e-9 m, and these functions are not that smooth.
    steep = 1e-9 * 700 if sensor == "far away" else 1e-12 * 700
    off = np.abs(thinned - hits * WHOLE * asked(FUNCTIONS[name], SENSORS[sensor]))
    assert (off <= 0.5 + hits * WHOLE * (1.1 * TOLERANCE + steep)).all()
    weighted = hits * WHOLE
    table.thin(weighted, 1, o_m / GRID.voxel_m, GRID, ALL, weighted)
    assert weighted.tolist() == thinned.tolist()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_only_requested_voxels_are_changed(name: str) -> None:
    o_m, hits = np.array(SENSORS["inside"]), np.random.default_rng(2).integers(0, 9, len(ALL)).astype(np.uint32)
    table, whole, some = RangeTable.over(FUNCTIONS[name], o_m, GRID), np.empty(len(ALL), np.int64), ALL[5::7]
    table.thin(hits, WHOLE, o_m / GRID.voxel_m, GRID, ALL, whole)
    thinned = np.full(len(ALL), -77)
    table.thin(hits, WHOLE, o_m / GRID.voxel_m, GRID, some, thinned)
    assert thinned[some].tolist() == whole[some].tolist()
    assert (np.delete(thinned, some) == -77).all()


def test_a_limit_is_met_to_the_last_bit() -> None:
    """Centres at 0.5, 1.0, ... from a sensor in the middle of the first voxel: 7.0 counts, one bit less does not."""
    o, ones = np.array([0.5, 0.5, 0.5]), np.ones(math.prod(GRID.shape), dtype=np.uint32)
    for limit_m, seen in ((7.0, 15), (math.nextafter(7.0, 0.0), 14)):
        table = RangeTable.over(lambda r, limit_m=limit_m: (r <= limit_m).astype(float), o * GRID.voxel_m, GRID)
        thinned = np.empty(len(ones), dtype=np.int64)
        table.thin(ones, WHOLE, o, GRID, ALL, thinned)
        assert thinned.reshape(GRID.shape)[:, 0, 0].tolist() == [WHOLE] * seen + [0] * (30 - seen)


def test_a_smooth_function_is_evaluated_seldom_and_a_rough_one_for_each_voxel() -> None:
    calls: list[int] = []

    def counted(function: ByRange) -> ByRange:
        return lambda r: calls.append(len(r)) or function(r)  # type: ignore[func-returns-value]

    o_m, hits = np.array(SENSORS["inside"]), np.ones(math.prod(GRID.shape), dtype=np.uint32)
    for name, most in (("rain", 0), ("a hard limit", 60), ("narrow bands", len(hits))):
        calls.clear()
        table = RangeTable.over(counted(FUNCTIONS[name]), o_m, GRID)
        tried, thinned = len(calls), np.empty(len(hits), dtype=np.int64)
        table.thin(hits, WHOLE, o_m / GRID.voxel_m, GRID, ALL, thinned)
        assert sum(calls[tried:]) <= most
        assert tried == (1 if name != "narrow bands" else 3)


def thin_by_hand(
    hits: np.ndarray,
    unit: int,
    o: np.ndarray,
    cubics: np.ndarray,
    cells: np.ndarray,
    near: float,
    per_voxel: float,
) -> list[int]:
    """The formula of the kernel, voxel by voxel in Python's floats, which are those of the kernel."""
    result = []
    for cell in cells.tolist():
        ix, iy, iz = (int(i) for i in np.unravel_index(cell, GRID.shape))
        squared = (ix + 0.5 - o[0]) ** 2 + (iy + 0.5 - o[1]) ** 2 + (iz + 0.5 - o[2]) ** 2
        s = math.sqrt(squared) * per_voxel - near
        piece = min(max(int(s), 0), len(cubics) - 1)
        a, b, c, d = cubics[piece].tolist()
        s -= piece
        share, amount = ((d * s + c) * s + b) * s + a, int(hits[cell]) * unit
        result.append(-1 - amount if math.isnan(share) else round(share * amount))  # halves to even
    return result


@pytest.mark.parametrize("order", ["ascending", "shuffled", "one", "none"])
@pytest.mark.parametrize("sensor", ["inside", "beside and above"])
def test_the_kernel_agrees_with_python_to_the_last_bit(sensor: str, order: str) -> None:
    generator = np.random.default_rng(3)
    cells = {"ascending": ALL[::3], "shuffled": generator.permutation(ALL), "one": ALL[-1:], "none": ALL[:0]}[order]
    hits = generator.integers(0, 4, len(ALL)).astype(np.uint32)
    cubics = generator.uniform(-0.5, 0.5, (16, 4))
    cubics[[3, 7]] = np.nan
    o = np.array(SENSORS[sensor]) / GRID.voxel_m
    per_m, near_m = 1.0625, 0.8
    shape, thinned = np.asarray(GRID.shape), np.full(len(ALL), -7)
    unknown = hit_kernels.thin_by_range(hits, WHOLE, o, shape, GRID.voxel_m, near_m, per_m, cubics, cells, thinned)
    expected = thin_by_hand(hits, WHOLE, o, cubics, cells, near_m * per_m, GRID.voxel_m * per_m)
    assert thinned[cells].tolist() == expected
    assert unknown == sum(value < 0 and value % WHOLE == WHOLE - 1 for value in expected)
    assert (np.delete(thinned, cells) == -7).all()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_cubics_go_through_four_points_and_are_checked_at_three(name: str) -> None:
    """As with whole arrays in NumPy, to the last bit; here each piece has its own seven points."""
    near_m, far_m, pieces = 1.5, 18.7, 64
    nodes = np.arange(pieces)[:, None] + np.arange(7) / 6
    values = FUNCTIONS[name]((near_m + nodes * ((far_m - near_m) / pieces)).ravel()).reshape(pieces, 7)
    through = np.array([[2, 0, 0, 0], [-11, 18, -9, 2], [18, -45, 36, -9], [-9, 27, -27, 9]]) / 2
    expected = (values[:, ::2, None] * through.T).sum(axis=1)
    s = np.arange(1, 6, 2) / 6
    between = ((expected[:, 3:] * s + expected[:, 2:3]) * s + expected[:, 1:2]) * s + expected[:, :1]
    expected[~(np.abs(between - values[:, 1::2]) <= TOLERANCE).all(axis=1)] = np.nan

    cubics, each = np.empty((pieces, 4)), np.append(values[:, :6], values[-1, 6])
    rejected = hit_kernels.fit_cubics(each, through, TOLERANCE, cubics)
    assert np.array_equal(cubics, expected, equal_nan=True)
    assert rejected == np.isnan(expected[:, 0]).sum()
