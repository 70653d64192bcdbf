"""Compare the voxels of the march with exact arithmetic, on millions of segments.

Most segments are decided by sorted crossings in float64, which share only the formula of a crossing with the march:
the crossings of all planes are sorted, and the middle between two of them decides the voxel. If a piece is within
2e-8 m of the bound of 1 micrometre, or its middle is closer to a plane than rounding could move it, the rational oracle
decides the segment instead. So every answer is certain, and only a few are slow.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numba
import numpy as np
from tests.oracles import march as oracle

import egvs
from benchmarks.numerics.row import Row
from egvs.core.grid import Grid
from egvs.kernels import traversal
from egvs.sensors.scanner import Scanner

ROOT = Path(__file__).resolve().parents[2]
SCENES = ("nishishinjuku", "ingolstadt")
RULE = "chord > 1e-6 m"
FAR_M = 1e7

_kernel = numba.njit(nogil=True, error_model="numpy", cache=True)


@_kernel
def crossing_times(o, d, shape, times):
    """Fill ``times`` with 0, 1 and the crossings of all planes between; return their number."""
    n = 2
    times[0], times[1] = 0.0, 1.0
    for a in range(3):
        if d[a] == 0.0:
            continue
        for k in range(shape[a] + 1):
            t = (k - o[a]) / d[a]
            if 0.0 < t < 1.0:
                times[n] = t
                n += 1
    return n


@_kernel
def cell_at(o, d, shape, t):
    """Cell of a segment's point at ``t``; -1 outside the grid, -2 when rounding could move it across a plane."""
    is_outside, cell = False, 0
    for a in range(3):
        x = o[a] + t * d[a]
        k = np.floor(x)
        if d[a] != 0.0:
            error = 1e-15 * (abs(o[a]) + abs(t * d[a]))
            if min(x - k, k + 1.0 - x) <= error:
                if -1.0 <= k <= shape[a]:
                    return -2
                is_outside = True
        if not 0.0 <= x < shape[a]:
            is_outside = True
        else:
            cell = cell * shape[a] + np.int64(k)
    return -1 if is_outside else cell


@_kernel
def sorted_cells(o, d, shape, voxel_m, times, cells):
    """Fill ``cells`` with those of one segment, by sorted crossings; return their number, or -1 if uncertain."""
    size = max(abs(d[0]), abs(d[1]), abs(d[2]))
    if size == 0.0 or size > 1e150 or size < 1e-150:
        return -1
    length = size * np.sqrt((d[0] / size) ** 2 + (d[1] / size) ** 2 + (d[2] / size) ** 2) * voxel_m
    n = crossing_times(o, d, shape, times)
    pieces = np.sort(times[:n])
    count = 0
    margin_m = 2e-8
    for i in range(n - 1):
        chord = (pieces[i + 1] - pieces[i]) * length
        if chord < 1e-6 - margin_m:
            continue
        cell = cell_at(o, d, shape, 0.5 * (pieces[i] + pieces[i + 1]))
        if cell == -1:
            continue
        if cell == -2 or chord < 1e-6 + margin_m:
            return -1
        # Two pieces of one voxel: rounding has put a crossing between them.
        if count > 0 and cells[count - 1] == cell:
            return -1
        cells[count] = cell
        count += 1
    return count


@_kernel
def compare(o, d, shape, voxel_m, verdict):
    """Set a verdict for each segment: 0 the march agrees, 1 it does not, 2 undecided. Return the number of voxels."""
    longest = shape.sum() + 8
    times, expected, cells, t_cells = (
        np.empty(longest),
        np.empty(longest, np.int64),
        np.empty(longest, np.int64),
        np.empty((longest, 2)),
    )
    buffer, crossed = traversal.crossing_buffer(shape), 0
    for i in range(o.shape[0]):
        n = sorted_cells(o[i], d[i], shape, voxel_m, times, expected)
        count, _, _ = traversal.list_voxels(o[i], d[i], shape, voxel_m, cells, t_cells, buffer)
        crossed += count
        verdict[i] = 2 if n < 0 else 0 if n == count and np.all(expected[:n] == cells[:count]) else 1
    return crossed


