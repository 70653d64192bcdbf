r"""Base classes of effects: name, source and parameters, and the method through which each kind acts.

The plain scene has straight beams, opaque static geometry and no weather. Everything beyond it is an *effect*: a table
``[effects.<name>]`` in the scenario, and one module, imported only when the scenario names it. An effect acts in one
stage, in one of these ways:

============= ======== ========================================================================================
base class    stage    what it does
============= ======== ========================================================================================
Expand        scan     turns a beam into weighted sub-beams; the weights of a beam add up to 1
TransmitScan  scan     cuts a cast beam into parts; each is the share of the beam that ends at another range
TransmitScore score    gives the share of a beam that reaches each voxel that it crosses
Detect        score    gives the probability that the return of a target at a given range is detected
Traffic       traffic  changes who is on the road, and how boxes are made from it
Echo          clouds   loses or disturbs single returns of a simulated point cloud, by surface; scores do not see it
============= ======== ========================================================================================

.. math:: hits(v) = \sum_{beams} \sum_{sub} w_{sub} \cdot transmit(beam, v) \cdot detect(range(v))

Weights are expectations; nothing is drawn at random. Without effects each factor is 1, and hits are numbers of beams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from egvs.core.errors import InputError, RunError
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.wording import format_percent
from egvs.scenario.effects_config import EffectParameters
from egvs.sensors.beam_hooks import BeamCutter, BeamExpander
from egvs.traffic.vehicle_boxes import TrafficHook

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from egvs.artefacts.tpog import Tpog
    from egvs.core.grid import Grid
    from egvs.scenario.model import Scenario
    from egvs.sensors.scene import Scene
    from egvs.sensors.sensor import Sensor
    from egvs.sensors.voxel_crossings import Crossings, TransmittanceSteps


P = TypeVar("P", bound=EffectParameters)


@dataclass(frozen=True)
class Echoes:
    """Returns of one simulated sweep before losses and noise.

    Attributes
    ----------
    range_m
        Range, (n,) float64.
    cosine
        Cosine of the angle of incidence, 0 to 1, (n,) float64.
    is_glass
        Whether the return is from a window of a vehicle, (n,) bool.
    vehicle_draw
        A number from 0 to 1, evenly distributed over vehicles, the same for a vehicle in all frames and at all sites;
        NaN for the static world, (n,) float64.
    """

    range_m: FloatArray
    cosine: FloatArray
    is_glass: BoolArray
    vehicle_draw: FloatArray


_SAMPLES = 8
"""Points along each side of the region of interest over which a probability is averaged."""


@dataclass(frozen=True)
class Effect(Generic[P]):
    """Base of all effects.

    Attributes
    ----------
    parameters
        Validated parameters of the scenario.
    NAME, SOURCE
        Name of the effect, and the publication of its model.
    STAGE, KIND
        The stage in which it acts, and how; set by the base classes below.
    Model
        The class of ``parameters``.
    QUALITY
        Parameters that trade time for accuracy, with values from coarse to fine; the accuracy study varies them.
    TRIAL
        Values for parameters without a default, for ``egvs effects`` to try the effect on a scene that does not name
        it.
    USER_KNOWLEDGE
        What only the user can know and what decides whether the effect is needed, e.g. "the weather"; empty if the
        scene decides.
    """

    parameters: P
    NAME: ClassVar[str]
    SOURCE: ClassVar[str]
    STAGE: ClassVar[str]
    KIND: ClassVar[str]
    Model: ClassVar[type[EffectParameters]]
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {}
    TRIAL: ClassVar[dict[str, Any]] = {}
    USER_KNOWLEDGE: ClassVar[str] = ""

    def why_idle(self, scene: Scene) -> str | None:
        """Return why the effect provably cannot change the result in this scene; None when it can."""
        return None

    def refusal(self, scene: Scene) -> InputError | None:
        """Return the error with which a run of this scene would stop; None when nothing is missing."""
        return None

    def summary(self, scene: Scene) -> str:
        """Return what in the scene the effect acts on, with numbers; empty where there is nothing to say."""
        return ""

    @property
    def settings(self) -> dict[str, Any]:
        """What the result depends on, for the cache key of a stage: the parameters."""
        return self.parameters.model_dump(mode="json")

    @property
    def reads(self) -> tuple[str, ...]:
        """Artefacts that the effect reads in addition to those of its stage."""
        return ()


def checked_shares(effect: Effect[Any], shares: object, count: int, unit: str, most: float = 1.0) -> FloatArray:
    """Return the ``count`` shares of an effect, or other numbers from 0 to ``most``.

    Raises
    ------
    RunError
        For anything else, which would give a wrong score.
    """
    if not isinstance(shares, np.ndarray):
        actual = f"{type(shares).__name__}"
    elif shares.dtype.kind not in "fiub":
        actual = f"{type(shares).__name__} of {shares.dtype}"
    elif shares.shape != (count,):
        actual = f"an array of shape {shares.shape} for {count} {unit}"
    elif shares.size and not (shares.min() >= 0 and shares.max() <= most):  # false where one is NaN
        actual = f"values from {shares.min():g} to {shares.max():g}"
    else:
        return shares
    expected = "share from 0 to 1" if most == 1.0 else f"number from 0 to {most:g}"
    raise RunError(f"effects.{effect.NAME}: expected one {expected} for each of {count} {unit}, got {actual}")


class Expand(Effect[P], BeamExpander):
    """Turns a beam into weighted sub-beams."""

    STAGE: ClassVar[str] = "scan"
    KIND: ClassVar[str] = "expand"


class TransmitScan(Effect[P], BeamCutter):
    """Lets part of a beam through static surfaces."""

    STAGE: ClassVar[str] = "scan"
    KIND: ClassVar[str] = "transmit"


class TransmitScore(Effect[P]):
    """Gives the share of a beam that reaches a voxel."""

    STAGE: ClassVar[str] = "score"
    KIND: ClassVar[str] = "transmit"

    def prepare(self, scene: Scene, tpog: Tpog, trajectories: Path | None) -> TransmitScore[P]:
        """Return the effect with the data that :meth:`share` needs, read once before any site is scored.

        Parameters
        ----------
        scene
            The scene that is scored.
        tpog
            The occupancy grid of the traffic.
        trajectories
            ``trajectories.parquet``; None if the run has none, which is an error for an effect that :attr:`reads` it.
        """
        raise NotImplementedError

    def for_sensor(self, sensor_m: FloatArray, grid: Grid) -> TransmitScore[P]:
        """Return the effect for one sensor (3,) in the grid frame, with all that does not depend on its beams.

        Called from several threads.
        """
        return self

    def share(self, crossings: Crossings) -> FloatArray:
        """Return the share of its beam, 0 to 1, that reaches each crossing, (k,). Called from several threads."""
        raise NotImplementedError

    def transmittance_steps(self, ends_m: FloatArray) -> Iterator[TransmittanceSteps] | None:
        """Yield where the transmitted shares of beams drop, some beams at a time.

        This is the information of :meth:`share` without a list of crossings; None where the effect needs that list.

        Parameters
        ----------
        ends_m
            Ends of all beams relative to the sensor, (n, 3).
        """
        return None


class Detect(Effect[P]):
    """Gives the probability that a return is detected."""

    STAGE: ClassVar[str] = "score"
    KIND: ClassVar[str] = "detect"
    THINS_SPANS: ClassVar[bool] = False
    """Whether the span of the points on a vehicle is that of the returns which are left, in expectation."""

    def refusal(self, scene: Scene) -> InputError | None:
        """Return the error for a sensor that lacks a value which the effect needs."""
        try:
            for sensor in filter(self.acts_on, scene.used_sensors.values()):
                checked_shares(self, self.detect(np.ones(1), sensor), 1, "ranges")
        except InputError as error:
            return error
        return None

    def acts_on(self, sensor: Sensor) -> bool:
        """Return whether the effect loses returns of a sensor."""
        return True

    def detection_shares(self, scene: Scene) -> tuple[float, float]:
        """Return the mean detection probability over the region of interest, at its worst and its best site."""
        low = np.asarray(scene.roi.origin_m)
        size = np.asarray(scene.roi.size_m)
        ticks = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        points = low + size * np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
        shares = []
        for site in scene.sites:
            range_m = np.sqrt(((points - site.pose.position_m) ** 2).sum(axis=1))
            sensor = scene.sensor(site.sensor)
            detected = self.detect(range_m, sensor) if self.acts_on(sensor) else np.ones(len(range_m))
            shares.append(checked_shares(self, detected, len(range_m), "ranges").mean())
        return float(min(shares)), float(max(shares))

    def summary(self, scene: Scene) -> str:
        """Return the share of returns from the region of interest that is detected, as a sentence."""
        worst, best = (format_percent(share, 0) for share in self.detection_shares(scene))
        shares = best if worst == best else f"{worst} to {best}"
        return f"by its formula, {shares} of returns from the region are detected"

    def detect(self, range_m: FloatArray, sensor: Sensor) -> FloatArray:
        """Return the detection probability (n,), 0 to 1, of targets at ``range_m`` (n,) metres from the sensor.

        It is not called for each beam and voxel, see :mod:`egvs.scoring.visibility`.
        """
        raise NotImplementedError

    def detect_surface(
        self, range_m: FloatArray, sensor: Sensor, reflectivity: FloatArray | None, of_class: FloatArray | None = None
    ) -> FloatArray:
        """Return the detection probability as :meth:`detect`, of surfaces of known reflectivity, if it matters.

        Parameters
        ----------
        range_m
            Range of each surface, (n,) float64.
        sensor
            The sensor.
        reflectivity
            Reflectivity of each surface, (n,) float64; that of cars if None.
        of_class
            Reflectivity of the class of the road user that each surface belongs to, (n,) float64; NaN for the static
            world. None if all surfaces are whole road users.
        """
        return self.detect(range_m, sensor)


class Echo(Effect[P]):
    """Loses or disturbs returns of simulated point clouds (``egvs clouds``, ``egvs validate``).

    It needs the surface that a beam meets, which scores do not know: they count beams through voxels and boxes.
    """

    STAGE: ClassVar[str] = "clouds"
    KIND: ClassVar[str] = "echo"

    def probability(self, echoes: Echoes) -> FloatArray:
        """Return the probability that each return is detected, (n,), 0 to 1."""
        return np.ones(len(echoes.range_m))

    def sigma_m(self, echoes: Echoes) -> FloatArray:
        """Return the standard deviation that is added to the noise of the sensor, as variances add, (n,)."""
        return np.zeros(len(echoes.range_m))


class Traffic(Effect[P], TrafficHook):
    """Changes who is on the road, and how boxes are made.

    An effect with a method ``ground`` also is a :class:`egvs.world.terrain.GroundSource`.
    """

    STAGE: ClassVar[str] = "traffic"
    KIND: ClassVar[str] = "traffic"
    AUTO_ENABLED: ClassVar[bool] = False
    """Whether it also acts where the scenario does not name it; then :meth:`acts` alone decides."""

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Return whether the effect can change anything, from the scenario alone, and the reason."""
        return True, "named"

    def why_idle(self, scene: Scene) -> str | None:
        """Return the reason of :meth:`acts` where the effect does not act."""
        on, reason = self.acts(scene.scenario)
        return None if on else reason

    def refusal(self, scene: Scene) -> InputError | None:
        """Return the error of ``scenario_error``."""
        return self.scenario_error(scene.scenario)

    def config_key(self, scenario: Scenario) -> str:
        """Return the file and key that messages point to."""
        return f"{scenario.file}: effects.{self.NAME}"
