"""Simulate the traffic of a city once, and split the recording into one file per junction.

Steps of :func:`make_city_traffic`: make the scenarios of the junctions name the city's files; find the region of each
junction; hash everything that the files depend on. If ``traffic.json`` has the same hash and no file was changed,
nothing is done. Otherwise record the traffic as for any scenario (:mod:`egvs.traffic.recording`), once per period,
and write all files in one pass. Files appear complete and ``traffic.json`` last, so an interrupted command is repeated.
The same city gives the same bytes.

**Which vehicles.** The results of a run depend on vehicles whose boxes meet the region of interest (TPOG), are between
a site and the region (points on vehicles, moving occlusion), or are within
:data:`egvs.scoring.target_scores.ISOLATED_GAP_M` of a vehicle in the region. The rectangle around the region and all
sites, extended by :data:`MARGIN_M`, contains them all. A junction gets every row whose box may be partly inside.

**Files.** Floating car data with frames and sizes in the metadata (:mod:`egvs.traffic.finished_fcd`), times from the
first frame on. Boxes are counted and checked while they pass, as for any scenario. Memory does not depend on the number
of frames.

**Scenarios.** Only the keys ``fcd`` and ``periods`` of ``[traffic]`` are written, and only if they name other files of
the city, other periods or other weights than ``city.toml``. Comments and all other keys stay.

World frame, metres, milliseconds.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import tomlkit
from tomlkit.exceptions import TOMLKitError

from egvs.artefacts import parquet
from egvs.core import files, platform, reading
from egvs.core.errors import WARNINGS_KEY, Diagnostic, InputError, RunError
from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.core.progress import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.extensions.city.model import CITY_FILE, JUNCTIONS_FILE, JUNCTIONS_FOLDER, TRAFFIC_FOLDER, City, CityJunction
from egvs.extensions.city.region_checks import RegionChecks, empty_regions
from egvs.runs import stage_keys
from egvs.runs.run import lock_run_folder
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import load, scenario_from_dict
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scoring.target_scores import ISOLATED_GAP_M
from egvs.sensors import sites
from egvs.stages import traffic
from egvs.stages.base import Summary
from egvs.traffic import recording, sumo_folder, trajectories, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.finished_fcd import FcdMetadata
from egvs.traffic.locks import WatchedRegion
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics
from egvs.traffic.vehicle_boxes import TrafficHook, VehicleSize
from egvs.world import geolocation

RECORD_FILE, SUMO_FOLDER = "traffic.json", "sumo"
"""In the folder of the traffic: the inputs and hashes of its files, and the folder that opens in sumo-gui."""

MAX_VEHICLE_LENGTH_M = 80.0
"""A vehicle in the region may extend by half of this beyond it; neighbours of longer vehicles may be missing."""

MARGIN_M = ISOLATED_GAP_M + MAX_VEHICLE_LENGTH_M / 2
ROUNDING_M = 10.0
"""Rectangles are rounded outwards to this, so that a pole can move a little without a new simulation."""

GROUP_FRAMES = 20
"""Number of frames of the whole city that are in memory at a time."""

_TO_CITY_FOLDER = "../../"
_SOURCE_KEYS = ("fcd", "periods")
_COLUMNS = ("id", "type", "x", "y", "z", "angle", "slope", "speed")

_FLUSH_ROWS = 8192
"""Number of rows of a junction that are written together."""

_OTHER_OPEN_FILES = 64
_MAX_REASONS = 5
_CITY_HEIGHT_M = 5.0


@dataclass(frozen=True)
class CityTraffic:
    """The traffic of a city.

    Attributes
    ----------
    is_new
        Whether it was made by this call.
    summary
        Summary of the complete traffic, as in the ``run.json`` of a scenario.
    rows
        Number of rows of each junction, over all periods.
    left_out
        Why a junction cannot be ranked, by name: its traffic is locked, or there is hardly any.
    linked
        Names of the junctions whose scenarios were changed.
    """

    is_new: bool
    summary: Mapping[str, Any]
    rows: Mapping[str, int]
    left_out: Mapping[str, str] = field(default_factory=dict)
    linked: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Number of frames of every junction, over all periods."""
        return int(self.summary["frames"])


