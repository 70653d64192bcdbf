"""The convention of headings is found by points in boxes, or refused: it is never guessed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.validation.measured import yaw_conventions
from egvs.formats.sweep_files import Sweep
from egvs.formats.sweep_labels import SweepLabels

INVERSE = {
    "x-ccw": lambda yaw: yaw,
    "x-cw": lambda yaw: -yaw,
    "y-ccw": lambda yaw: yaw - math.pi / 2,
    "y-cw": lambda yaw: math.pi / 2 - yaw,
}


def filled_boxes(count: int, size_m: tuple[float, float], seed: int = 1) -> tuple[FloatArray, FloatArray]:
    """Return boxes in a row at headings between the axes, (n, 7), and points all over them."""
    rng = np.random.default_rng(seed)
    boxes, points = [], []
    for number in range(count):
        yaw = rng.uniform(0.15, 0.6)
        boxes.append((20.0 * number, 5.0, 0.0, *size_m, 1.5, yaw))
        along, across = rng.uniform(-0.5, 0.5, (2, 300)) * np.array(size_m)[:, None]
        x = 20.0 * number + along * math.cos(yaw) - across * math.sin(yaw)
        y = 5.0 + along * math.sin(yaw) + across * math.cos(yaw)
        points.append(np.column_stack([x, y, rng.uniform(-0.5, 0.7, 300)]))
    return np.array(boxes), np.concatenate(points)


def find(boxes: FloatArray, points_m: FloatArray) -> str:
    names = tuple(map(str, range(len(boxes))))
    labels = SweepLabels(Path("labels.csv"), "s", names, ("car",) * len(boxes), boxes, states_yaw=False)
    return yaw_conventions.find_convention([(Sweep("s", points_m), labels)])[0]


@pytest.mark.parametrize("name", INVERSE)
@pytest.mark.parametrize("size_m", [(12.0, 2.5), (4.4, 1.2)])
def test_finds_the_convention_of_long_boxes(name: str, size_m: tuple[float, float]) -> None:
    boxes, points = filled_boxes(8, size_m)
    boxes[:, 6] = INVERSE[name](boxes[:, 6])
    assert find(boxes, points) == name


@pytest.mark.parametrize("count", [1, 2, 4])
def test_few_boxes_are_refused_even_if_one_convention_fits(count: int) -> None:
    boxes, points = filled_boxes(count, (12.0, 2.5))
    with pytest.raises(InputError, match=rf"expected 5 boxes that tell, got {count}.*--yaw x-ccw"):
        find(boxes, points)


@pytest.mark.parametrize("size_m", [(2.0, 2.0), (2.2, 2.0), (0.8, 0.7)])
def test_square_boxes_and_pedestrians_are_refused(size_m: tuple[float, float]) -> None:
    boxes, points = filled_boxes(30, size_m)
    with pytest.raises(InputError, match=r"labels\.csv: the convention of headings is not clear"):
        find(boxes, points)


def test_boxes_without_points_are_refused() -> None:
    boxes, points = filled_boxes(8, (4.4, 1.2))
    with pytest.raises(InputError, match="points in boxes by convention: x-ccw 0"):
        find(boxes, points + np.array([0.0, 500.0, 0.0]))