def settle(o, d, shape, voxel_m):
    """Return the voxels by sorted crossings; None if float64 is not certain."""
    n = np.asarray(shape, np.int64)
    cells = np.empty(n.sum() + 8, np.int64)
    count = sorted_cells(np.asarray(o, float), np.asarray(d, float), n, voxel_m, np.empty(n.sum() + 8), cells)
    if count < 0:
        return None
    return {tuple(int(i) for i in np.unravel_index(c, tuple(n))) for c in cells[:count]}


def walk(o, d, shape, voxel_m):
    """Return the voxels that the march lists."""
    n = np.asarray(shape, np.int64)
    cells, t_cells = np.empty(n.sum() + 8, np.int64), np.empty((n.sum() + 8, 2))
    count, _, _ = traversal.list_voxels(o, d, n, voxel_m, cells, t_cells, traversal.crossing_buffer(n))
    return {tuple(int(i) for i in np.unravel_index(c, tuple(n))) for c in cells[:count]}


def check(o, d, shape, voxel_m):
    """Return how many segments have a chord within 1e-8 m of the bound, are wrong, and were decided by rationals."""
    verdict = np.empty(len(o), np.int64)
    # Contiguous, so that one kernel is compiled for all callers.
    compare(np.ascontiguousarray(o), np.ascontiguousarray(d), np.asarray(shape, np.int64), voxel_m, verdict)
    excluded = mismatches = 0
    for i in np.flatnonzero(verdict):
        wrong = walk(o[i], d[i], shape, voxel_m) ^ oracle.crossed(o[i], d[i], shape, voxel_m)
        ambiguous = oracle.ambiguous(o[i], d[i], shape, voxel_m)
        excluded += bool(ambiguous)
        mismatches += not wrong <= ambiguous
    return excluded, mismatches, int((verdict > 0).sum())


def hostile(rng, n, shape, voxel_m):
    """Return starts and extents (n, 3): lattice points, last bits, 1e-12 to 1e-4 beside, zeros, subnormals, far."""
    span = np.asarray(shape, float)

    def points(size):
        base = np.rint(rng.uniform(-2, 1, (size, 3)) + rng.uniform(0, 1, (size, 3)) * (span + 2))
        kind = rng.integers(0, 8, (size, 3))
        eps = rng.choice([-1.0, 1.0], (size, 3)) * 10.0 ** rng.uniform(-12, -4, (size, 3))
        tiny = rng.choice([5e-324, -5e-324, 1e-310, -1e-310, 0.0, -0.0], (size, 3))
        out = np.where(kind == 1, base + 0.5, base)
        out = np.where(kind == 2, np.nextafter(base, rng.choice([-9.0, 99.0], (size, 3))), out)
        out = np.where(kind == 3, base + eps, out)
        out = np.where(kind == 4, rng.uniform(-2, 2, (size, 3)) + rng.uniform(0, 1, (size, 3)) * span, out)
        return np.where(kind == 5, tiny, out)

    start, end = points(n), points(n)
    kind = rng.integers(0, 12, n)
    same = rng.random((n, 3)) < 0.25
    end = np.where(same, start, end)  # along axes and in planes
    d = end - start
    diagonal = rng.integers(-12, 13, (n, 1)) * rng.choice([-1.0, 0.0, -0.0, 1.0], (n, 3))
    d = np.where((kind == 1)[:, None], diagonal, d)
    d = np.where((kind == 2)[:, None] & same, rng.choice([5e-324, -5e-324, 1e-310, -1e-310, 1e-300], (n, 3)), d)
    away = rng.uniform(-1, 1, (n, 3)) * FAR_M / voxel_m
    far = (kind == 3)[:, None]
    start, d = np.where(far, end + away, start), np.where(far, -away * rng.choice([1.0, 2.0], (n, 1)), d)
    d = np.where((kind == 4)[:, None], away, d)
    back = rng.random(n) < 0.5
    turned = start + d
    return np.where(back[:, None], turned, start), np.where(back[:, None], -d, d)


