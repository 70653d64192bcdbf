"""Find the convention of the headings of labelled boxes, by the points that the boxes hold.

A file that does not say where headings count from, and in which direction, is read in all four conventions. In the
right one boxes lie on vehicles, in the others most lie across them. The best one is taken if it holds
:data:`MIN_RATIO` times the points of the next, and if at least :data:`FEWEST_BOXES` boxes hold other numbers of points
in the two: single boxes that are a little misplaced favour any of them. Otherwise the file is refused. Conventions that
give the same boxes, such as those of vehicles that all drive along x or y, count as one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.validation.measured.box_points import points_in_boxes
from egvs.formats.sweep_files import Sweep
from egvs.formats.sweep_labels import SweepLabels

MIN_RATIO = 1.5

FEWEST_BOXES = 5
"""Fewest boxes that tell the best convention from the next."""

SAME_RAD = math.radians(1.0)
"""Boxes whose directions differ by at most this are the same; front and rear are not told apart."""

CONVENTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "x-ccw": lambda yaw: yaw,
    "x-cw": lambda yaw: -yaw,
    "y-ccw": lambda yaw: yaw + math.pi / 2.0,
    "y-cw": lambda yaw: math.pi / 2.0 - yaw,
}
"""Heading counter-clockwise from x, by the axis that it counts from and the direction, seen from above."""

Pairs = Sequence[tuple[Sweep, SweepLabels]]


def in_convention(labels: SweepLabels, name: str) -> SweepLabels:
    """Return labels whose headings are read in a convention."""
    boxes = labels.boxes.copy()
    boxes[:, 6] = CONVENTIONS[name](boxes[:, 6])
    return labels.with_boxes(boxes)


def find_convention(pairs: Pairs) -> tuple[str, dict[str, int]]:
    """Return the convention of labels, and the points that boxes hold in each convention that differs.

    Parameters
    ----------
    pairs
        Sweeps with their labels.

    Raises
    ------
    InputError
        If no convention is clearly the best.
    """
    by_box: dict[str, IntArray] = {}
    directions: list[FloatArray] = []
    for name, convert in CONVENTIONS.items():
        yaw = np.concatenate([convert(labels.boxes[:, 6]) for _, labels in pairs])
        if any(_are_same(yaw, other) for other in directions):
            continue
        directions.append(yaw)
        counts = [points_in_boxes(sweep.points_m, in_convention(labels, name).boxes) for sweep, labels in pairs]
        by_box[name] = np.concatenate(counts)
    held = {name: int(counts.sum()) for name, counts in by_box.items()}
    best, *others = sorted(held, key=lambda name: -held[name])
    text = ", ".join(f"{name} {count:,}" for name, count in held.items())
    problem = ""
    if not held[best] or (others and held[best] < MIN_RATIO * held[others[0]]):
        problem = f"the convention of headings is not clear: points in boxes by convention: {text}"
    elif others and (telling := np.count_nonzero(by_box[best] != by_box[others[0]])) < FEWEST_BOXES:
        problem = (
            f"the convention of headings is not clear: expected {FEWEST_BOXES} boxes that tell, got {telling}; points "
            f"in boxes by convention: {text}"
        )
    if problem:
        hint = f"State it: --yaw {best}. If boxes hold few points in all of them, labels are in another frame."
        raise InputError(pairs[0][1].file, problem, hint)
    return best, held


def _are_same(yaw: FloatArray, other: FloatArray) -> bool:
    return bool((np.abs(np.sin(yaw - other)) <= math.sin(SAME_RAD)).all())
