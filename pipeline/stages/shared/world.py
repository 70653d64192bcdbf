"""The static world as ``statics.ply`` in a run's folder holds it, read once."""

from __future__ import annotations

from pipeline.stages.base import Workspace
from pipeline.world.mesh import World, read_ply

STATICS = "statics.ply"


def world_of(work: Workspace) -> World:
    """The static world."""
    return work.remember("world", (STATICS,), lambda: read_ply(work.path(STATICS))[0])


def remember_world(work: Workspace, world: World) -> None:
    """The static world that was just written, so that it need not be read, nor looked through, again."""
    work.remember("world", (STATICS,), lambda: world)