def uniform(rng, n, shape, voxel_m):
    """Return random segments in and around the grid."""
    del voxel_m
    span = np.asarray(shape, float)
    start, end = rng.uniform(-0.3, 1.3, (2, n, 3)) * span
    return start, end - start


def near_the_bound(rng, n, shape, voxel_m):
    """Segments that cut a corner by 0.5 to 2 micrometres."""
    span = np.asarray(shape, float)
    corner = np.rint(rng.uniform(0.6, 0.99, (n, 3)) * (span - 1))
    corner[:, 2] += 0.5
    u = np.column_stack([rng.uniform(0.05, 1, n), rng.uniform(0.05, 1, n), rng.uniform(-0.3, 0.3, n)])
    chord = rng.uniform(0.5, 2, n) * 1e-6 / voxel_m
    # Between the planes x = corner and y = corner the segment needs the offset / u of each: shift x by chord * u_x.
    size = np.sqrt((u**2).sum(axis=1))
    corner[:, 0] += chord * u[:, 0] / size
    return corner - u * 4, u * rng.uniform(4.5, 9, (n, 1))


def hunt(case, make, seed, n, shape, voxel_m, built=False):
    """Check ``n`` segments, some tens of thousands at a time, and return a row."""
    rng = np.random.default_rng(seed)
    done = excluded = mismatches = exact = 0
    while done < n:
        size = min(n - done, 50_000)
        o, d = make(rng, size, shape, voxel_m)
        result = check(o, d, shape, voxel_m)
        excluded, mismatches, exact, done = excluded + result[0], mismatches + result[1], exact + result[2], done + size
    tested = f"sorted crossings with a margin; {exact} in rational arithmetic"
    return Row(
        case, RULE, tested, done, excluded, mismatches, "-" if built else f"{excluded} within 1e-8 m of the bound"
    )


@_kernel
def fragile(o, d, shape, voxel_m, moved_m):
    """Whether moving an end by ``moved_m`` could change a voxel, in float64; see the oracle's ``fragile``."""
    longest = shape.sum() + 8
    times = np.empty(longest)
    n = crossing_times(o, d, shape, times)
    length = np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2) * voxel_m
    grow = moved_m / voxel_m
    pieces = np.sort(times[:n])
    first, last = np.empty((3, 2), np.int64), np.empty(3, np.int64)
    for i in range(n - 1):
        # Every voxel that the segment touches when made a little larger, seen from the two ends and the middle of a
        # piece.
        for a in range(3):
            x, y = o[a] + pieces[i] * d[a], o[a] + pieces[i + 1] * d[a]
            first[a, 0] = np.int64(max(np.floor(min(x, y) - 2 * grow), 0.0))
            first[a, 1] = np.int64(min(np.floor(max(x, y) + 2 * grow), shape[a] - 1.0))
        for last[0] in range(first[0, 0], first[0, 1] + 1):
            for last[1] in range(first[1, 0], first[1, 1] + 1):
                for last[2] in range(first[2, 0], first[2, 1] + 1):
                    if _may_turn(o, d, last, grow, length, moved_m):
                        return True
    return False


@_kernel
def _may_turn(o, d, cell, grow, length, moved_m):
    """Whether the chords of a smaller and of a larger voxel are on different sides of the bound."""
    low_in, high_in, low_out, high_out = 0.0, 1.0, 0.0, 1.0
    for a in range(3):
        k = float(cell[a])
        if d[a] == 0.0:
            if not k - grow <= o[a] < k + 1.0 + grow:
                return False
            if not k + grow <= o[a] < k + 1.0 - grow:
                high_in = -1.0
            continue
        p, q = (k - grow - o[a]) / d[a], (k + 1.0 + grow - o[a]) / d[a]
        low_out, high_out = max(low_out, min(p, q)), min(high_out, max(p, q))
        p, q = (k + grow - o[a]) / d[a], (k + 1.0 - grow - o[a]) / d[a]
        low_in, high_in = max(low_in, min(p, q)), min(high_in, max(p, q))
    outer, inner = (high_out - low_out) * length, max(high_in - low_in, 0.0) * length
    return outer > 1e-6 - 2 * moved_m and outer > 0.0 and inner <= 1e-6 + 2 * moved_m


