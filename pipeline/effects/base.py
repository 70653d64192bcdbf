r"""What an effect is: its name, source and parameters, and the one thing that it does.

The plain scene has straight beams, opaque static geometry and no weather. Everything beyond it is an *effect*: a table
``[effects.<name>]`` in the scenario, and one module, imported only when it is named. An effect acts in one stage, in
one of these ways:

============= ======== ========================================================================================
base class    stage    what it does
============= ======== ========================================================================================
Expand        scan     turns a beam into weighted sub-beams; the weights of a beam add up to 1
TransmitScan  scan     cuts a cast beam into parts, each a share of the beam that ends elsewhere
TransmitScore score    gives the share of a beam that gets as far as each voxel that it crosses
Detect        score    gives the chance that a target at a range sends a return that is noticed
Traffic       traffic  changes who moves, and how boxes are made of it
============= ======== ========================================================================================

.. math:: hits(v) = \sum_{beams} \sum_{sub} w_{sub} \cdot transmit(beam, v) \cdot detect(range(v))

Weights are expectations, not dice. Without effects each factor is 1, and hits counts beams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from pipeline.core.errors import InputError
from pipeline.scenario.effects import EffectParameters
from pipeline.sensing.beam_effects import BeamCutter, BeamExpander
from pipeline.traffic.extensions import TrafficExtension

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.artefacts.readers import Tpog
    from pipeline.core.grid import Grid
    from pipeline.scenario.models import Scenario
    from pipeline.sensing.crossings import Crossings, Falls
    from pipeline.sensing.scene import Scene
    from pipeline.sensing.sensors import Sensor

P = TypeVar("P", bound=EffectParameters)

_SAMPLES = 8
"""Places along each side of the region of interest at which a chance is averaged."""


@dataclass(frozen=True)
class Effect(Generic[P]):
    """Base of all effects.

    Attributes
    ----------
    parameters
        As the scenario names them, checked.
    NAME, SOURCE
        The effect's name, and where its model is published.
    STAGE, KIND
        Where it acts and how; the base classes below set them.
    Model
        The class of ``parameters``.
    QUALITY
        Parameters that trade time for accuracy, and values from cheap to fine; the accuracy study tries them.
    TRIAL
        Values for parameters without a default, with which ``egvs effects`` tries the effect before a scene that does
        not name it.
    UNTOLD
        What a scene does not tell that decides whether it needs the effect ("the weather"); empty where it tells.
    """

    parameters: P
    NAME: ClassVar[str]
    SOURCE: ClassVar[str]
    STAGE: ClassVar[str]
    KIND: ClassVar[str]
    Model: ClassVar[type[EffectParameters]]
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {}
    TRIAL: ClassVar[dict[str, Any]] = {}
    UNTOLD: ClassVar[str] = ""

    def why_idle(self, scene: Scene) -> str | None:
        """Why the effect provably cannot change the result in this scene; None when it can."""
        del scene
        return None

    def refusal(self, scene: Scene) -> InputError | None:
        """What a run of this scene would be refused for; None when nothing is missing."""
        del scene
        return None

    def seen(self, scene: Scene) -> str:
        """What in the scene the effect is about, in words and with its numbers; empty where there is nothing to say."""
        del scene
        return ""

    @property
    def reads(self) -> tuple[str, ...]:
        """Artefacts that the effect reads beyond those that its stage reads anyway."""
        return ()


class Expand(Effect[P], BeamExpander):
    """One beam into weighted sub-beams."""

    STAGE: ClassVar[str] = "scan"
    KIND: ClassVar[str] = "expand"


class TransmitScan(Effect[P], BeamCutter):
    """What gets beyond static surfaces."""

    STAGE: ClassVar[str] = "scan"
    KIND: ClassVar[str] = "transmit"


class TransmitScore(Effect[P]):
    """What gets as far as a voxel."""

    STAGE: ClassVar[str] = "score"
    KIND: ClassVar[str] = "transmit"

    def prepare(self, scene: Scene, tpog: Tpog, trajectories: Path | None) -> TransmitScore[P]:
        """Read what :meth:`share` needs, once, before any site is scored; returns the effect that holds it.

        ``trajectories`` is ``trajectories.parquet``; None where there is none, which is refused by an effect that reads
        it (:attr:`reads`)."""
        raise NotImplementedError

    def seen_from(self, sensor_m: NDArray[np.float64], grid: Grid) -> TransmitScore[P]:
        """The effect for one sensor (3,), in the grid's frame, whose crossings it is asked about next; here is the
        place for what does not depend on the beams. Called from several threads."""
        del sensor_m, grid
        return self

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share (k,), 0 to 1, of its beam that gets as far as each crossing of ``crossings``; called from several
        threads."""
        raise NotImplementedError

    def falls(self, ends_m: NDArray[np.float64]) -> Iterator[Falls] | None:
        """Where the shares of all beams (n, 3; their ends seen from the sensor) fall, some beams at a time; None where
        that is not known without crossings. Tells the same as :meth:`share`, which needs crossings to be listed."""
        del ends_m
        return None


class Detect(Effect[P]):
    """The chance that a return is noticed."""

    STAGE: ClassVar[str] = "score"
    KIND: ClassVar[str] = "detect"

    def refusal(self, scene: Scene) -> InputError | None:
        """Something that a sensor does not say."""
        try:
            for sensor in scene.used_sensors.values():
                self.detect(np.ones(1), sensor)
        except InputError as error:
            return error
        return None

    def noticed(self, scene: Scene) -> tuple[float, float]:
        """Share of returns from the region of interest that is noticed, by the effect's own formula: at the site where
        it is least, and where it is most."""
        low, size = np.asarray(scene.roi.origin_m), np.asarray(scene.roi.size_m)
        parts = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        places = low + size * np.stack(np.meshgrid(parts, parts, parts), axis=-1).reshape(-1, 3)
        shares = [
            self.detect(np.sqrt(((places - site.pose.position_m) ** 2).sum(axis=1)), scene.sensor(site.sensor)).mean()
            for site in scene.sites
        ]
        return float(min(shares)), float(max(shares))

    def seen(self, scene: Scene) -> str:
        """The share of returns from the region of interest that is noticed."""
        worst, best = (f"{share:.0%}" for share in self.noticed(scene))
        spread = best if worst == best else f"{worst} to {best}"
        return f"by its formula, {spread} of returns from the region are noticed"

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        """Chance (n,), 0 to 1, for targets at ``range_m`` (n,) metres from the sensor.

        It is not asked once for each beam and voxel, see :mod:`pipeline.scoring.thinning`."""
        raise NotImplementedError


class Traffic(Effect[P], TrafficExtension):
    """Who moves, and how boxes are made of it. With ``ground``: a :class:`pipeline.world.ground.GroundSource`."""

    STAGE: ClassVar[str] = "traffic"
    KIND: ClassVar[str] = "traffic"
    SELF_ACTING: ClassVar[bool] = False
    """Whether it also acts where nobody names it; then :meth:`acts` alone decides."""

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Whether it can change anything, judged from the scenario alone; and why (not)."""
        return True, "named"

    def why_idle(self, scene: Scene) -> str | None:
        """As :meth:`acts` has it."""
        on, reason = self.acts(scene.scenario)
        return None if on else reason

    def refusal(self, scene: Scene) -> InputError | None:
        """As :meth:`refuses` has it."""
        return self.refuses(scene.scenario)

    def place(self, scenario: Scenario) -> str:
        """Where messages point to."""
        return f"{scenario.file}: effects.{self.NAME}"
