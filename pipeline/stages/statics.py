"""The statics stage: everything that stands at the junction, as triangles in ``statics.ply``.

Steps: find what lays the ground where the network has relief; read, mend and build footprints and meshes
(:mod:`pipeline.world.static_world`); write one mesh in the world frame, in metres.
"""

from __future__ import annotations

from pipeline.checks.mesh_parts import digests
from pipeline.core import files
from pipeline.effects import on_traffic
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.stages.shared.built import built
from pipeline.stages.shared.world import STATICS, remember_world
from pipeline.traffic import sumo_folder
from pipeline.world import world_frame
from pipeline.world.mesh import write_ply

NAME = "statics"
ARTEFACTS = (STATICS,)


def inputs(work: Workspace) -> StageInputs:
    """The statics settings, the region of interest (for the ground's extent), and the files' hashes."""
    scenario, model, box = work.scenario, work.scenario.statics, work.scenario.roi.box
    named = [*(("footprints", f) for f in model.footprints), *(("polygons", f) for f in model.polygons)]
    hashes = {name: files.sha256_of(scenario.find(name, f"statics.{key}")) for key, name in named}
    for mesh in model.meshes:
        hashes |= digests(scenario.find(mesh.file, "statics.meshes"), mesh.file)
    ground = on_traffic.ground(scenario)
    if ground is not None and (path := sumo_folder.network_path(scenario)) is not None:
        hashes["surface"] = files.sha256_of(path)
    settings = {"name": scenario.name, "statics": model.model_dump(mode="json"), "roi": [box.origin_m, box.size_m]}
    settings |= world_frame.key(scenario)
    return StageInputs(settings, hashes, modules=() if ground is None else (type(ground).__module__,))


def run(work: Workspace, inputs: StageInputs) -> Summary:
    """Build the static world and write ``statics.ply``.

    Returns
    -------
    dict
        ``triangles``; ``built`` (solids a kind), ``mended`` and ``left_out`` (how often each mend or omission was
        needed).
    """
    ground = on_traffic.ground(work.scenario)
    world, counts = built(work)
    write_ply(work.path(STATICS), world, work.metadata(inputs, seeded=False))
    remember_world(work, world)
    notes = {} if ground is None else {"notes": [f"{ground.NAME}: on, the ground follows the network's roads"]}
    return {"triangles": len(world.faces), "solids": len(world.solids), **counts.to_json(), **notes}
