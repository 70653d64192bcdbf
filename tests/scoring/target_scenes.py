"""Scenes for tests of what is seen of vehicles, and a slow twin: every beam against every box, in float64.

The twin shares no code with the kernel: it cuts a beam with the six planes of a box's faces, and asks of each point
whether it lies on the face."""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.grid import Grid
from egvs.effects.base import Detect
from egvs.effects.returns import ReturnProbability
from egvs.scenario.effects_config import EffectParameters
from egvs.scoring.targets import TargetRecord, VisibleTargets, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors import sensor
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose

GRID = Grid((100.0, 200.0, 0.0), 1.0, (40, 20, 5))
SENSOR = sensor.CATALOGUE["VLP-16"]
SHRINK_M = 1e-4 + 1e-9

Noticed = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class LossesByRange(Detect[EffectParameters]):
    """An effect that detects returns by a function of the range, and leaves extents as they are."""

    shares: Noticed
    NAME: ClassVar[str] = "by_range"

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        return self.shares(range_m)


def by_range(noticed: Noticed) -> ReturnProbability:
    return ReturnProbability((LossesByRange(EffectParameters(), noticed),), SENSOR)


def frame(boxes, kinds=None, pitch=None, number=0, vehicles=None, part=None) -> TrafficFrame:
    """Boxes as ``traffic_frames.BOX``."""
    boxes = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    kinds = ("passenger",) * len(boxes) if kinds is None else kinds
    pitch = np.zeros(len(boxes)) if pitch is None else np.array(pitch)
    vehicles = tuple(f"v{i}" for i in range(len(boxes))) if vehicles is None else vehicles
    more = () if part is None else (np.array(part),)
    return TrafficFrame(number, tuple(vehicles), tuple(kinds), boxes, pitch, *more)


def beams_to(at, ends, weight=None) -> Beams:
    """An empty scan from (x, y, z) whose beams end at ``ends``, seen from there."""
    given = None if weight is None else np.array(weight, dtype=np.float64)
    return Beams(Pose(*at), SENSOR, np.array(ends, dtype=np.float64).reshape(-1, 3), given)


def seen(frames: Sequence[TrafficFrame], beams: Beams, noticed: Noticed | None = None) -> VisibleTargets:
    """What is seen in the grid of these tests."""
    return visible_targets(TargetRecord.of(frames, GRID), beams, None if noticed is None else by_range(noticed))


def axes_of(yaw: float, pitch: float) -> NDArray[np.float64]:
    """Forward, left and up of a box, one a row: a turn about y that lifts the nose, then one about z."""
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    lift = np.array(
        [[math.cos(pitch), 0.0, -math.sin(pitch)], [0.0, 1.0, 0.0], [math.sin(pitch), 0.0, math.cos(pitch)]]
    )
    return (turn @ lift).T


def entered_m(box, pitch, origin, direction) -> float:
    """Where a ray meets the first of the six faces of a box 0.1 mm smaller on each side; infinity where it does not."""
    axes, half = axes_of(box[6], pitch), np.array(box[3:6]) / 2 - SHRINK_M
    o, d, nearest = axes @ (np.array(origin) - np.array(box[:3])), axes @ np.array(direction), math.inf
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for side in (-1.0, 1.0):
            if d[axis] == 0.0:
                continue
            t = (side * half[axis] - o[axis]) / d[axis]
            at = o + t * d
            if t >= 0.0 and (np.abs(at[others]) < half[others]).all():
                nearest = min(nearest, t)
    return nearest


def holds(box, pitch, origin) -> bool:
    """Whether a box holds a point."""
    return bool(
        (np.abs(axes_of(box[6], pitch) @ (np.array(origin) - np.array(box[:3]))) < np.array(box[3:6]) / 2).all()
    )


def is_beyond(box, pitch, origin) -> bool:
    """Whether no part of a box lies in the upright block round the region and the sensor."""
    corners = np.array(box[:3]) + np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T * box[3:6] @ axes_of(
        box[6], pitch
    )
    low, high = np.array(GRID.roi.origin_m), np.array(GRID.roi.origin_m) + np.array(GRID.roi.size_m)
    return bool(
        (corners.min(axis=0) > np.maximum(high, origin)).any() or (corners.max(axis=0) < np.minimum(low, origin)).any()
    )


COLUMNS = ("points", "points_alone", "points_on_sides", "length_share", "width_share", "hole_m", "range_m",
           "depression_deg", "side")  # fmt: skip


def hole_slowly(along: Sequence[float]) -> float:
    """The longest run of empty slices between two with points, as a share; ``along`` from 0 to 1."""
    slices = sorted({min(max(int(64 * u), 0), 63) for u in along})
    return max([b - a - 1 for a, b in itertools.pairwise(slices)], default=0) / 64


def seen_slowly(frames: Sequence[TrafficFrame], beams: Beams, noticed: Noticed | None = None) -> dict[str, list[float]]:
    """Columns of ``SeenTargets``, beam by beam and box by box."""
    found: dict[str, list[float]] = {name: [] for name in COLUMNS}
    for one in frames:
        for row, column in _of_frame(one, beams, noticed or (lambda r: np.ones(len(r)))).items():
            if row in one.target_rows(GRID.roi).tolist():
                for name, value in column.items():
                    found[name].append(value)
    return found


