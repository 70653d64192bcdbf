"""Writes everything that stands at the junction into ``statics.ply``, as triangles.

Steps: find what lays the ground where the network has relief; read, mend and build footprints and meshes
(:mod:`pipeline.world.building`); write one mesh in the world frame, in metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.core import files
from pipeline.core.progress import Progress, silent
from pipeline.scenario.models import Scenario
from pipeline.stages.base import metadata
from pipeline.traffic import configuration
from pipeline.world import building
from pipeline.world.building import BuildCounts, GroundSource
from pipeline.world.mesh import World, write_ply

NAME = "statics"
ARTEFACTS = ("statics.ply",)


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """The statics settings, the region of interest (for the ground's extent), and the files' hashes."""
    del out
    return _inputs(scenario, _ground(scenario))


def _inputs(scenario: Scenario, ground: GroundSource | None) -> dict[str, Any]:
    model = scenario.statics
    named = [*(("footprints", f) for f in model.footprints), *(("polygons", f) for f in model.polygons),
             *(("meshes", m.file) for m in model.meshes)]  # fmt: skip
    hashes = {name: files.sha256_of(scenario.find(name, f"statics.{key}")) for key, name in named}
    if ground is not None and (path := configuration.network_path(scenario)) is not None:
        hashes["surface"] = files.sha256_of(path)
    box = scenario.roi.box
    return {
        "settings": {
            "name": scenario.name,
            "statics": model.model_dump(mode="json"),
            "roi": [box.origin_m, box.size_m],
        },
        "files": hashes,
    }


def run(scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Build the static world and write ``statics.ply``.

    Returns
    -------
    dict
        ``triangles``; ``built`` (solids a kind), ``mended`` and ``left_out`` (how often each mend or omission was
        needed).
    """
    del jobs
    ground = _ground(scenario)
    world, counts = building.build(scenario, ground, progress)
    write_ply(out / ARTEFACTS[0], world, metadata(scenario, _inputs(scenario, ground), seed=None))
    notes = {} if ground is None else {"notes": [f"{ground.NAME}: on, the ground follows the network's roads"]}
    return {"triangles": len(world.faces), "solids": len(world.solids), **counts.to_json(), **notes}


def build(scenario: Scenario) -> tuple[World, BuildCounts]:
    """The static world of a scenario, and what went into it; nothing is written."""
    return building.build(scenario, _ground(scenario))


def _ground(scenario: Scenario) -> GroundSource | None:
    """What lays the ground; None where it is flat, which imports no effect."""
    if not configuration.may_have_heights(scenario):
        return None
    from pipeline.effects import registry

    return registry.ground_effect(scenario)
