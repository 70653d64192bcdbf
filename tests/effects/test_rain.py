"""Rain."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.detect_helpers import (
    RANGES_M,
    SENSOR,
    hits_along_beam,
    make_effect,
)

rates = st.floats(0, 300)


@given(rates, rates, st.sampled_from(["japan", "france", "itu2025", "goodin"]))
def test_more_rain_never_raises_detection(one: float, other: float, law: str) -> None:
    less, more = (
        make_effect("rain", rate_mm_h=rate, law=law).detect(RANGES_M, SENSOR) for rate in sorted((one, other))
    )
    assert (more <= less).all()
    assert (np.diff(more) <= 0).all()


# On paper: one beam, one voxel
def test_rain_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """10 mm/h: 1.58 * 10^0.63 = 6.740 dB/km; at 30.25 m 0.0605 km both ways, 0.4078 dB, a share of 10^-0.04078 =
    0.9104."""
    assert hits_along_beam(one_beam_run, "effects.rain.rate_mm_h=10")[40] == pytest.approx(0.9104, abs=5e-5)


def test_rain_law_france_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """10 mm/h: 1.076 * 10^0.67 = 5.033 dB/km; 0.0605 km, 0.3045 dB, 0.9323."""
    assert hits_along_beam(one_beam_run, "effects.rain={rate_mm_h = 10, law = 'france'}")[40] == pytest.approx(
        0.9323, abs=5e-5
    )


def test_rain_law_goodin_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """10 mm/h: 0.01 * 10^0.6 = 0.03981 / m; over 60.5 m 2.4085, e^-2.4085 = 0.0899."""
    assert hits_along_beam(one_beam_run, "effects.rain={rate_mm_h = 10, law = 'goodin'}")[40] == pytest.approx(
        0.0899, abs=5e-5
    )


# Against the sources
def test_rain_law_japan_follows_from_marshall_palmer_drops() -> None:
    """8000 e^(-4.1 R^-0.21 D) drops / (m^3 mm), each taking away twice its cross-section: pi * 8000 / 4.1^3 R^0.63
    mm^2/m^3."""
    for rate in (1.0, 10.0, 50.0):
        by_drops_per_m = math.pi * 8000 / (4.1 * rate**-0.21) ** 3 * 1e-6
        assert make_effect("rain", rate_mm_h=rate).extinction_per_m() == pytest.approx(by_drops_per_m, rel=0.005)  # type: ignore[attr-defined]


def test_rain_laws_of_itu_are_similar_and_goodin_is_not() -> None:
    result = {
        law: make_effect("rain", rate_mm_h=10, law=law).extinction_per_m()
        for law in ("japan", "france", "itu2025", "goodin")
    }  # type: ignore[attr-defined]
    assert result["france"] < result["itu2025"] < result["japan"] < 1.4 * result["france"]
    assert 25 < result["goodin"] / result["japan"] < 27
