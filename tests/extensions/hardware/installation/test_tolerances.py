"""Tolerances are where the score of the moved sensor has dropped by a point."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from egvs.extensions.hardware.installation.tolerances import distance_to_one_point, pose_tolerances
from tests.extensions.hardware.installation.conftest import InstalledRun


@pytest.mark.slow
def test_losses_are_those_of_the_moved_sensor(installed: InstalledRun) -> None:
    sites = installed.sites
    site, session = sites.site("pole_a"), sites.session
    result = pose_tolerances(session, site)
    assert [tolerance.quantity.name for tolerance in result.tolerances] == ["tilt", "roll", "bearing", "height"]
    assert result.frames == 40
    height = result.tolerances[-1]
    for offset, loss in zip(height.offsets, height.losses, strict=True):
        moved = session.rate("pole_a", replace(site.pose, z_m=site.pose.z_m + offset)).scores[session.rank_by]
        assert loss == pytest.approx(100.0 * (result.planned - moved))
    for tolerance in result.tolerances:
        inside = [
            loss
            for offset, loss in zip(tolerance.offsets, tolerance.losses, strict=True)
            if -tolerance.down < offset < tolerance.up
        ]
        assert max(inside) < 1.0


@pytest.mark.parametrize(
    ("losses", "expected"),
    [
        ([(0.0, 0.0), (1.0, 2.0)], 0.5),
        ([(0.0, 0.0), (1.0, -1.0), (2.0, 1.0), (4.0, 0.0)], 2.0),
        ([(0.0, 0.0), (2.0, 0.5), (4.0, 0.9)], math.inf),
        ([(0.0, 0.0)], math.inf),
    ],
)
def test_distance_is_linear_between_steps(losses: list[tuple[float, float]], expected: float) -> None:
    assert distance_to_one_point(losses) == expected


@pytest.mark.slow
def test_poses_below_the_ground_are_left_out(installed: InstalledRun) -> None:
    sites = installed.sites
    site = sites.site("pole_a")
    low = replace(site, pose=replace(site.pose, z_m=0.4))
    height = pose_tolerances(sites.session, low).tolerances[-1]
    assert height.offsets[0] == -0.25
