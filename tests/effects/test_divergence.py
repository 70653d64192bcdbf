"""Beam divergence."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.effects.divergence import Divergence
from egvs.effects.divergence import beam_nodes as cone_nodes
from egvs.scenario.effects_config import DivergenceParameters
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from tests.effects.scan_helpers import (
    DIVERGENCE,
    hits_along_only_beam,
    one_beam_scene,
    prism,
    scan_hits,
)


# --- divergence
@pytest.mark.parametrize(("count", "degree"), [(7, 5), (19, 5)])
def test_sub_beams_have_the_moments_of_the_gaussian_profile(count: int, degree: int) -> None:
    offsets, weights = cone_nodes(count)
    assert len(weights) == count and weights.min() > 0
    assert math.fsum(weights) == pytest.approx(1, abs=1e-15)
    sigma = 1 / 4  # the intensity is 1/e^2 at two standard deviations, which is half the full angle
    for a in range(degree + 1):
        for e in range(degree + 1 - a):
            exact = 0.0 if a % 2 or e % 2 else sigma ** (a + e) * math.prod(range(1, a, 2)) * math.prod(range(1, e, 2))
            assert (weights * offsets[:, 0] ** a * offsets[:, 1] ** e).sum() == pytest.approx(
                exact, rel=1e-14, abs=1e-15
            )


def test_radial_moments_of_19_sub_beams() -> None:
    offsets, weights = cone_nodes(19)
    s = 8 * (offsets**2).sum(axis=1)
    assert [(weights * s**n).sum() for n in range(5)] == pytest.approx([math.factorial(n) for n in range(5)])


def test_sub_beams_are_offset_in_azimuth_and_elevation_of_the_sensor() -> None:
    sensor = Sensor("s", (10.0,), (0.0,), 8, 100.0, "", divergence_mrad=(8.0, 2.0))
    mount = Pose(0, 0, 0, yaw_deg=30, pitch_deg=-20, roll_deg=40)
    pose = mount.angles_deg
    rays, parent, weights = Divergence(DivergenceParameters()).expand(sensor.directions(*pose), sensor, mount)
    assert parent.tolist() == [i for i in range(8) for _ in range(7)]
    np.testing.assert_array_equal(rays[::7], sensor.directions(*pose))
    np.testing.assert_allclose((rays**2).sum(axis=1), 1, atol=1e-15)
    inside = rays @ rotation_world_sensor(*pose)  # back into the sensor's frame
    elevation = np.arcsin(inside[:, 2]).reshape(8, 7)
    azimuth = np.arctan2(inside[:, 1], inside[:, 0]).reshape(8, 7)
    temp_path = np.angle(np.exp(1j * (azimuth - azimuth[:, :1]))) * math.cos(math.radians(10))
    offsets, _ = cone_nodes(7)
    np.testing.assert_allclose(temp_path, np.tile(8e-3 * offsets[:, 0], (8, 1)), atol=1e-5)
    np.testing.assert_allclose(elevation - math.radians(10), np.tile(2e-3 * offsets[:, 1], (8, 1)), atol=1e-5)
    assert weights.reshape(8, 7).sum(axis=1) == pytest.approx(1)


def test_beam_along_the_axis_of_the_sensor_diverges() -> None:
    sensor = Sensor("s", (90.0,), (0.0,), 1, 100.0, "", divergence_mrad=(4.0, 4.0))
    rays, _, _ = Divergence(DivergenceParameters()).expand(sensor.directions(), sensor, Pose(0, 0, 0))
    assert np.hypot(rays[1:, 0], rays[1:, 1]) == pytest.approx(2e-3, rel=1e-5)


@pytest.mark.parametrize("count", [7, 19])
def test_thin_pole_shades_part_of_a_cone(mini: Path, tmp_path: Path, count: int) -> None:
    """A pole of 0.1 m, 30 m away, in a cone of 10 mrad, 0.3 m wide there.

    7 sub-beams: the ring lies at half the full angle: 0.15 m x (cos 0, cos 60) = 0.15, 0.075 m aside, past the pole's
    0.05 m. The pole takes the middle, whose weight is 1/2. (A Gaussian of that width has erf(0.05 / 0.075 / sqrt 2) =
    0.495 there.) 19 sub-beams: rings at 0.15 m x sqrt((3 -+ sqrt 3) / 2) = 0.1194 and 0.2307 m. Inner: 0.1194 x cos(60
    n) = 0.0597, 0.1194: past. Outer: 0.2307 x cos(15 + 30 n) = 0.2229, 0.1631, 0.0597: all past. The middle weighs 1/3.
    """
    folder = one_beam_scene(mini, prism(20, 0.2, 20.1, 0.3, 0, 5, "pole"))
    wide = f"{DIVERGENCE}{count}", "effects.divergence.divergence_mrad=[10, 0.1]"
    plain_scan_run, cone = (
        hits_along_only_beam(scan_hits(folder, tmp_path / "a")),
        hits_along_only_beam(scan_hits(folder, tmp_path / "b", *wide)),
    )
    assert plain_scan_run[:40].tolist() == [1] * 40 and plain_scan_run[41:].tolist() == [0] * 39
    assert cone[:40] == pytest.approx(1, abs=1e-8)
    assert cone[41:43] == pytest.approx({7: 1 / 2, 19: 2 / 3}[count], abs=1e-8)


def test_divergence_of_the_sensor_is_the_default(mini: Path, tmp_path: Path) -> None:
    """Across 3 mrad the cone is 0.09 m wide at 30 m: a pole of 0.1 m takes all of it."""
    folder = one_beam_scene(mini, prism(20, 0.2, 20.1, 0.3, 0, 5, "pole"))
    assert not hits_along_only_beam(scan_hits(folder, tmp_path / "a", f"{DIVERGENCE}7"))[41:].any()
