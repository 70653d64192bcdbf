r"""Beam divergence: a beam is a cone, part of which gets past a thin pole.

Model: the cone has a Gaussian profile whose intensity falls to :math:`1/e^2` at half the sensor's full angle
:math:`\Theta` on either side. With a the angle across (azimuth) and e along the elevation,

.. math:: I(a, e) \propto \exp\left(-2 \left[ (2a/\Theta_a)^2 + (2e/\Theta_e)^2 \right]\right)

(Siegman 1986, *Lasers*, ch. 17). It is cast as 7 or 19 weighted sub-beams: the middle of the cone and one or two rings.
With :math:`s = 8 a^2/\Theta_a^2 + 8 e^2/\Theta_e^2` the profile is :math:`e^{-s}`; the rings are the nodes of the
Gauss-Radau-Laguerre rule in s, :math:`s = 2`, or :math:`s = 3 \pm \sqrt 3`, with 6 and 12 sub-beams evenly round. With
7 this is formula :math:`E_2^{r^2}` 5-1 of Stroud (1971), *Approximate Calculation of Multiple Integrals*, exact for
polynomials up to degree 5.

Use it for poles, signs and edges at ranges where the beam is as wide as they are. Limits: a straight shadow edge falls
between nodes, so the share of a single beam comes in steps (7: twelfths, and half for the middle); a target in a voxel
counts by the share that reaches it, whatever a detector makes of it; angles are approximated by their tangents (exact
to 1e-5 below 10 mrad). Angles refer to 1/e^2; an angle at half maximum, as Ouster states it, is to be multiplied by
1.70. Where a maker does not say which it means, 1/e^2 is assumed.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np

from egvs.core.grid import FloatArray
from egvs.core.special import cosdg, sindg
from egvs.effects.base import Expand
from egvs.scenario.effects_config import DivergenceParameters, EffectParameters
from egvs.sensors.beam_hooks import SubBeams
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose


class _Ring(NamedTuple):
    """A ring of sub-beams; ``weight`` is that of the whole ring."""

    s: float
    weight: float
    sub_beams: int
    first_deg: float


_ROOT = math.sqrt(3.0)
_RINGS: dict[int, tuple[_Ring, ...]] = {
    1: (),
    7: (_Ring(2.0, 1 / 2, 6, 0.0),),
    19: (
        _Ring(3 - _ROOT, (_ROOT + 1) / (2 * _ROOT) / (3 - _ROOT), 6, 0.0),
        _Ring(3 + _ROOT, (_ROOT - 1) / (2 * _ROOT) / (3 + _ROOT), 12, 15.0),
    ),
}
"""Rings of each rule, by its number of sub-beams."""


class Divergence(Expand[DivergenceParameters]):
    """A beam as a cone of weighted sub-beams."""

    NAME: ClassVar[str] = "divergence"
    SOURCE: ClassVar[str] = "Gaussian beam (Siegman 1986); cubature E2r2 5-1 of Stroud (1971)"
    Model: ClassVar[type[EffectParameters]] = DivergenceParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"sub_beams": (7, 19)}

    @property
    def copies(self) -> int:
        """Number of sub-beams per beam."""
        return int(self.parameters.sub_beams)

    def why_idle(self, scene: Scene) -> str | None:
        """A single sub-beam, or a cone without width, is the plain beam."""
        if self.parameters.sub_beams == 1:
            return "sub_beams is 1"
        if not scene.cast_sites:
            return "all scans are measured"
        sensors = {site.sensor: scene.sensor(site.sensor, f"site {site.name}") for site in scene.cast_sites}
        if all(self.angles_mrad(sensor) == (0.0, 0.0) for sensor in sensors.values()):
            return "divergence_mrad is 0"
        return None

    def summary(self, scene: Scene) -> str:
        """Return the width of a beam at the far end of the region of interest, as a sentence."""
        low = np.asarray(scene.roi.origin_m)
        high = low + np.asarray(scene.roi.size_m)
        widths_m = []
        for site in scene.cast_sites:
            position = np.asarray(site.pose.position_m)
            far_m = float(np.sqrt((np.maximum(np.abs(low - position), np.abs(high - position)) ** 2).sum()))
            widths_m.append(1e-3 * max(self.angles_mrad(scene.sensor(site.sensor))) * far_m)
        return f"at the far end of the region a beam is {100 * max(widths_m):.0f} cm wide"

    def angles_mrad(self, sensor: Sensor) -> tuple[float, float]:
        """Return the full angles across and along the elevation."""
        across, along = self.parameters.divergence_mrad or sensor.divergence_mrad
        return across, along

    def expand(self, directions: FloatArray, sensor: Sensor, pose: Pose) -> SubBeams:
        """Return sub-beams offset in the sensor's azimuth and elevation; the middle one comes first, unchanged."""
        offsets, weights = beam_nodes(self.parameters.sub_beams)
        across, along = (1e-3 * angle for angle in self.angles_mrad(sensor))
        if across == along == 0.0:
            offsets, weights = beam_nodes(1)
        sideways, upwards = _tangents(directions, rotation_world_sensor(*pose.angles_deg))
        rays = np.empty((len(directions), len(weights), 3))
        rays[:, 0] = directions
        for i, (a, e) in enumerate(offsets[1:], start=1):
            moved = directions + (across * a) * sideways + (along * e) * upwards
            rays[:, i] = moved / np.sqrt((moved**2).sum(axis=1))[:, None]
        parent = np.repeat(np.arange(len(directions)), len(weights))
        return SubBeams(rays.reshape(-1, 3), parent, np.tile(weights, len(directions)))


def beam_nodes(sub_beams: int) -> tuple[FloatArray, FloatArray]:
    """Return the nodes and weights of a rule, the middle first.

    Returns
    -------
    offsets
        Offsets across and along the elevation, (k, 2), in full angles.
    weights
        Weights, (k,), whose sum is 1.
    """
    rings = _RINGS[sub_beams]
    offsets = [(0.0, 0.0)]
    weights = [1.0 - math.fsum(ring.weight for ring in rings)]
    for ring in rings:
        radius = math.sqrt(ring.s / 8)
        for turn in ring.first_deg + np.arange(ring.sub_beams) * (360.0 / ring.sub_beams):
            offsets.append((radius * float(cosdg(turn)), radius * float(sindg(turn))))
            weights.append(ring.weight / ring.sub_beams)
    return np.array(offsets), np.array(weights)


def _tangents(directions: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors towards larger azimuth and larger elevation of a rotated sensor, (n, 3) each."""
    sideways = np.cross(rotation[:, 2], directions)
    length = np.sqrt((sideways**2).sum(axis=1))
    is_vertical = length < 1e-9  # along the sensor's axis there is no azimuth; any pair will do
    units = sideways / np.where(is_vertical, 1.0, length)[:, None]
    sideways = np.where(is_vertical[:, None], rotation[:, 1], units)
    upwards: FloatArray = np.cross(directions, sideways)
    return sideways, upwards
