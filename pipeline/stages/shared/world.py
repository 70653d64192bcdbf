"""The static world as ``statics.ply`` in a run's folder holds it, read once."""

from __future__ import annotations

from pipeline.stages.base import Workspace
from pipeline.world.mesh import World, read_ply

STATICS = "statics.ply"


def world_of(work: Workspace) -> World:
    """The static world."""
    return work.remember("world", (STATICS,), lambda: read_ply(work.path(STATICS))[0])
