"""A scene: the static world, the candidate sites, their sensors and the active effects, resolved once.

:func:`egvs.stages.scene_inputs.resolve_scene` builds the scene. Later steps take its parts from it instead of
reading a file again. A scene can be sent to another process.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeVar

from egvs.core.grid import Roi
from egvs.scenario.model import Scenario
from egvs.sensors.return_model import LossDecision
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.sensors.sites import Pose, Site
from egvs.world.supports import Supports

if TYPE_CHECKING:
    from egvs.world.mesh import World


class ActiveEffect(Protocol):
    """An effect that acts in the scene."""

    NAME: ClassVar[str]
    STAGE: ClassVar[str]


@dataclass(frozen=True)
class InactiveEffect:
    """An effect of the scenario that provably changes nothing, and the reason."""

    name: str
    stage: str
    why: str


Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Scene:
    """The static world with candidate sites, sensors and effects.

    Attributes
    ----------
    scenario
        The scenario, as loaded.
    world
        The static world.
    sites
        Candidate sites, in the order of the sites file.
    effects
        Effects of the scan and score stages that can change a result here, in the order in which they act.
    inactive_effects
        Effects of these stages that provably change nothing here.
    dropped
        Candidates of a rule where no pole can stand, each with the reason.
    losses
        Which sensors need losses of returns; None before effects are added, and where the scenario decides it.
    """

    scenario: Scenario
    world: World
    sites: tuple[Site, ...]
    effects: tuple[ActiveEffect, ...] = ()
    inactive_effects: tuple[InactiveEffect, ...] = ()
    dropped: tuple[tuple[Site, str], ...] = ()
    losses: LossDecision | None = None
    _sensors: dict[str, Sensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def roi(self) -> Roi:
        """The region of interest."""
        return self.scenario.roi.box

    @property
    def cast_sites(self) -> tuple[Site, ...]:
        """Sites whose scans are simulated, not measured."""
        return tuple(site for site in self.sites if site.points is None)

    @property
    def used_sensors(self) -> dict[str, Sensor]:
        """Sensors of the sites, by name; InputError when one is unknown."""
        return {site.sensor: self.sensor(site.sensor, f"site {site.name}") for site in self.sites}

    def sensor(self, name: str, where: str = "sensor") -> Sensor:
        """Return a sensor of the scenario or the catalogue; InputError naming ``where`` if it is unknown."""
        if name not in self._sensors:
            self._sensors[name] = scenario_sensor(name, self.scenario, where)
        return self._sensors[name]

    @cached_property
    def supports(self) -> Supports:
        """The solids that can carry a sensor."""
        return Supports.of(self.world)

    def own_supports(self, pose: Pose) -> tuple[int, ...]:
        """Return the solids that carry a sensor at a pose, which its scan leaves out."""
        return self.supports.at(pose.x_m, pose.y_m)

    def site(self, name: str) -> Site:
        """Return the site called ``name``; KeyError if no site has this name."""
        return {site.name: site for site in self.sites}[name]

    def acting(self, kind: type[Kind], stage: str | None = None) -> tuple[Kind, ...]:
        """Return the effects of one kind (and stage), in order."""
        return tuple(effect for effect in self.effects if isinstance(effect, kind) and stage in (None, effect.STAGE))

    def skipped(self, stage: str) -> list[str]:
        """Return one note, "NAME: REASON", for each inactive effect of a stage."""
        return [f"{effect.name}: {effect.why}" for effect in self.inactive_effects if effect.stage == stage]

    @property
    def weights_beams(self) -> bool:
        """Whether the rows of its scans are weighted: by effects, or by directions of a sensor with dwell times."""
        patterns = (config.pattern for config in self.scenario.sensors.values())
        has_dwell_times = any(pattern is not None and pattern.file is not None for pattern in patterns)
        return has_dwell_times or any(effect.STAGE == "scan" for effect in self.effects)
