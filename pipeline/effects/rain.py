r"""How much of a return does rain take away?

Model: the pulse is thinned on its way out and back, :math:`detect(r) = e^{-2 \alpha r}`, with the specific attenuation of ITU-R P.1814
(2007), eq. (4), :math:`\gamma = k R^{\beta}` dB/km for a rain rate R in mm/h. The recommendation gives two pairs (k, beta): 1.58, 0.63
(Japan) and 1.076, 0.67 (France).

Calls for it: a site that must work in rain. Limits: no backscatter (false returns of drops), no spray behind vehicles, no wet
surfaces; the pulse energy, not the detection threshold, is what is lost - a sensor with much in reserve loses less (see range_limit).
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.effects import Detect, Parameters, Scene
from pipeline.sensors import Sensor

_POWER_LAWS = {"japan": (1.58, 0.63), "france": (1.076, 0.67)}
_NEPERS_PER_DB = math.log(10) / 10


class Model(Parameters):
    """Parameters of ``[effects.rain]``."""

    rate_mm_h: Annotated[float, Field(ge=0, le=300, description="Rain rate; 2 is light, 10 moderate, 50 violent")]
    law: Annotated[Literal["japan", "france"], Field(description="Which power law of ITU-R P.1814")] = "japan"


class Rain(Detect):
    """Two-way extinction by rain."""

    NAME: ClassVar[str] = "rain"
    SOURCE: ClassVar[str] = "ITU-R P.1814 (2007), power law k R^beta"
    Model: ClassVar[type[Parameters]] = Model

    def idle(self, scene: Scene) -> str | None:
        """Without rain nothing is lost."""
        del scene
        return "rate_mm_h is 0" if self.parameters.rate_mm_h == 0 else None

    def extinction_per_m(self) -> float:
        """Specific attenuation in nepers a metre."""
        k, beta = _POWER_LAWS[self.parameters.law]
        return float(k * self.parameters.rate_mm_h**beta * _NEPERS_PER_DB / 1000)

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        """exp(-2 alpha r)."""
        del sensor
        share: NDArray[np.float64] = np.exp(-2 * self.extinction_per_m() * range_m)
        return share


EFFECT = Rain
