"""Mount sway."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.effects.mount_sway import rotate_directions
from egvs.effects.mount_sway import tilt_nodes as sway_nodes
from tests.effects.scan_helpers import (
    SWAY,
    one_beam_scene,
    prism,
    scan_hits,
)


# --- mount_sway
@pytest.mark.parametrize(("samples", "degree"), [(4, 3), (9, 5), (16, 7)])
def test_tilts_have_the_moments_of_the_gaussian(samples: int, degree: int) -> None:
    tilts, weights = sway_nodes(samples)
    assert len(weights) == samples and weights.min() > 0
    for a in range(degree + 1):
        for b in range(degree + 1):
            exact = 0.0 if a % 2 or b % 2 else math.prod(range(1, a, 2)) * math.prod(range(1, b, 2))
            assert (weights * tilts[:, 0] ** a * tilts[:, 1] ** b).sum() == pytest.approx(exact, rel=1e-14, abs=1e-13)


def test_tilt_rotates_about_axes_of_the_world() -> None:
    ahead, left, up = np.eye(3)[:, None]
    assert rotate_directions(left, 90, 0)[0] == pytest.approx(up[0])  # about x: y goes up
    assert rotate_directions(up, 0, 90)[0] == pytest.approx(ahead[0])  # about y: z goes to x
    assert rotate_directions(np.array([[0.6, 0.8, 0.0]]), 0.6, 0.8)[0] == pytest.approx(
        [0.6, 0.8, 0.0]
    )  # the axis stays
    rng = np.random.default_rng(3)
    some = rng.normal(size=(50, 3))
    some /= np.linalg.norm(some, axis=1)[:, None]
    turned = rotate_directions(rotate_directions(some, 3, -4), -3, 4)
    np.testing.assert_allclose(turned, some, atol=1e-15)
    np.testing.assert_allclose(
        np.einsum("ij,ij->i", rotate_directions(some, 3, -4), some).min(), math.cos(math.radians(5)), atol=0.02
    )


def test_swaying_sensor_looks_over_a_wall_for_a_share(mini: Path, tmp_path: Path) -> None:
    """A wall at 15 m reaches 0.05 m above the beam. 9 poses at 1 degree: 0 and -+sqrt(3) degrees about y, weighing 2/3,
    1/6, 1/6.

    The beam goes along x, so a turn about y lifts it by 15 m x tan(1.732 deg) = 0.45 m, or lowers it: 1/6 gets over the
    wall. A turn about x leaves it (but for 0.02 degrees aside)."""
    folder = one_beam_scene(mini, prism(5, -6, 5.1, 6, 0, 2.3, "building"))
    sets = f"{SWAY}1", "effects.mount_sway.samples=9"
    result = scan_hits(folder, tmp_path / "b", *sets)["only"]
    assert result[0].sum() == pytest.approx(1, abs=1e-8)
    assert result[12:40].max(axis=(1, 2)) == pytest.approx(1 / 6, abs=1e-8)
