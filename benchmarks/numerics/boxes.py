"""Compare the voxels that the occupancy counts with exact arithmetic, on a million boxes.

Each box is counted alone, and its voxels are compared with the depth of overlap, in float64 from the fifteen axes of
the separating-axis theorem. (The kernel's path for level boxes clips polygons instead; its path for pitched boxes uses
the same theorem, but not depths.) If a depth is within 1e-8 m of the bound of 0.1 mm, 50-digit arithmetic decides the
pair instead. So every answer is certain, and only a few are slow.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import mpmath
import numba
import numpy as np
from tests.oracles import boxes as oracle

import egvs
from benchmarks.numerics.row import Row
from benchmarks.scenes import recorded_boxes
from egvs.artefacts.frame_boxes import FrameBoxes
from egvs.core.grid import Grid
from egvs.kernels import occupancy
from egvs.scoring.occupancy import count_occupancy

ROOT = Path(__file__).resolve().parents[2]
RULE = "depth > 0.1 mm + 1 nm"
UNSURE_M = 1e-8

_kernel = numba.njit(nogil=True, error_model="numpy", cache=True)


@_kernel
def _prepare(box, axes, normals):
    """Fill the axes of a box and the fifteen candidate normals."""
    cy, sy, cp, sp = np.cos(box[3]), np.sin(box[3]), np.cos(box[4]), np.sin(box[4])
    axes[0, 0], axes[0, 1], axes[0, 2] = cy * cp, sy * cp, sp
    axes[1, 0], axes[1, 1], axes[1, 2] = -sy, cy, 0.0
    axes[2, 0], axes[2, 1], axes[2, 2] = -cy * sp, -sy * sp, cp
    normals[:] = 0.0
    for a in range(3):
        normals[a, a] = 1.0
        normals[3 + a] = axes[a]
        x, y, z = axes[a, 0], axes[a, 1], axes[a, 2]
        normals[6 + a, 1], normals[6 + a, 2] = -z, y
        normals[9 + a, 0], normals[9 + a, 2] = z, -x
        normals[12 + a, 0], normals[12 + a, 1] = -y, x


@_kernel
def _depth(box, axes, normals, low, voxel_m):
    deepest = 0.5 * min(box[5], box[6], box[7])
    for n in range(15):
        size = abs(normals[n, 0]) + abs(normals[n, 1]) + abs(normals[n, 2])
        if size < 1e-200:
            continue
        gap, reach, along = 0.0, 0.5 * voxel_m * size, 0.0
        for a in range(3):
            gap += (low[a] + 0.5 * voxel_m - box[a]) * normals[n, a]
            shadow = abs(axes[a, 0] * normals[n, 0] + axes[a, 1] * normals[n, 1] + axes[a, 2] * normals[n, 2])
            reach += 0.5 * box[5 + a] * shadow
            along += shadow
        deepest = min(deepest, (reach - abs(gap)) / along)
    return deepest


@_kernel
def depth_in(box, low, voxel_m):
    """Return the depth of a box in the voxel at ``low``."""
    axes, normals = np.empty((3, 3)), np.empty((15, 3))
    _prepare(box, axes, normals)
    return _depth(box, axes, normals, low, voxel_m)


@_kernel
def compare(values, shape, voxel_m, ambiguous, nearest):
    """Count each box by itself and compare.

    Returns how many voxels differ, how many pairs there were, and how many entries of ``ambiguous`` (box, ix, iy, iz,
    what the kernel says) are filled: pairs within UNSURE_M of the bound. ``nearest`` gets each box's least distance of
    a depth to the bound."""
    nx, ny, nz = shape[0], shape[1], shape[2]
    steps, last_frame = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)
    axes, normals, low = np.empty((3, 3)), np.empty((15, 3)), np.empty(3)
    first, last, frame = np.empty(3, np.int64), np.empty(3, np.int64), np.zeros(1, np.int64)
    wrong, pairs, n = 0, 0, 0
    for b in range(values.shape[0]):
        box = values[b]
        steps[:] = 0
        frame[0] = b
        occupancy.count_boxes(frame, values[b : b + 1], shape, voxel_m, steps, last_frame)
        occupancy.sum_layers(steps)
        _prepare(box, axes, normals)
        for a in range(3):
            reach = 0.01
            for i in range(3):
                reach += 0.5 * box[5 + i] * abs(axes[i, a])
            first[a] = np.int64(min(max(np.floor((box[a] - reach) / voxel_m), 0.0), float(shape[a])))
            last[a] = np.int64(min(max(np.ceil((box[a] + reach) / voxel_m), 0.0), float(shape[a])))
        nearest[b] = np.inf
        inside = 0
        for ix in range(first[0], last[0]):
            for iy in range(first[1], last[1]):
                for iz in range(first[2], last[2]):
                    low[0], low[1], low[2] = ix * voxel_m, iy * voxel_m, iz * voxel_m
                    deep = _depth(box, axes, normals, low, voxel_m)
                    counted = steps[iz, ix, iy]
                    inside += counted
                    pairs += 1
                    nearest[b] = min(nearest[b], abs(deep - 1e-4))
                    if abs(deep - 1e-4) <= UNSURE_M:
                        if n < ambiguous.shape[0]:
                            ambiguous[n, 0], ambiguous[n, 1], ambiguous[n, 2], ambiguous[n, 3], ambiguous[n, 4] = (
                                b,
                                ix,
                                iy,
                                iz,
                                counted,
                            )
                        n += 1
                    else:
                        wrong += counted != (1 if deep > 1e-4 else 0)
        wrong += abs(steps[:nz].sum() - inside)  # nothing outside the box's own bounds
    return wrong, pairs, n


def check(values, shape, voxel_m):
    """Return numbers of pairs: all, decided in 50 digits, within 1e-10 m of the bound, and wrong."""
    ambiguous, nearest = np.empty((40 * len(values) + 100, 5), np.int64), np.empty(len(values))
    wrong, pairs, n = compare(values, np.asarray(shape, np.int64), voxel_m, ambiguous, nearest)
    assert n <= len(ambiguous)
    excluded = 0
    with mpmath.workdps(oracle.DIGITS):
        bound, margin, voxel = mpmath.mpf(100001) / 10**9, mpmath.mpf(1) / 10**10, mpmath.mpf(voxel_m)
        for b, ix, iy, iz, counted in ambiguous[:n].tolist():
            exact = oracle.depth(*oracle.exact_box(values[b]), [ix * voxel, iy * voxel, iz * voxel], voxel) - bound
            if abs(exact) <= margin:
                excluded += 1
            else:
                wrong += counted != (exact > 0)
    return pairs, n, excluded, wrong


def hostile(rng, n, shape, voxel_m):
    """Return boxes (n, 8) with sides at or near voxel faces, yaw at or near multiples of 45 degrees, thin, huge."""
    span = np.asarray(shape, float)
    centre_m = np.rint(rng.uniform(-1, 1, (n, 3)) + rng.uniform(0, 1, (n, 3)) * 2 * span) * voxel_m / 2
    offset = rng.choice([0.0, 1e-4, -1e-4, 0.9e-4, 1.1e-4, 1e-9, -1e-9, 1e-4 + 3e-9, 1e-4 - 3e-9, 1e-4 + 1e-7], (n, 3))
    centre_m = np.where(rng.random((n, 3)) < 0.5, centre_m + offset, centre_m)
    centre_m = np.where(rng.random((n, 3)) < 0.3, np.nextafter(centre_m, rng.choice([-99.0, 99.0], (n, 3))), centre_m)
    free = rng.uniform(-0.2, 1.2, (n, 3)) * span * voxel_m
    centre_m = np.where(rng.random((n, 1)) < 0.3, free, centre_m)
    yaw = rng.integers(-8, 9, n) * np.pi / 4
    yaw = np.where(rng.random(n) < 0.5, np.nextafter(yaw, rng.choice([-9.0, 9.0], n)), yaw)
    yaw = np.where(rng.random(n) < 0.4, rng.uniform(-7, 7, n), yaw)
    pitch = rng.choice([0.0, 0.0, 0.0, -0.0, 1e-310, 1e-17, -1e-13, 1e-12, 1e-9, 1e-5, 0.05, np.pi / 4, -np.pi / 2], n)
    pitch = np.where(rng.random(n) < 0.2, rng.uniform(-0.4, 0.4, n), pitch)
    size = np.where(rng.random((n, 3)) < 0.5, rng.integers(1, 7, (n, 3)) * voxel_m, 10 ** rng.uniform(-3, 0.5, (n, 3)))
    size = np.where(rng.random((n, 3)) < 0.03, 50.0, size)
    return np.column_stack([centre_m, yaw, pitch, size])


def vehicles(rng, n, shape, voxel_m):
    """Return boxes (n, 8) as in traffic: random positions and headings, sizes of cars, mostly level."""
    span = np.asarray(shape, float) * voxel_m
    centre_m = rng.uniform(-0.1, 1.1, (n, 3)) * span
    size = rng.uniform([1.0, 0.5, 0.5], [5.0, 2.5, 3.5], (n, 3))
    centre_m[:, 2] = size[:, 2] / 2
    return np.column_stack(
        [centre_m, rng.uniform(-np.pi, np.pi, n), np.where(rng.random(n) < 0.7, 0.0, rng.uniform(-0.1, 0.1, n)), size]
    )


def hunt(case, make, seed, n, shape, voxel_m):
    """Check ``n`` boxes, some thousands at a time, and return a row."""
    rng = np.random.default_rng(seed)
    done = pairs = exact_pairs = excluded = wrong = 0
    while done < n:
        size = min(n - done, 5_000)
        result = check(np.ascontiguousarray(make(rng, size, shape, voxel_m)), shape, voxel_m)
        pairs, exact_pairs, excluded, wrong, done = (
            pairs + result[0],
            exact_pairs + result[1],
            excluded + result[2],
            wrong + result[3],
            done + size,
        )
    return Row(
        case,
        RULE,
        f"depth from 15 axes; {exact_pairs} of {pairs} pairs in 50 digits",
        done,
        excluded,
        wrong,
        f"{excluded} pairs within 1e-10 m of the bound",
    )


def real(scale):
    """Check simulated traffic: every box, and the counts after moving all boxes by 1e-9 m along each axis."""
    frames = max(100, round(5000 * min(scale, 1.0) / 100) * 100)
    scenario = egvs.load(ROOT / "scenarios" / "nishishinjuku", [f"traffic.frames={frames}"])
    grid, recorded = scenario.roi.grid, recorded_boxes(scenario)
    frame, values = recorded.frame, recorded.values
    ambiguous, nearest = np.empty((len(values), 5), np.int64), np.empty(len(values))
    selected = np.ascontiguousarray(values[:: max(1, round(1 / max(scale, 1e-9) / 2))])
    wrong, pairs, _ = compare(selected, np.asarray(grid.shape, np.int64), grid.voxel_m, ambiguous, nearest)
    close = int((nearest[: len(selected)] <= 1e-9).sum())
    before = count_occupancy(recorded, grid, frames)
    turned = 0
    for axis in range(3):
        for sign in (-1, 1):
            moved = values + sign * 1e-9 * np.eye(8)[axis]
            turned += int((count_occupancy(FrameBoxes(frame, moved), grid, frames) != before).sum())
    return [
        Row(
            "boxes of nishishinjuku",
            RULE,
            f"depth from 15 axes, {pairs} pairs",
            len(selected),
            close,
            wrong,
            f"nearest to the bound {nearest[: len(selected)].min():.1e} m",
        ),
        Row(
            "boxes of nishishinjuku moved by 1e-9 m, 6 ways",
            "no count may change",
            "the same kernel",
            6 * len(values),
            0,
            turned,
            f"{turned} counts changed",
        ),
    ]


def in_decimals(scale):
    """Upright boxes whose sides lie on planes, or 0.1 mm before or behind one to the last digit, moved by tenths of a
    metre, in voxels of 0.1, 0.2 and 0.3 m: each against fractions of the decimals."""
    rng, n = np.random.default_rng(24), max(60, round(40_000 * scale))
    shape, mismatches, on_bound, done = (7, 6, 5), 0, 0, 0
    shrink = Fraction(100001, 10**9)
    for _ in range(n):
        tenths = int(rng.integers(1, 4))
        voxel, moved = Fraction(tenths, 10), Fraction(int(rng.integers(-40_000, 40_000)), 10)
        offset = rng.choice([0, 1, -1, 2, 1000], (2, 3))
        low, high = np.sort(rng.integers(-2, np.array(shape) + 3, (2, 3)), axis=0)
        sides = [
            [tenths * int(k) * Fraction(1, 10) + int(b) * Fraction(1, 10**4) for k, b in zip(ks, bs, strict=True)]
            for ks, bs in zip((low, high + 1), offset, strict=True)
        ]
        if min(b - a for a, b in zip(*sides, strict=True)) < Fraction(1, 100):
            continue  # no box
        done, on_bound = done + 1, on_bound + bool((np.abs(offset) == 1).any())
        centre = [float((a + b) / 2 + moved) for a, b in zip(*sides, strict=True)]
        size = [float(b - a) for a, b in zip(*sides, strict=True)]
        grid = Grid((float(moved),) * 3, float(voxel), shape)
        values = np.array([[*grid.to_grid_m(np.array(centre)), 0.0, 0.0, *size]])
        expected = np.zeros(shape, np.int32)
        spans = [
            [i for i in range(count_) if a + shrink < (i + 1) * voxel and b - shrink > i * voxel]
            for a, b, count_ in zip(*sides, shape, strict=True)
        ]
        expected[np.ix_(*spans)] = 1
        mismatches += bool((count_occupancy(FrameBoxes(np.zeros(1, np.int64), values), grid, 1) != expected).any())
    tested = f"rational arithmetic on the decimals; {on_bound} with a side on the bound of 0.1 mm"
    return Row("boxes with sides on planes of 0.1 to 0.3 m, moved by tenths", RULE, tested, done, 0, mismatches, "-")


def rows(scale: float) -> list[Row]:
    """Run all checks of the occupancy; scale 1 is the complete run."""

    def selected(n):
        return max(50, round(n * scale))

    return [
        hunt("adversarial boxes, 0.25 m", hostile, 21, selected(500_000), (8, 7, 5), 0.25),
        hunt("adversarial boxes, 0.1 m", hostile, 22, selected(200_000), (9, 8, 7), 0.1),
        hunt("random vehicles", vehicles, 23, selected(300_000), (24, 20, 12), 0.25),
        in_decimals(scale),
        *real(scale),
    ]
