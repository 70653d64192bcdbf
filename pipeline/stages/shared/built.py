"""The static world as the scenario's files give it, built once: the check looks at it, the statics stage writes it."""

from __future__ import annotations

from pipeline.effects import on_traffic
from pipeline.stages.base import Workspace
from pipeline.world import static_world
from pipeline.world.mesh import World
from pipeline.world.static_world import BuildCounts


def built(work: Workspace) -> tuple[World, BuildCounts]:
    """The static world, and what went into it; InputError when a file that the scenario names is not sound."""
    scenario = work.scenario
    return work.remember("built", (), lambda: static_world.build(scenario, on_traffic.ground(scenario), work.progress))
