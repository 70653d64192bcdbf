"""One simulation cut to every junction.

Makes the scenarios of junctions name the city's traffic: one file each, or one for each period of ``city.toml``.

Only ``[traffic]`` is written, and only where it names other files of the city's, other periods, or other weights than
``city.toml`` has now; comments and all other keys stay.

How much of a city's traffic a junction needs.

What a run makes of traffic depends on the boxes that can meet the region of interest (the TPOG), that can stand between
a site and the region, or a vehicle in it (points on target, moving occlusion), and that stand within
:data:`egvs.scoring.target_scores.ISOLATED_GAP_M` of such a vehicle. So the rectangle round the region and all
sites, grown by :data:`MARGIN_M`, has them all: a vehicle belongs to it when any of its box may lie there. World frame,
metres.

Cuts one recording of a city's traffic to all its junctions in one pass.

Steps, for some whole frames at a time: rows become boxes, and are counted, as for any scenario, so that the same
promises are kept; each junction takes the rows whose boxes may lie in its region (:mod:`egvs.city.traffic_split`), as
they are, and writes them as floating car data that state their frames (:mod:`egvs.traffic.finished_fcd`). Times
count from the first frame. Memory does not grow with the number of frames.

World frame, metres, milliseconds.

Makes a city's traffic: one simulation, cut to every junction while it is read.

Steps of :func:`make_city_traffic`: have junctions name the city's files; find the region of each; hash all that the
files depend on;
where the seal beside them says the same and no file was altered, nothing is to be done; else record the traffic once,
or once a period, as any scenario's (:mod:`egvs.traffic.recording`), and write all junctions' files
(:mod:`egvs.city.traffic_split`). Files appear whole, the seal last: what was killed is made again. The same city gives
the same bytes.
"""

from __future__ import annotations

import math
import os
import resource
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import tomlkit
from numpy.typing import NDArray
from tomlkit.exceptions import TOMLKitError

from egvs.artefacts import parquet
from egvs.city.model import CITY_FILE, JUNCTIONS_FILE, JUNCTIONS_FOLDER, TRAFFIC_FOLDER, City, CityJunction
from egvs.core import files, reading
from egvs.core.errors import WARNINGS_KEY, Diagnostic, InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.runs import stages
from egvs.runs.run import lock_run_folder
from egvs.scenario.loading import load, scenario_from_dict
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scoring.target_scores import ISOLATED_GAP_M
from egvs.sensors import sites
from egvs.stages import traffic
from egvs.stages.base import Summary
from egvs.stages.inputs import open_folder
from egvs.traffic import recording, sumo_folder, trajectories, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.finished_fcd import FcdMetadata
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics
from egvs.traffic.vehicle_boxes import TrafficHook, VehicleSize
from egvs.world import geolocation

_UP = "../../"
_SOURCE_KEYS = ("fcd", "periods")


def link_scenarios(city: City) -> tuple[str, ...]:
    """Write what has to be; the junctions whose scenarios were changed.

    A scenario whose traffic comes from elsewhere is left as it is, and refused when the traffic is made.
    """
    return tuple(junction.id for junction in city.junctions if _link_scenario(city, junction))


def _link_scenario(city: City, junction: CityJunction) -> bool:
    path = junction.scenario_folder(city) / SCENARIO_FILE
    values = reading.read_toml(path)
    own = values.get("traffic", {})
    its = {key: own[key] for key in _SOURCE_KEYS if key in own} if isinstance(own, dict) else {}
    wanted = _expected_traffic(city, junction)
    if (
        its == wanted
        or not its
        or not all(str(name).startswith(f"{_UP}{TRAFFIC_FOLDER}/") for name in _named_files(its))
    ):
        return False
    try:
        document = tomlkit.parse(path.read_text(encoding="utf-8"))
    except (TOMLKitError, UnicodeDecodeError):  # what one reader takes and the other does not
        return False
    table: Any = document["traffic"]
    for key in its:
        del table[key]
    if "fcd" in wanted:
        table["fcd"] = wanted["fcd"]
    else:
        periods = tomlkit.aot()
        for period in wanted["periods"]:
            periods.append(tomlkit.item(period))
        periods[-1].add(tomlkit.nl())
        table["periods"] = periods
    files.write_text(path, tomlkit.dumps(document))
    return True


