"""Surface losses: the probability of a return, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.effects.base import Echo, Echoes
from tests.effects.detect_helpers import make_effect


def echoes(incidence_deg: float, *, glass: bool = False, draw: float = np.nan) -> Echoes:
    """One return at 20 m."""
    cosine = np.cos(np.radians([incidence_deg]))
    return Echoes(np.array([20.0]), cosine, np.array([glass]), np.array([draw]))


def probability(returns: Echoes, **parameters: float) -> float:
    effect = make_effect("surface_losses", **parameters)
    assert isinstance(effect, Echo)
    (value,) = effect.probability(returns)
    return float(value)


def test_grazing_loss_is_half_at_its_angle_and_nothing_far_below() -> None:
    """At 86 degrees half of 0.66 is lost; at 86.36, two widths on, 0.66 / (1 + e^-2) = 0.5813; at 60 nothing."""
    assert probability(echoes(86.0)) == pytest.approx(1 - 0.33, abs=1e-9)
    assert probability(echoes(86.36)) == pytest.approx(1 - 0.5813, abs=1e-4)
    assert probability(echoes(60.0)) == pytest.approx(1.0, abs=1e-12)


def test_dark_vehicles_are_those_with_the_lowest_draws() -> None:
    """12 % of the vehicles are dark, and lose 40 %; the static world, without a draw, is not dark."""
    assert probability(echoes(0.0, draw=0.1199)) == pytest.approx(0.6)
    assert probability(echoes(0.0, draw=0.12)) == pytest.approx(1.0)
    assert probability(echoes(0.0)) == pytest.approx(1.0)


def test_losses_multiply_on_a_window_of_a_dark_vehicle() -> None:
    """0.6 * 0.79 = 0.474; at 86 degrees 0.474 * 0.67 = 0.3176."""
    assert probability(echoes(0.0, glass=True, draw=0.0)) == pytest.approx(0.474)
    assert probability(echoes(86.0, glass=True, draw=0.0)) == pytest.approx(0.31758, abs=1e-5)


def test_adds_no_noise() -> None:
    effect = make_effect("surface_losses")
    assert isinstance(effect, Echo)
    assert effect.sigma_m(echoes(89.0)).tolist() == [0.0]


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"grazing_loss": 0, "dark_loss": 0, "glass_loss": 0}, "all losses are 0"),
        ({"grazing_loss": 0, "dark_share": 0, "glass_loss": 0}, "all losses are 0"),
        ({"grazing_loss": 0, "dark_share": 0}, None),
        ({}, None),
    ],
)
def test_idle_without_losses(parameters: dict[str, float], reason: str | None) -> None:
    assert make_effect("surface_losses", **parameters).why_idle(None) == reason  # type: ignore[arg-type]
