"""Builds the scene of a scenario in memory: its static world, its sites, and the effects that act before it."""

from __future__ import annotations

from pipeline.effects import on_traffic, scenes
from pipeline.scenario.models import Scenario
from pipeline.sensing.scene import Scene
from pipeline.world import building


def build_scene(scenario: Scenario) -> Scene:
    """The scene of a scenario, its static world built in memory; nothing is written.

    Raises
    ------
    InputError
        When the scenario, or a file that it names, is wrong.
    """
    world, _ = building.build(scenario, on_traffic.ground(scenario))
    return scenes.resolve(scenario, world)
