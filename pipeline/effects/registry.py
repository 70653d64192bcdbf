r"""Which effects exist, and what may one do?

The plain scene has straight beams, opaque static geometry and no weather. Everything beyond it is an *effect*: a table
``[effects.<name>]`` in the scenario, and one module of that name in this folder, imported only when it is named. An
effect acts in one stage, in one of four ways:

========== ======== ===========================================================================================
kind       stage    what it does
========== ======== ===========================================================================================
expand     scan     turns a beam into weighted sub-beams; the weights of a beam add up to 1
transmit   scan     cuts a cast beam into parts, each a share of the beam that ends elsewhere
transmit   score    gives the share of a beam that gets as far as each voxel that it crosses
detect     score    gives the chance that a target at a range sends a return that is noticed
traffic    traffic  changes who moves, and how boxes are made of it
========== ======== ===========================================================================================

.. math:: hits(v) = \sum_{beams} \sum_{sub} w_{sub} \cdot transmit(beam, v) \cdot detect(range(v))

Weights are expectations, not dice. Without effects each factor is 1, and hits counts beams.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pipeline.core.errors import InputError
from pipeline.core.models import StrictModel
from pipeline.traffic import configuration

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.core.grid import Roi
    from pipeline.scenario.models import Scenario
    from pipeline.sensing.crossings import Crossings
    from pipeline.sensing.sensors import Sensor
    from pipeline.sensing.sites import Site
    from pipeline.traffic.boxes import Size
    from pipeline.traffic.extensions import BoxChange, TrafficPlan
    from pipeline.traffic.network import Network
    from pipeline.world.casting import EmptyScan
    from pipeline.world.mesh import World
    from pipeline.world.terrain import Surface

KINDS: dict[str, tuple[str, str]] = {
    "range_limit": ("score", "detect"),
    "rain": ("score", "detect"),
    "fog": ("score", "detect"),
    "dropout": ("score", "detect"),
    "moving_occlusion": ("score", "transmit"),
    "divergence": ("scan", "expand"),
    "mount_sway": ("scan", "expand"),
    "foliage": ("scan", "transmit"),
    "pedestrians_bicycles": ("traffic", "traffic"),
    "articulated": ("traffic", "traffic"),
    "slope": ("traffic", "traffic"),
}
"""Every effect: the stage that it acts in, and its kind. Composed in this order within a stage."""

SELF_ACTING: dict[str, Callable[[Scenario], bool]] = {"slope": configuration.may_have_heights}
"""Effects that switch themselves on where leaving them out would be wrong; and a quick look whether they may, so that
elsewhere none is imported."""


class Parameters(StrictModel):
    """Base of an effect's parameters."""


@dataclass(frozen=True)
class Effect:
    """Base of all effects.

    Attributes
    ----------
    parameters
        As the scenario names them, checked.
    NAME, SOURCE
        The effect's name, and where its model is published.
    Model
        The class of ``parameters``.
    QUALITY
        Parameters that trade time for accuracy, and values from cheap to fine; the accuracy study tries them.
    """

    parameters: Any
    NAME: ClassVar[str]
    SOURCE: ClassVar[str]
    Model: ClassVar[type[Parameters]]
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {}

    @property
    def reads(self) -> tuple[str, ...]:
        """Artefacts that the effect reads beyond those that its stage reads anyway."""
        return ()

    def idle(self, scene: Scene) -> str | None:
        """Why the effect provably cannot change the result in this scene; None when it can."""
        del scene
        return None

    def lacks(self, scene: Scene) -> InputError | None:
        """What a run of this scene would be refused for; None when nothing is missing."""
        del scene
        return None


@dataclass(frozen=True)
class Scene:
    """What an effect may look at to tell whether it is called for."""

    scenario: Scenario
    world: World
    sites: tuple[Site, ...]


