r"""Range limit: losses of returns by range and reflectivity, and a constant share.

Model: the power law of returns from diffuse surfaces, with the threshold of the sensor's data sheet; formula, sources
and defaults are in :mod:`egvs.sensors.return_model`. With softness 0 the limit is hard (Goodin et al. 2019, Electronics
8(1):89): detected up to :math:`r_{max}`, nothing beyond.

The effect acts by itself, for all sensors with a rated range, if the losses of any can change the result
(:func:`egvs.sensors.return_model.decide_losses`); with ``[effects.range_limit]`` it always acts, with
``effects.range_limit = false`` never.

The width of the normal distribution: Ouster's OS1 (revision 6) detects 10 % targets at 45 m with a probability above
90 %, and at 55 m above 50 %. Read as equalities, that is s = 0.31, of a flat target of one reflectivity. On cars it was
1.0 with the same sensor, because paint, incidence and gloss scatter as well.

Limits: the default was fitted on two units. Pulses that saturate or are range-gated do not follow the power law; thin
targets return less than r^-2. Returns are lost independently: a vehicle that is darker than others loses no more than
they do. Beyond the sensor's maximum range there are no beams, whatever the target. With weather, probabilities are
multiplied: the joint loss of power is not compared with one threshold.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

from egvs.core.grid import FloatArray
from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters, RangeLimitParameters
from egvs.sensors.return_model import ReturnModel, road_user_classes
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor


@dataclass(frozen=True)
class RangeLimit(Detect[RangeLimitParameters]):
    """The power law of returns, with the sensor's threshold.

    Attributes
    ----------
    skips_unrated
        Whether a sensor without a rated range has no losses, instead of raising an error.
    """

    skips_unrated: bool = False
    NAME: ClassVar[str] = "range_limit"
    SOURCE: ClassVar[str] = (
        "Höfle and Pfeifer 2007 (power law); the sensor's datasheet (threshold); fitted on two units"
    )
    Model: ClassVar[type[EffectParameters]] = RangeLimitParameters
    THINS_SPANS: ClassVar[bool] = True

    @property
    def settings(self) -> dict[str, Any]:
        """The parameters, and the reflectivities of all classes."""
        return super().settings | {"classes": {name: users.reflectivity for name, users in road_user_classes().items()}}

    @classmethod
    def of(cls, model: ReturnModel) -> Self:
        """Return the effect with the losses of a model."""
        return cls(RangeLimitParameters(**asdict(model)))

    def acts_on(self, sensor: Sensor) -> bool:
        """Return whether the losses of a sensor are simulated."""
        return not (self.skips_unrated and sensor.rated_range_m is None)

    def why_idle(self, scene: Scene) -> str | None:
        """A hard limit beyond the range of all sensors changes nothing; the range of a measured scan is unknown."""
        if any(site.points is not None for site in scene.sites):
            return None
        parameters = self.parameters
        for sensor in filter(self.acts_on, scene.used_sensors.values()):
            softness = sensor.softness if parameters.softness is None else parameters.softness
            dropout = sensor.dropout if parameters.dropout is None else parameters.dropout
            if softness > 0 or dropout > 0 or self.limit_m(sensor) <= sensor.range_m * (1 + 1e-9):
                return None
        return "every beam ends before the limit"

    def return_model(self, sensor: Sensor) -> ReturnModel:
        """Return the losses of a sensor; an InputError where no rated range is stated."""
        return ReturnModel.of(sensor, self.parameters)

    def limit_m(self, sensor: Sensor) -> float:
        """Return the range at which a car is at the threshold; an InputError where no rated range is stated."""
        model = self.return_model(sensor)
        return model.limit_m(model.target_reflectivity())

    def detect(self, range_m: FloatArray, sensor: Sensor) -> FloatArray:
        """Return the probability for cars, see :meth:`egvs.sensors.return_model.ReturnModel.probability`."""
        return self.return_model(sensor).probability(range_m)

    def detect_surface(
        self, range_m: FloatArray, sensor: Sensor, reflectivity: FloatArray | None, of_class: FloatArray | None = None
    ) -> FloatArray:
        """Return the probability for surfaces, see :meth:`egvs.effects.base.Detect.detect_surface`."""
        model = self.return_model(sensor)
        if reflectivity is not None:
            reflectivity = model.surface_reflectivity(reflectivity, of_class)
        return model.probability(range_m, reflectivity)