Hit = tuple[float, float, float]
"""Share of a point that comes, and where it is along and across the box from its centre."""


def _hits_of_frame(one: TrafficFrame, beams: Beams, noticed: Noticed) -> tuple[dict[int, list[Hit]], dict[int, float]]:
    """Points on each box, and the sum of the beams that meet it, hidden or not."""
    origin = np.array(beams.pose.position_m)
    boxes = [
        (row, box, pitch)
        for row, (box, pitch) in enumerate(zip(one.boxes, one.pitch_rad, strict=True))
        if not holds(box, pitch, origin) and not is_beyond(box, pitch, origin)
    ]
    hits: dict[int, list[Hit]] = {row: [] for row in range(len(one.boxes))}
    alone = dict.fromkeys(hits, 0.0)
    for number, end in enumerate(beams.ends_m):
        length = float(np.linalg.norm(end))
        weight = 1.0 if beams.weight is None else float(beams.weight[number])
        met = {row: entered_m(box, pitch, origin, end / length) for row, box, pitch in boxes}
        for row, t in met.items():
            alone[row] += weight if t < length else 0.0
        first = min(met, key=lambda row: met[row], default=None)
        if first is not None and met[first] < length:
            worth = weight * float(noticed(np.array([met[first]]))[0])
            at = origin + end / length * met[first] - one.boxes[first, :3]
            u, v, _ = (float(value) for value in axes_of(one.boxes[first, 6], one.pitch_rad[first]) @ at)
            hits[first].append((worth, u, v))
    return hits, alone


def _of_points(box: NDArray[np.float64], hits: Sequence[Hit]) -> dict[str, float]:
    """Columns that follow from the points on a box, whoever they are from."""
    kept = np.array([hit[1:] for hit in hits if hit[0] > 0.0]).reshape(-1, 2)
    span = np.ptp(kept, axis=0) / box[3:5] if len(kept) else (0.0, 0.0)
    half = box[3:5] / 2 - SHRINK_M
    on_side = [hit[0] for hit in hits if abs(hit[1]) > half[0] - 1e-6 or abs(hit[2]) > half[1] - 1e-6]
    return {
        "points_on_sides": sum(on_side),
        "hole_m": box[3] * hole_slowly([(u / half[0] + 1) / 2 for u, _ in kept]),
        "points": sum(hit[0] for hit in hits),
        "length_share": float(span[0]),
        "width_share": float(span[1]),
    }


def _of_view(box: NDArray[np.float64], origin: NDArray[np.float64]) -> dict[str, float]:
    """Columns that follow from where a box is seen from."""
    range_m = float(np.linalg.norm(box[:3] - origin))
    sight = complex(box[0] - origin[0], box[1] - origin[1])
    return {
        "range_m": range_m,
        "depression_deg": math.degrees(math.asin((origin[2] - box[2]) / range_m)),
        "side": abs(math.sin(cmath.phase(sight) - box[6])),
    }


def _of_frame(one: TrafficFrame, beams: Beams, noticed: Noticed) -> dict[int, dict[str, float]]:
    hits, alone = _hits_of_frame(one, beams, noticed)
    found = {}
    for row, its in hits.items():
        view = _of_view(one.boxes[row], np.array(beams.pose.position_m))
        reached = alone[row] * float(noticed(np.array([view["range_m"]]))[0])
        found[row] = {**_of_points(one.boxes[row], its), **view, "points_alone": reached}
    return found


def fused_slowly(frames: Sequence[TrafficFrame], scans: Sequence[Beams]) -> dict[str, list[float]]:
    """Columns of what all scans see together: their points are thrown together before anything is computed of them."""
    found: dict[str, list[float]] = {name: [] for name in COLUMNS if name != "points_alone"}
    for one in frames:
        by_scan = [_hits_of_frame(one, beams, lambda r: np.ones(len(r)))[0] for beams in scans]
        for row in one.target_rows(GRID.roi).tolist():
            counts = [sum(hit[0] for hit in hits[row]) for hits in by_scan]
            views = [_of_view(one.boxes[row], np.array(beams.pose.position_m)) for beams in scans]
            most = [view for view, count in zip(views, counts, strict=True) if count == max(counts)]
            together = [hit for hits in by_scan for hit in hits[row]]
            nearest = min(most, key=lambda view: view["range_m"])
            for name, value in {**_of_points(one.boxes[row], together), **nearest}.items():
                found[name].append(value)
    return found


def random_boxes(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Boxes in and round the region, the largest as large as a bus, as ``traffic_frames.BOX``."""
    return np.column_stack([
        100 + rng.uniform(-4, 44, count), 200 + rng.uniform(-4, 24, count), rng.uniform(0.5, 2, count),
        rng.uniform(2, 12, count), rng.uniform(1, 3, count), rng.uniform(1, 4, count), rng.uniform(-7, 7, count),
    ])  # fmt: skip