@_kernel
def count_fragile(o, d, shape, voxel_m, moved_m):
    """Return the number of beams that a move could change: in a plane because a component is 0, and others."""
    in_plane, others = 0, 0
    for i in range(d.shape[0]):
        if fragile(o, d[i], shape, voxel_m, moved_m):
            exact = False
            for a in range(3):
                exact |= d[i, a] == 0.0 and abs(o[a] - np.rint(o[a])) * voxel_m <= moved_m
            if exact:
                in_plane += 1
            else:
                others += 1
    return in_plane, others


def scene_beams(name):
    """Return grid and beams (site, o, d) of a shipped scenario."""
    scenario = egvs.load(ROOT / "scenarios" / name)
    scene, grid = egvs.build_scene(scenario), scenario.roi.grid
    scanner = Scanner(scene)
    result = [
        (site.name, *grid.segments(site.pose.position_m, scanner.scan_site(site).rows.ends_m)) for site in scene.sites
    ]
    return grid, result


def shipped(name, scale):
    """Check a shipped scenario: its beams, the sums of their chords, and how many a nanometre could change."""
    grid, sites = scene_beams(name)
    shape = np.asarray(grid.shape, np.int64)
    step = max(1, round(1 / max(scale, 1e-9) ** 0.5))
    total = excluded = mismatches = exact = in_plane = others = 0
    worst_sum = longest_gap = 0.0
    broken = 0
    for _, o, ends in sites[::step]:
        d = ends[::step].copy()
        total += len(d)
        result = check(np.broadcast_to(o, d.shape), d, grid.shape, grid.voxel_m)
        excluded, mismatches, exact = excluded + result[0], mismatches + result[1], exact + result[2]
        result = count_fragile(o, d, shape, grid.voxel_m, 1e-9)
        in_plane, others = in_plane + result[0], others + result[1]
        result = traversal.audit_beams(o, d, shape, grid.voxel_m, np.zeros(int(shape.prod()), np.uint32))
        worst_sum, longest_gap, broken = (
            max(worst_sum, result[0]),
            max(longest_gap, result[1]),
            broken + result[2] + result[3],
        )
    return [
        Row(f"beams of {name}", RULE, f"sorted crossings with a margin; {exact} in rational arithmetic", total,
            excluded, mismatches, "-"),
        Row(f"beams of {name}, sum of chords", "equals the segment to 1e-12, no voxel twice", "march.audit", total, 0,
            broken + (worst_sum > 1e-12), f"{worst_sum:.1e} of the segment; longest gap {longest_gap:.1e} m"),
        Row(f"beams of {name}, ends moved by 1e-9 m", "no voxel may change",
            "chords in voxels 1e-9 m larger and smaller", total, in_plane + others, 0,
            f"{in_plane} beams exactly in a plane, {others} others"),
    ]  # fmt: skip


def far_chords(scale):
    """Compare chords of beams that start 1e7 m away with fractions."""
    rng, n = np.random.default_rng(16), max(10, round(2000 * scale))
    shape, voxel_m, worst = np.array((12, 8, 5), np.int64), 0.25, Fraction(0)
    cells, t_cells = np.empty(40, np.int64), np.empty((40, 2))
    for _ in range(n):
        target = rng.uniform(0, 1, 3) * shape
        away = rng.normal(size=3)
        o = target - away / np.sqrt((away**2).sum()) * FAR_M / voxel_m
        d = 2 * (target - o)
        exact = oracle.shares(o, d, shape.tolist())
        count, _, _ = traversal.list_voxels(o, d, shape, voxel_m, cells, t_cells, traversal.crossing_buffer(shape))
        for c in range(count):
            i, j, k = (int(i) for i in np.unravel_index(cells[c], tuple(shape)))
            worst = max(
                worst, abs(Fraction(t_cells[c, 1]) - Fraction(t_cells[c, 0]) - exact[i, j, k]) * Fraction(2 * FAR_M)
            )
    return Row(
        "chords of beams from 1e7 m away",
        "to 4 u R = 4.5e-9 m",
        "rational arithmetic",
        n,
        0,
        int(worst > Fraction(45, 10**10)),
        f"{float(worst):.1e} m",
    )


