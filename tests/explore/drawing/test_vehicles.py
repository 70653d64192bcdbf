"""Drawn vehicles fill their boxes, turned and pitched as recorded."""

from __future__ import annotations

import math

import numpy as np

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.explore import drawing
from egvs.validation import cloud_simulation

BOXES = np.array([[10.0, 20.0, 0.75, 4.5, 1.8, 1.5, 0.0], [1000.0, -5.0, 1.5, 12.0, 2.5, 3.0, math.pi / 2]])


def frame(pitch_rad: float = 0.0) -> TrafficFrame:
    return TrafficFrame(0, ("a", "b"), ("passenger", "bus"), BOXES, np.array([0.0, pitch_rad]))


def test_a_vehicle_fills_its_box() -> None:
    one = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([True, False]), (8.0, 0.0, 0.0)
    )
    assert np.allclose(one.points.min(axis=0), [2 - 2.25, 20 - 0.9, 0.0], atol=1e-5)
    assert np.allclose(one.points.max(axis=0), [2 + 2.25, 20 + 0.9, 1.5], atol=1e-5)
    turned = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([False, True]), (1000.0, 0.0, 0.0)
    )
    assert np.allclose(turned.points.min(axis=0), [-1.25, -11.0, 0.0], atol=1e-5)
    assert np.allclose(turned.points.max(axis=0), [1.25, 1.0, 3.0], atol=1e-5)
    assert one.faces.max() == len(one.points) - 1
    both = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([True, True]), (0.0, 0.0, 0.0)
    )
    assert len(both.faces) == len(one.faces) + len(turned.faces)


def test_its_nose_goes_up_with_its_pitch() -> None:
    level, up = (
        drawing.vehicle_mesh(
            frame(pitch),
            ["sedan", "bus"],
            cloud_simulation.builtin_bodies(),
            np.array([False, True]),
            (1000.0, -5.0, 1.5),
        )
        for pitch in (0.0, 0.1)
    )
    front = level.points[:, 1] > 5.9  # it drives north
    assert front.any()
    assert np.allclose(up.points[front, 2] - level.points[front, 2], 6.0 * math.sin(0.1), atol=0.03)


def test_of_no_vehicle_there_is_nothing() -> None:
    none = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([False, False]), (0.0, 0.0, 0.0)
    )
    assert (none.points.shape, none.faces.shape) == ((0, 3), (0, 3))
