r"""Mixed returns: where a pulse meets an edge, the sensor measures a range between two surfaces, or one of them.

Model: a beam is the cone of :mod:`egvs.effects.divergence`, in sub-beams i with weights :math:`w_i`. Each ends on an
object (a box of traffic, or a solid of the static world) at range :math:`r_i` with intensity :math:`I_i` (reflectivity
times the cosine of the angle of incidence), and returns the power

.. math:: P_i \propto w_i I_i / r_i^2

A cone that meets one object only returns the range of its axis. Any other cone meets an edge, and its sub-beams,
ascending by range, are separate echoes where the next one is at least the range resolution of a pulse of duration
:math:`\tau` (``pulse_ns``) behind:

.. math:: \Delta r = \frac{c \tau}{2}

The sensor reports the strongest echo (largest sum of :math:`P_i`) or the first one (``returns``). If it contains one
object, its range is that of the heaviest sub-beam on it. If it contains several, the echo is *mixed*:

.. math:: r = \frac{\sum P_i r_i}{\sum P_i}

*Label*: the object with the largest sum of :math:`P_i` in the echo. *Intensity*: :math:`\sum w_i I_i` over the echo, so
a pulse of which a part gets past an edge is dimmer, and effects that lose returns see a reflectivity that is lower by
as much. The point lies on the axis of the beam.

Sources: mixed pixels at range discontinuities, Hebert and Krotkov (1992, "3D measurements from imaging laser radars:
how good are they?", Image and Vision Computing 10(3), 170-178) and Tang, Huber and Akinci (2007, "A comparative
analysis of depth-discontinuity and mixed-pixel detection algorithms", 3DIM, 29-38); sub-beams that share a pulse's
energy, Winiwarter et al. (2022, HELIOS++, Remote Sensing of Environment 269, 112772). 5 ns is the pulse of Velodyne's
data sheet of the HDL-64E; other makers rarely state theirs. Its :math:`\Delta r` is 0.75 m. Velodyne's manual of the
VLS-128 records two returns of a pulse only where they are 1 m or more apart (6.7 ns).

Use it for detectors that see silhouettes of vehicles and people in clouds. Limits: scores do not see it. Makers filter
such points ("interstitial points" in Hesai's manual of the XT32M2X), some by default, and do not say how. Edges of an
object before itself (a mirror before its car) give no mixed return. The pulse has no shape: the mean stands for the
peak, and echoes just below :math:`\Delta r` apart may be two peaks. A share of the cone comes in steps, as in
``divergence``, and nothing beyond its outermost sub-beams returns.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.effects import registry
from egvs.effects.divergence import Divergence
from egvs.effects.merge import Cones, Merge, MergedReturns
from egvs.scenario.effects_config import DivergenceParameters, EffectParameters, MixedReturnsParameters
from egvs.sensors.beam_hooks import BeamCutter
from egvs.sensors.scene import Scene

METRES_PER_NS = 0.299792458
"""Speed of light."""


class MixedReturns(Merge[MixedReturnsParameters]):
    """One return of a pulse that meets an edge."""

    NAME: ClassVar[str] = "mixed_returns"
    SOURCE: ClassVar[str] = "Hebert and Krotkov 1992, Tang et al. 2007 (mixed pixels); HDL-64E data sheet (5 ns)"
    Model: ClassVar[type[EffectParameters]] = MixedReturnsParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = Divergence.QUALITY
    USER_KNOWLEDGE: ClassVar[str] = "whether the sensor filters returns between two surfaces"

    @property
    def cone(self) -> Divergence:
        """The cone of a pulse."""
        parameters = self.parameters
        return Divergence(
            DivergenceParameters(sub_beams=parameters.sub_beams, divergence_mrad=parameters.divergence_mrad)
        )

    @property
    def resolution_m(self) -> float:
        """Distance from which on two surfaces return separate echoes, metres."""
        return 0.5 * METRES_PER_NS * self.parameters.pulse_ns

    def why_idle(self, scene: Scene) -> str | None:
        """A cone without width meets no edge."""
        return self.cone.why_idle(scene)

    def refusal(self, scene: Scene) -> InputError | None:
        """Leaves divide a pulse by chance, so they have no edges."""
        effects = registry.scenario_effects(scene.scenario, "scan")
        cutters = [effect.NAME for effect in effects if isinstance(effect, BeamCutter) and not effect.why_idle(scene)]
        if not cutters:
            return None
        problem = f"cannot act together with {cutters[0]}, which divides pulses"
        return InputError("effects.mixed_returns", problem, "Remove one of the two effects.")

    def merge(self, cones: Cones) -> MergedReturns:
        """Return the one return of each cone that meets an edge."""
        range_m, weight = cones.range_m, cones.weight
        is_hit = np.isfinite(range_m)
        near_m = np.where(is_hit, range_m, 1.0)
        brightness = np.where(is_hit, weight * cones.intensity, 0.0)
        power = brightness / near_m**2

        echo = _echoes(range_m, self.resolution_m)
        if self.parameters.returns == "first":
            reported = np.zeros(len(range_m), dtype=np.int64)
        else:
            echo_power = [np.where(echo == number, power, 0.0).sum(axis=1) for number in range(range_m.shape[1])]
            reported = np.argmax(echo_power, axis=0)
        in_echo = is_hit & (echo == reported[:, None])

        # The label: of the objects in the echo, the one with the largest power.
        power = np.where(in_echo, power, 0.0)
        same = cones.surface[:, :, None] == cones.surface[:, None, :]
        object_power = np.where(in_echo, (same * power[:, None, :]).sum(axis=2), -1.0)
        rows = np.arange(len(range_m))
        labelled = cones.surface[rows, np.argmax(object_power, axis=1)]
        on_object = in_echo & (cones.surface == labelled[:, None])
        main = np.argmax(np.where(on_object, weight, -1.0), axis=1)

        is_mixed = (in_echo & ~on_object).any(axis=1)
        total = power.sum(axis=1)
        share = np.where(total[:, None] > 0, power, weight * in_echo)  # where no surface of the echo reflects: by area
        mean_m = (share * near_m).sum(axis=1) / share.sum(axis=1)
        merged_m = np.where(is_mixed, mean_m, range_m[rows, main])

        main_intensity = cones.intensity[rows, main]
        by_area = (weight * in_echo).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            received = np.where(in_echo, brightness, 0.0).sum(axis=1) / main_intensity
        return MergedReturns(main, merged_m, np.where(main_intensity > 0, received, by_area))


def _echoes(range_m: FloatArray, resolution_m: float) -> IntArray:
    """Return the number of the echo that each sub-beam belongs to, 0 for the nearest, (p, k) int64."""
    order = np.argsort(range_m, axis=1, kind="stable")
    ascending = np.take_along_axis(range_m, order, axis=1)
    previous, following = ascending[:, :-1], ascending[:, 1:]
    is_behind = following >= previous + resolution_m  # also where both are infinite, which is no hit
    number = np.zeros(range_m.shape, dtype=np.int64)
    number[:, 1:] = np.cumsum(is_behind, axis=1)
    echo: IntArray = np.empty_like(number)
    np.put_along_axis(echo, order, number, axis=1)
    return echo