def _expected_traffic(city: City, junction: CityJunction) -> dict[str, Any]:
    """What of ``[traffic]`` follows from the city."""
    if not city.traffic.periods:
        return {"fcd": _relative_traffic_path(city, junction, "")}
    return {
        "periods": [
            {"name": period.name, "weight": period.weight, "fcd": _relative_traffic_path(city, junction, period.name)}
            for period in city.traffic.periods
        ]
    }


def _relative_traffic_path(city: City, junction: CityJunction, period: str) -> str:
    return _UP + junction.traffic_file(city, period).relative_to(city.folder).as_posix()


def _named_files(sources: dict[str, Any]) -> Iterator[Any]:
    """The files that a scenario's traffic comes from."""
    if "fcd" in sources:
        yield sources["fcd"]
    periods = sources.get("periods", [])
    for period in periods if isinstance(periods, list) else [periods]:
        yield period.get("fcd", "") if isinstance(period, dict) else ""


MAX_VEHICLE_LENGTH_M = 80.0
"""A vehicle in the region may reach half of this beyond it; a longer tram's neighbours may be missed."""

MARGIN_M = ISOLATED_GAP_M + MAX_VEHICLE_LENGTH_M / 2
ROUNDING_M = 10.0
"""Rectangles are rounded outwards to this, so that a pole that moves a little needs no new simulation."""


