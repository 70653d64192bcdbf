"""Targets inside the sensor's blind zone are not detected: detect(r) = 0 below nearest_m, 1 from there on."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters
from egvs.sensors.sensor import Sensor


class BlindZoneParameters(EffectParameters):
    """The keys of [effects.blind_zone]."""

    nearest_m: float = Field(gt=0, description="Closer targets are not detected")


class BlindZone(Detect[BlindZoneParameters]):
    """A hard lower limit of the range."""

    NAME: ClassVar[str] = "blind_zone"
    SOURCE: ClassVar[str] = "the sensor's datasheet"
    Model: ClassVar[type[EffectParameters]] = BlindZoneParameters

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        return np.where(range_m < self.parameters.nearest_m, 0.0, 1.0)
