"""What is scanned and scored, resolved once: the static world, the candidate sites, their sensors, the live effects.

A scene is built by :func:`pipeline.effects.scene_resolving.resolve` and passed on; whoever needs one of its parts takes
it from here instead of reading a file again. It can be sent to another process.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeVar

from pipeline.core.grid import Roi
from pipeline.scenario.models import Scenario
from pipeline.sensing import sensors
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Site

if TYPE_CHECKING:
    from pipeline.world.mesh import World


class LiveEffect(Protocol):
    """What a scene knows of an effect that acts in it."""

    NAME: ClassVar[str]
    STAGE: ClassVar[str]


@dataclass(frozen=True)
class IdleEffect:
    """A named effect that provably changes nothing, and why."""

    name: str
    stage: str
    why: str


Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Scene:
    """What is scanned and scored.

    Attributes
    ----------
    scenario
        As loaded.
    world
        The static world.
    sites
        Candidate sites, in the order of the sites file.
    effects
        The named effects of the scan and score stages that can change a result here, in the order in which they act.
    idle
        The named effects of these stages that provably change nothing here.
    dropped
        Candidates of a rule that no pole can stand for, each with the reason.
    """

    scenario: Scenario
    world: World
    sites: tuple[Site, ...]
    effects: tuple[LiveEffect, ...] = ()
    idle: tuple[IdleEffect, ...] = ()
    dropped: tuple[tuple[Site, str], ...] = ()
    _sensors: dict[str, Sensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def roi(self) -> Roi:
        """The region of interest, without voxels."""
        return self.scenario.roi.box

    @property
    def cast_sites(self) -> tuple[Site, ...]:
        """Sites whose scans are simulated, not measured."""
        return tuple(site for site in self.sites if site.points is None)

    @property
    def used_sensors(self) -> dict[str, Sensor]:
        """The sensors of the sites, by name; InputError when one is unknown."""
        return {site.sensor: self.sensor(site.sensor, f"site {site.name}") for site in self.sites}

    def sensor(self, name: str, place: str = "sensor") -> Sensor:
        """The sensor called ``name``: the scenario's own, else the catalogue's; InputError naming ``place`` else."""
        if name not in self._sensors:
            self._sensors[name] = sensors.of_scenario(name, self.scenario, place)
        return self._sensors[name]

    def site(self, name: str) -> Site:
        """The site called ``name``; KeyError when there is none."""
        return {site.name: site for site in self.sites}[name]

    def acting(self, kind: type[Kind], stage: str | None = None) -> tuple[Kind, ...]:
        """The live effects of one kind (and stage), in order."""
        return tuple(e for e in self.effects if isinstance(e, kind) and stage in (None, e.STAGE))

    def skipped(self, stage: str) -> list[str]:
        """What to say of the effects of a stage that are named but change nothing."""
        return [f"{effect.name}: {effect.why}" for effect in self.idle if effect.stage == stage]

    @property
    def weights_beams(self) -> bool:
        """Whether rows of its scans are shares of beams."""
        return any(effect.STAGE == "scan" for effect in self.effects)
