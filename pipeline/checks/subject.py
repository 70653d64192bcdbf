"""What is checked: a scenario, and as much of what it names as can be read.

Steps of :func:`gather`: look for every file; read the network, the static world and the sites, each on its own, so that
one that is wrong hides nothing of the others. Whatever is refused becomes an error among the findings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

from pipeline.checks import files
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding, FindingsError
from pipeline.effects import on_traffic, scene_resolving
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.sensing.scene import Scene
from pipeline.sensing.sites import Site
from pipeline.traffic import sumo_folder
from pipeline.traffic.network import Network
from pipeline.world import static_world
from pipeline.world.carriageway import Carriageway
from pipeline.world.mesh import World

T = TypeVar("T")


@dataclass(frozen=True)
class Subject:
    """What rules look at; a part is None where the scenario has none, or it cannot be read.

    Attributes
    ----------
    sites
        All candidates; of a rule, those that a pole can stand for, where the static world is known.
    scene
        Sites and static world, without effects.
    """

    scenario: Scenario
    network: Network | None = None
    carriageway: Carriageway | None = None
    world: World | None = None
    sites: tuple[Site, ...] = ()
    scene: Scene | None = None

    def site_place(self, site: Site) -> str:
        """Where a message about a site points to; seen from the scenario's folder."""
        model = self.scenario.sites
        source = model.file or ("sites.grid" if model.grid is not None else "sites.along")
        return f"{source}: site {site.name}"


@dataclass
class Refusals:
    """Collects what is refused, so that all of it is told at once."""

    found: list[Finding] = field(default_factory=list)

    def unless_refused(self, rule: str, make: Callable[[], T]) -> T | None:
        """What ``make`` gives; None, and an error among the findings, where the input is wrong."""
        try:
            return make()
        except FindingsError as error:
            self.found += error.findings
            return None
        except InputError as error:
            self.found.append(Finding.of(rule, error))
            return None


def build_world(scenario: Scenario) -> World:
    """The static world, built in memory."""
    return static_world.build(scenario, on_traffic.ground(scenario))[0]


def gather(scenario: Scenario, world_of: Callable[[Scenario], World] = build_world) -> tuple[Subject, list[Finding]]:
    """Read what a scenario names; ``world_of`` builds its static world. The findings are all errors."""
    refusals = Refusals(list(files.missing(scenario)))
    network = refusals.unless_refused("network", lambda: sumo_folder.roads(scenario))
    world = refusals.unless_refused("statics", lambda: world_of(scenario))
    if world is None:
        refusals.found += list(_of_each_file(scenario))
    carriageway = None if network is None else Carriageway.of(network)
    subject = Subject(scenario, network, carriageway if carriageway and carriageway.lanes else None, world)
    candidates = refusals.unless_refused("sites", lambda: sites.of(scenario))
    if candidates is not None:
        subject = replace(subject, sites=candidates)
        if world is not None:
            scene = refusals.unless_refused("sites", lambda: scene_resolving.without_effects(scenario, world))
            subject = subject if scene is None else replace(subject, sites=scene.sites, scene=scene)
    return subject, refusals.found


def _of_each_file(scenario: Scenario) -> Iterator[Finding]:
    """What is wrong with each file of static geometry, where one is known to be."""
    model = scenario.statics
    nothing = model.model_copy(update={"footprints": (), "polygons": (), "meshes": ()})
    for key in ("footprints", "polygons", "meshes"):
        for file in getattr(model, key):
            alone = scenario.model_copy(update={"statics": nothing.model_copy(update={key: (file,)})})
            refusals = Refusals()
            refusals.unless_refused("statics", partial(static_world.build, alone))
            yield from refusals.found
