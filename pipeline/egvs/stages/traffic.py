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

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from contextvars import copy_context
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import UNKNOWN_BOXES_KEY
from egvs.core.errors import WARNINGS_KEY, InputError, MissingBackendError
from egvs.core.platform import relative_path
from egvs.core.progress import SummedProgress, no_progress
from egvs.core.sumo_home import sumo_home
from egvs.core.threads import map_ordered
from egvs.effects import registry
from egvs.scenario.model import TERRAIN_KEY, Scenario
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.traffic import (
    class_sizes,
    finished_fcd,
    network,
    recording,
    signal_descriptions,
    signal_plans,
    sumo,
    sumo_folder,
    traffic_sources,
    trajectories,
)
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.locks import WatchedRegion
from egvs.traffic.signals import read_signals
from egvs.traffic.vehicle_boxes import TrafficHook
from egvs.world import geolocation


def dependencies(context: StageContext) -> StageDependencies:
    """Return what the trajectories depend on; the weights of periods do not matter."""
    scenario = context.scenario
    periods = scenario.by_period().values()
    effects, _ = registry.active_traffic_effects(scenario)
    traffic = scenario.traffic.model_dump(mode="json")
    del traffic["observed"]  # it is compared with the traffic later
    if all(period.traffic.is_finished for period in periods):
        traffic.pop("signals", None)  # nothing is simulated
    for period in traffic["periods"]:
        del period["weight"]
    settings = {"seed": scenario.seed, "name": scenario.name, "traffic": traffic}
    if scenario.is_recorded or scenario.traffic.pedestrian_tracks is not None:
        settings |= geolocation.world_frame_settings(scenario)
    # an effect that is enabled automatically depends on the network and the terrain only
    named_effects = registry.effect_settings(effect for effect in effects if not effect.AUTO_ENABLED)
    if named_effects:
        settings["effects"] = named_effects

    digests = {}
    if scenario.statics.terrain is not None:
        digests["terrain"] = context.inputs.digests.of(scenario.find(scenario.statics.terrain, TERRAIN_KEY))
    for period_scenario in periods:
        for path in _source_files(period_scenario):
            digests[_relative_name(path, scenario)] = context.inputs.digests.of(path)
    needs_sumo = any(not period.traffic.is_finished or period.traffic.vtypes for period in periods)
    versions = {"sumo": sumo.sumo_version() if needs_sumo else None}
    if scenario.is_recorded:
        versions["sizes_by"] = _installed_sumo_version()
    modules = list(registry.effect_modules(effects))
    for period_scenario in periods:
        modules += traffic_sources.loaded_modules(period_scenario)
    return StageDependencies(settings, digests, versions, tuple(dict.fromkeys(modules)))


def _installed_sumo_version() -> str | None:
    """Version of the SUMO that knows the sizes of its own vehicle types, which a finished file may use."""
    try:
        return sumo.sumo_version()
    except MissingBackendError:
        return None


def _source_files(scenario: Scenario) -> list[Path]:
    """The files that the traffic of one period comes from."""
    traffic = scenario.traffic
    if traffic.tracks is not None:
        sources = traffic_sources.source_of(scenario).files(scenario)
        network = sumo_folder.network_path(scenario)
        return sources if network is None else [*sources, network]
    if traffic.fcd is not None:
        sources = [scenario.find(traffic.fcd, "traffic.fcd"), *finished_fcd.size_files(scenario)]
        network = sumo_folder.network_path(scenario)
        return sources if network is None else [*sources, network]
    sources = []
    if traffic.sumocfg is not None:
        sources.append(scenario.find(traffic.sumocfg, "traffic.sumocfg"))
    if traffic.pedestrian_tracks is not None:
        sources += traffic_sources.source_of(scenario).files(scenario)
    return [*sources, *sumo_folder.demand_files(scenario).all(), *signal_plans.signal_files(scenario)]


def _relative_name(path: Path, scenario: Scenario) -> str:
    """Name of a file that does not depend on where the scenario and SUMO are installed."""
    if path.is_relative_to(sumo_home()):
        return f"$SUMO_HOME/{path.relative_to(sumo_home()).as_posix()}"
    return relative_path(path, scenario.folder)


def prepare() -> None:
    """Load what reads SUMO's rows: pyarrow loads its functions, and pandas, when it first compares a column."""
    import pyarrow.compute as pc

    pc.not_equal(pa.array([""]), "")


