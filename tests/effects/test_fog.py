"""Fog."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.sensors.sensor import Sensor
from tests.effects.detect_helpers import (
    RANGES_M,
    hits_along_beam,
    make_effect,
    scored,
    visibility_m,
)


@pytest.mark.slow
@given(
    visibility_m,
    visibility_m,
    st.sampled_from(["kim", "kruse"]),
    st.sampled_from([865.0, 905.0, 1550.0]),
    st.sampled_from([0.02, 0.05]),
)
def test_thicker_fog_never_raises_detection(
    one: float, other: float, model: str, wavelength_nm: float, contrast: float
) -> None:
    sensor = Sensor("test", (0.0,), (0.0,), 1, 100.0, "this test", wavelength_nm=wavelength_nm)
    thick, thin = (
        make_effect("fog", visibility_m=v, model=model, contrast=contrast).detect(RANGES_M, sensor)
        for v in sorted((one, other))
    )
    assert (thick <= thin).all()
    assert (np.diff(thick) <= 0).all()


def test_fog_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """At 100 m, Kim's model ignores the wavelength; the contrast after 100 m is 2 %, so after 20.5 m it is 0.02^0.205 =
    0.4484."""
    assert hits_along_beam(one_beam_run, "effects.fog.visibility_m=100")[0] == pytest.approx(0.02**0.205, abs=1e-9)
    assert hits_along_beam(one_beam_run, "effects.fog.visibility_m=100")[0] == pytest.approx(0.4484, abs=5e-5)


def test_fog_model_kruse_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """1 km: q = 0.585, (905 / 550)^-0.585 = 0.7473; 3.912 * 0.7473 = 2.923 / km; 0.0605 km, e^-0.1769 = 0.8379."""
    assert hits_along_beam(one_beam_run, "effects.fog={visibility_m = 1000, model = 'kruse'}")[40] == pytest.approx(
        0.8379, abs=5e-5
    )


def exponent(model: str, visibility_m: float) -> float:
    """q, from the extinction at two wavelengths."""
    fog = make_effect("fog", visibility_m=visibility_m, model=model)
    return -math.log(fog.extinction_per_m(1100.0) / fog.extinction_per_m(550.0), 2)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("visibility_m", "kim", "kruse"),
    [
        (60_000, 1.6, 1.6),
        (10_000, 1.3, 1.3),
        (4_000, 0.98, 0.585 * 4 ** (1 / 3)),
        (700, 0.2, 0.585 * 0.7 ** (1 / 3)),
        (300, 0, 0.585 * 0.3 ** (1 / 3)),
    ],
)
def test_exponents_agree_with_the_sources(visibility_m: float, kim: float, kruse: float) -> None:
    assert exponent("kim", visibility_m) == pytest.approx(kim, abs=1e-9)
    assert exponent("kruse", visibility_m) == pytest.approx(kruse, abs=1e-9)


@pytest.mark.parametrize("edge_m", [500.0, 1000.0, 6000.0])
def test_exponent_of_kim_is_continuous_in_fog_and_mist(edge_m: float) -> None:
    assert exponent("kim", edge_m * (1 - 1e-9)) == pytest.approx(exponent("kim", edge_m * (1 + 1e-9)), abs=1e-6)


def test_fog_attenuates_17_db_over_the_visibility_at_550_nm() -> None:
    """As ITU-R P.1814-1 prints it: 17 / V dB/km."""
    per_m = make_effect("fog", visibility_m=2000).extinction_per_m(550.0)  # type: ignore[attr-defined]
    assert per_m * 1000 * 10 / math.log(10) == pytest.approx(17 / 2, rel=1e-3)


def test_visibility_at_either_contrast_gives_the_same_fog() -> None:
    """A contrast of 2 % at 391 m is one of 5 % at 300 m; near 700 m the exponent depends on it, too."""
    for at_2_percent in (391.2, 700.0):
        at_5_percent = at_2_percent * math.log(0.05) / math.log(0.02)
        one, other = (
            make_effect("fog", visibility_m=at_2_percent),
            make_effect("fog", visibility_m=at_5_percent, contrast=0.05),
        )
        assert one.extinction_per_m(905.0) == pytest.approx(other.extinction_per_m(905.0), rel=1e-12)  # type: ignore[attr-defined]


def test_fog_depends_on_the_wavelength_of_the_sensor(score_run: tuple[Path, Path]) -> None:
    haze = "effects.fog={visibility_m = 1000, model = 'kruse'}"
    near, far = (scored(score_run, [haze, f"sensors.small.wavelength_nm={w}"])[0]["egvs"] for w in (865, 1550))
    assert all(a < b for a, b in zip(near, far, strict=True))
