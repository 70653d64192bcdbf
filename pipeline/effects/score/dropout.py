r"""A constant share of returns is lost.

Model: :math:`detect(r) = 1 - share`, whatever the range. It is the expectation of dropping each return by the throw of
a die, as the LiDAR of CARLA does under ``dropoff_general_rate`` (Dosovitskiy et al. 2017, CoRL, PMLR 78).

Calls for it: losses that are known as one number (a sensor's own statistics, a dirty window, packets lost on the way),
and a margin of safety: gamma caps the hits, so a site with beams to spare loses less than the share. Limits: real
losses depend on range, incidence and material (Manivasagam et al. 2020, CVPR, learn them); a loss that belongs to range
or weather is better named as such.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pipeline.effects.base import Detect
from pipeline.scenario.effects import DropoutParameters, EffectParameters
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor


class Dropout(Detect[DropoutParameters]):
    """A constant share of returns lost."""

    NAME: ClassVar[str] = "dropout"
    SOURCE: ClassVar[str] = "Dosovitskiy et al. 2017 (CARLA), dropoff_general_rate, as an expectation"
    Model: ClassVar[type[EffectParameters]] = DropoutParameters
    TRIAL: ClassVar[dict[str, Any]] = {"share": 0.1}
    UNTOLD: ClassVar[str] = "how dirty the sensor gets"

    def why_idle(self, scene: Scene) -> str | None:
        """Nothing is lost when the share is nothing."""
        del scene
        return "share is 0" if self.parameters.share == 0 else None

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        """1 - share."""
        del sensor
        return np.full(len(range_m), 1.0 - self.parameters.share)
