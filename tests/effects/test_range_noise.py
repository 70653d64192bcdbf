"""Range noise that grows with range and incidence, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.effects.base import Echo, Echoes
from tests.effects.detect_helpers import make_effect


def sigma_m(range_m: float, incidence_deg: float, **parameters: float) -> float:
    effect = make_effect("range_noise", **parameters)
    assert isinstance(effect, Echo)
    cosine = np.cos(np.radians([incidence_deg]))
    (value,) = effect.sigma_m(Echoes(np.array([range_m]), cosine, np.array([False]), np.array([np.nan])))
    return float(value)


def test_noise_is_footprint_times_range_times_tangent() -> None:
    """40 m at 45 degrees: 0.037e-3 * 40 * 1 = 1.48 mm; 1 mrad at 30 m and 60 degrees: 0.03 * 1.73205 = 0.05196 m."""
    assert sigma_m(40.0, 45.0) == pytest.approx(1.48e-3)
    assert sigma_m(30.0, 60.0, footprint_mrad=1) == pytest.approx(0.05196, abs=1e-5)


def test_no_noise_is_added_at_normal_incidence_and_at_most_the_largest() -> None:
    assert sigma_m(100.0, 0.0) == 0.0
    assert sigma_m(100.0, 89.9) == 0.1
    assert sigma_m(100.0, 90.0, max_sigma_m=0.3) == pytest.approx(0.3)


def test_measured_noise_of_the_road() -> None:
    """Chengdu, 3.7 m above the road: 1.0 cm at 34 m and 2.7 cm at 46 m with a sensor of 5.4 mm; within a third."""
    for range_m, incidence_deg, measured_m in ((34.4, 83.82, 0.0101), (46.1, 85.38, 0.0271), (93.3, 87.72, 0.0936)):
        assert np.hypot(0.0054, sigma_m(range_m, incidence_deg)) == pytest.approx(measured_m, rel=0.35)


def test_loses_no_returns() -> None:
    effect = make_effect("range_noise")
    assert isinstance(effect, Echo)
    returns = Echoes(np.array([5.0]), np.array([0.0]), np.array([True]), np.array([0.0]))
    assert effect.probability(returns).tolist() == [1.0]


@pytest.mark.parametrize("parameters", [{"footprint_mrad": 0}, {"max_sigma_m": 0}])
def test_idle_without_noise(parameters: dict[str, float]) -> None:
    effect = make_effect("range_noise", **parameters)
    assert effect.why_idle(None) == "no noise is added"  # type: ignore[arg-type]
