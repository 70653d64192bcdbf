"""The traffic stage: every vehicle of every frame, as ``trajectories.parquet``.

Steps: get rows of floating car data (FCD) - from SUMO as a subprocess, from a SUMO that is already running, or from a
finished file (:mod:`pipeline.traffic.recording`); make boxes of them, check what the scenario promises, and write them
(:mod:`pipeline.traffic.trajectories`). Effects that the scenario names, and a network with relief, bring people on foot
and on bicycles, rear parts, and boxes that stand on slopes.

World frame (x east, y north, z up), metres, radians, seconds. The folder ``sumo`` beside the artefact opens in
sumo-gui.

SUMO (https://eclipse.dev/sumo) stands in for the paper's game-engine simulator.
"""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

from pipeline.artefacts import tables
from pipeline.core import files
from pipeline.core.findings import WARNINGS
from pipeline.core.sumo_home import sumo_home
from pipeline.effects import on_traffic, registry
from pipeline.scenario.models import Scenario
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.traffic import recording, sumo, sumo_folder, trajectories
from pipeline.traffic.finished import sizes
from pipeline.world import world_frame

NAME = "traffic"
ARTEFACTS = ("trajectories.parquet",)
COMPANIONS = ("sumo",)


def inputs(work: Workspace) -> StageInputs:
    """Everything that the trajectories depend on."""
    scenario, traffic = work.scenario, work.scenario.traffic
    if traffic.fcd is not None:
        sources = [scenario.find(traffic.fcd, "traffic.fcd"), *sizes.files(scenario)]
    else:
        sources = sumo_folder.sources(scenario).all()
        if traffic.sumocfg is not None:
            sources.insert(0, scenario.find(traffic.sumocfg, "traffic.sumocfg"))
    effects, _ = on_traffic.live(scenario)
    settings = {"seed": scenario.seed, "name": scenario.name, "traffic": traffic.model_dump(mode="json")}
    if traffic.fcd is not None:
        settings |= world_frame.key(scenario)
    # one that acts by itself depends on the network alone
    if named := registry.settings(effect for effect in effects if not effect.SELF_ACTING):
        settings["effects"] = named
    hashes = {_label(path, scenario): files.sha256_of(path) for path in sources}
    version = None if traffic.fcd is not None and not traffic.vtypes else sumo.version()
    return StageInputs(settings, hashes, {"sumo": version}, registry.modules(effects))


def _label(path: Path, scenario: Scenario) -> str:
    """A file's name seen from the scenario's folder, so that it does not depend on where that is."""
    if path.is_relative_to(sumo_home()):
        return f"$SUMO_HOME/{path.relative_to(sumo_home()).as_posix()}"
    return Path(os.path.relpath(path, scenario.folder)).as_posix()


def run(work: Workspace, inputs: StageInputs, traci: tuple[str, int] | None = None) -> Summary:
    """Make the trajectories. SUMO runs on one thread, so that its bytes do not depend on how many there are.

    Parameters
    ----------
    traci
        Host and port of a SUMO that is already running; nothing is started then.

    Returns
    -------
    dict
        What came out, as JSON: frames, vehicles, speeds, standing, collisions, overlaps, SUMO's flags and seconds.

    Raises
    ------
    InputError
        When the scenario or a file that it names is wrong.
    RunError
        When SUMO fails, N vehicles are not held, or a vehicle stands without end.
    """
    scenario = work.scenario
    effects, notes = on_traffic.live(scenario)
    world = world_frame.of(scenario)
    source = recording.record(scenario, work.path(COMPANIONS[0]), effects, work.progress, traci, world)
    with source as recorded, tables.writer(work.path(ARTEFACTS[0]), "trajectories") as file:
        tally, reports = trajectories.write(scenario, recorded, effects, file, work.progress)
        period_s, frames = recorded.window.period_ms / 1000.0, recorded.window.count
        file.describe(work.metadata(inputs, frames=frames, frame_period_s=period_s, sumo=inputs.more["sumo"]))
        summary = recorded.summary()
        doubts = trajectories.doubts(tally, recorded, scenario.roi.box)
    result = tally.to_json(period_s) | ({} if summary is None else asdict(summary))
    result[WARNINGS] = [*result.get(WARNINGS, []), *(finding.to_json() for finding in doubts)]
    if notes:
        result["notes"] = [*result.get("notes", []), *notes]
    return result | reports
