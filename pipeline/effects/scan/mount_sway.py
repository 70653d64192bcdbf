r"""What a sensor sees from a pole that moves.

Model: the mount tilts by a rotation vector :math:`(\alpha, \beta, 0)`: one turn by :math:`\sqrt{\alpha^2 + \beta^2}`
about the horizontal axis :math:`(\alpha, \beta)` of the world through the sensor, with :math:`\alpha, \beta`
independent and Gaussian, each of standard deviation ``tilt_deg`` (Rodrigues' formula turns the beams). The scan is the
mean over this distribution, taken at the nodes of the Gauss-Hermite rule of n nodes for each axis (Abramowitz and
Stegun 1964, 25.4.46; closed forms up to n = 4), which has all moments of the Gaussian up to degree :math:`2n - 1`:

.. math:: E f(\alpha, \beta) \approx \sum_{i,j} w_i w_j\, f(\sigma x_i, \sigma x_j)

Calls for it: slender poles, cantilever arms, bridges. Limits: the sensor turns but does not move (1 degree on a pole of
5 m would move it by 9 cm); no torsion about the pole; within one turn of the sensor the pole is taken to stand still.
The Gaussian is an assumption, and no amplitude is taken from the literature: ``tilt_deg`` is the user's to measure or
to guess.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from pipeline.effects.base import Expand
from pipeline.scenario.effects import EffectParameters, MountSwayParameters
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose

_ROOT = math.sqrt(6.0)
_HERMITE: dict[int, tuple[tuple[float, float], ...]] = {
    1: ((0.0, 1.0),),
    2: ((-1.0, 1 / 2), (1.0, 1 / 2)),
    3: ((-math.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (math.sqrt(3.0), 1 / 6)),
    4: tuple(
        (sign * math.sqrt(3 + inner * _ROOT), (3 - inner * _ROOT) / 12)
        for sign, inner in ((-1, 1), (-1, -1), (1, -1), (1, 1))
    ),
}
"""Nodes and weights for a Gaussian of standard deviation 1, by their number on one axis."""


class MountSway(Expand[MountSwayParameters]):
    """A pose averaged over a tilt distribution."""

    NAME: ClassVar[str] = "mount_sway"
    SOURCE: ClassVar[str] = "Gaussian tilt (assumed); Gauss-Hermite rule (Abramowitz and Stegun 1964, 25.4.46)"
    Model: ClassVar[type[EffectParameters]] = MountSwayParameters
    TRIAL: ClassVar[dict[str, Any]] = {"tilt_deg": 0.5}
    UNTOLD: ClassVar[str] = "how the mount moves"
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"samples": (4, 9, 16)}

    @property
    def copies(self) -> int:
        """One a pose."""
        return int(self.parameters.samples)

    def why_idle(self, scene: Scene) -> str | None:
        """A pole at rest is the plain one."""
        if self.parameters.tilt_deg == 0:
            return "tilt_deg is 0"
        if self.parameters.samples == 1:
            return "samples is 1"
        return "all scans are measured" if not scene.cast_sites else None

    def expand(
        self, directions: NDArray[np.float64], sensor: Sensor, pose: Pose
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Each beam once for each pose."""
        del sensor, pose
        tilts, weights = nodes(self.parameters.samples if self.parameters.tilt_deg > 0 else 1)
        rays = np.empty((len(directions), len(weights), 3))
        for i, (about_x, about_y) in enumerate(tilts * self.parameters.tilt_deg):
            rays[:, i] = tilted(directions, float(about_x), float(about_y))
        parent = np.repeat(np.arange(len(directions)), len(weights))
        return rays.reshape(-1, 3), parent, np.tile(weights, len(directions))


def nodes(samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tilts about x and y, (samples, 2), in standard deviations, and weights, (samples,), whose sum is 1."""
    rule = _HERMITE[math.isqrt(samples)]
    tilts = np.array([(x, y) for x, _ in rule for y, _ in rule])
    weights = np.array([v * w for _, v in rule for _, w in rule])
    return tilts, weights


def tilted(directions: NDArray[np.float64], about_x_deg: float, about_y_deg: float) -> NDArray[np.float64]:
    """Unit vectors (n, 3) turned by the rotation vector (about_x, about_y, 0), degrees; unchanged when that is 0."""
    angle = math.hypot(about_x_deg, about_y_deg)
    if angle == 0.0:
        return directions
    axis = np.array([about_x_deg / angle, about_y_deg / angle, 0.0])
    along = directions[:, :1] * axis[0] + directions[:, 1:2] * axis[1]
    turned: NDArray[np.float64] = (
        directions * cosdg(angle) + np.cross(axis, directions) * sindg(angle) + axis * along * (1.0 - cosdg(angle))
    )
    return turned
