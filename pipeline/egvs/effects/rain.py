r"""Rain: extinction attenuates returns on the way out and back.

Model:

.. math:: detect(r) = e^{-2 \alpha r}, \qquad \alpha = \frac{\ln 10}{10} \cdot \frac{k R^{\beta}}{1000} \; [1/m]

with the specific attenuation :math:`k R^{\beta}` in dB/km, the power law of ITU-R P.1814, for a rain rate R in mm/h.
The sources disagree, so the pair (k, beta) is selected by name:

=========== ===== ====== ============================================================================================
law         k     beta   from
=========== ===== ====== ============================================================================================
``japan``   1.58  0.63   ITU-R P.1814 (2007), "Japan"
``france``  1.076 0.67   Carbonneau and Wisely 1998, Proc. SPIE 3232, 119-128; ITU-R P.1814 (2007), "France"
``itu2025`` 1.292 0.6436 ITU-R P.1814-1 (09/2025), drop-size distribution of shape 0
``goodin``  43.4  0.6    Goodin et al. 2019, Electronics 8(1):89: alpha = 0.01 R^0.6 per metre, put into dB/km
=========== ===== ====== ============================================================================================

The default is Japan's. It follows from the drop sizes of Marshall and Palmer (1948) when each drop removes twice its
cross-section, so it can be checked by hand (k = 1.584), and it is the strongest of the three ITU pairs at any rate.
P.1814-1 has four more drop-size distributions; shape -2 is stronger below 5 mm/h, and 2 above 30 mm/h. Goodin's pair is
26 times stronger at 10 mm/h, a visual range of 100 m where observers see kilometres; it is there for comparison with
simulators that use it.

Use it for a site that must work in rain. Limits: the returned share of the pulse stands for the detection probability;
a sensor with signal margin loses less. No returns from drops, no spray behind vehicles, no wet surfaces or windows.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from egvs.core.grid import FloatArray
from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters, RainParameters
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor

_NATURAL_LOGS_PER_DB = math.log(10) / 10
_POWER_LAWS = {
    "japan": (1.58, 0.63),
    "france": (1.076, 0.67),
    "itu2025": (1.2924, 0.6436),
    "goodin": (0.01 * 1000 / _NATURAL_LOGS_PER_DB, 0.6),
}
"""k in dB/km and beta, for a rain rate in mm/h."""


class Rain(Detect[RainParameters]):
    """Two-way extinction by rain."""

    NAME: ClassVar[str] = "rain"
    SOURCE: ClassVar[str] = (
        "ITU-R P.1814, power law k R^beta; the default pair is that of Marshall and Palmer's drops (1948)"
    )
    Model: ClassVar[type[EffectParameters]] = RainParameters
    TRIAL: ClassVar[dict[str, Any]] = {"rate_mm_h": 10.0}
    USER_KNOWLEDGE: ClassVar[str] = "the weather"

    def why_idle(self, scene: Scene) -> str | None:
        """A rain rate of 0 changes nothing."""
        if self.parameters.rate_mm_h == 0:
            return "rate_mm_h is 0"
        return None

    def extinction_per_m(self) -> float:
        """Return the extinction coefficient of the Beer-Lambert law, in 1/m."""
        k, beta = _POWER_LAWS[self.parameters.law]
        return float(k * self.parameters.rate_mm_h**beta * _NATURAL_LOGS_PER_DB / 1000)

    def detect(self, range_m: FloatArray, sensor: Sensor) -> FloatArray:
        """Return exp(-2 alpha r)."""
        return np.exp(-2 * self.extinction_per_m() * range_m)
