r"""Fog: extinction attenuates returns on the way out and back.

Model: the extinction follows from the visibility and decreases with the wavelength,

.. math:: detect(r) = e^{-2 \alpha r}, \qquad
          \alpha = \frac{-\ln \varepsilon}{V} \left( \frac{\lambda}{550\,\mathrm{nm}} \right)^{-q}

for a visibility V, the range at which the contrast of a black target has fallen to epsilon (Koschmieder 1924). The
exponent q depends on V:

- ``kruse`` (Kruse, McGlauchlin and McQuistan 1962, Elements of Infrared Technology): 1.6 above 50 km, 1.3 above 6 km,
  else :math:`0.585 \, V_{km}^{1/3}`. Derived from haze; it predicts that fog is thinner in the infrared, which
  measurements in fog contradict.
- ``kim`` (Kim, McArthur and Korevaar 2001, Proc. SPIE 4214, 26-37), the default: the same above 6 km, then :math:`0.16
  \, V_{km} + 0.34` above 1 km, :math:`V_{km} - 0.5` above 0.5 km, and 0 below: fog attenuates all wavelengths alike.
  ITU-R P.1814-1 (09/2025) has this exponent too; the edition of 2007 had Kruse's.

Both models use the visibility at a contrast of 2 % (-ln 0.02 = 3.91), so that is the default. Instruments at roads and
airports report the meteorological optical range, which is at 5 % (-ln 0.05 = 3.00): for these, set ``contrast =
0.05``; V is converted to 2 % before q is computed.

Use it for a site that must work in fog, mist or haze. Limits: the returned share of the pulse stands for the detection
probability; a sensor with signal margin loses less; one that is blinded by backscatter from the fog loses more.
Homogeneous fog; single scattering; wavelengths from 400 to 1550 nm.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from egvs.core.grid import FloatArray
from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters, FogParameters
from egvs.sensors.sensor import Sensor

_GREEN_NM = 550.0
_MODELS_CONTRAST = 0.02


class Fog(Detect[FogParameters]):
    """Two-way extinction by fog."""

    NAME: ClassVar[str] = "fog"
    SOURCE: ClassVar[str] = "Kim, McArthur and Korevaar 2001, Proc. SPIE 4214; Kruse et al. 1962"
    Model: ClassVar[type[EffectParameters]] = FogParameters
    TRIAL: ClassVar[dict[str, Any]] = {"visibility_m": 200.0}
    USER_KNOWLEDGE: ClassVar[str] = "the weather"

    def extinction_per_m(self, wavelength_nm: float) -> float:
        """Return the extinction coefficient of the Beer-Lambert law, in 1/m."""
        green_per_m = -math.log(self.parameters.contrast) / self.parameters.visibility_m
        visibility_km = -math.log(_MODELS_CONTRAST) / green_per_m / 1000
        exponent = _kim_exponent if self.parameters.model == "kim" else _kruse_exponent
        return float(green_per_m * (wavelength_nm / _GREEN_NM) ** -exponent(visibility_km))

    def detect(self, range_m: FloatArray, sensor: Sensor) -> FloatArray:
        """Return exp(-2 alpha r) at the sensor's wavelength."""
        return np.exp(-2 * self.extinction_per_m(sensor.wavelength_nm) * range_m)


def _kruse_exponent(visibility_km: float) -> float:
    """Exponent q of Kruse et al."""
    if visibility_km > 6:
        return 1.6 if visibility_km > 50 else 1.3
    return float(0.585 * visibility_km ** (1 / 3))


def _kim_exponent(visibility_km: float) -> float:
    """Exponent q of Kim et al.; Kruse's from 6 km on."""
    if visibility_km > 6:
        return _kruse_exponent(visibility_km)
    if visibility_km > 1:
        return 0.16 * visibility_km + 0.34
    return max(visibility_km - 0.5, 0.0)