@dataclass(frozen=True)
class TrafficRegion:
    """The rectangle of a junction, and its scenario, whose effects may need complete paths."""

    low_x_m: float
    low_y_m: float
    high_x_m: float
    high_y_m: float
    scenario: Scenario

    @property
    def area(self) -> Roi:
        """The rectangle, up to the height of the region of interest."""
        box = self.scenario.roi.box
        size_m = self.high_x_m - self.low_x_m, self.high_y_m - self.low_y_m, box.size_m[2]
        return Roi((self.low_x_m, self.low_y_m, box.origin_m[2]), size_m)

    def to_json(self) -> list[float]:
        """Return the rectangle."""
        return [self.low_x_m, self.low_y_m, self.high_x_m, self.high_y_m]

    def followed_types(self, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Return the vehicle types of which every row is needed."""
        return registry.followed_types(self.scenario, sizes)

    def may_contain(self, x_m: FloatArray, y_m: FloatArray, reach_m: FloatArray) -> BoolArray:
        """Return which boxes may be partly inside.

        Parameters
        ----------
        x_m, y_m
            Centres of the front bumpers, shape (n,).
        reach_m
            Largest distances from there to a corner, shape (n,).
        """
        inside: BoolArray = (x_m >= self.low_x_m - reach_m) & (x_m <= self.high_x_m + reach_m)
        inside &= (y_m >= self.low_y_m - reach_m) & (y_m <= self.high_y_m + reach_m)
        return inside


def make_city_traffic(
    city: City,
    progress: ProgressCallback = no_progress,
    overrides: Sequence[str] = (),
    on_recording: Callable[[], None] = lambda: None,
) -> CityTraffic:
    """Make the traffic files of a city's junctions, unless they are up to date.

    Parameters
    ----------
    city
        From :func:`egvs.extensions.city.model.load_city`.
    progress
        Called with the number of frames that were written.
    overrides
        ``KEY=VALUE`` for the scenarios of all junctions: they may need more of the traffic.
    on_recording
        Called before traffic is recorded; not if the files are up to date.

    Raises
    ------
    InputError
        When the city, a junction's scenario, or a file that they name is wrong.
    RunError
        When SUMO fails, the number of vehicles is not held, the traffic locks at every junction (SUMO is stopped then),
        or another process uses the folder.
    """
    folder = city.folder / TRAFFIC_FOLDER
    with lock_run_folder(folder):
        linked = tuple(junction.id for junction in city.junctions if _link_scenario(city, junction))
        regions = find_traffic_regions(city, overrides)
        scenario = city_traffic_scenario(city, regions)
        key = _traffic_key(scenario, folder, regions)
        existing = _read_record(city, key)
        if existing is not None:
            return _city_traffic(False, existing, scenario, regions, linked)
        on_recording()

        summaries, periods = dict[str, Summary](), list[_RecordedPeriod]()
        locked: dict[str, str] = {}
        for period, period_scenario in scenario.by_period().items():
            paths = {junction.id: junction.traffic_file(city, period) for junction in city.junctions}
            sumo_path = folder / SUMO_FOLDER / period
            recorded = _record_period(period_scenario, sumo_path, regions, paths, progress)
            summaries[period] = recorded.summary
            periods.append(recorded)
            for name, reason in recorded.locked.items():
                locked.setdefault(name, f"{reason} (period {period})" if period else reason)
        summary = traffic.merge_summaries(summaries) if city.traffic.periods else summaries[""]
        if len(locked) == len(regions):
            raise RunError(_no_ranking_problem(scenario, locked))
        for path in traffic_paths(city, locked):
            path.unlink(missing_ok=True)

        digests = {
            _traffic_label(city, path): files.hash_file(path) for path in traffic_paths(city, regions.keys() - locked)
        }
        record = {
            "key": key, "files": digests, "rows": _sum_by_junction([recorded.rows for recorded in periods]),
            "mean_vehicles": _mean_vehicles(periods, int(summary["frames"])), "locked": locked, "summary": summary,
        }  # fmt: skip
        files.write_text(folder / RECORD_FILE, files.to_json_text(record, indent=1) + "\n")
        return _city_traffic(True, record, scenario, regions, linked)


def _sum_by_junction(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total = Counter[str]()
    for by_junction in counts:
        total.update(by_junction)
    return dict(total)


def _mean_vehicles(periods: Sequence[_RecordedPeriod], frames: int) -> dict[str, float]:
    """Return the mean number of vehicles in each region of interest, over all frames of all periods."""
    total = _sum_by_junction([recorded.vehicles for recorded in periods])
    return {name: count / frames for name, count in total.items()}


def _city_traffic(
    is_new: bool,
    record: Mapping[str, Any],
    scenario: Scenario,
    regions: Mapping[str, TrafficRegion],
    linked: tuple[str, ...],
) -> CityTraffic:
    """Return the traffic of ``traffic.json``, with a warning about each junction that cannot be ranked.

    Whether a junction has enough vehicles depends on its score, so another score needs no new traffic.
    """
    empty = empty_regions(record["mean_vehicles"], {name: region.scenario for name, region in regions.items()})
    left_out = empty | record["locked"]
    if len(left_out) == len(regions):
        raise RunError(_no_ranking_problem(scenario, left_out))
    warnings = list(_left_out_warnings(scenario, left_out))
    unused = {name: count for name, count in record["rows"].items() if name not in left_out}
    warnings += _no_traffic_warnings(scenario, unused)
    summary = dict(record["summary"])
    summary[WARNINGS_KEY] = [*summary.get(WARNINGS_KEY, []), *(warning.to_json() for warning in warnings)]
    return CityTraffic(is_new, summary, record["rows"], left_out, linked)


def _no_ranking_problem(scenario: Scenario, left_out: Mapping[str, str]) -> str:
    where, hint = recording.demand_key(scenario)
    reasons = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:_MAX_REASONS])
    return f"{where}: no junction can be ranked: {reasons}. {hint}"


def traffic_paths(city: City, names: Collection[str]) -> Iterator[Path]:
    """Yield the files of all periods of some junctions."""
    for period in [period.name for period in city.traffic.periods] or [""]:
        for junction in city.junctions:
            if junction.id in names:
                yield junction.traffic_file(city, period)


def _traffic_label(city: City, path: Path) -> str:
    return path.relative_to(city.folder / TRAFFIC_FOLDER).as_posix()


def _read_record(city: City, key: str) -> dict[str, Any] | None:
    """Return ``traffic.json``; None if it has another key, or a file is missing or was changed."""
    path = city.folder / TRAFFIC_FOLDER / RECORD_FILE
    if not path.is_file():
        return None
    record = reading.read_json(path)
    match record:
        case {
            "key": str(old_key), "files": dict(digests), "rows": dict(rows), "mean_vehicles": dict(),
            "locked": dict(locked), "summary": dict(),
        }:  # fmt: skip
            pass
        case _:
            return None
    if old_key != key:
        return None
    for traffic_path in traffic_paths(city, rows.keys() - locked):
        if not traffic_path.is_file() or files.hash_file(traffic_path) != digests.get(
            _traffic_label(city, traffic_path)
        ):
            return None
    return dict(record)


def _traffic_key(scenario: Scenario, folder: Path, regions: Mapping[str, TrafficRegion]) -> str:
    """Return a hash of all inputs: the traffic, the regions, the effects of the junctions, the program.

    A region of interest decides whether a junction is locked, the rectangle around it which vehicles it gets.
    """
    dependencies = traffic.dependencies(open_folder(scenario, folder))
    effects = {}
    for name, region in regions.items():
        effects[name] = registry.effect_settings(registry.scenario_effects(region.scenario, traffic.STAGE.name))
    return files.hash_json(
        {
            "inputs": dependencies.to_json(),
            "regions": {name: region.to_json() for name, region in regions.items()},
            "regions_of_interest": {name: _horizontal(region.scenario.roi.box) for name, region in regions.items()},
            "effects": effects,
            "program": stage_keys.program_inputs(traffic.STAGE.name, scenario, dependencies.modules),
            "splitting": stage_keys.source_digest(__name__).digest,
        }
    )


def _horizontal(roi: Roi) -> list[float]:
    """Return the corner and the size of a region, seen from above."""
    return [*roi.origin_m[:2], *roi.size_m[:2]]


def city_traffic_scenario(city: City, regions: Mapping[str, TrafficRegion]) -> Scenario:
    """Return the city's traffic as a scenario, with a region of interest that contains all regions.

    InputError for an effect that adds no traffic.
    """
    for name in city.effects.named:
        if not getattr(registry.load_effect_class(name), "ADDS_TRAFFIC", False):
            hint = f"Move it to {JUNCTIONS_FOLDER}/{SCENARIO_FILE}, or to the scenarios of some junctions."
            raise InputError(f"{city.file}: effects.{name}", "adds no traffic", hint)
    low_x_m = min(region.low_x_m for region in regions.values())
    low_y_m = min(region.low_y_m for region in regions.values())
    high_x_m = max(region.high_x_m for region in regions.values())
    high_y_m = max(region.high_y_m for region in regions.values())
    values = {
        "name": "city",  # a renamed folder has the same traffic
        "seed": city.seed,
        "roi": {
            "center_m": [(low_x_m + high_x_m) / 2, (low_y_m + high_y_m) / 2, _CITY_HEIGHT_M / 2],
            "size_m": [high_x_m - low_x_m, high_y_m - low_y_m, _CITY_HEIGHT_M],
            "voxel_m": _CITY_HEIGHT_M,
        },
        "tpog": {"blocks": 1},  # possible with any number of frames
        "traffic": city.traffic.model_dump(mode="json", exclude_unset=True),
        "effects": city.effects.model_dump(mode="json"),
        "sites": {"file": JUNCTIONS_FILE},
    }
    scenario = scenario_from_dict(values, city.folder, str(city.file))
    scenario._file_name = CITY_FILE
    return scenario


def _link_scenario(city: City, junction: CityJunction) -> bool:
    """Make the scenario of a junction name the city's files and periods; return whether it was changed.

    A scenario with traffic from elsewhere is not changed, and is an error in :func:`find_traffic_regions`.
    """
    path = junction.scenario_folder(city) / SCENARIO_FILE
    table = reading.read_toml(path).get("traffic", {})
    if not isinstance(table, dict):
        return False
    sources = {key: table[key] for key in _SOURCE_KEYS if key in table}
    expected = _expected_sources(city, junction)
    if not sources or sources == expected or not _are_city_files(sources):
        return False
    try:
        document = tomlkit.parse(path.read_text(encoding="utf-8"))
    except (TOMLKitError, UnicodeDecodeError):  # TOML readers differ in what they accept
        return False

    traffic_table: Any = document["traffic"]
    for key in sources:
        del traffic_table[key]
    if "fcd" in expected:
        traffic_table["fcd"] = expected["fcd"]
    else:
        periods = tomlkit.aot()
        for period in expected["periods"]:
            periods.append(tomlkit.item(period))
        periods[-1].add(tomlkit.nl())
        traffic_table["periods"] = periods
    files.write_text(path, tomlkit.dumps(document))
    return True


def _expected_sources(city: City, junction: CityJunction) -> dict[str, Any]:
    """Return the keys of a junction's ``[traffic]`` that follow from the city."""
    if not city.traffic.periods:
        return {"fcd": _relative_traffic_path(city, junction, "")}
    periods = []
    for period in city.traffic.periods:
        file = _relative_traffic_path(city, junction, period.name)
        periods.append({"name": period.name, "weight": period.weight, "fcd": file})
    return {"periods": periods}


def _relative_traffic_path(city: City, junction: CityJunction, period: str) -> str:
    return _TO_CITY_FOLDER + junction.traffic_file(city, period).relative_to(city.folder).as_posix()


def _are_city_files(sources: dict[str, Any]) -> bool:
    """Return whether all files of a ``[traffic]`` table are in the city's traffic folder."""
    periods = sources.get("periods", [])
    if not isinstance(periods, list) or not all(isinstance(period, dict) for period in periods):
        return False
    names = [period.get("fcd", "") for period in periods]
    if "fcd" in sources:
        names.append(sources["fcd"])
    return all(str(name).startswith(f"{_TO_CITY_FOLDER}{TRAFFIC_FOLDER}/") for name in names)


def find_traffic_regions(city: City, overrides: Sequence[str] = ()) -> dict[str, TrafficRegion]:
    """Return the region of each junction, by name.

    Parameters
    ----------
    city
        The city.
    overrides
        ``KEY=VALUE`` for the scenarios of all junctions.

    Raises
    ------
    InputError
        When a scenario is wrong, or its traffic is not the city's.
    """
    return {junction.id: _traffic_region(city, junction, overrides) for junction in city.junctions}


def _traffic_region(city: City, junction: CityJunction, overrides: Sequence[str]) -> TrafficRegion:
    scenario = load(junction.scenario_folder(city), overrides)
    _check_traffic(city, junction, scenario)
    poses = [site.pose for site in sites.candidate_sites(scenario)]
    roi = scenario.roi.box
    xs_m = [roi.origin_m[0], roi.origin_m[0] + roi.size_m[0], *(pose.x_m for pose in poses)]
    ys_m = [roi.origin_m[1], roi.origin_m[1] + roi.size_m[1], *(pose.y_m for pose in poses)]
    return TrafficRegion(
        ROUNDING_M * math.floor((min(xs_m) - MARGIN_M) / ROUNDING_M),
        ROUNDING_M * math.floor((min(ys_m) - MARGIN_M) / ROUNDING_M),
        ROUNDING_M * math.ceil((max(xs_m) + MARGIN_M) / ROUNDING_M),
        ROUNDING_M * math.ceil((max(ys_m) + MARGIN_M) / ROUNDING_M),
        scenario,
    )


def _check_traffic(city: City, junction: CityJunction, scenario: Scenario) -> None:
    """Raise an InputError unless a junction's scenario uses the city's files, periods and frames."""
    by_period = scenario.by_period()
    city_periods = {period.name for period in city.traffic.periods} or {""}
    if by_period.keys() != city_periods:
        problem = f"has {_format_periods(by_period)}, but the city has {_format_periods(city_periods)}"
        hint = f"Use the periods of {city.file}, with the city's files."
        raise InputError(f"{scenario.file}: traffic", problem, hint)

    for name, period_scenario in by_period.items():
        config, expected = period_scenario.traffic, junction.traffic_file(city, name)
        if config.fcd is None or os.path.realpath(scenario.folder / config.fcd) != os.path.realpath(expected):
            source = config.fcd or config.network or config.sumocfg
            hint = f'Set fcd = "{_relative_traffic_path(city, junction, name)}".'
            raise InputError(f"{scenario.file}: traffic", f"comes from {source}, not from the city's files", hint)

    period_s, city_period_s = scenario.traffic.frame_period_s, city.traffic.frame_period_s
    stride = period_s / city_period_s
    if abs(stride - round(stride)) > 1e-9 or round(stride) < 1:
        problem = f"expected a multiple of {city_period_s:g} s, the frame period of {city.file}, got {period_s:g} s"
        hint = f"Use, for example, {city_period_s:g}."
        raise InputError(scenario.locate("traffic.frame_period_s"), problem, hint)


def _format_periods(names: Iterable[str]) -> str:
    if not any(names):
        return "no periods"
    return f"the periods {', '.join(sorted(names))}"


class _RecordedPeriod(NamedTuple):
    """Summary of a period, and by junction: rows, vehicles in the region (sum over frames), why it is locked."""

    summary: Summary
    rows: dict[str, int]
    vehicles: dict[str, int]
    locked: dict[str, str]


def _record_period(
    scenario: Scenario,
    folder: Path,
    regions: Mapping[str, TrafficRegion],
    paths: Mapping[str, Path],
    progress: ProgressCallback,
) -> _RecordedPeriod:
    """Record the traffic of one period and write all files."""
    effects, notes = registry.active_traffic_effects(scenario)
    world = geolocation.scenario_georeference(scenario)
    watched = {name: WatchedRegion(region.scenario.roi.box, region.area) for name, region in regions.items()}
    with recording.record_traffic(scenario, folder, effects, progress, None, world, watched) as recorded:
        checks = RegionChecks({name: region.scenario.roi.box for name, region in regions.items()}, recorded)
        statistics, rows = split_recording(scenario, recorded, regions, paths, effects, progress, checks)
        recording_summary = recorded.summary()
        warnings = trajectories.traffic_warnings(statistics, recorded, scenario.roi.box, recording.demand_key(scenario))
    summary = statistics.to_json(recorded.window.period_ms / 1000.0)
    if recording_summary is not None:
        summary |= asdict(recording_summary)

    # The share of frames with overlaps is a matter of each junction.
    warnings = [warning for warning in warnings if warning.rule != "overlaps"]
    if any(not effect.ADDS_TRAFFIC for effect in effects):
        warnings += _slope_warnings(scenario, regions)
    all_warnings = [*summary.get(WARNINGS_KEY, []), *(warning.to_json() for warning in warnings)]
    summary[WARNINGS_KEY] = [_reword_for_city(warning) for warning in all_warnings]
    if notes:
        summary["notes"] = [*summary.get("notes", []), *notes]
    return _RecordedPeriod(summary, rows, dict(checks.vehicles), checks.locked)


def _reword_for_city(warning: Mapping[str, Any]) -> dict[str, Any]:
    """Adapt the texts of a warning: the region of interest of the city's scenario surrounds all junctions."""
    reworded = dict(warning)
    for key, value in warning.items():
        if isinstance(value, str):
            reworded[key] = value.replace("the region of interest", "the city's junctions")
    return reworded


def _slope_warnings(scenario: Scenario, regions: Mapping[str, TrafficRegion]) -> Iterator[Diagnostic]:
    """Warn about junctions that would treat a hilly network as flat."""
    flat = [name for name, region in regions.items() if region.scenario.traffic.roads is None]
    if flat:
        problem = f"the network has slopes, but the ground of {', '.join(flat)} is level, because they name no roads"
        hint = "Set traffic.roads in their scenarios."
        yield Diagnostic("relief", sumo_folder.traffic_location(scenario), problem, hint)


def _no_traffic_warnings(scenario: Scenario, rows: Mapping[str, int]) -> Iterator[Diagnostic]:
    empty = [name for name, count in rows.items() if not count]
    if empty:
        problem = f"no vehicle comes near {', '.join(empty)}"
        hint = f"Use more traffic, or remove their rows from {JUNCTIONS_FILE}."
        yield Diagnostic("junctions without traffic", sumo_folder.traffic_location(scenario), problem, hint)


def _left_out_warnings(scenario: Scenario, left_out: Mapping[str, str]) -> Iterator[Diagnostic]:
    where, hint = recording.demand_key(scenario)
    for name, reason in left_out.items():
        yield Diagnostic("junctions left out", where, f"{name} is left out, because {reason}", hint)


@dataclass
class _JunctionWriter:
    """Writes the rows of a junction into its file, many at a time."""

    region: TrafficRegion
    followed_types: frozenset[str]
    file: parquet.ArtefactWriter
    rows: int = 0
    vehicles: set[str] = field(default_factory=set)
    _pending: list[pa.Table] = field(default_factory=list)

    def add(self, rows: pa.Table) -> None:
        self._pending.append(rows)
        self.vehicles.update(pc.unique(rows["id"]).to_pylist())
        self.rows += rows.num_rows
        if sum(table.num_rows for table in self._pending) >= _FLUSH_ROWS:
            self.flush()

    def flush(self) -> None:
        if not self._pending:
            return
        rows = pa.concat_tables(self._pending).combine_chunks()
        columns = {f"vehicle_{name}": rows[name].chunk(0) for name in _COLUMNS}
        self.file.write({"timestep_time": rows["time_ms"].to_numpy() / 1000.0, **columns})
        self._pending.clear()


def split_recording(
    scenario: Scenario,
    recording: Recording,
    regions: Mapping[str, TrafficRegion],
    paths: Mapping[str, Path],
    extensions: Sequence[TrafficHook],
    progress: ProgressCallback,
    checks: RegionChecks,
) -> tuple[TrafficStatistics, dict[str, int]]:
    """Write the files of all junctions. No file appears before the recording is complete and checked.

    Parameters
    ----------
    scenario, recording
        The city's traffic as a scenario, and its recording.
    regions, paths
        Region and file of each junction, by name.
    extensions
        Effects that change the traffic.
    progress
        Called with the number of frames that were written.
    checks
        Collects the junctions that are locked.

    Returns
    -------
    tuple
        Statistics of the complete traffic, and the number of rows of each junction.

    Raises
    ------
    InputError, RunError
        As :func:`egvs.traffic.trajectories.write_trajectories`.
    """
    period_ms, where = recording.window.period_ms, recording.source or recording.where
    statistics = TrafficStatistics(recording.window.count, stopped_on_purpose=recording.stopped_on_purpose)
    uncounted = frozenset[str]().union(*(extension.uncounted_types(recording.sizes) for extension in extensions))
    platform.raise_open_file_limit(len(regions) + _OTHER_OPEN_FILES)
    with ExitStack() as stack:
        writers = {}
        for name, region in regions.items():
            file = stack.enter_context(parquet.artefact_writer(paths[name], "fcd"))
            writers[name] = _JunctionWriter(region, region.followed_types(recording.sizes), file)
        for group in trajectories.frame_groups(recording, GROUP_FRAMES):
            boxes = vehicle_boxes.boxes_from_bumpers(group, recording.sizes, period_ms / 1000.0, where, uncounted)
            statistics.add(boxes)
            checks.add_frames(boxes, statistics)
            _write_rows(_with_frame_times(group, period_ms), writers.values(), recording.sizes)
            progress("frames written", group.first_frame + group.frames, statistics.frames)
        # vehicles that stand outside the regions of interest do not matter
        trajectories.check_recording(scenario, statistics, replace(recording, standing_limit_s=None))
        checks.check_teleports({name: len(writer.vehicles) for name, writer in writers.items()})
        fcd_metadata = FcdMetadata.for_recording(period_ms, statistics.frames, dict(recording.sizes))
        for writer in writers.values():
            writer.flush()
            writer.file.describe({"schema": parquet.SCHEMA_VERSION, **fcd_metadata.model_dump(mode="json")})
    return statistics, {name: writer.rows for name, writer in writers.items()}


def _write_rows(rows: pa.Table, writers: Iterable[_JunctionWriter], sizes: Mapping[str, VehicleSize]) -> None:
    """Give each junction the rows of its region, and all rows of the types that it follows, in the order of time."""
    x_m, y_m = rows["x"].to_numpy(), rows["y"].to_numpy()
    types = rows["type"].combine_chunks().dictionary_encode()
    names, type_of_row = types.dictionary.to_pylist(), types.indices.to_numpy()
    reach_m = np.array([np.hypot(sizes[name].length_m, sizes[name].width_m) for name in names])[type_of_row]
    max_reach_m = float(reach_m.max(initial=0.0))

    # Search along x first: most rows of a large city are far from a junction.
    by_x = np.argsort(x_m, kind="stable")
    for writer in writers:
        region = writer.region
        first, last = np.searchsorted(x_m[by_x], [region.low_x_m - max_reach_m, region.high_x_m + max_reach_m])
        chosen = by_x[first:last]
        chosen = chosen[region.may_contain(x_m[chosen], y_m[chosen], reach_m[chosen])]
        if writer.followed_types:
            is_followed = np.array([name in writer.followed_types for name in names])[type_of_row]
            chosen = np.union1d(chosen, np.flatnonzero(is_followed))
        if chosen.size:
            writer.add(rows.take(pa.array(np.sort(chosen))))


def _with_frame_times(group: FrameGroup, period_ms: int) -> pa.Table:
    """Return the rows of a group by ascending frame, with times from the first frame on."""
    order = np.argsort(group.frame, kind="stable")  # pedestrians come after the vehicles of the whole group
    rows = group.rows
    if np.any(np.diff(group.frame) < 0):
        rows = rows.take(pa.array(order))
    times_ms = pc.cast(pa.array(group.frame[order] * period_ms), pa.int64())
    return rows.set_column(rows.schema.get_field_index("time_ms"), "time_ms", times_ms)
