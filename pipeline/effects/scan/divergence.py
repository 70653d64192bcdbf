r"""How much of a beam gets past a thin pole.

Model: a beam is a cone with a Gaussian profile, whose intensity has fallen to :math:`1/e^2` at half the sensor's full
angle :math:`\Theta` on either side: with a the angle across (azimuth) and e along the elevation,

.. math:: I(a, e) \propto \exp\left(-2 \left[ (2a/\Theta_a)^2 + (2e/\Theta_e)^2 \right]\right)

(Siegman 1986, *Lasers*, ch. 17). It is cast as 7 or 19 weighted sub-beams: the middle of the cone and one or two rings.
With :math:`s = 8 a^2/\Theta_a^2 + 8 e^2/\Theta_e^2` the profile is :math:`e^{-s}`; the rings are the nodes of the
Gauss-Radau-Laguerre rule in s, :math:`s = 2`, or :math:`s = 3 \pm \sqrt 3`, with 6 and 12 sub-beams evenly round. With
7 this is formula :math:`E_2^{r^2}` 5-1 of Stroud (1971), *Approximate Calculation of Multiple Integrals*, exact for
polynomials up to degree 5.

Calls for it: poles, signs and edges at ranges where the beam is as wide as they are. Limits: a flat shadow edge falls
between nodes, so a single beam's share comes in steps (7: twelfths, and half for the middle); a target in a voxel
counts by the share that gets there, not by what a detector makes of it; angles are taken as their tangents (exact to
1e-5 below 10 mrad). Angles are those of 1/e^2; a full width at half maximum (as Ouster states it) is 1.70 times as wide
there. Where a maker does not say which it means, 1/e^2 is taken.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import cosdg, sindg

from pipeline.effects.base import Expand
from pipeline.scenario.effects import DivergenceParameters, EffectParameters
from pipeline.sensing import sensors
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose

# Rings of each rule: (s, weight of the ring, sub-beams on it, azimuth of the first in degrees).
_ROOT = math.sqrt(3.0)
_RINGS: dict[int, tuple[tuple[float, float, int, float], ...]] = {
    1: (),
    7: ((2.0, 1 / 2, 6, 0.0),),
    19: (
        (3 - _ROOT, (_ROOT + 1) / (2 * _ROOT) / (3 - _ROOT), 6, 0.0),
        (3 + _ROOT, (_ROOT - 1) / (2 * _ROOT) / (3 + _ROOT), 12, 15.0),
    ),
}

_Angle = Annotated[float, Field(ge=0, le=100)]


class Divergence(Expand[DivergenceParameters]):
    """A beam as a cone of weighted sub-beams."""

    NAME: ClassVar[str] = "divergence"
    SOURCE: ClassVar[str] = "Gaussian beam (Siegman 1986); cubature E2r2 5-1 of Stroud (1971)"
    Model: ClassVar[type[EffectParameters]] = DivergenceParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"sub_beams": (7, 19)}

    @property
    def copies(self) -> int:
        """As asked for."""
        return int(self.parameters.sub_beams)

    def why_idle(self, scene: Scene) -> str | None:
        """A single sub-beam, or a cone without width, is the plain beam."""
        if self.parameters.sub_beams == 1:
            return "sub_beams is 1"
        cast = scene.cast_sites
        if not cast:
            return "all scans are measured"
        known = {site.sensor: scene.sensor(site.sensor, f"site {site.name}") for site in cast}
        return None if any(any(self.angles_mrad(sensor)) for sensor in known.values()) else "divergence_mrad is 0"

    def seen(self, scene: Scene) -> str:
        """How wide a beam is at the far end of the region of interest."""
        low = np.asarray(scene.roi.origin_m)
        high = low + np.asarray(scene.roi.size_m)
        widths_m = []
        for site in scene.cast_sites:
            at = np.asarray(site.pose.position_m)
            far_m = float(np.sqrt((np.maximum(np.abs(low - at), np.abs(high - at)) ** 2).sum()))
            widths_m.append(1e-3 * max(self.angles_mrad(scene.sensor(site.sensor))) * far_m)
        return f"at the far end of the region a beam is {100 * max(widths_m):.0f} cm wide"

    def angles_mrad(self, sensor: Sensor) -> tuple[float, float]:
        """Full angles across and along the elevation."""
        across, along = self.parameters.divergence_mrad or sensor.divergence_mrad
        return across, along

    def expand(
        self, directions: NDArray[np.float64], sensor: Sensor, pose: Pose
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Sub-beams in the sensor's own azimuth and elevation, the middle one of each beam first and unchanged."""
        offsets, weights = nodes(self.parameters.sub_beams)
        across, along = (1e-3 * angle for angle in self.angles_mrad(sensor))
        if across == along == 0.0:
            offsets, weights = nodes(1)
        sideways, upwards = _frame(directions, sensors.rotation(*pose.angles_deg))
        rays = np.empty((len(directions), len(weights), 3))
        rays[:, 0] = directions
        for i, (a, e) in enumerate(offsets[1:], start=1):
            moved = directions + (across * a) * sideways + (along * e) * upwards
            rays[:, i] = moved / np.sqrt((moved**2).sum(axis=1))[:, None]
        parent = np.repeat(np.arange(len(directions)), len(weights))
        return rays.reshape(-1, 3), parent, np.tile(weights, len(directions))


def nodes(sub_beams: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offsets across and along, (k, 2), in full angles, and weights, (k,), whose sum is 1; the middle is first."""
    offsets, weights = [(0.0, 0.0)], [1.0 - math.fsum(weight for _, weight, _, _ in _RINGS[sub_beams])]
    for s, weight, count, first_deg in _RINGS[sub_beams]:
        radius = math.sqrt(s / 8)
        for turn in first_deg + np.arange(count) * (360.0 / count):
            offsets.append((radius * float(cosdg(turn)), radius * float(sindg(turn))))
            weights.append(weight / count)
    return np.array(offsets), np.array(weights)


def _frame(
    directions: NDArray[np.float64], rotation: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors towards larger azimuth and larger elevation of a sensor that is turned so, (n, 3) each."""
    sideways = np.cross(rotation[:, 2], directions)
    size = np.sqrt((sideways**2).sum(axis=1))
    upright = size < 1e-9  # along the sensor's axis there is no azimuth; any pair will do
    sideways = np.where(upright[:, None], rotation[:, 1], sideways / np.where(upright, 1.0, size)[:, None])
    upwards: NDArray[np.float64] = np.cross(directions, sideways)
    return sideways, upwards
