r"""Mount sway: the scan is averaged over the tilts of a swaying pole.

Model: the mount tilts by a rotation vector :math:`(\alpha, \beta, 0)`: a rotation by :math:`\sqrt{\alpha^2 + \beta^2}`
about the horizontal axis :math:`(\alpha, \beta)` of the world through the sensor, with :math:`\alpha, \beta`
independent and Gaussian, each of standard deviation ``tilt_deg`` (Rodrigues' formula rotates the beams). The scan is
the mean over this distribution, at the nodes of the Gauss-Hermite rule of n nodes for each axis (Abramowitz and
Stegun 1964, 25.4.46; closed forms up to n = 4), which has all moments of the Gaussian up to degree :math:`2n - 1`:

.. math:: E f(\alpha, \beta) \approx \sum_{i,j} w_i w_j\, f(\sigma x_i, \sigma x_j)

Use it for slender poles, cantilever arms and bridges. Limits: the sensor rotates but does not move (1 degree on a pole
of 5 m would move it by 9 cm); no torsion about the pole; the pole is still during one turn of the sensor. The Gaussian
is an assumption, and no amplitude is from the literature: ``tilt_deg`` has to be measured or estimated.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from egvs.core.grid import FloatArray
from egvs.core.special import cosdg, sindg
from egvs.effects.base import Expand
from egvs.scenario.effects_config import EffectParameters, MountSwayParameters
from egvs.sensors.beam_hooks import SubBeams
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose

_ROOT = math.sqrt(6.0)
_HERMITE: dict[int, tuple[tuple[float, float], ...]] = {
    1: ((0.0, 1.0),),
    2: ((-1.0, 1 / 2), (1.0, 1 / 2)),
    3: ((-math.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (math.sqrt(3.0), 1 / 6)),
    4: (
        (-math.sqrt(3 + _ROOT), (3 - _ROOT) / 12),
        (-math.sqrt(3 - _ROOT), (3 + _ROOT) / 12),
        (math.sqrt(3 - _ROOT), (3 + _ROOT) / 12),
        (math.sqrt(3 + _ROOT), (3 - _ROOT) / 12),
    ),
}
"""Nodes and weights for a Gaussian of standard deviation 1, by their number on one axis."""


class MountSway(Expand[MountSwayParameters]):
    """A pose averaged over a tilt distribution."""

    NAME: ClassVar[str] = "mount_sway"
    SOURCE: ClassVar[str] = "Gaussian tilt (assumed); Gauss-Hermite rule (Abramowitz and Stegun 1964, 25.4.46)"
    Model: ClassVar[type[EffectParameters]] = MountSwayParameters
    TRIAL: ClassVar[dict[str, Any]] = {"tilt_deg": 0.5}
    USER_KNOWLEDGE: ClassVar[str] = "how the mount moves"
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"samples": (4, 9, 16)}

    @property
    def copies(self) -> int:
        """Number of tilts."""
        return int(self.parameters.samples)

    def why_idle(self, scene: Scene) -> str | None:
        """A pole at rest changes nothing."""
        if self.parameters.tilt_deg == 0:
            return "tilt_deg is 0"
        if self.parameters.samples == 1:
            return "samples is 1"
        if not scene.cast_sites:
            return "all scans are measured"
        return None

    def expand(self, directions: FloatArray, sensor: Sensor, pose: Pose) -> SubBeams:
        """Return each beam once for each tilt."""
        tilts, weights = tilt_nodes(self.parameters.samples if self.parameters.tilt_deg > 0 else 1)
        rays = np.empty((len(directions), len(weights), 3))
        for i, (about_x, about_y) in enumerate(tilts * self.parameters.tilt_deg):
            rays[:, i] = rotate_directions(directions, float(about_x), float(about_y))
        parent = np.repeat(np.arange(len(directions)), len(weights))
        return SubBeams(rays.reshape(-1, 3), parent, np.tile(weights, len(directions)))


def tilt_nodes(samples: int) -> tuple[FloatArray, FloatArray]:
    """Return tilts about x and y, (samples, 2), in standard deviations, and weights, (samples,), whose sum is 1."""
    rule = _HERMITE[math.isqrt(samples)]
    tilts = np.array([(x, y) for x, _ in rule for y, _ in rule])
    weights = np.array([v * w for _, v in rule for _, w in rule])
    return tilts, weights


def rotate_directions(directions: FloatArray, x_deg: float, y_deg: float) -> FloatArray:
    """Rotate unit vectors (n, 3) by the rotation vector (x_deg, y_deg, 0); unchanged where that is 0."""
    angle = math.hypot(x_deg, y_deg)
    if angle == 0.0:
        return directions
    axis = np.array([x_deg / angle, y_deg / angle, 0.0])
    along = directions[:, :1] * axis[0] + directions[:, 1:2] * axis[1]
    cos = cosdg(angle)
    rotated: FloatArray = directions * cos + np.cross(axis, directions) * sindg(angle) + axis * along * (1.0 - cos)
    return rotated
