r"""Range noise: measured ranges scatter more on surfaces that a beam meets at a grazing angle.

Model: the footprint of a beam on a slanted surface extends along the beam by an amount proportional to
:math:`r \tan\theta` (range r, angle of incidence :math:`\theta`; Baltsavias 1999, ISPRS J. Photogramm. Remote Sens. 54,
199-214). The measured range is that of some part of the footprint. So with the noise :math:`\sigma_0` of the sensor,

.. math:: \sigma^2 = \sigma_0^2 + \min(f r \tan\theta, \sigma_{max})^2

The default f is measured on one real unit, on a carriageway between 25 and 120 m, see "Against a measurement" in
``docs/validity.md``; the roughness of the road is part of it. :math:`\sigma_{max}` is assumed.

Use it for low sensors and long ranges. Limits: scores do not see it; no bias of the range at grazing incidence (Laconte
et al. 2019 report up to 20 cm for other sensors), no correlation between neighbours.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from egvs.core.grid import FloatArray
from egvs.effects.base import Echo, Echoes
from egvs.scenario.effects_config import EffectParameters, RangeNoiseParameters
from egvs.sensors.scene import Scene


class RangeNoise(Echo[RangeNoiseParameters]):
    """Noise that grows with range and incidence."""

    NAME: ClassVar[str] = "range_noise"
    SOURCE: ClassVar[str] = "Baltsavias 1999 (footprint on a slope); measured: one 80-beam LiDAR (Su et al. 2024)"
    Model: ClassVar[type[EffectParameters]] = RangeNoiseParameters
    USER_KNOWLEDGE: ClassVar[str] = "how much the sensor's ranges scatter on grazed surfaces"

    def why_idle(self, scene: Scene) -> str | None:
        """No added noise changes nothing."""
        if self.parameters.footprint_mrad == 0 or self.parameters.max_sigma_m == 0:
            return "no noise is added"
        return None

    def sigma_m(self, echoes: Echoes) -> FloatArray:
        """Return the added standard deviation of each range, metres, (n,)."""
        cosine = np.clip(echoes.cosine, 0.0, 1.0)
        sine = np.sqrt(1.0 - cosine**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = np.where(sine > 0, 1e-3 * self.parameters.footprint_mrad * echoes.range_m * sine / cosine, 0.0)
        return np.minimum(sigma, self.parameters.max_sigma_m)
