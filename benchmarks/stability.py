"""Cost of stable decisions.

Time of our kernels relative to textbook methods, and how many voxels those get wrong, on the shipped junction:

- traversal, compared with Amanatides and Woo (1987), who accumulate t and count every visited voxel. Wrong voxels have
  other hits than by exact arithmetic, summed over the sites;
- occupancy with boxes shrunk by 0.1 mm, compared with boxes that may touch, for simulated traffic. Wrong voxels change
  their count when every box moves by 1e-9 m.

Repeats are timed in turns; medians are compared. Machines differ, but ratios less so.
"""

from __future__ import annotations

import re
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np

import egvs
from benchmarks.numerics.march import check, scene_beams
from benchmarks.scenes import recorded_boxes
from egvs.kernels import occupancy, traversal

ROOT = Path(__file__).resolve().parents[1]
SCENE = "nishishinjuku"
REPEATS = 9

_kernel = numba.njit(nogil=True, error_model="numpy", cache=True)


@_kernel
def _start(o, d, n, t):
    """Return voxel at the start, step, first crossing and time between crossings of one axis, as in the paper."""
    i = min(max(np.int64(np.floor(o + t * d)), 0), n - 1)
    if d > 0.0:
        return i, 1, (i + 1 - o) / d, 1.0 / d
    if d < 0.0:
        return i, -1, (i - o) / d, -1.0 / d
    return i, 0, np.inf, np.inf


@_kernel
def textbook_march(o, d, shape, hits):
    """Add each beam to the voxels that it visits: Amanatides and Woo (1987), "A Fast Voxel Traversal Algorithm"."""
    nx, ny, nz = shape[0], shape[1], shape[2]
    for beam in range(d.shape[0]):
        t, t_last = 0.0, 1.0
        for a in range(3):
            if d[beam, a] == 0.0:
                if not 0.0 <= o[a] < shape[a]:
                    t_last = -1.0
            else:
                p, q = -o[a] / d[beam, a], (shape[a] - o[a]) / d[beam, a]
                t, t_last = max(t, min(p, q)), min(t_last, max(p, q))
        if not t < t_last:
            continue
        ix, sx, tx, dtx = _start(o[0], d[beam, 0], nx, t)
        iy, sy, ty, dty = _start(o[1], d[beam, 1], ny, t)
        iz, sz, tz, dtz = _start(o[2], d[beam, 2], nz, t)
        cell = (ix * ny + iy) * nz + iz
        step_x, step_y = sx * ny * nz, sy * nz
        while True:
            hits[cell] += np.uint32(1)
            if tx < ty and tx < tz:
                ix += sx
                if tx >= t_last or ix < 0 or ix >= nx:
                    break
                cell += step_x
                tx += dtx
            elif ty < tz:
                iy += sy
                if ty >= t_last or iy < 0 or iy >= ny:
                    break
                cell += step_y
                ty += dty
            else:
                iz += sz
                if tz >= t_last or iz < 0 or iz >= nz:
                    break
                cell += sz
                tz += dtz


def touching_box_kernels() -> Any:
    """Return the box kernels with boxes that are not shrunk, compiled anew."""
    source = Path(occupancy.__file__).read_text(encoding="utf-8")
    for old, new in (
        (r"^SHRINK_M = .*$", "SHRINK_M = 0.0"),
        (r"njit\(\)$", "numba.njit(nogil=True, error_model='numpy')"),
    ):
        source, ours_hits = re.subn(old, new, source, flags=re.MULTILINE)
        assert ours_hits
    namespace: dict[str, Any] = {"__name__": "touching", "numba": numba}
    exec(compile(source, "touching boxes", "exec"), namespace)
    return SimpleNamespace(**namespace)


def median_seconds(works: Sequence[Callable[[], object]]) -> list[float]:
    """Return the median processor seconds of each call, measured in turns after one call each."""
    times: list[list[float]] = [[] for _ in works]
    for turn in range(REPEATS + 1):
        for work, taken in zip(works, times, strict=True):
            begin = time.process_time()
            work()
            if turn:
                taken.append(time.process_time() - begin)
    return [statistics.median(taken) for taken in times]


def march_rows() -> list[tuple[str, float, float, int]]:
    """Compare the traversals for the beams of all sites."""
    grid, sites = scene_beams(SCENE)
    shape = np.asarray(grid.shape, np.int64)
    hits = np.zeros(int(shape.prod()), np.uint32)

    def ours() -> None:
        for _, o, d in sites:
            traversal.count_hits(o, d, shape, grid.voxel_m, hits)

    def theirs() -> None:
        for _, o, d in sites:
            textbook_march(o, d, shape, hits)

    wrong_ours = wrong_theirs = 0
    for _, o, d in sites:
        ours_hits, textbook_hits = np.zeros_like(hits), np.zeros_like(hits)
        traversal.count_hits(o, d, shape, grid.voxel_m, ours_hits)
        textbook_march(o, d, shape, textbook_hits)
        # Every beam of ours is right by exact arithmetic, or counted here; so what differs from ours is wrong.
        wrong_ours += check(np.broadcast_to(o, d.shape), d, grid.shape, grid.voxel_m)[1]
        wrong_theirs += int((ours_hits != textbook_hits).sum())
    our_s, textbook_s = median_seconds([ours, theirs])
    return [
        (f"march, {len(sites)} sites: textbook", textbook_s, 1.0, wrong_theirs),
        (f"march, {len(sites)} sites: ours", our_s, our_s / textbook_s, wrong_ours),
    ]


def box_rows() -> list[tuple[str, float, float, int]]:
    """Compare our boxes with touching boxes, for 1000 frames of traffic."""
    frames = 1000
    scenario = egvs.load(ROOT / "scenarios" / SCENE, [f"traffic.frames={frames}"])
    grid = scenario.roi.grid
    boxes_near = recorded_boxes(scenario)
    frame, values = boxes_near.frame, boxes_near.values
    shape, (nx, ny, nz) = np.asarray(grid.shape, np.int64), grid.shape
    steps, last_frame = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)

    def count(kernels: Any, moved: Any) -> Any:
        steps[:], last_frame[:] = 0, -1
        kernels.count_boxes(frame, moved, shape, grid.voxel_m, steps, last_frame)
        kernels.sum_layers(steps)
        return steps[:-1]

    plain = touching_box_kernels()
    wrong = []
    for kernels in (plain, occupancy):
        before, changed = count(kernels, values).copy(), np.zeros((nz, nx, ny), bool)
        for axis in range(3):
            for nudge in (-1e-9, 1e-9):
                changed |= count(kernels, values + nudge * np.eye(8)[axis]) != before
        wrong.append(int(changed.sum()))
    textbook_s, our_s = median_seconds([lambda: count(plain, values), lambda: count(occupancy, values)])
    return [
        (f"boxes, {frames} frames: touching", textbook_s, 1.0, wrong[0]),
        (f"boxes, {frames} frames: ours", our_s, our_s / textbook_s, wrong[1]),
    ]


def rows() -> list[tuple[str, float, float, int]]:
    """Return what, seconds, ratio to the textbook's, and wrong voxels."""
    return march_rows() + box_rows()


if __name__ == "__main__":
    for row in rows():
        print(*row)
