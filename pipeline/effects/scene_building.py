"""Builds the scene of a scenario in memory: its static world, its sites, and the effects that act before it."""

from __future__ import annotations

from pipeline.effects import on_traffic, scene_resolving
from pipeline.scenario.models import Scenario
from pipeline.sensing.scene import Scene
from pipeline.world import static_world


def build_scene(scenario: Scenario) -> Scene:
    """The scene of a scenario, its static world built in memory; nothing is written.

    Raises
    ------
    InputError
        When the scenario, or a file that it names, is wrong.
    """
    world, _ = static_world.build(scenario, on_traffic.ground(scenario))
    return scene_resolving.resolve(scenario, world)
