r"""Find how the frames of two lists of labels of one place lie to each other, by the boxes themselves.

Boxes that stand in both lists at the same instants have the same distance vectors in all sweeps, after the right turn.
Every turn in steps of two degrees is tried: the vectors between all boxes of one list and all of the other are counted
in cells of one metre, and the fullest cell is the shift. The best is refined by least squares over the nearest boxes.
It is taken if it brings :data:`egvs.extensions.validation.measured.yaw_conventions.MIN_RATIO` times the boxes together
that the next one does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.validation.measured.yaw_conventions import MIN_RATIO

NEAR_M = 3.0
"""Boxes of two lists within this distance in plan are of one road user."""

MOST_SWEEPS = 100
"""Pairs of sweeps that are used, evenly spaced."""

FEWEST_TOGETHER = 30
"""Fewest boxes that must come together."""

SAME_FRAME_SHARE = 0.5
"""Lists of which more boxes stand together, as they are, are in one frame."""

_TURN_STEP = math.radians(2.0)
_CELL_M = 1.0
_REFINEMENTS = 10
_OTHER_TURN, _OTHER_SHIFT_M = math.radians(10.0), 6.0
"""A turn or a shift that differs by more is another answer."""

_FINALISTS = 6
"""Answers that are refined."""

Centres = Sequence[tuple[FloatArray, FloatArray]]


class PlanPose(NamedTuple):
    """A turn about z, then a shift in plan: from the frame of one list to that of another."""

    turn_rad: float
    x_m: float
    y_m: float

    def apply(self, x_y: FloatArray) -> FloatArray:
        """Return positions (n, 2) in the other frame."""
        cos, sin = math.cos(self.turn_rad), math.sin(self.turn_rad)
        turned: FloatArray = x_y @ np.array([[cos, sin], [-sin, cos]]) + (self.x_m, self.y_m)
        return turned


SAME = PlanPose(0.0, 0.0, 0.0)


def count_together(centres: Centres, pose: PlanPose) -> int:
    """Return how many boxes of the first list have one of the second within :data:`NEAR_M`."""
    return sum(int(are_near(pose.apply(first), second, NEAR_M).sum()) for first, second in centres)


def are_near(x_y: FloatArray, others: FloatArray, within_m: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which positions (n, 2) have another one, of (m, 2), within a distance, (n,) bool."""
    if not len(others):
        return np.zeros(len(x_y), dtype=np.bool_)
    away_m = x_y[:, None] - others[None]
    near: np.ndarray[tuple[int], np.dtype[np.bool_]] = ((away_m**2).sum(axis=2) <= within_m**2).any(axis=1)
    return near


def find_pose(centres: Centres, where: str) -> PlanPose:
    """Return how the first list lies in the frame of the second.

    Parameters
    ----------
    centres
        Centres in plan of the boxes of both lists, (n, 2) and (m, 2), for each pair of sweeps.
    where
        The lists, for messages.

    Raises
    ------
    InputError
        If no turn and shift brings clearly the most boxes together.
    """
    pairs = [pair for pair in centres if len(pair[0]) and len(pair[1])]
    if not pairs:
        raise InputError(where, "no pair of sweeps has boxes in both lists", "Give labels of the same instants.")
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_SWEEPS)).astype(int))
    pairs = [pairs[number] for number in chosen.tolist()]
    most = sum(min(len(first), len(second)) for first, second in pairs)
    as_they_are = count_together(pairs, SAME)
    if as_they_are > SAME_FRAME_SHARE * most:
        return SAME
    ranked = sorted((_refine(pairs, pose), pose) for pose in _candidates(pairs))
    (best_count, best), *others = [refined for refined, _ in reversed(ranked)]
    if not _is_other(best, SAME):
        return SAME
    next_count = max([as_they_are, *(count for count, pose in others if _is_other(best, pose))])
    if best_count < FEWEST_TOGETHER or best_count < MIN_RATIO * next_count:
        problem = (
            f"the frames of the lists do not fit: of {most:,} boxes, {as_they_are:,} stand together as they are, "
            f"{best_count:,} in the best other way and {next_count:,} in the next"
        )
        raise InputError(where, problem, "Name the sites of the sensors: SCENARIO --site NAME --site NAME.")
    return best


def _candidates(pairs: Centres) -> list[PlanPose]:
    """Return the best shifts of all turns that differ from one another, those that bring most boxes together first."""
    ranked: list[tuple[int, PlanPose]] = []
    for turn_rad in np.arange(-math.pi, math.pi, _TURN_STEP).tolist():
        turn = PlanPose(turn_rad, 0.0, 0.0)
        away_m = np.concatenate([(second[None] - turn.apply(first)[:, None]).reshape(-1, 2) for first, second in pairs])
        cells = np.round(away_m / _CELL_M).astype(np.int64)
        low, width = cells.min(axis=0), int(np.ptp(cells[:, 1])) + 1
        numbers, counts = np.unique((cells[:, 0] - low[0]) * width + cells[:, 1] - low[1], return_counts=True)
        fullest = int(np.argmax(counts))
        x, y = divmod(int(numbers[fullest]), width)
        pose = PlanPose(turn_rad, (x + int(low[0])) * _CELL_M, (y + int(low[1])) * _CELL_M)
        ranked.append((int(counts[fullest]), pose))
    chosen: list[PlanPose] = []
    for _, pose in sorted(ranked, reverse=True):
        if all(_is_other(pose, other) for other in chosen) and len(chosen) < _FINALISTS:
            chosen.append(pose)
    return chosen


def _refine(pairs: Centres, pose: PlanPose) -> tuple[int, PlanPose]:
    """Return how many boxes come together, and the pose by least squares over the nearest ones."""
    for _ in range(_REFINEMENTS):
        near, targets = [], []
        for first, second in pairs:
            away_m = ((pose.apply(first)[:, None] - second[None]) ** 2).sum(axis=2)
            nearest = away_m.argmin(axis=1)
            is_near = away_m[np.arange(len(first)), nearest] <= NEAR_M**2
            near.append(first[is_near])
            targets.append(second[nearest[is_near]])
        points, others = np.concatenate(near), np.concatenate(targets)
        if len(points) < 2:
            break
        middle, other_middle = points.mean(axis=0), others.mean(axis=0)
        a, b = points - middle, others - other_middle
        turn_rad = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
        shift_m = other_middle - PlanPose(turn_rad, 0.0, 0.0).apply(middle)
        before, pose = pose, PlanPose(turn_rad, float(shift_m[0]), float(shift_m[1]))
        if np.allclose(before, pose, rtol=0.0, atol=1e-4):
            break
    return count_together(pairs, pose), pose


def _is_other(pose: PlanPose, other: PlanPose) -> bool:
    turn_rad = abs(math.remainder(pose.turn_rad - other.turn_rad, 2.0 * math.pi))
    return turn_rad > _OTHER_TURN or math.hypot(pose.x_m - other.x_m, pose.y_m - other.y_m) > _OTHER_SHIFT_M