def _tenths(at: np.ndarray) -> tuple[float, float, float]:
    """Return whole tenths of a metre as metres, as their decimals are read."""
    x, y, z = (float(Fraction(int(c), 10)) for c in at)
    return x, y, z


def in_decimals(scale):
    """Beams whose sites and ends lie on tenths of a metre, in voxels of 0.1, 0.2 and 0.3 m, moved by tenths.

    Each beam is built twice, at the origin and moved by k * 0.1 m, from decimals that are rounded as a file's are; both
    must cross the same voxels, and those that fractions of the decimals say."""
    rng, n = np.random.default_rng(17), max(60, round(60_000 * scale))
    shape, excluded, mismatches, in_plane = (12, 8, 5), 0, 0, 0
    for _ in range(n):
        tenths, size = int(rng.integers(1, 4)), np.array(shape)
        low = rng.integers(-60, 60, 3)
        start, end = (low + tenths * rng.integers(-2, size + 3) for _ in range(2))
        end = np.where(rng.random(3) < 0.4, start, end)
        beam_m = [float(Fraction(int(b - a), 10)) for a, b in zip(start, end, strict=True)]
        noise = rng.choice([0.0, 0.0, 3e-17, -5e-16], 3)
        result = []
        for moved in (0, int(rng.integers(1, 40_000_000))):
            origin, site = (_tenths(at + moved) for at in (low, start))
            grid = Grid(origin, float(Fraction(tenths, 10)), shape)
            o, d = grid.segments(site, np.array([beam_m]) + noise)
            result.append(walk(o, d[0], shape, grid.voxel_m))
        exact_o, exact_d = oracle.in_world(site, np.add(beam_m, noise).tolist(), origin, grid.voxel_m)
        in_plane += any(c.denominator == 1 and not x for c, x in zip(exact_o, exact_d, strict=True))
        ambiguous = oracle.ambiguous(exact_o, exact_d, shape, Fraction(tenths, 10))
        excluded += bool(ambiguous)
        wrong = result[1] ^ oracle.crossed(exact_o, exact_d, shape, Fraction(tenths, 10))
        mismatches += result[0] != result[1] or not wrong <= ambiguous
    tested = f"rational arithmetic on the decimals, and the same moved by up to 4000 km; {in_plane} beams in a plane"
    return Row("beams on tenths of a metre, voxels of 0.1 to 0.3 m", RULE, tested, 2 * n, excluded, mismatches, "-")


def rows(scale: float) -> list[Row]:
    """Run all checks of the march; scale 1 is the complete run."""

    def scaled(n):
        return max(50, round(n * scale))

    result = [
        hunt("adversarial segments, 0.25 m", hostile, 11, scaled(500_000), (7, 5, 4), 0.25),
        hunt("adversarial segments, 0.1 m, a larger grid", hostile, 12, scaled(250_000), (40, 24, 10), 0.1),
        hunt("adversarial segments, 16 m", hostile, 13, scaled(250_000), (12, 9, 6), 16.0),
        hunt("random segments", uniform, 14, scaled(10_000_000), (40, 20, 10), 0.25),
        hunt("corners cut by 0.5 to 2 micrometres", near_the_bound, 15, scaled(20_000), (20, 20, 6), 0.25),
        far_chords(scale),
        in_decimals(scale),
    ]
    for name in SCENES:
        result += shipped(name, scale)
    return result
