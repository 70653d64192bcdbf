"""Base class of effects that make one return of what the cone of a pulse meets, in simulated point clouds only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from egvs.core.grid import FloatArray, IntArray
from egvs.effects.base import Echo, Expand, P


@dataclass(frozen=True)
class Cones:
    """What the sub-beams of some beams meet, (p, k) each: p beams with k sub-beams, whose axis comes first.

    Attributes
    ----------
    range_m
        Range, float64; infinite where a sub-beam meets nothing. At least one of each beam meets something.
    weight
        Share of the beam, float64; the weights of a beam add up to 1.
    intensity
        Reflectivity times the cosine of the angle of incidence, 0 to 1, float64.
    surface
        Number of the object that it ends on, int64.
    """

    range_m: FloatArray
    weight: FloatArray
    intensity: FloatArray
    surface: IntArray


class MergedReturns(NamedTuple):
    """The return of each of some beams.

    Attributes
    ----------
    sub_beam
        The sub-beam whose object and surface it has, (p,) int64.
    range_m
        Measured range, (p,) float64.
    power
        Received power, in that of a whole beam on the surface of ``sub_beam``, (p,) float64.
    """

    sub_beam: IntArray
    range_m: FloatArray
    power: FloatArray


class Merge(Echo[P]):
    """Makes one return of what the sub-beams of a pulse meet; it replaces the effect divergence in clouds."""

    @property
    def cone(self) -> Expand[Any]:
        """Splits beams into sub-beams, the axis of each first."""
        raise NotImplementedError

    def merge(self, cones: Cones) -> MergedReturns:
        """Return one return for each beam that does not meet a single object with its whole cone."""
        raise NotImplementedError
