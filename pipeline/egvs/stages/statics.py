"""The statics stage: everything that stands at the junction, as triangles in ``statics.ply``.

Steps: find what lays the ground where the network has relief; read, mend and build footprints and meshes
(:mod:`egvs.world.static_world`); write one mesh in the world frame, in metres.
"""

from __future__ import annotations

from egvs.effects import registry
from egvs.formats.meshes import mesh_digests
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.traffic import sumo_folder
from egvs.world import geolocation
from egvs.world.mesh import write_ply


def dependencies(work: StageContext) -> StageDependencies:
    """The statics settings, the region of interest (for the ground's extent), and the files' hashes."""
    scenario, model, box = work.scenario, work.scenario.statics, work.scenario.roi.box
    named = [*(("footprints", f) for f in model.footprints), *(("polygons", f) for f in model.polygons)]
    hashes = {name: work.inputs.digest(scenario.find(name, f"statics.{key}")) for key, name in named}
    for mesh in model.meshes:
        hashes |= mesh_digests(scenario.find(mesh.file, "statics.meshes"), mesh.file)
    ground = registry.ground_effect(scenario)
    if ground is not None and (path := sumo_folder.network_path(scenario)) is not None:
        hashes["surface"] = work.inputs.digest(path)
    settings = {"name": scenario.name, "statics": model.model_dump(mode="json"), "roi": [box.origin_m, box.size_m]}
    settings |= geolocation.world_frame_settings(scenario)
    return StageDependencies(settings, hashes, modules=() if ground is None else (type(ground).__module__,))


def run(work: StageContext, inputs: StageDependencies) -> Summary:
    """Build the static world and write ``statics.ply``.

    Returns
    -------
    dict
        ``triangles``; ``built`` (solids a kind), ``mended`` and ``left_out`` (how often each mend or omission was
        needed).
    """
    ground = registry.ground_effect(work.scenario)
    world, counts = work.inputs.built_world
    write_ply(work.folder.statics, world, work.metadata(inputs, seeded=False))
    notes = {} if ground is None else {"notes": [f"{ground.NAME}: on, the ground follows the network's roads"]}
    return {"triangles": len(world.faces), "solids": len(world.solids), **counts.to_json(), **notes}


STAGE = Stage("statics", __name__, dependencies, run, code=("egvs.world.static_world",))