@dataclass(frozen=True)
class TrafficRegion:
    """What a junction needs: a rectangle, and the effects that ask for whole ways."""

    low_x_m: float
    low_y_m: float
    high_x_m: float
    high_y_m: float
    scenario: Scenario

    def to_json(self) -> list[float]:
        """The rectangle."""
        return [self.low_x_m, self.low_y_m, self.high_x_m, self.high_y_m]

    def followed_types(self, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Types of which every row is kept, wherever it is."""
        return registry.followed_types(self.scenario, sizes)


def find_traffic_regions(city: City, sets: Sequence[str] = ()) -> dict[str, TrafficRegion]:
    """The region of each junction, with ``sets`` laid over its scenario.

    InputError where a scenario is wrong, or has other traffic than the city's.
    """
    return {junction.id: _traffic_region(city, junction, sets) for junction in city.junctions}


def _traffic_region(city: City, junction: CityJunction, sets: Sequence[str]) -> TrafficRegion:
    scenario = load(junction.scenario_folder(city), sets)
    _check_traffic(city, junction, scenario)
    roi = scenario.roi.box
    spots = [(site.pose.x_m, site.pose.y_m) for site in sites.candidate_sites(scenario)]
    low = [min(roi.origin_m[i], *(spot[i] for spot in spots)) for i in (0, 1)]
    high = [max(roi.origin_m[i] + roi.size_m[i], *(spot[i] for spot in spots)) for i in (0, 1)]
    x0, y0 = (ROUNDING_M * math.floor((value - MARGIN_M) / ROUNDING_M) for value in low)
    x1, y1 = (ROUNDING_M * math.ceil((value + MARGIN_M) / ROUNDING_M) for value in high)
    return TrafficRegion(x0, y0, x1, y1, scenario)


def _check_traffic(city: City, junction: CityJunction, scenario: Scenario) -> None:
    """InputError where a junction's scenario does not take the city's traffic as it is."""
    traffic, alone = scenario.traffic, scenario.by_period()
    its = {period.name for period in city.traffic.periods} or {""}
    if alone.keys() != its:
        found = f"has {_format_periods(alone)}, the city {_format_periods(its)}"
        raise InputError(f"{scenario.file}: traffic", found, f"a period for each of {city.file}, with the city's files")
    for name, of_period in alone.items():
        wanted, given = junction.traffic_file(city, name), of_period.traffic
        if given.fcd is None or os.path.realpath(scenario.folder / given.fcd) != os.path.realpath(wanted):
            source = given.fcd or given.network or given.sumocfg
            right = f'fcd = "../../{wanted.relative_to(city.folder).as_posix()}"'
            raise InputError(f"{scenario.file}: traffic", f"comes from {source}, not from the city's", right)
    strides = traffic.frame_period_s / city.traffic.frame_period_s
    if abs(strides - round(strides)) > 1e-9 or round(strides) < 1:
        found = f"{traffic.frame_period_s:g} s, but {city.file} has a frame each {city.traffic.frame_period_s:g} s"
        raise InputError(f"{scenario.file}: traffic.frame_period_s", found, "the same, or a multiple of it")


def _format_periods(names: Iterable[str]) -> str:
    return f"the periods {', '.join(sorted(names))}" if any(names) else "no periods"


GROUP_FRAMES = 20
"""Frames that are held at a time, with every vehicle of the city."""

_FLUSH_ROWS = 8192
"""Rows of a junction that are written together."""

_SPARE_FILES = 64
_COLUMNS = ("id", "type", "x", "y", "z", "angle", "slope", "speed")


@dataclass
class _JunctionWriter:
    """A junction's rows on their way into its file."""

    region: TrafficRegion
    file: parquet.ArtefactWriter
    rows: int = 0
    _waiting: list[pa.Table] = field(default_factory=list)

    def add(self, rows: pa.Table) -> None:
        self._waiting.append(rows)
        self.rows += rows.num_rows
        if sum(table.num_rows for table in self._waiting) >= _FLUSH_ROWS:
            self.flush()

    def flush(self) -> None:
        if self._waiting and (rows := pa.concat_tables(self._waiting).combine_chunks()).num_rows:
            columns = {f"vehicle_{name}": rows[name].chunk(0) for name in _COLUMNS}
            self.file.write({"timestep_time": rows["time_ms"].to_numpy() / 1000.0, **columns})
        self._waiting.clear()


def split_recording(
    scenario: Scenario,
    recording: Recording,
    regions: Mapping[str, TrafficRegion],
    paths: Mapping[str, Path],
    extensions: Sequence[TrafficHook],
    progress: ProgressCallback,
) -> tuple[TrafficStatistics, dict[str, int]]:
    """Write the file of every junction; what the whole traffic adds up to, and the rows of each junction.

    No file appears before the recording is through and keeps its promises: InputError and RunError as
    :func:`egvs.traffic.trajectories.write_trajectories`.
    """
    tally = TrafficStatistics(recording.window.count, stopped_on_purpose=recording.stopped_on_purpose)
    period_ms, place = recording.window.period_ms, recording.source or recording.where
    uncounted = frozenset[str]().union(*(extension.uncounted_types(recording.sizes) for extension in extensions))
    followed = {name: region.followed_types(recording.sizes) for name, region in regions.items()}
    _raise_file_limit(len(regions))
    with ExitStack() as stack:
        cuts = {
            name: _JunctionWriter(region, stack.enter_context(parquet.artefact_writer(paths[name], "fcd")))
            for name, region in regions.items()
        }
        for group in trajectories.frame_groups(recording, GROUP_FRAMES):
            tally.add(vehicle_boxes.boxes_from_bumpers(group, recording.sizes, period_ms / 1000.0, place, uncounted))
            for name, rows in _junction_rows(group, period_ms, cuts, recording.sizes, followed):
                cuts[name].add(rows)
            progress("frames written", group.first_frame + group.frames, tally.frames)
        trajectories.check_recording(scenario, tally, recording)
        stated = FcdMetadata.for_recording(period_ms, tally.frames, dict(recording.sizes))
        for cut in cuts.values():
            cut.flush()
            cut.file.describe({"schema": parquet.SCHEMA_VERSION, **stated.model_dump(mode="json")})
    return tally, {name: cut.rows for name, cut in cuts.items()}


def _raise_file_limit(count: int) -> None:
    """All junctions' files are open at a time: more than a process has by default, in a large city."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + _SPARE_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted and (hard == resource.RLIM_INFINITY or hard >= wanted):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _junction_rows(
    group: FrameGroup,
    period_ms: int,
    cuts: Mapping[str, _JunctionWriter],
    sizes: Mapping[str, vehicle_boxes.VehicleSize],
    followed: Mapping[str, frozenset[str]],
) -> Iterator[tuple[str, pa.Table]]:
    """The rows of a group that each junction takes, in order of time; those that take none are left out."""
    rows = _with_frame_times(group, period_ms)
    x, y = rows["x"].to_numpy(), rows["y"].to_numpy()
    types = rows["type"].combine_chunks().dictionary_encode()
    names, code = types.dictionary.to_pylist(), types.indices.to_numpy()
    reach_m = np.array([np.hypot(sizes[name].length_m, sizes[name].width_m) for name in names])[code]
    eastward = np.argsort(x, kind="stable")
    far_m = float(reach_m.max(initial=0.0))
    for name, cut in cuts.items():
        region = cut.region
        bounds = np.searchsorted(x[eastward], [region.low_x_m - far_m, region.high_x_m + far_m])
        near = eastward[bounds[0] : bounds[1]]
        near = near[_may_reach(region, x[near], y[near], reach_m[near])]
        if followed[name]:
            whole = np.flatnonzero(np.array([its in followed[name] for its in names])[code])
            near = np.union1d(near, whole)
        if near.size:
            yield name, rows.take(pa.array(np.sort(near)))


def _with_frame_times(group: FrameGroup, period_ms: int) -> pa.Table:
    """The group's rows in order of their frames, with times from the first frame on."""
    order = np.argsort(group.frame, kind="stable")  # persons come after the vehicles of the whole group
    rows = group.rows.take(pa.array(order)) if np.any(np.diff(group.frame) < 0) else group.rows
    index = rows.schema.get_field_index("time_ms")
    return rows.set_column(index, "time_ms", pc.cast(pa.array(group.frame[order] * period_ms), pa.int64()))


def _may_reach(
    region: TrafficRegion, x_m: NDArray[np.float64], y_m: NDArray[np.float64], reach_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether boxes with these front bumpers may lie in the region in part."""
    inside = (x_m >= region.low_x_m - reach_m) & (x_m <= region.high_x_m + reach_m)
    found: NDArray[np.bool_] = inside & (y_m >= region.low_y_m - reach_m) & (y_m <= region.high_y_m + reach_m)
    return found


SEAL_FILE, SUMO_FOLDER = "traffic.json", "sumo"
"""In the folder of the traffic: what its files were made of, and the folder that opens in sumo-gui."""

_HEIGHT_M = 5.0


@dataclass(frozen=True)
class CityTraffic:
    """A city's traffic.

    Attributes
    ----------
    is_new
        Whether it was made now.
    summary
        What came out of the whole, as ``run.json`` has it of a scenario's traffic.
    rows
        Rows of each junction, of all periods.
    linked
        Junctions whose scenarios were changed, to name the city's periods.
    """

    is_new: bool
    summary: Mapping[str, Any]
    rows: Mapping[str, int]
    linked: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Frames of every junction, of all periods."""
        return int(self.summary["frames"])


def make_city_traffic(city: City, progress: ProgressCallback = no_progress, sets: Sequence[str] = ()) -> CityTraffic:
    """Make the traffic of a city's junctions, unless it is there.

    Parameters
    ----------
    sets
        Laid over every junction's scenario, as ``--set`` does: they may ask for more of the traffic.

    Raises
    ------
    InputError
        When the city, a junction's scenario, or a file that they name is wrong.
    RunError
        When SUMO fails, N vehicles are not held, a vehicle stands without end, or another process is at work there.
    """
    folder = city.folder / TRAFFIC_FOLDER
    with lock_run_folder(folder):
        linked = link_scenarios(city)
        its_regions = find_traffic_regions(city, sets)
        scenario = city_traffic_scenario(city, its_regions)
        key = _traffic_key(scenario, folder, its_regions)
        if (known := _read_sealed_traffic(city, key)) is not None:
            return replace(known, linked=linked)
        summaries, rows = dict[str, Summary](), Counter[str]()
        for period, of_period in scenario.by_period().items():
            paths = {junction.id: junction.traffic_file(city, period) for junction in city.junctions}
            summaries[period], its_rows = _record_period(
                of_period, folder / SUMO_FOLDER / period, its_regions, paths, progress
            )
            rows.update(its_rows)
        summary = summaries[""] if "" in summaries else traffic.merge_summaries(summaries)
        summary[WARNINGS_KEY] = [*summary.get(WARNINGS_KEY, []), *_no_traffic_warnings(scenario, rows)]
        digests = {_traffic_label(city, path): files.hash_file(path) for path in _traffic_paths(city)}
        seal = {"key": key, "files": digests, "rows": dict(rows), "summary": summary}
        files.write_text(folder / SEAL_FILE, files.to_json_text(seal, indent=1) + "\n")
    return CityTraffic(True, summary, dict(rows), linked)


def _traffic_paths(city: City) -> Iterator[Path]:
    """The files of all junctions and periods."""
    for period in [period.name for period in city.traffic.periods] or [""]:
        yield from (junction.traffic_file(city, period) for junction in city.junctions)


def _traffic_label(city: City, path: Path) -> str:
    return path.relative_to(city.folder / TRAFFIC_FOLDER).as_posix()


def city_traffic_scenario(city: City, traffic_regions: Mapping[str, TrafficRegion]) -> Scenario:
    """The city's traffic as a scenario, whose region of interest holds all junctions' regions."""
    for name in city.effects.named:
        if not getattr(registry.find_effect_class(name), "ADDS_TRAFFIC", False):
            right = f"in {JUNCTIONS_FOLDER}/{SCENARIO_FILE}, for every junction, or in those of some"
            raise InputError(f"{city.file}: effects.{name}", "adds no traffic", right)
    low = [min(getattr(region, key) for region in traffic_regions.values()) for key in ("low_x_m", "low_y_m")]
    high = [max(getattr(region, key) for region in traffic_regions.values()) for key in ("high_x_m", "high_y_m")]
    middle, size = (
        [(a + b) / 2 for a, b in zip(low, high, strict=True)],
        [b - a for a, b in zip(low, high, strict=True)],
    )
    values = {
        "name": "city",  # a folder that is renamed has the same traffic
        "seed": city.seed,
        "roi": {"center_m": [*middle, _HEIGHT_M / 2], "size_m": [*size, _HEIGHT_M], "voxel_m": _HEIGHT_M},
        "tpog": {"blocks": 1},  # of any number of frames
        "traffic": city.traffic.model_dump(mode="json", exclude_unset=True),
        "effects": city.effects.model_dump(mode="json"),
        "sites": {"file": JUNCTIONS_FILE},
    }
    scenario = scenario_from_dict(values, city.folder, str(city.file))
    scenario._file_name = CITY_FILE
    return scenario


def _traffic_key(scenario: Scenario, folder: Path, traffic_regions: Mapping[str, TrafficRegion]) -> str:
    """A hash of all that the files depend on: the traffic, the regions, the effects that follow ways, the program."""
    read = traffic.dependencies(open_folder(scenario, folder))
    own = {
        name: registry.effect_settings(registry.scenario_effects(its.scenario, traffic.STAGE.name))
        for name, its in traffic_regions.items()
    }
    about = {
        "inputs": read.to_json(),
        "regions": {name: region.to_json() for name, region in traffic_regions.items()},
        "effects": own,
        "program": stages.program_inputs(traffic.STAGE.name, scenario, read.modules),
        "cutting": stages.source_digest(__name__).digest,
    }
    return files.hash_json(about)


def _read_sealed_traffic(city: City, key: str) -> CityTraffic | None:
    """The traffic that is there, where it is this one and whole."""
    path = city.folder / TRAFFIC_FOLDER / SEAL_FILE
    if not path.is_file():
        return None
    match reading.read_json(path):
        case {"key": str(its), "files": dict(digests), "rows": dict(rows), "summary": dict(summary)} if its == key:
            pass
        case _:
            return None
    for its_file in _traffic_paths(city):
        if not its_file.is_file() or files.hash_file(its_file) != digests.get(_traffic_label(city, its_file)):
            return None
    return CityTraffic(False, summary, rows)


def _record_period(
    scenario: Scenario,
    folder: Path,
    traffic_regions: Mapping[str, TrafficRegion],
    paths: Mapping[str, Path],
    progress: ProgressCallback,
) -> tuple[Summary, dict[str, int]]:
    """Record the traffic of one period and write every junction's file; what came out, and the rows of each."""
    effects, notes = registry.active_traffic_effects(scenario)
    world = geolocation.scenario_georeference(scenario)
    with recording.record_traffic(scenario, folder, effects, progress, None, world) as recorded:
        tally, rows = split_recording(scenario, recorded, traffic_regions, paths, effects, progress)
        done = recorded.summary()
        doubts = trajectories.traffic_warnings(tally, recorded, scenario.roi.box)
    summary = tally.to_json(recorded.window.period_ms / 1000.0) | ({} if done is None else asdict(done))
    doubts = [doubt for doubt in doubts if doubt.rule != "overlaps"]  # a share of frames: each junction tells its own
    if any(not effect.ADDS_TRAFFIC for effect in effects):
        doubts += _slope_warnings(scenario, traffic_regions)
    told = [*summary.get(WARNINGS_KEY, []), *(finding.to_json() for finding in doubts)]
    summary[WARNINGS_KEY] = [{key: _reword_for_city(value) for key, value in warning.items()} for warning in told]
    if notes:
        summary["notes"] = [*summary.get("notes", []), *notes]
    return summary, rows


def _slope_warnings(scenario: Scenario, traffic_regions: Mapping[str, TrafficRegion]) -> Iterator[Diagnostic]:
    """A warning of junctions that do not know the relief of the network."""
    flat = [name for name, region in traffic_regions.items() if region.scenario.traffic.roads is None]
    if flat:
        found = f"the network goes up and down, but {', '.join(flat)} name no roads: the ground is level there"
        cure = "traffic.roads in their scenarios"
        yield Diagnostic("relief", sumo_folder.traffic_key(scenario), found, cure)


def _no_traffic_warnings(scenario: Scenario, rows: Mapping[str, int]) -> list[dict[str, Any]]:
    """A warning of junctions to which nobody comes."""
    if not (empty := [name for name, count in rows.items() if not count]):
        return []
    found, cure = f"no vehicle comes near {', '.join(empty)}", f"more traffic, or no row for them in {JUNCTIONS_FILE}"
    return [Diagnostic("junctions without traffic", sumo_folder.traffic_key(scenario), found, cure).to_json()]


def _reword_for_city(value: Any) -> Any:
    """A warning's words: what stands for the region of interest is the rectangle round all junctions."""
    return value.replace("the region of interest", "the city's junctions") if isinstance(value, str) else value
