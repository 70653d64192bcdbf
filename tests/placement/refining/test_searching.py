"""The search finds known lowest points, asks for no more than it may, and draws nothing from NumPy's global state."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.placement.refinement import minimise

LOWEST = np.array([0.95, 0.3, 1.0])
ENDS: tuple[list[float | None], list[float | None]] = ([None, 0.0, 0.0], [None, 1.0, 1.0])


def asked(axes: int, evaluations: int, start: float = 0.5, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The points that are asked for, and their losses: the squared distance from the lowest point, round the circle on
    the first axis."""
    points, losses = [], []

    def of(some: np.ndarray) -> np.ndarray:
        away = some - LOWEST[:axes]
        away[:, 0] -= np.rint(away[:, 0])
        points.append(some)
        losses.append((away**2).sum(axis=1))
        return losses[-1]

    ends = ENDS[0][:axes], ENDS[1][:axes]
    minimise(of, np.full(axes, start), ends, evaluations, np.random.default_rng(seed))
    return np.concatenate(points), np.concatenate(losses)


@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("start", [0.0, 0.45])
def test_the_lowest_point_is_found_round_the_end_of_a_circle_and_at_an_end(axes: int, start: float) -> None:
    points, losses = asked(axes, 400, start)
    assert len(points) <= 400
    assert losses.min() < 1e-5
    assert ((points[:, 1:] >= 0.0) & (points[:, 1:] <= 1.0)).all()


def test_it_is_drawn_from_the_generator_alone() -> None:
    before = global_state()
    np.testing.assert_array_equal(asked(3, 100)[0], asked(3, 100)[0])
    assert not np.array_equal(asked(3, 100)[0], asked(3, 100, seed=1)[0])
    assert global_state() == before


def global_state() -> str:
    """Of NumPy's own generator."""
    return repr(np.random.get_state(legacy=False))  # noqa: NPY002 - what libraries may draw from


def test_losses_that_are_all_alike_end_it() -> None:
    calls = []
    minimise(
        lambda some: calls.append(len(some)) or np.full(len(some), 1e6),  # type: ignore[func-returns-value]
        np.full(2, 0.5),
        ([0.0, 0.0], [1.0, 1.0]),
        100_000,
        np.random.default_rng(0),
    )
    assert sum(calls) < 30_000
