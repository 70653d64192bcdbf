"""The statics stage: buildings, poles, trees and ground at the junction, as triangles in ``statics.ply``.

Steps: find the source of the ground where the network has relief; read, repair and build footprints and meshes
(:mod:`egvs.world.static_world`); write one mesh in the world frame, in metres.
"""

from __future__ import annotations

from egvs.effects import registry
from egvs.formats import vector_files
from egvs.formats.meshes import mesh_digests
from egvs.scenario.model import TERRAIN_KEY
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.traffic import sumo_folder
from egvs.world import geolocation
from egvs.world.mesh import write_ply


def dependencies(context: StageContext) -> StageDependencies:
    """Return what the static world depends on: [statics], the region (for the extent of the ground), files by hash."""
    scenario = context.scenario
    config = scenario.statics
    digests = {}
    for key in ("footprints", "polygons"):
        for name in getattr(config, key):
            path = scenario.find(name, f"statics.{key}")
            digests[name] = context.inputs.digests.of(path)
            for part in vector_files.companion_files(path):
                digests[f"statics.{key}: {part.name}"] = context.inputs.digests.of(part)
    for mesh in config.meshes:
        digests |= mesh_digests(scenario.find(mesh.file, "statics.meshes"), mesh.file)
    modules: tuple[str, ...] = ()
    ground = registry.ground_effect(scenario)
    if ground is not None:
        modules = (type(ground).__module__,)
        network = sumo_folder.network_path(scenario)
        if network is not None:
            digests["surface"] = context.inputs.digests.of(network)
        if config.terrain is not None:
            digests["terrain"] = context.inputs.digests.of(scenario.find(config.terrain, TERRAIN_KEY))
    box = scenario.roi.box
    settings = {"name": scenario.name, "statics": config.model_dump(mode="json"), "roi": [box.origin_m, box.size_m]}
    settings |= geolocation.world_frame_settings(scenario)
    return StageDependencies(settings, digests, modules=modules)


def run(context: StageContext, inputs: StageDependencies) -> Summary:
    """Build the static world and write ``statics.ply``.

    Parameters
    ----------
    context
        The run folder and the inputs.
    inputs
        What the static world depends on.

    Returns
    -------
    dict
        ``triangles``, ``solids``; counts of what was built, repaired and left out; ``notes``.
    """
    world, counts = context.inputs.built_world
    write_ply(context.folder.statics, world, context.metadata(inputs, seeded=False))
    summary: Summary = {"triangles": len(world.faces), "solids": len(world.solids), **counts.to_json()}
    ground = registry.ground_effect(context.scenario)
    if ground is not None:
        terrain = context.scenario.statics.terrain
        beyond = "" if terrain is None else f", and {terrain} beyond them"
        summary["notes"] = [f"{ground.NAME}: on, the ground follows the network's roads{beyond}"]
    return summary


STAGE = Stage("statics", __name__, dependencies, run, code=("egvs.world.static_world",))