def run(context: StageContext, inputs: StageDependencies, traci: tuple[str, int] | None = None) -> Summary:
    """Make the trajectories. Each SUMO runs on one thread, so that its output does not depend on their number.

    Parameters
    ----------
    context
        The run folder and the inputs.
    inputs
        What the trajectories depend on.
    traci
        Host and port of a SUMO that is already running; none is started then.

    Returns
    -------
    dict
        Outcome as JSON: frames, vehicles, speeds, standing, collisions, overlaps, SUMO's flags and seconds.

    Raises
    ------
    InputError
        When the scenario or a file that it names is wrong.
    RunError
        When SUMO fails, N vehicles are not held, or a vehicle stands without end.
    """
    has_periods = bool(context.scenario.traffic.periods)
    if traci is not None and has_periods:
        raise InputError("--traci", "the scenario has periods", "Use a scenario without [[traffic.periods]].")
    seeds = context.scenario.traffic.seeds
    if traci is not None and seeds > 1:
        raise InputError("--traci", f"expected traffic.seeds = 1, got {seeds}", "A running SUMO has one seed.")
    if traci is not None and context.scenario.traffic.signals:
        raise InputError("--traci", "a running SUMO has plans of its own", "Remove [traffic.signals].")
    summaries = {}
    periods = []
    unknown_boxes: list[dict[str, Any]] = []
    frames = 0
    with parquet.artefact_writer(context.folder.trajectories, "trajectories", follow=context.follow) as file:
        for name, scenario in context.scenario.by_period().items():
            window, summaries[name], unknown = _record_period(context, scenario, name, file, frames, traci)
            unknown_boxes += unknown
            frames += window.count
            periods.append({"name": name, "frames": window.count})
        metadata: dict[str, Any] = {"frames": frames, "frame_period_s": window.period_ms / 1000.0}
        if has_periods:
            metadata["periods"] = periods
        if seeds > 1:
            metadata["seeds"] = seeds
        if unknown_boxes:
            metadata[UNKNOWN_BOXES_KEY] = unknown_boxes
        file.describe(context.metadata(inputs, **metadata, sumo=inputs.more["sumo"]))
    summary = merge_summaries(summaries) if has_periods else summaries[""]
    if plans := _signal_plans(context):
        summary["signals"] = plans
    return summary


def _signal_plans(context: StageContext) -> list[dict[str, Any]]:
    """Return the plans of the signals in the region, from the network that was simulated; none where none was."""
    scenario = next(iter(context.scenario.by_period().values()))
    paths = sorted(context.folder.sumo.rglob(sumo_folder.NETWORK_FILE))
    if scenario.traffic.is_finished or not paths:
        return []
    roads = network.read_net_xml(paths[0])
    if not roads.stop_lines:
        return []
    return signal_descriptions.describe_simulated(scenario, read_signals(paths[0], roads))


def _record_period(
    context: StageContext,
    scenario: Scenario,
    period: str,
    file: parquet.ArtefactWriter,
    first_frame: int,
    traci: tuple[str, int] | None,
) -> tuple[FrameWindow, Summary, list[dict[str, Any]]]:
    """Write the frames of one period; return them, what happened, and where positions are unknown."""
    effects, notes = registry.active_traffic_effects(scenario)
    summaries = []
    unknown: list[dict[str, Any]] = []
    frames = 0
    runs = scenario.by_seed()
    with ExitStack() as simulations:
        for number, recorded in enumerate(_record_runs(context, runs, period, effects, traci, simulations), start=1):
            prefix = f"{number}:" if len(runs) > 1 else ""
            summary, unknown_boxes = _write_run(
                context, runs[number - 1], recorded, effects, file, first_frame + frames, prefix
            )
            if notes:
                summary["notes"] = [*summary.get("notes", []), *notes]
            summaries.append(summary)
            unknown += unknown_boxes
            frames += recorded.window.count
            window = replace(recorded.window, count=frames)
    if len(runs) == 1:
        return window, summaries[0], unknown

    from egvs.stages.seed_summaries import merge_seed_summaries

    return window, merge_seed_summaries(summaries, [run.seed for run in runs]), unknown


