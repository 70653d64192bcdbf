"""Find the convention of the headings of labelled boxes, by the points that the boxes hold.

A file that does not say where headings count from, and in which direction, is read in all four conventions. In the
right one boxes lie on vehicles, in the others most lie across them. The best one is taken if it holds
:data:`MIN_RATIO` times the points of the next; otherwise the file is refused. Conventions that give the same boxes,
such as those of vehicles that all drive along x or y, count as one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.validation.measured.box_points import points_in_boxes
from egvs.formats.sweep_files import Sweep
from egvs.formats.sweep_labels import SweepLabels

MIN_RATIO = 1.5

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
    held: dict[str, int] = {}
    directions: list[FloatArray] = []
    for name, convert in CONVENTIONS.items():
        yaw = np.concatenate([convert(labels.boxes[:, 6]) for _, labels in pairs])
        if any(_are_same(yaw, other) for other in directions):
            continue
        directions.append(yaw)
        held[name] = sum(
            int(points_in_boxes(sweep.points_m, in_convention(labels, name).boxes).sum()) for sweep, labels in pairs
        )
    ranked = sorted(held, key=lambda name: -held[name])
    best = ranked[0]
    if (len(ranked) > 1 and held[best] < MIN_RATIO * held[ranked[1]]) or not held[best]:
        counts = ", ".join(f"{name} {count:,}" for name, count in held.items())
        problem = f"the convention of headings is not clear: points in boxes by convention: {counts}"
        hint = f"State it: --yaw {best}. If boxes hold few points in all of them, labels are in another frame."
        raise InputError(pairs[0][1].file, problem, hint)
    return best, held


def _are_same(yaw: FloatArray, other: FloatArray) -> bool:
    return bool((np.abs(np.sin(yaw - other)) <= math.sin(SAME_RAD)).all())
