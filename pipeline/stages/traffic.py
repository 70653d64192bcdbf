"""Puts every vehicle of every frame into ``trajectories.parquet``.

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
from pathlib import Path
from typing import Any

from pipeline.artefacts import tables
from pipeline.core import files
from pipeline.core.progress import Progress, silent
from pipeline.core.sumo_home import sumo_home
from pipeline.scenario.models import Scenario
from pipeline.stages.base import metadata
from pipeline.traffic import configuration, recording, sumo, trajectories
from pipeline.traffic.extensions import TrafficExtension

NAME = "traffic"
ARTEFACTS = ("trajectories.parquet",)


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Everything that the trajectories depend on."""
    del out
    traffic = scenario.traffic
    if traffic.fcd is not None:
        sources = [scenario.find(traffic.fcd, "traffic.fcd")]
    else:
        sources = configuration.sources(scenario).all()
        if traffic.sumocfg is not None:
            sources.insert(0, scenario.find(traffic.sumocfg, "traffic.sumocfg"))
    return {
        "settings": {
            "seed": scenario.seed,
            "name": scenario.name,
            "traffic": traffic.model_dump(mode="json"),
            **_effect_settings(scenario),
        },
        "files": {_label(path, scenario): files.sha256_of(path) for path in sources},
        "sumo": None if traffic.fcd is not None else sumo.version(),
    }


def _effect_settings(scenario: Scenario) -> dict[str, Any]:
    """The effects that act. One that cannot change the result is left out, as if it were not named."""
    if not scenario.effects:
        return {}
    from pipeline.effects import registry

    settings = registry.traffic_settings(scenario)
    return {"effects": settings} if settings else {}


def _label(path: Path, scenario: Scenario) -> str:
    """A file's name seen from the scenario's folder, so that it does not depend on where that is."""
    if path.is_relative_to(sumo_home()):
        return f"$SUMO_HOME/{path.relative_to(sumo_home()).as_posix()}"
    return Path(os.path.relpath(path, scenario.folder)).as_posix()


def run(
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    traci: tuple[str, int] | None = None,
) -> dict[str, Any]:
    """Make the trajectories.

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
    del jobs  # SUMO runs on one thread, so that its bytes do not depend on how many there are
    about = inputs(scenario, out)
    acting, notes = _acting(scenario)
    source = recording.record(scenario, out / "sumo", acting, progress, traci)
    with source as recorded, tables.writer(out / ARTEFACTS[0], "trajectories") as file:
        written = trajectories.write(scenario, recorded, acting, file, progress)
        period_s = recorded.window.period_ms / 1000.0
        frames = scenario.traffic.frames
        file.describe(metadata(scenario, about, frames=frames, frame_period_s=period_s, sumo=about["sumo"]))
        summary = recorded.summary()
    result = written.counts.to_json() | ({} if summary is None else summary.to_json())
    if notes:
        result["notes"] = [*result.get("notes", []), *notes]
    return result | written.of_extensions


def _acting(scenario: Scenario) -> tuple[tuple[TrafficExtension, ...], tuple[str, ...]]:
    """The effects that act on the traffic, and what to say of them; none is imported where none can act."""
    if not scenario.effects and not configuration.may_have_heights(scenario):
        return (), ()
    from pipeline.effects import registry

    return registry.traffic_effects(scenario)
