"""Dropout: a constant share of returns is lost.

Model: :math:`detect(r) = 1 - share`, whatever the range. This is the expectation of dropping each return at random, as
the LiDAR of CARLA does with ``dropoff_general_rate`` (Dosovitskiy et al. 2017, CoRL, PMLR 78).

Use it for losses that are known as one number (a sensor's statistics, a dirty window, lost packets), and as a margin of
safety: gamma caps the hits, so a site with beams to spare loses less than the share. Limits: real losses depend on
range, incidence and material (Manivasagam et al. 2020, CVPR, learn them); for losses by range or weather, use the
effects of that name.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from egvs.core.grid import FloatArray
from egvs.effects.base import Detect
from egvs.scenario.effects_config import DropoutParameters, EffectParameters
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor


class Dropout(Detect[DropoutParameters]):
    """Loss of a constant share of returns."""

    NAME: ClassVar[str] = "dropout"
    SOURCE: ClassVar[str] = "Dosovitskiy et al. 2017 (CARLA), dropoff_general_rate, as an expectation"
    Model: ClassVar[type[EffectParameters]] = DropoutParameters
    TRIAL: ClassVar[dict[str, Any]] = {"share": 0.1}
    USER_KNOWLEDGE: ClassVar[str] = "how dirty the sensor gets"

    def why_idle(self, scene: Scene) -> str | None:
        """A share of 0 changes nothing."""
        if self.parameters.share == 0:
            return "share is 0"
        return None

    def detect(self, range_m: FloatArray, sensor: Sensor) -> FloatArray:
        """Return 1 - share."""
        return np.full(len(range_m), 1.0 - self.parameters.share)
