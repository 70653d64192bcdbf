"""Range limit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.core.errors import InputError
from egvs.scenario.sensor_config import SensorConfig
from egvs.sensors import sensor
from egvs.sensors.sensor import CATALOGUE
from tests.effects.detect_helpers import (
    RANGES_M,
    SENSOR,
    hits_along_beam,
    make_effect,
    make_scene,
    scored,
)


@given(st.floats(0.001, 100), st.floats(0.001, 100), st.floats(0, 89.9), st.floats(0, 3))
def test_darker_target_is_detected_less(one: float, other: float, incidence_deg: float, softness: float) -> None:
    dark, bright = (
        make_effect("range_limit", reflectivity=rho, incidence_deg=incidence_deg, softness=softness).detect(
            RANGES_M, SENSOR
        )
        for rho in sorted((one, other))
    )
    assert (dark <= bright).all()
    assert (np.diff(dark) <= 0).all()
    assert ((dark >= 0) & (bright <= 1)).all()


def test_hard_limit_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """Rated 40 m at 0.8: a quarter of that reflectivity comes back from 20 m; middles of chords are at 19.75 and 20.25
    m."""
    result = hits_along_beam(
        one_beam_run,
        "effects.range_limit={rated_range_m = 40, rated_reflectivity = 0.8, reflectivity = 0.2,"
        " softness = 0, dropout = 0}",
    )
    np.testing.assert_array_equal(result, [1.0] * 20 + [0.0] * 60)


def test_incidence_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """cos 60 deg = 1/2, and another factor of 1/2 in reflectivity: again 20 m."""
    result = hits_along_beam(
        one_beam_run,
        "effects.range_limit={rated_range_m = 40, rated_reflectivity = 0.8, reflectivity = 0.4, incidence_deg = 60,"
        " softness = 0, dropout = 0}",
    )
    np.testing.assert_array_equal(result, [1.0] * 20 + [0.0] * 60)


def test_soft_limit_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    """Rated 20.25 m: one half there. At 10.25 m the power is (20.25 / 10.25)^2 = 3.903 times the threshold, ln =
    1.3618; over a softness of 1 the normal distribution says 0.9134."""
    result = hits_along_beam(
        one_beam_run,
        "effects.range_limit={rated_range_m = 20.25, rated_reflectivity = 0.03, softness = 1, dropout = 0}",
    )
    assert result[20] == 0.5
    assert result[0] == pytest.approx(0.9134, abs=5e-5)


def test_flat_target_of_a_datasheet() -> None:
    """Ouster OS1: 10 % targets 50 % at 55 m and 90 % at 45 m, a softness of 0.3; on cars it is 1."""
    os1 = sensor.CATALOGUE["OS1-128"]
    flat = make_effect("range_limit", reflectivity=0.1, softness=0.3, dropout=0)
    at_45, at_55 = flat.detect(np.array([45.0, 55.0]), os1)
    assert at_55 == pytest.approx(0.5, abs=1e-12)
    assert at_45 == pytest.approx(0.9, abs=0.015)


def test_everything_but_the_dropout_is_detected_next_to_the_sensor() -> None:
    assert make_effect("range_limit").detect(np.array([0.0, 1e-6]), SENSOR).tolist() == [0.95, 0.95]


# Sensors
def test_catalogue_sensors_have_a_rated_range() -> None:
    for entry in CATALOGUE.values():
        assert entry.rated_range_m is not None, f"{entry.name} needs one for range_limit"
        assert 0 < entry.rated_range_m <= entry.range_m
        assert 0 < entry.rated_reflectivity <= 1
        assert 800 < entry.wavelength_nm < 1600


def test_custom_sensor_may_have_a_rated_range(score_run: tuple[Path, Path]) -> None:
    rated = [
        "sensors.small.rated_range_m=30",
        "sensors.small.rated_reflectivity=0.4",
        "sensors.small.wavelength_nm=1550",
    ]
    result = sensor.resolve_sensor("small", egvs.load(score_run[0], rated).sensors, "here")
    assert (result.rated_range_m, result.rated_reflectivity, result.wavelength_nm) == (30.0, 0.4, 1550.0)
    assert result.divergence_mrad == sensor.Sensor.divergence_mrad
    by_sensor, by_effect = (
        scored(score_run, settings)[0]
        for settings in (
            [*rated, "effects.range_limit.softness=0"],
            ["effects.range_limit={rated_range_m = 30, rated_reflectivity = 0.4, softness = 0}"],
        )
    )
    assert by_sensor == by_effect


def test_missing_optics_are_not_in_the_sensor_settings() -> None:
    model = SensorConfig(elevations_deg=(0,), azimuth_step_deg=1, range_m=5)
    assert set(model.model_dump(mode="json")) == {
        "elevations_deg",
        "channels",
        "azimuth_offsets_deg",
        "azimuth_step_deg",
        "range_m",
    }
    output = model.model_copy(update={"rated_range_m": 3.0})
    assert output.model_dump(mode="json")["rated_range_m"] == 3.0
    assert SensorConfig.model_validate(output.model_dump(mode="json")) == output


def test_rejects_sensor_without_rated_range(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, output = run_egvs("run", mini, "--out", tmp_path / "out", "--set", "effects.range_limit.reflectivity=0.2")
    assert code == 2
    assert (
        "sensor small: rated_range_m is missing. Add it to [sensors.small], or to [effects.range_limit]."
        in " ".join(output.split())
    )
    assert not (tmp_path / "out" / "scores.parquet").exists()


def test_range_limit_is_active_for_measured_scans(score_run: tuple[Path, Path]) -> None:
    """Its points may lie beyond the sensor's nominal range."""
    (score_run[0] / "one.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    (score_run[0] / "cloud.csv").write_text("x_m,y_m,z_m\n20,0,1\n")
    measured = make_scene(score_run, "sites.points='cloud.csv'", "sites.file='one.csv'")
    assert make_effect("range_limit", softness=0, rated_range_m=600).why_idle(measured) is None


@pytest.mark.parametrize(
    "key",
    ["wavelength_nm=0", "rated_range_m=-3", "rated_reflectivity=0", "divergence_mrad=[1]", "divergence_mrad=[-1, 1]"],
)
def test_rejects_bad_optics(mini: Path, key: str) -> None:
    with pytest.raises(InputError, match=rf"sensors\.small\.{key.split('=')[0]}"):
        egvs.load(mini, [f"sensors.small.{key}"])
