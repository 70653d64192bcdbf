r"""How far away a target of some reflectivity still comes back.

Model: a target that is larger than the beam's footprint and scatters like Lambert returns a power that goes as
:math:`\rho \cos\theta / r^2` (Höfle and Pfeifer 2007, ISPRS J. Photogramm. Remote Sens. 62(6), 415-433). The sensor's
datasheet fixes the threshold: a target of reflectivity :math:`\rho_0`, met squarely at :math:`r_0`, is at the edge of
being noticed. So with

.. math:: \frac{P}{P_{min}} = \left( \frac{r_{max}}{r} \right)^2, \qquad
          r_{max} = r_0 \sqrt{\frac{\rho \cos\theta}{\rho_0}}

- softness 0, the hard form (Goodin et al. 2019, Electronics 8(1):89): noticed up to :math:`r_{max}`, nothing beyond;
- softness s > 0: :math:`detect(r) = \Phi(\ln(P / P_{min}) / s)`, with the normal distribution :math:`\Phi`: one half at
  :math:`r_{max}`.

Why the normal distribution in the logarithm of power: what makes returns of one range and nominal reflectivity differ
are factors (paint, tilt, alignment, gain of the receiver), and a product of many factors is log-normal. Unlike noise
added to the power, it goes to 1 nearby and to 0 far away. The shape is chosen here; its width is from a datasheet:
Ouster's OS1 (revision 6) notices 10 % targets at 45 m with a chance above 90 % and at 55 m above 50 %. Read as
equalities, that is s = 0.31; 80 % targets at 100 m and 120 m are s = 0.28. Hence 0.3.

Calls for it: dark vehicles, long ranges, sensors near their limit: wherever the region of interest reaches beyond the
rated range at 10 %. Limits: one reflectivity and one incidence for all targets (a car's side at a glancing angle
returns less, a number plate far more); pulses that saturate or are range-gated do not follow the power law; thin
targets return less than r^-2. Beyond the sensor's maximum range there are no beams, whatever the target. With weather,
chances are multiplied: the joint loss of power is not put to one threshold.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, ndtr

from pipeline.core.errors import InputError
from pipeline.effects.base import Detect
from pipeline.scenario.effects import EffectParameters, RangeLimitParameters
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor


class RangeLimit(Detect[RangeLimitParameters]):
    """The power law of a return, against the sensor's threshold."""

    NAME: ClassVar[str] = "range_limit"
    SOURCE: ClassVar[str] = "Höfle and Pfeifer 2007 (power law); the sensor's datasheet (threshold)"
    Model: ClassVar[type[EffectParameters]] = RangeLimitParameters

    def why_idle(self, scene: Scene) -> str | None:
        """A hard limit beyond the reach of every beam takes nothing; a measured scan's reach is not known."""
        if self.parameters.softness > 0 or any(site.points is not None for site in scene.sites):
            return None
        known = scene.used_sensors
        beyond = all(self.limit_m(sensor) > sensor.range_m * (1 + 1e-9) for sensor in known.values())
        return "every beam ends before the limit" if beyond else None

    def limit_m(self, sensor: Sensor) -> float:
        """Where the target is at the sensor's threshold.

        Raises
        ------
        InputError
            When neither the sensor nor the scenario says at which range it is rated.
        """
        own = self.parameters
        range_m = own.rated_range_m or sensor.rated_range_m
        if range_m is None:
            raise InputError(
                f"effects.range_limit: sensor {sensor.name}",
                "no rated_range_m",
                f"rated_range_m under [sensors.{sensor.name}], or under [effects.range_limit]",
            )
        rated = own.rated_reflectivity or sensor.rated_reflectivity
        return range_m * math.sqrt(own.reflectivity * float(cosdg(own.incidence_deg)) / rated)

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        """1 up to the limit and 0 beyond; or the soft form, 1/2 at the limit."""
        limit_m, softness = self.limit_m(sensor), self.parameters.softness
        if softness == 0:
            return (range_m <= limit_m).astype(np.float64)
        with np.errstate(divide="ignore", over="ignore"):  # at the sensor itself the power is without bound
            chance: NDArray[np.float64] = ndtr(2 * np.log(limit_m / range_m) / softness)
        return chance