class Detect(Effect):
    """The chance that a return is noticed."""

    def lacks(self, scene: Scene) -> InputError | None:
        """Something that a sensor does not say."""
        from pipeline.sensing import sensors

        try:
            for name in dict.fromkeys(site.sensor for site in scene.sites):
                self.detect(
                    np.ones(1), sensors.resolve(name, scene.scenario.sensors, f"{scene.scenario.file}: sensors")
                )
        except InputError as error:
            return error
        return None

    def detect(self, range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
        """Chance (n,), 0 to 1, for targets at ``range_m`` (n,) metres from the sensor."""
        raise NotImplementedError


class Expand(Effect):
    """One beam into weighted sub-beams."""

    @property
    def copies(self) -> int:
        """How many sub-beams a beam has."""
        raise NotImplementedError

    def expand(
        self, directions: NDArray[np.float64], sensor: Sensor, site: Site
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Sub-beams (m, 3), unit vectors along the world's axes, of some beams ``directions`` (n, 3) of ``sensor`` as
        it is mounted at ``site``; the row of ``directions`` that each comes from (m,), ascending, and its weight (m,);
        the weights of one beam add up to 1."""
        raise NotImplementedError


class TransmitScan(Effect):
    """What gets beyond static surfaces."""

    def opaque(self, world: World) -> World:
        """The world without what this effect lets beams through."""
        raise NotImplementedError

    def cutter(self, world: World, roi: Roi) -> Callable[[EmptyScan, Site], EmptyScan]:
        """What cuts the scan of a site that was cast at :meth:`opaque` into weighted parts; prepared once, threads may
        share it.

        Each part is a beam from the sensor that ends where that share of the beam ends, so that the weights of a beam
        still add up to what they were, and a voxel's hits are the share that gets as far."""
        raise NotImplementedError


class TransmitScore(Effect):
    """What gets as far as a voxel."""

    def prepare(self, scenario: Scenario, out: Path) -> TransmitScore:
        """Read what :meth:`share` needs, once, before any site is scored; returns the effect that holds it."""
        raise NotImplementedError

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share (k,), 0 to 1, of its beam that gets as far as each crossing of ``crossings``; called from several
        threads."""
        raise NotImplementedError


class Traffic(Effect):
    """Who moves, and how boxes are made of it: a :class:`pipeline.traffic.extensions.TrafficExtension` that changes
    nothing."""

    SELF_ACTING: ClassVar[bool] = False
    """Whether it also acts where nobody names it; then :meth:`acts` alone decides."""
    ADDS_TRAFFIC: ClassVar[bool] = False
    """Whether it has a :meth:`plan`."""
    LAYS_GROUND: ClassVar[bool] = False
    """Whether it has a :meth:`ground`."""

    @property
    def adds_traffic(self) -> bool:
        """See :data:`ADDS_TRAFFIC`."""
        return self.ADDS_TRAFFIC

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Whether it can change anything, judged from the scenario alone; and why (not)."""
        reason = self.why_idle(scenario)
        return reason is None, reason or "named"

    def why_idle(self, scenario: Scenario) -> str | None:
        """Why it cannot change anything; None when it can."""
        del scenario
        return None

    def idle(self, scene: Scene) -> str | None:
        """As :meth:`acts` has it."""
        on, reason = self.acts(scene.scenario)
        return None if on else reason

    def lacks(self, scene: Scene) -> InputError | None:
        """As :meth:`refusal` has it."""
        return self.refusal(scene.scenario)

    def refusal(self, scenario: Scenario) -> InputError | None:
        """Why this scenario cannot have it; None when it can."""
        del scenario
        return None

    def sizes(self) -> dict[str, Size]:
        """Sizes of the types of vehicles and persons that it adds."""
        return {}

    def uncounted_types(self, sizes: Mapping[str, Size]) -> frozenset[str]:
        """Which of SUMO's types are no vehicles of the scenario."""
        del sizes
        return frozenset()

    def plan(
        self, scenario: Scenario, roads: Network, begin_s: float, end_s: float, rng: np.random.Generator
    ) -> TrafficPlan:
        """The traffic that it adds between two times."""
        raise NotImplementedError

    def box_change(self, scenario: Scenario, sizes: Mapping[str, Size]) -> BoxChange | None:
        """What changes the boxes of a recording whose vehicles have these sizes; None for nothing."""
        del scenario, sizes
        return None

    def ground(
        self, scenario: Scenario, low_m: NDArray[np.float64] | None = None, high_m: NDArray[np.float64] | None = None
    ) -> Surface:
        """The ground over a rectangle; around the network when None."""
        raise NotImplementedError


def make(name: str, parameters: dict[str, Any], place: str) -> Effect:
    """Import one effect and check its parameters.

    Raises
    ------
    InputError
        For an effect that does not exist (naming the nearest), or parameters that are wrong.
    """
    if name not in KINDS:
        near = difflib.get_close_matches(name, KINDS, 1, 0.4)
        right = f"did you mean {near[0]}?" if near else f"known are {', '.join(KINDS)}"
        raise InputError(f"{place}.{name}", "unknown effect", right)
    kind = kind_of(name)
    try:
        return kind(kind.Model.of(parameters))
    except ValidationError as error:
        item = error.errors()[0]
        key = ".".join(str(part) for part in item["loc"])
        if item["type"] == "extra_forbidden":
            known = list(kind.Model.model_fields)
            near = difflib.get_close_matches(key, known, 1, 0.5)
            right = f"did you mean {near[0]}?" if near else f"known here are {', '.join(known) or 'none'}"
            raise InputError(f"{place}.{name}.{key}", "unknown key", right) from None
        if item["type"] == "missing":
            raise InputError(f"{place}.{name}.{key}", "missing", "this key is needed") from None
        raise InputError(f"{place}.{name}.{key}".rstrip("."), f"{item['input']!r}", item["msg"]) from None


def kind_of(name: str) -> type[Effect]:
    """Import one effect."""
    kind: type[Effect] = importlib.import_module(f"pipeline.effects.{KINDS[name][0]}.{name}").EFFECT
    return kind


def needs(name: str) -> list[str]:
    """The parameters of an effect that have no default."""
    return [key for key, field in kind_of(name).Model.model_fields.items() if field.is_required()]


def of(scenario: Scenario, stage: str) -> tuple[Effect, ...]:
    """The effects that a scenario names and that act in ``stage``, in the order of :data:`KINDS`."""
    place = f"{scenario.file}: effects"
    named = [name for name, (where, _) in KINDS.items() if where == stage and name in scenario.effects]
    return tuple(make(name, dict(scenario.effects[name]), place) for name in named)


def acting(
    scenario: Scenario, stage: str, world: World, standing: tuple[Site, ...]
) -> tuple[tuple[Effect, ...], dict[str, str]]:
    """The named effects of a stage that can change its result, in order; and why each other one cannot."""
    found, scene = of(scenario, stage), Scene(scenario, world, standing)
    reasons = {effect.NAME: effect.idle(scene) for effect in found}
    live = tuple(effect for effect in found if reasons[effect.NAME] is None)
    return live, {name: reason for name, reason in reasons.items() if reason is not None}


def traffic_effects(scenario: Scenario) -> tuple[tuple[Traffic, ...], tuple[str, ...]]:
    """The effects on the traffic that act, in order; and notes on those that act by themselves or are skipped."""
    live, notes = [], []
    for effect in _traffic(scenario):
        (on, reason), named = effect.acts(scenario), effect.NAME in scenario.effects
        if on:
            live.append(effect)
        if on and effect.SELF_ACTING:
            notes.append(f"{effect.NAME}: on, {reason}")
        elif not on:
            skipped = f"named, but {reason}: skipped, the result is the same"
            notes.append(f"{effect.NAME}: {skipped if named else f'off, {reason}'}")
    return tuple(live), tuple(notes)


def ground_effect(scenario: Scenario) -> Traffic | None:
    """The effect that lays the ground; None where it is flat."""
    return next((e for e in _traffic(scenario) if e.LAYS_GROUND and e.acts(scenario)[0]), None)


def traffic_settings(scenario: Scenario) -> dict[str, Any]:
    """What the traffic's inputs say of the named effects that act. One that acts by itself depends on files alone."""
    named = [effect for effect in _traffic(scenario) if not effect.SELF_ACTING]
    return settings(effect for effect in named if effect.acts(scenario)[0])


def _traffic(scenario: Scenario) -> Iterator[Traffic]:
    """The effects on the traffic that are named, or may act by themselves."""
    for name, (stage, _) in KINDS.items():
        if stage == "traffic" and (name in scenario.effects or (name in SELF_ACTING and SELF_ACTING[name](scenario))):
            effect = make(name, dict(scenario.effects.get(name, {})), f"{scenario.file}: effects")
            assert isinstance(effect, Traffic)
            yield effect


def settings(effects: Iterable[Effect]) -> dict[str, Any]:
    """What a stage's inputs say of its effects: empty when there is none."""
    return {effect.NAME: effect.parameters.model_dump(mode="json") for effect in effects}
