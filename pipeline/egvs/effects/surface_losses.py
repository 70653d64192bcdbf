r"""Surface losses: returns lost at grazing incidence, on dark vehicles, and on windows of vehicles.

Model: the three losses are independent. With the angle of incidence :math:`\theta`, a return is detected with

.. math:: P = \Bigl(1 - \frac{L_g}{1 + e^{-(\theta - \theta_g) / w_g}}\Bigr)
          \bigl(1 - L_d\,[\text{dark vehicle}]\bigr) \bigl(1 - L_w\,[\text{window}]\bigr)

A vehicle is dark, or not, in all frames and from all sites: its name and the scenario's seed decide.

The defaults are measured on one real unit, see "Against a measurement" in ``docs/validity.md``: grazing loss on a
carriageway, where incidence and range grow together (so it may partly be a loss by range); dark vehicles and windows on
48 cars and vans. Windows are those of the simulated bodies.

Use it to learn what such losses do to detection; ``dropout`` is the loss that is the same everywhere. Limits: scores do
not see it, since they know voxels and boxes, not surfaces. A lost return does not reappear from behind the window. Dark
is inferred from lost returns: colours of the vehicles are not known.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from scipy.special import expit

from egvs.core.grid import FloatArray
from egvs.effects.base import Echo, Echoes
from egvs.scenario.effects_config import EffectParameters, SurfaceLossesParameters
from egvs.sensors.scene import Scene


class SurfaceLosses(Echo[SurfaceLossesParameters]):
    """Losses by incidence, dark vehicles and windows."""

    NAME: ClassVar[str] = "surface_losses"
    SOURCE: ClassVar[str] = "measured: one 80-beam LiDAR at a freeway (Su et al. 2024, IEEE Sensors J. 24, 14)"
    Model: ClassVar[type[EffectParameters]] = SurfaceLossesParameters
    USER_KNOWLEDGE: ClassVar[str] = "how much the sensor loses on dark, glossy and grazed surfaces"

    def why_idle(self, scene: Scene) -> str | None:
        """No loss changes nothing."""
        parameters = self.parameters
        dark = parameters.dark_share * parameters.dark_loss
        if parameters.grazing_loss == dark == parameters.glass_loss == 0:
            return "all losses are 0"
        return None

    def probability(self, echoes: Echoes) -> FloatArray:
        """Return the probability that each return is detected, (n,)."""
        parameters = self.parameters
        incidence_deg = np.degrees(np.arccos(np.clip(echoes.cosine, 0.0, 1.0)))
        steps = (incidence_deg - parameters.grazing_deg) / parameters.grazing_width_deg
        probability: FloatArray = 1.0 - parameters.grazing_loss * expit(steps)
        is_dark = echoes.vehicle_draw < parameters.dark_share  # NaN, the static world, is not dark
        probability[is_dark] *= 1.0 - parameters.dark_loss
        probability[echoes.is_glass] *= 1.0 - parameters.glass_loss
        return probability