def _record_runs(
    context: StageContext,
    runs: Sequence[Scenario],
    period: str,
    effects: Sequence[TrafficHook],
    traci: tuple[str, int] | None,
    simulations: ExitStack,
) -> Iterator[recording.Recording]:
    """Yield the recording of each simulation in order; several run at the same time, on the threads of the context.

    ``simulations`` ends them, and removes their temporary files.
    """
    georeference = context.inputs.georeference
    regions = {"": WatchedRegion(context.scenario.roi.box)}
    progress = SummedProgress(context.progress)

    def record(number: int) -> recording.Recording:
        folder = context.folder.sumo / period
        if len(runs) > 1:
            folder /= f"seed{number + 1}"
        return simulations.enter_context(
            recording.record_traffic(
                runs[number], folder, effects, progress.part(number), traci, georeference, regions, live=len(runs) == 1
            )
        )

    # a copy for each thread, so that a run in the background can be told to end
    contexts = [copy_context() for _ in runs]
    threads = min(context.threads, len(runs))
    yield from map_ordered(lambda number: contexts[number].run(record, number), range(len(runs)), threads)


def _write_run(
    context: StageContext,
    scenario: Scenario,
    recorded: recording.Recording,
    effects: Sequence[TrafficHook],
    file: parquet.ArtefactWriter,
    first_frame: int,
    name_prefix: str,
) -> tuple[Summary, list[dict[str, Any]]]:
    """Write the frames of one simulation, or of a finished file; return its summary, and the unknown positions."""
    progress = no_progress if recorded.is_live else context.progress  # SUMO's progress is reported then
    tally, reports = trajectories.write_trajectories(
        scenario, recorded, effects, file, progress, first_frame, name_prefix
    )
    sumo_summary = recorded.summary()
    warnings = trajectories.traffic_warnings(tally, recorded, scenario.roi.box, recording.demand_key(scenario))
    summary = tally.to_json(recorded.window.period_ms / 1000.0)
    if sumo_summary is not None:
        summary |= asdict(sumo_summary)
    if recorded.tracks is not None:
        summary["tracks"] = dict(recorded.tracks)
    if recorded.types:
        summary["sizes"] = {name: sized.to_json() for name, sized in recorded.types.items()}
    warnings = [*recorded.warnings, *warnings]
    if recorded.tracks is None:  # of tracks and kinds, the check knows the sizes
        kinds = {kind.name for kind in scenario.traffic.named_kinds}
        sizes = {name: size for name, size in recorded.sizes.items() if name not in kinds}
        warnings += class_sizes.warn_unusual_sizes(sizes, recorded.where)
    summary[WARNINGS_KEY] = [*summary.get(WARNINGS_KEY, []), *(warning.to_json() for warning in warnings)]
    unknown = [{**gap, "frames": [first_frame + frame for frame in gap["frames"]]} for gap in recorded.unknown_boxes]
    return summary | reports, unknown


def merge_summaries(summaries: dict[str, Summary]) -> Summary:
    """Join the summaries of periods; what SUMO reports is at the same keys as without periods."""
    merged: Summary = {"frames": sum(summary["frames"] for summary in summaries.values()), "periods": summaries}
    merged["flags"] = {name: summary.pop("flags", None) for name, summary in summaries.items()}
    merged["sumo_seconds"] = round(sum(summary.pop("sumo_seconds", None) or 0.0 for summary in summaries.values()), 3)
    peaks_mb = [summary.pop("sumo_peak_mb", None) for summary in summaries.values()]
    known_peaks_mb = [peak_mb for peak_mb in peaks_mb if peak_mb is not None]
    if known_peaks_mb:
        merged["sumo_peak_mb"] = max(known_peaks_mb)
    counts = []
    warnings = []
    for name, summary in summaries.items():
        version = summary.pop("sumo", None)
        if version is not None:
            merged["sumo"] = version
        counts += [{**count, "place": f"{count['place']} ({name})"} for count in summary.pop("counts", None) or ()]
        for warning in summary.pop(WARNINGS_KEY, ()):
            warnings.append({**warning, "where": f"{warning['where']} ({name})"})
    if counts:
        merged["counts"] = counts
    if warnings:
        merged[WARNINGS_KEY] = warnings
    return merged


STAGE = Stage("traffic", __name__, dependencies, run, reads_traffic=True, prepare=(prepare,))
