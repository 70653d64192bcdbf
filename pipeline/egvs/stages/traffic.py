"""The traffic stage: every vehicle of every frame, as ``trajectories.parquet``.

Steps: get rows of floating car data (FCD) - from SUMO as a subprocess, from a SUMO that is already running, or from a
finished file (:mod:`egvs.traffic.recording`); make boxes of them, check what the scenario promises, and write them
(:mod:`egvs.traffic.trajectories`). Effects that the scenario names, and a network with relief, bring people on foot
and on bicycles, rear parts, and boxes that stand on slopes.

World frame (x east, y north, z up), metres, radians, seconds. The folder ``sumo`` beside the artefact opens in
sumo-gui.

SUMO (https://eclipse.dev/sumo) stands in for the paper's game-engine simulator.
"""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from egvs.artefacts import parquet
from egvs.core.errors import WARNINGS_KEY, InputError, MissingBackendError
from egvs.core.runtime import sumo_home
from egvs.effects import registry
from egvs.scenario.model import Scenario
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.traffic import finished_fcd, recording, sumo, sumo_folder, trajectories
from egvs.traffic.fcd import FrameWindow
from egvs.world import geolocation


def dependencies(work: StageContext) -> StageDependencies:
    """Everything that the trajectories depend on; which weights periods have, is no part of it."""
    scenario, traffic = work.scenario, work.scenario.traffic
    sources = dict.fromkeys(path for alone in scenario.by_period().values() for path in _sources(alone))
    effects, _ = registry.active_traffic_effects(scenario)
    shown = traffic.model_dump(mode="json")
    for period in shown["periods"]:
        del period["weight"]
    settings = {"seed": scenario.seed, "name": scenario.name, "traffic": shown}
    if scenario.is_recorded:
        settings |= geolocation.world_frame_settings(scenario)
    # one that acts by itself depends on the network alone
    if named := registry.effect_settings(effect for effect in effects if not effect.SELF_ACTING):
        settings["effects"] = named
    hashes = {_relative_name(path, scenario): work.inputs.digest(path) for path in sources}
    asks_sumo = any(alone.traffic.fcd is None or alone.traffic.vtypes for alone in scenario.by_period().values())
    version = sumo.sumo_version() if asks_sumo else None
    sizes_by = {"sizes_by": _installed_sumo_version()} if scenario.is_recorded else {}
    return StageDependencies(settings, hashes, {"sumo": version, **sizes_by}, registry.effect_modules(effects))


def _installed_sumo_version() -> str | None:
    """The version of the SUMO that says how large its own types in a finished file are; without one, such a file is
    refused."""
    try:
        return sumo.sumo_version()
    except MissingBackendError:
        return None


def _sources(scenario: Scenario) -> list[Path]:
    """The files that one period's traffic comes from."""
    traffic = scenario.traffic
    if traffic.fcd is not None:
        roads = sumo_folder.network_path(scenario)
        return [
            scenario.find(traffic.fcd, "traffic.fcd"),
            *finished_fcd.size_files(scenario),
            *([] if roads is None else [roads]),
        ]
    own = [scenario.find(traffic.sumocfg, "traffic.sumocfg")] if traffic.sumocfg is not None else []
    return [*own, *sumo_folder.demand_files(scenario).all()]


def _relative_name(path: Path, scenario: Scenario) -> str:
    """A file's name seen from the scenario's folder, so that it does not depend on where that is."""
    if path.is_relative_to(sumo_home()):
        return f"$SUMO_HOME/{path.relative_to(sumo_home()).as_posix()}"
    return Path(os.path.relpath(path, scenario.folder)).as_posix()


def run(work: StageContext, inputs: StageDependencies, traci: tuple[str, int] | None = None) -> Summary:
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
    periods = work.scenario.by_period()
    if traci is not None and work.scenario.traffic.periods:
        raise InputError("--traci", "the scenario has periods", "a scenario without [[traffic.periods]]")
    summaries, first_frame, described = {}, 0, []
    with parquet.artefact_writer(work.folder.trajectories, "trajectories") as file:
        for name, scenario in periods.items():
            window, summaries[name] = _record(work, scenario, name, file, first_frame, traci)
            first_frame += window.count
            described.append({"name": name, "frames": window.count})
        about: dict[str, Any] = {"frames": first_frame, "frame_period_s": window.period_ms / 1000.0}
        if work.scenario.traffic.periods:
            about["periods"] = described
        file.describe(work.metadata(inputs, **about, sumo=inputs.more["sumo"]))
    return merge_summaries(summaries) if work.scenario.traffic.periods else summaries[""]


def _record(
    work: StageContext,
    scenario: Scenario,
    period: str,
    file: parquet.ArtefactWriter,
    first_frame: int,
    traci: tuple[str, int] | None,
) -> tuple[FrameWindow, Summary]:
    """Write the frames of one period."""
    effects, notes = registry.active_traffic_effects(scenario)
    folder = work.folder.sumo / period
    with recording.record_traffic(
        scenario, folder, effects, work.progress, traci, work.inputs.georeference
    ) as recorded:
        tally, reports = trajectories.write_trajectories(scenario, recorded, effects, file, work.progress, first_frame)
        summary = recorded.summary()
        doubts = trajectories.traffic_warnings(tally, recorded, scenario.roi.box)
    result = tally.to_json(recorded.window.period_ms / 1000.0) | ({} if summary is None else asdict(summary))
    result[WARNINGS_KEY] = [*result.get(WARNINGS_KEY, []), *(finding.to_json() for finding in doubts)]
    if notes:
        result["notes"] = [*result.get("notes", []), *notes]
    return recorded.window, result | reports


def merge_summaries(summaries: dict[str, Summary]) -> Summary:
    """The summaries of periods as one; what is of SUMO stands where it does without periods."""
    together: Summary = {"frames": sum(its["frames"] for its in summaries.values()), "periods": summaries}
    if flags := {name: summary.pop("flags", None) for name, summary in summaries.items()}:
        together["flags"] = flags
    if seconds := [summary.pop("sumo_seconds", None) or 0.0 for summary in summaries.values()]:
        together["sumo_seconds"] = round(sum(seconds), 3)
    versions = {summary.pop("sumo", None) for summary in summaries.values()} - {None}
    if versions:
        together["sumo"] = versions.pop()
    counts = [
        {**count, "place": f"{count['place']} ({name})"}
        for name, summary in summaries.items()
        for count in summary.pop("counts", None) or ()
    ]
    if counts:
        together["counts"] = counts
    warnings = [
        {**warning, "where": f"{warning['where']} ({name})"}
        for name, summary in summaries.items()
        for warning in summary.pop(WARNINGS_KEY, ())
    ]
    return together | ({WARNINGS_KEY: warnings} if warnings else {})


STAGE = Stage("traffic", __name__, dependencies, run)
