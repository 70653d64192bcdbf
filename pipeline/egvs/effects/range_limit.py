r"""Range limit: the farthest range at which a target of a given reflectivity returns enough power.

Model: a target that is larger than the beam's footprint and scatters like Lambert returns a power proportional to
:math:`\rho \cos\theta / r^2` (Höfle and Pfeifer 2007, ISPRS J. Photogramm. Remote Sens. 62(6), 415-433). The sensor's
datasheet fixes the threshold: a target of reflectivity :math:`\rho_0` at normal incidence is just detected at
:math:`r_0`. So with

.. math:: \frac{P}{P_{min}} = \left( \frac{r_{max}}{r} \right)^2, \qquad
          r_{max} = r_0 \sqrt{\frac{\rho \cos\theta}{\rho_0}}

- softness 0, the hard form (Goodin et al. 2019, Electronics 8(1):89): detected up to :math:`r_{max}`, nothing beyond;
- softness s > 0: :math:`detect(r) = \Phi(\ln(P / P_{min}) / s)`, with the normal distribution :math:`\Phi`: one half at
  :math:`r_{max}`.

Why a normal distribution of the logarithm of power: returns of the same range and nominal reflectivity differ by
factors (paint, tilt, alignment, gain of the receiver), and a product of many factors is log-normal. Unlike noise added
to the power, it tends to 1 nearby and to 0 far away. The shape is our choice; its width is from a datasheet: Ouster's
OS1 (revision 6) detects 10 % targets at 45 m with a probability above 90 %, and at 55 m above 50 %. Read as equalities,
that is s = 0.31; 80 % targets at 100 m and 120 m give s = 0.28. Hence 0.3.

Use it for dark vehicles, long ranges and sensors near their limit: wherever the region of interest extends beyond the
rated range at 10 %. Limits: one reflectivity and one incidence for all targets (a car's side at a glancing angle
returns less, a number plate far more); pulses that saturate or are range-gated do not follow the power law; thin
targets return less than r^-2. Beyond the sensor's maximum range there are no beams, whatever the target. With weather,
probabilities are multiplied: the joint loss of power is not compared with one threshold.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from scipy.special import cosdg, ndtr

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters, RangeLimitParameters
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor


class RangeLimit(Detect[RangeLimitParameters]):
    """The power law of returns, with the sensor's threshold."""

    NAME: ClassVar[str] = "range_limit"
    SOURCE: ClassVar[str] = "Höfle and Pfeifer 2007 (power law); the sensor's datasheet (threshold)"
    Model: ClassVar[type[EffectParameters]] = RangeLimitParameters

    def why_idle(self, scene: Scene) -> str | None:
        """A hard limit beyond the range of all sensors changes nothing; the range of a measured scan is unknown."""
        if self.parameters.softness > 0 or any(site.points is not None for site in scene.sites):
            return None
        sensors = scene.used_sensors.values()
        if all(self.limit_m(sensor) > sensor.range_m * (1 + 1e-9) for sensor in sensors):
            return "every beam ends before the limit"
        return None

    def limit_m(self, sensor: Sensor) -> float:
        """Return the range at which the target is at the sensor's threshold.

        Raises
        ------
        InputError
            When neither the sensor nor the scenario states a rated range.
        """
        parameters = self.parameters
        range_m = parameters.rated_range_m or sensor.rated_range_m
        if range_m is None:
            where = f"effects.range_limit: sensor {sensor.name}"
            hint = f"Add it to [sensors.{sensor.name}], or to [effects.range_limit]."
            raise InputError(where, "rated_range_m is missing", hint)
        rated = parameters.rated_reflectivity or sensor.rated_reflectivity
        return range_m * math.sqrt(parameters.reflectivity * float(cosdg(parameters.incidence_deg)) / rated)

    def detect(self, range_m: FloatArray, sensor: Sensor) -> FloatArray:
        """Return 1 up to the limit and 0 beyond; or the soft form, 1/2 at the limit."""
        limit_m = self.limit_m(sensor)
        softness = self.parameters.softness
        if softness == 0:
            return (range_m <= limit_m).astype(np.float64)
        with np.errstate(divide="ignore", over="ignore"):  # the power is infinite at the sensor itself
            chance: FloatArray = ndtr(2 * np.log(limit_m / range_m) / softness)
        return chance
