"""The probability that a return is detected, with all effects of a scene that lose returns.

:class:`ReturnProbability` is what scores over voxels, scores over vehicles, simulated point clouds and detectors take
it from: each multiplies the beams that meet something by it, or draws with it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from egvs.core.grid import FloatArray
from egvs.effects.base import Detect, checked_shares
from egvs.sensors.return_model import class_of

if TYPE_CHECKING:
    from egvs.sensors.scene import Scene
    from egvs.sensors.sensor import Sensor


@dataclass(frozen=True)
class ReturnProbability:
    """The probability that a sensor detects returns.

    Attributes
    ----------
    effects
        Effects that lose returns of this sensor, in the order in which they act.
    sensor
        The sensor.
    """

    effects: tuple[Detect[Any], ...]
    sensor: Sensor

    @classmethod
    def of(cls, scene: Scene, sensor: Sensor) -> Self | None:
        """Return the probability for a sensor in a scene; None where every return is detected."""
        effects: tuple[Detect[Any], ...] = scene.acting(Detect, "score")
        acting = tuple(effect for effect in effects if effect.acts_on(sensor))
        return cls(acting, sensor) if acting else None

    @property
    def thins_spans(self) -> bool:
        """Whether a beam counts by its probability where the span of points is measured, not fully."""
        return any(effect.THINS_SPANS for effect in self.effects)

    def __call__(
        self, range_m: FloatArray, reflectivity: FloatArray | None = None, of_class: FloatArray | None = None
    ) -> FloatArray:
        """Return the probability that a return is detected, (n,) float64, 0 to 1.

        Parameters
        ----------
        range_m
            Range of each target, (n,) float64.
        reflectivity
            Reflectivity of each target, (n,) float64; by default that of cars.
        of_class
            Where targets are not whole road users: reflectivity of the class of the road user that each is a part of,
            (n,) float64, NaN for the static world.

        Raises
        ------
        RunError
            For an effect that returns something else than a share for each range.
        """
        detected = np.ones(len(range_m))
        for effect in self.effects:
            shares = effect.detect_surface(range_m, self.sensor, reflectivity, of_class)
            detected = detected * checked_shares(effect, shares, len(range_m), "ranges")
        return detected


def reflectivity_of(vclasses: Iterable[str]) -> FloatArray:
    """Return the reflectivity of road users by their SUMO vClasses, (n,) float64."""
    return np.array([class_of(vclass).reflectivity for vclass in vclasses], dtype=np.float64)
