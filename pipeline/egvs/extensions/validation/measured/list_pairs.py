"""Pair the sweeps of two lists of labels, and place the boxes of both above the sensor of one of them.

Sweeps belong together by time, or by name where a list has no times. Poses of sensors come from a scenario, from the
files, or from the boxes themselves (:mod:`egvs.extensions.validation.measured.list_poses`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.wording import list_first, number_of
from egvs.extensions.validation.measured.comparison import GROUPS
from egvs.extensions.validation.measured.list_poses import SAME, PlanPose, are_near, find_pose
from egvs.extensions.validation.measured.sensor_site import SensorSite, boxes_in_world, move_boxes
from egvs.formats.sweep_labels import MAX_TIME_DIFFERENCE_S, SensorPose, SweepLabels
from egvs.sensors.sites import Pose


@dataclass(frozen=True, eq=False)
class LabelList:
    """The labels of one sensor, or detections in its sweeps.

    Attributes
    ----------
    path
        Where they are from.
    labels
        Of each sweep, headed as stated or in the convention that is taken.
    pose
        Pose of the sensor in the world: that of its site, or above its boxes at the origin.
    site
        The sensor there; None if it is unknown.
    pose_note
        A sentence on the pose.
    is_in_scenario
        Whether the pose is that of a site of a scenario.
    """

    path: Path
    labels: tuple[SweepLabels, ...]
    pose: Pose
    site: SensorSite | None
    pose_note: str
    is_in_scenario: bool

    @property
    def name(self) -> str:
        """Name of the file or folder."""
        return self.path.resolve().name

    @property
    def shared_pose(self) -> SensorPose | None:
        """Pose in a frame that sensors share, if the files have one."""
        return next((item.pose for item in self.labels if item.pose is not None), None)


def pair_sweeps(first: LabelList, second: LabelList) -> list[tuple[SweepLabels, SweepLabels]]:
    """Return the labels of the same instants: by time where both lists have times, by name otherwise.

    Raises
    ------
    InputError
        If no sweep of one list belongs to one of the other.
    """
    times_s = [np.array([item.time_s for item in one.labels]) for one in (first, second)]
    if all(np.isfinite(times).all() for times in times_s):
        pairs = _pair_by_time(first.labels, second.labels, *times_s)
        spans = [f"{times.min():.3f} to {times.max():.3f} s" for times in times_s]
        problem = f"expected sweeps of the same instants as {first.name} ({spans[0]}), got others ({spans[1]})"
    else:
        counts = [Counter(item.sweep for item in one.labels) for one in (first, second)]
        for one, count in zip((first, second), counts, strict=True):
            if twice := [name for name, number in count.items() if number > 1]:
                problem = f"sweep {twice[0]!r} has labels twice, and no times"
                raise InputError(one.path, problem, "Give one set of labels for each sweep.")
        by_name = {item.sweep: item for item in second.labels}
        pairs = [(item, by_name[item.sweep]) for item in first.labels if item.sweep in by_name]
        pairs.sort(key=lambda pair: pair[0].sweep)
        if not pairs and len(first.labels) == len(second.labels) == 1:
            pairs = [(first.labels[0], second.labels[0])]
        names = [list_first([item.sweep or "unnamed" for item in one.labels], 3) for one in (first, second)]
        problem = f"expected sweeps named as those of {first.name} ({names[0]}), got others ({names[1]})"
    if not pairs:
        hint = f"Sweeps belong together by time, within {1000 * MAX_TIME_DIFFERENCE_S:.0f} ms, or by name."
        raise InputError(second.path, problem, hint)
    return pairs


def _pair_by_time(
    first: Sequence[SweepLabels], second: Sequence[SweepLabels], first_s: FloatArray, second_s: FloatArray
) -> list[tuple[SweepLabels, SweepLabels]]:
    """Return pairs of neighbours in time, each sweep at most once, in the order of time."""
    order = np.argsort(second_s, kind="stable")
    after = np.searchsorted(second_s[order], first_s)
    nearest: dict[int, tuple[float, int]] = {}
    for row, position in enumerate(after.tolist()):
        for other in order[max(position - 1, 0) : position + 1].tolist():
            apart_s = abs(float(second_s[other] - first_s[row]))
            if apart_s <= MAX_TIME_DIFFERENCE_S and (apart_s, row) < nearest.get(other, (math.inf, 0)):
                nearest[other] = apart_s, row
    of_first: dict[int, tuple[float, int]] = {}
    for other, (apart_s, row) in nearest.items():
        of_first[row] = min((apart_s, other), of_first.get(row, (math.inf, other)))
    rows = sorted(of_first, key=lambda row: float(first_s[row]))
    return [(first[row], second[of_first[row][1]]) for row in rows]


@dataclass(frozen=True, eq=False)
class PlacedPair:
    """Boxes of a pair of sweeps above the tested sensor.

    Attributes
    ----------
    other, tested
        Labels of both.
    boxes, tested_boxes
        Their boxes in the world of the tested list, (n, 7) and (m, 7) float64.
    """

    other: SweepLabels
    tested: SweepLabels
    boxes: FloatArray
    tested_boxes: FloatArray

    def matched(self, within_m: float, tested: BoolArray | None = None) -> BoolArray:
        """Return which boxes of the other list have a tested one nearby, (n,); ``tested`` chooses some of those."""
        return match_boxes(self.boxes, self.other.classes, self.tested_boxes, self.tested.classes, within_m, tested)

    def alone(self, within_m: float) -> BoolArray:
        """Return which tested boxes have none of the other list nearby, (m,)."""
        return ~match_boxes(self.tested_boxes, self.tested.classes, self.boxes, self.other.classes, within_m)

    @property
    def time_s(self) -> float:
        """When the sweep of the other list was recorded; that of the tested one if only this is known."""
        return self.other.time_s if math.isfinite(self.other.time_s) else self.tested.time_s


def _kind(cls: str) -> str:
    return "" if cls == "other" else "people" if cls in GROUPS["people"] else "vehicles"


def match_boxes(
    boxes: FloatArray,
    classes: Sequence[str],
    others: FloatArray,
    other_classes: Sequence[str],
    within_m: float,
    chosen: BoolArray | None = None,
) -> BoolArray:
    """Return which boxes have one of the other boxes of their kind, or of no kind, within a distance, (n,)."""
    found = np.zeros(len(boxes), dtype=np.bool_)
    kinds, other_kinds = np.array([_kind(cls) for cls in classes]), np.array([_kind(cls) for cls in other_classes])
    for kind in ("", "people", "vehicles"):
        rows = kinds == kind
        candidates = np.isin(other_kinds, [kind, ""]) if kind else np.ones(len(others), dtype=np.bool_)
        if chosen is not None:
            candidates = candidates & chosen
        found[rows] = are_near(boxes[rows, :2], others[candidates, :2], within_m)
    return found


def place_pairs(tested: LabelList, other: LabelList) -> tuple[list[PlacedPair], list[str]]:
    """Return pairs of sweeps with all boxes in the world of the tested list, and sentences on how that was done."""
    pairs = pair_sweeps(other, tested)
    notes = []
    for one, count in ((other, len(other.labels)), (tested, len(tested.labels))):
        if count > len(pairs):
            notes.append(f"{one.name}: {number_of(count - len(pairs), 'sweep')} without a partner left out.")
    place = [boxes_in_world(tested.pose, item.boxes) for _, item in pairs]
    shared, other_shared = tested.shared_pose, other.shared_pose
    if tested.site is other.site and tested.pose == other.pose:
        moved = [boxes_in_world(tested.pose, item.boxes) for item, _ in pairs]  # in the sweeps of the same sensor
    elif tested.is_in_scenario:
        moved = [boxes_in_world(other.pose, item.boxes) for item, _ in pairs]
    elif shared is not None and other_shared is not None and shared.frame == other_shared.frame:
        rotation = shared.rotation.T @ other_shared.rotation
        translation_m = shared.rotation.T @ (other_shared.translation_m - shared.translation_m)
        in_sensor = [move_boxes(item.boxes, rotation, translation_m) for item, _ in pairs]
        moved = [boxes_in_world(tested.pose, boxes) for boxes in in_sensor]
        apart_m = float(np.sqrt((translation_m**2).sum()))
        notes.append(f"The sensors are {apart_m:.1f} m apart, by their poses in {shared.frame}.")
    else:
        level = [boxes_in_world(other.pose, item.boxes) for item, _ in pairs]
        centres = [(a[:, :2], b[:, :2]) for a, b in zip(level, place, strict=True)]
        pose = find_pose(centres, f"{other.path}, {tested.path}")
        if pose == SAME:
            moved = [boxes_in_world(tested.pose, item.boxes) for item, _ in pairs]
            notes.append(
                "No file says where the sensors are; most boxes stand together, so both lists are in one frame."
            )
        else:
            moved = [_turned(boxes, pose) for boxes in level]
            notes.append(
                f"No file says where the sensors are: by their boxes, they are {math.hypot(pose.x_m, pose.y_m):.1f} m "
                f"apart, turned by {math.degrees(pose.turn_rad):.1f} degrees."
            )
    placed = []
    for (item, other_item), boxes, tested_boxes in zip(pairs, moved, place, strict=True):
        placed.append(PlacedPair(item, other_item, boxes, tested_boxes))
    return placed, notes


def _turned(boxes: FloatArray, pose: PlanPose) -> FloatArray:
    turned = boxes.copy()
    turned[:, :2] = pose.apply(boxes[:, :2])
    turned[:, 6] += pose.turn_rad
    return turned
