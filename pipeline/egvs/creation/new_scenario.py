"""Make a scenario from maps: roads, and what stands beside them.

Steps of :func:`create_scenario`: open the files (:mod:`egvs.creation.map_readers`); build the network; choose a
junction and put the region of interest around it; cut the network to its surroundings; collect buildings and other
static objects within sensor range (:mod:`egvs.creation.static_objects`); find candidate sites along the kerbs; assume
flows, and find how much of them the network carries; write

    network.net.xml    the streets                                       (traffic)
    statics.geojson    footprints with heights, and import counts        (statics)
    sites.csv          candidate sites                                   (scan, score)
    zones.geojson      crosswalks, stop lines, approaches                (score)
    scenario.toml      the scenario that names them

and, where the maps have meshes, one PLY file for each kind of object.

World frame: the network's x (east), y (north) in metres. The ground is z = 0, or follows the network's lanes where they
have heights. The same maps give the same bytes: no dates, no paths, objects sorted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomlkit
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.core.grid import XY, FloatArray, Roi
from egvs.core.wording import by_number, number_of
from egvs.creation import (
    assumed_traffic,
    junction_zones,
    junctions,
    map_readers,
    scenario_files,
    static_objects,
    street_counts,
)
from egvs.creation.alignment import PointPair, check_used, make_alignment
from egvs.creation.assumed_traffic import DEFAULT_TRAFFIC, JUNCTION_BLOCKER_S, TELEPORT_S, AssumedTraffic
from egvs.creation.building_heights import ASSUMED, NEIGHBOURS, SURFACE_MODEL
from egvs.creation.junction_zones import Zone
from egvs.creation.junctions import JunctionRegion, KerbsidePole, StreetJunction, Streets
from egvs.creation.map_parts import (
    DECK_BASE_M,
    DEFAULT_BUILDING_M,
    OUT_OF_RANGE,
    ImportCounts,
    MapContext,
    RoadOptions,
    Terrain,
)
from egvs.creation.map_readers import MapFile, MapFiles
from egvs.creation.openstreetmap import ATTRIBUTION
from egvs.creation.plain_network import NETWORK_FILE
from egvs.creation.road_source import NetworkRoads, RoadSource
from egvs.creation.scenario_files import (
    PITCHES_DEG,
    SENSOR,
    SITES_FILE,
    STATICS_FILE,
    TERRAIN_FILE,
    ZONES_FILE,
    FileContent,
    TomlTable,
    reachable_area,
)
from egvs.creation.static_objects import MapSummary, ReadMap, StaticObjects, SurfaceModel
from egvs.creation.street_counts import StreetCounts
from egvs.creation.terrain import bridge_decks, ground_heights, ground_reference
from egvs.creation.terrain.ground_heights import HIGHEST_M, LOWEST_M
from egvs.creation.terrain.relief import Relief, ground_surface
from egvs.extensions.tracks.new import demand as demand_from_tracks
from egvs.extensions.tracks.new import files as recorded_traffic
from egvs.extensions.tracks.new import signal_programs
from egvs.extensions.tracks.new import signals as recorded_signals
from egvs.extensions.tracks.new.demand import TrackDemand
from egvs.extensions.tracks.new.files import TrackFiles
from egvs.extensions.tracks.new.motion import MatchedRecording, match_recording
from egvs.extensions.tracks.new.signal_assignment import RecordedMotion
from egvs.extensions.tracks.new.signal_programs import RecordedSignalNetwork, Replay
from egvs.extensions.tracks.recorded_tracks import RecordedTracks
from egvs.formats import ply
from egvs.scenario.loading import load
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.signal_config import ASSUMED_PLANS
from egvs.scenario.traffic_config import DEFAULT_FRAMES, DEFAULT_WARMUP_S, CountConfig, TrafficConfig
from egvs.sensors.sensor import CATALOGUE
from egvs.traffic.movements import MovementNames
from egvs.traffic.sumo import SumoInputError
from egvs.world.static_world import build_world

if TYPE_CHECKING:
    from egvs.creation.openstreetmap.overpass import DownloadedExtract

SURROUNDINGS_MIN_M = 100.0
FAR_FROM_AT_M = 50.0
"""A junction farther than this from the requested position may be the wrong one."""

_MOST_NAMED = 3
"""Number of junctions that the message about a position without a junction names."""

TERRAIN_STEP_M = 5.0
"""Distance of the points of the ground beyond the roads."""

PEOPLE_HINT = (
    "Pedestrians are added with --set effects.pedestrians_bicycles.pedestrians_per_h=300 (bicycles: bicycles_per_h)."
)

_SIGNALS_OF_TRACKS_NOTE = (
    "Recorded traffic does not depend on the signals. They are tested against it, and network.net.xml replays them on"
    " its clock; with --like instead of --tracks, simulated traffic obeys them."
)
_NO_SIGNALS_NOTE = "No junction in the map has signals; the one with the most incoming lanes was chosen."


@dataclass(frozen=True, repr=False)
class NewScenario:
    """What :func:`create_scenario` made.

    Attributes
    ----------
    folder
        The scenario's folder.
    junction, roi
        The junction, and the region of interest around it.
    streets
        The simulated streets.
    poles
        Number of locations for poles.
    statics
        What happened to the objects of the map.
    n_solids
        Number of solids of the static world, the ground included. A tree is two, an object that is cut may be several.
    traffic
        The traffic through the region of interest; None where no street leads through it.
    notes
        What to know before trusting the scenario.
    height_m
        Height of the region of interest.
    maps
        What each map with static objects contributed.
    attributions
        Who made the maps.
    from_at_m
        Distance of the junction from the requested position, 0 inside it; None without such a position.
    recorded
        The recorded traffic, if there is one.
    demand
        The demand that was estimated from recorded tracks, if there are such tracks.
    signal_notes
        Durations of recorded signals, with intervals; empty without them.
    counted
        The user's counts, if there are any.
    zones
        Zones of the junction, for which results are reported.
    are_lights_guessed
        Whether it was guessed which recorded light governs which road.
    """

    folder: Path
    junction: StreetJunction
    roi: JunctionRegion
    streets: Streets
    poles: int
    statics: ImportCounts
    n_solids: int
    traffic: AssumedTraffic | None
    notes: tuple[str, ...]
    height_m: float = junctions.ROI_HEIGHT_M
    maps: tuple[MapSummary, ...] = ()
    attributions: tuple[str, ...] = ()
    from_at_m: float | None = None
    recorded: RecordedTracks | None = None
    demand: TrackDemand | None = None
    signal_notes: tuple[str, ...] = ()
    counted: StreetCounts | None = None
    zones: tuple[Zone, ...] = ()
    are_lights_guessed: bool = False

    def __repr__(self) -> str:
        vehicles_per_hour = sum(flow.per_hour for flow in self.flows)
        parts = (
            f"{self.junction.title}, {self.junction.arms} arms",
            f"{self.n_candidates} candidate sites on {self.poles} poles",
            f"{self.n_solids} solids",
            f"{vehicles_per_hour:,.0f} vehicles an hour",
        )
        return f"NewScenario({self.folder.name}: {'; '.join(parts)})"

    @property
    def maps_have_notes(self) -> bool:
        """Whether there is something to know about single maps."""
        return any(summary.notes for summary in self.maps)

    @property
    def is_far_from_at(self) -> bool:
        """Whether the junction may be another one than the user meant."""
        return self.from_at_m is not None and self.from_at_m > FAR_FROM_AT_M

    @property
    def n_candidates(self) -> int:
        """Number of candidates: each pole with each height and each tilt."""
        return self.poles * len(junctions.HEIGHTS_M) * len(PITCHES_DEG)

    @property
    def flows(self) -> tuple[CountConfig, ...]:
        """The flows of the scenario; empty where no street leads through the region of interest."""
        if self.demand is not None:
            return self.demand.flows
        if self.counted is not None:
            return self.counted.flows
        return () if self.traffic is None else self.traffic.flows


@dataclass(frozen=True)
class NewScenarioOptions:
    """Options of :func:`create_scenario`.

    Attributes
    ----------
    lefthand
        Whether traffic drives on the left.
    walk
        Whether the network gets sidewalks and crossings, which pedestrians need.
    surroundings_m
        Distance from the junction at which streets end; inf for the complete map. The default depends on the format of
        the map.
    traffic
        A key of :data:`assumed_traffic.TRAFFIC_LEVELS`: the share of the flow that the junction carries. Or vehicles
        per hour.
    pole_spacing_m
        Distance between candidate poles along the kerbs; None for a few poles near the junction.
    align
        Two points that place files without a reference system; empty if there are no such files.
    tracks
        Files of recorded tracks, or folders of them, which replace assumed traffic.
    like
        The same, but from which the demand of simulated traffic is estimated.
    pedestrian_tracks
        The same, of people on foot and on bicycles, who are put beside simulated vehicles.
    signals
        Files of recorded signals of the junction, and of what their groups govern; see :mod:`recorded_signals`.
    track_crs
        Coordinate system of the tracks, as for the key ``traffic.track_crs``.
    track_columns
        TOML file with the meaning of the columns of tracks in a table of one's own.
    surface
        Rasters of the heights of roofs and trees; with a terrain, they give heights to buildings that have none.
    counts
        CSV file with counts by street, side of arrival and turn, see :mod:`street_counts`; instead of assumed traffic.
    """

    lefthand: bool = False
    walk: bool = False
    surroundings_m: float | None = None
    traffic: str | int = DEFAULT_TRAFFIC
    pole_spacing_m: float | None = None
    align: tuple[PointPair, ...] = ()
    tracks: tuple[Path, ...] = ()
    like: tuple[Path, ...] = ()
    pedestrian_tracks: tuple[Path, ...] = ()
    signals: tuple[Path, ...] = ()
    track_crs: str | None = None
    track_columns: Path | None = None
    surface: tuple[Path, ...] = ()
    counts: Path | None = None

    def check(self) -> None:
        """Raise an InputError when a value is out of its limits."""
        assumed_traffic.check_traffic(self.traffic)
        _check_pole_spacing(self.pole_spacing_m)
        if self.tracks and self.like:
            hint = "--tracks replays tracks, --like simulates such traffic."
            raise InputError("--like", "cannot be combined with --tracks", hint)
        if self.counts is not None and (self.tracks or self.like):
            key = "--tracks" if self.tracks else "--like"
            raise InputError("--counts", f"cannot be combined with {key}", "Use one of them.")
        if self.tracks and self.pedestrian_tracks:
            hint = "Give the files of all recorded road users by --tracks."
            raise InputError("--pedestrian-tracks", "is for simulated vehicles, not for --tracks", hint)
        for key, value in (("--track-crs", self.track_crs), ("--track-columns", self.track_columns)):
            if value is not None and not (self.tracks or self.like or self.pedestrian_tracks):
                hint = "Give them with --tracks, --like or --pedestrian-tracks."
                raise InputError(key, "has no effect without recorded tracks", hint)
        if self.surroundings_m is not None and self.surroundings_m < SURROUNDINGS_MIN_M:
            raise InputError(
                "--surroundings",
                f"expected at least {SURROUNDINGS_MIN_M:g} m, got {self.surroundings_m:g} m",
                "Choose a distance that includes the junction and its approaches.",
            )


def create_scenario(
    folder: str | Path,
    maps: str | Path | Sequence[str | Path],
    at: tuple[float, float] | None = None,
    options: NewScenarioOptions | None = None,
) -> NewScenario:
    """Make a scenario folder from maps.

    Parameters
    ----------
    folder
        Created by this function; may exist if it is empty.
    maps
        Files, or folders of files: one road map, and any number of maps of static objects.
    at
        Latitude, longitude in degrees, or x, y in metres if the road map has no reference system: choose the junction
        there, see :func:`junctions.choose_nearby`. By default, the largest one with signals.
    options
        Options; the defaults when None.

    Returns
    -------
    NewScenario
        A summary of the new scenario.

    Raises
    ------
    InputError
        When the folder is not empty, a file is damaged or of an unknown format, the road map has no drivable streets,
        ``at`` is outside or far from any junction, no site is possible, or an option has no effect. Nothing is written
        then.
    """
    options = options or NewScenarioOptions()
    options.check()
    folder = Path(folder)
    name = scenario_files.check_new_folder(folder)
    map_paths = [maps] if isinstance(maps, str | Path) else maps
    files = map_readers.open_maps([Path(path) for path in map_paths])
    surface_files = map_readers.open_surface(options.surface)
    roads = _read_roads(files.roads, RoadOptions(options.lefthand, options.walk, bool(files.terrain), at))
    recording, example, people = (
        _find_tracks(paths, options) for paths in (options.tracks, options.like, options.pedestrian_tracks)
    )
    any_tracks = recording or example or people
    junction = _choose_junction(roads.streets, at, any_tracks, files.roads.path)

    level = roads.on_level_of(junction)
    if level.streets is not roads.streets:
        junction = _find_again(level.streets, junction, roads.streets, files.roads.path)
    window = reachable_area(junctions.region_around(junction))
    frame = level.streets.frame
    alignment = make_alignment(options.align, frame) if options.align else None
    context = MapContext(frame, window, alignment, level.streets)
    roads = level.around(junction, options.surroundings_m)
    maps_read = static_objects.read_maps(files.solids, level, files.roads, context)
    terrain = ground_reference.read_terrain(files.terrain, ground_reference.with_roads(context, roads.streets))
    measured = static_objects.ground_mesh(maps_read)
    surface = ground_reference.read_terrain(surface_files, context)
    check_used(context)
    ground_notes = []
    if terrain is None and measured is not None:
        terrain = ground_reference.measured_ground(measured)
    elif measured is not None:
        ground_notes.append("The ground of the point cloud is not used, since a terrain file is given.")
    zero = ground_reference.find_zero(roads, files.roads, junction, terrain, files.terrain)
    roads = ground_reference.lay_on_ground(roads, files.roads, junction, terrain, files.terrain)
    terrain_m = None if terrain is None else _terrain_points(terrain, window, zero.height_m or 0.0)
    ground = ground_surface(roads.streets, terrain_m)
    objects = static_objects.collect_objects(
        maps_read, level.streets, junction.at_m, zero.height_m, ground, _surface_model(surface, terrain)
    )
    _check_zero_height(objects.zero_height_m, files)
    if files.terrain and terrain is not None and zero.height_m is not None:
        decks = bridge_decks.bridge_decks(roads.network, terrain, zero.height_m)
        objects = replace(objects, meshes=(*objects.meshes, *decks))
    if roads.streets is not level.streets:
        junction = _require_junction(junctions.find_again(roads.streets, junction, junction.at_m), files.roads.path)
    streets = roads.streets
    roi = junctions.region_around(junction)
    poles = junctions.kerbside_poles(streets, junction, roi, objects.areas, options.pole_spacing_m)
    if not poles:
        has_free_poles = bool(junctions.kerbside_poles(streets, junction, roi, [], options.pole_spacing_m))
        covering = objects.file_names if has_free_poles else ()
        raise _no_pole_error(junction, options, files.roads.path, covering)

    notes = [*roads.notes, *zero.notes, *(() if terrain is None else terrain.notes), *ground_notes]
    notes += _surface_notes(surface, objects.counts)
    if at is None and any_tracks is None and not junction.signalised:
        notes.append(_NO_SIGNALS_NOTE)
    notes += _ring_notes(streets, junction)
    notes += scenario_notes(roi.area.covers(junction.area), objects.counts)
    notes += _level_notes(level, objects.counts) + _range_notes(objects.counts)
    if options.walk:
        notes.append(PEOPLE_HINT)
    matched = [match_recording(tracks, streets) for tracks in (recording, example, people) if tracks is not None]
    signals = RecordedSignalNetwork(roads.network, ())
    if options.signals:
        replay = None
        if recording is not None:
            replay = Replay.of(recording.time_range_s, begin_s=0.0)
        elif people is not None:
            replay = Replay.of(people.time_range_s, begin_s=DEFAULT_WARMUP_S)
        signals = _with_signals(roads.network, junction, options.signals, streets, matched, replay)
        junction = replace(junction, signalised=True)
        notes += [] if recording is None else [_SIGNALS_OF_TRACKS_NOTE]
    like = None if example is None else matched[0]
    planned = _plan_traffic(signals.network, streets, junction, options, like, files.roads.path)
    notes += [*signals.notes, *planned.notes]
    relief = Relief.of_region(streets, junction, roi)
    if relief.other_levels:
        notes.append(f"Lanes on another level cross the region of interest: {', '.join(relief.other_levels)}.")

    scenario = NewScenario(
        folder, junction, roi, streets, len(poles), objects.counts, 0, planned.assumed, tuple(notes),
        height_m=relief.z_range_m[1] - relief.z_range_m[0], maps=objects.maps,
        attributions=_attributions(roads, objects), from_at_m=_distance_m(streets, junction, at),
        demand=planned.demand, signal_notes=signals.notes, counted=planned.counted,
        zones=junction_zones.junction_zones(streets, junction, roi), are_lights_guessed=signals.is_guessed,
    )  # fmt: skip
    ground_m = relief.ground_m(ground, poles)
    columns = _site_columns(poles, ground_m, relief, maps_read, roi, zero.height_m or 0.0)
    meshes = static_objects.mesh_files([mesh for mesh in objects.meshes if mesh.kind != static_objects.GROUND])
    terrain_files = {}
    if terrain_m is not None:
        terrain_files[TERRAIN_FILE] = partial(ply.write, points_m=terrain_m)
    statics = scenario_files.statics_table(list(meshes), *terrain_files)
    signals_end_s = None if signals.clock is None else signals.clock.to_s
    document = _scenario_toml(
        name, scenario, relief, statics, objects.zero_height_m, recording, people, signals_end_s
    )  # fmt: skip
    contents: dict[str, FileContent] = {
        NETWORK_FILE: signals.network,
        STATICS_FILE: scenario_files.solids_geojson(objects.solids, objects.counts, scenario.attributions),
        SITES_FILE: scenario_files.sites_csv(poles, columns),
        **({ZONES_FILE: junction_zones.zones_geojson(scenario.zones)} if scenario.zones else {}),
        **meshes,
        **terrain_files,
        **({} if recording is None else recording.copies()),
        **({} if people is None else people.copies()),
        SCENARIO_FILE: document,
    }
    checked: list[NewScenario] = []

    def check(partial_folder: Path) -> None:
        loaded = load(partial_folder)
        world, _ = build_world(loaded)
        recorded = None if recording is None else recorded_traffic.read_for_summary(loaded)
        checked.append(replace(scenario, n_solids=len(world.solids), recorded=recorded))

    scenario_files.publish_folder(folder, contents.items(), check)
    return checked[0]


def download_map(
    folder: Path, at: tuple[float, float] | None, options: NewScenarioOptions, url: str | None = None
) -> DownloadedExtract:
    """Download the map of a new scenario after its folder and its options were checked.

    Parameters
    ----------
    folder
        Folder of the new scenario.
    at
        Latitude, longitude in degrees.
    options
        Options of :func:`create_scenario`.
    url
        Address of the Overpass server, see :func:`egvs.creation.openstreetmap.overpass.download_extract`.

    Raises
    ------
    InputError
        When ``at`` is None, the folder is not empty, an option is out of its limits, or there is no complete answer.
    """
    if at is None:
        raise InputError("--download", "needs a point", "Add --at LAT,LON, such as --at 50.8704,9.7080.")
    from egvs.creation.openstreetmap import overpass  # other maps need none of it

    options.check()
    scenario_files.check_new_folder(folder)
    return overpass.download_extract(at, options.surroundings_m, url)


def _with_signals(
    network: str, junction: StreetJunction, paths: Sequence[Path], streets: Streets,
    matched: Sequence[MatchedRecording], replay: Replay | None,
) -> RecordedSignalNetwork:  # fmt: skip
    """Return the network with recorded signals at the junction, and notes on them."""
    if junction.ring is not None:
        raise InputError("--signals", "the junction is a roundabout", "Choose another junction with --at LAT,LON.")
    signals = recorded_signals.read_signals(paths)
    where = ", ".join(map(str, paths))
    motion = RecordedMotion.joined([each.motion() for each in matched])
    return signal_programs.apply_signals(network, junction.id, signals, streets.frame, where, motion, replay)


class _PlannedTraffic(NamedTuple):
    """The assumed traffic, the demand like recorded tracks, or the counts; neither for recorded traffic. And notes."""

    notes: Sequence[str] = ()
    assumed: AssumedTraffic | None = None
    demand: TrackDemand | None = None
    counted: StreetCounts | None = None


def _plan_traffic(
    network: str, streets: Streets, junction: StreetJunction, options: NewScenarioOptions,
    example: MatchedRecording | None, path: Path,
) -> _PlannedTraffic:  # fmt: skip
    if example is not None:
        demand = demand_from_tracks.estimate_demand(example, streets, junction)
        return _PlannedTraffic(demand.notes, demand=demand)
    if options.counts is not None:
        counted = street_counts.read_junction_counts(options.counts, streets, junction)
        return _PlannedTraffic(counted.notes, counted=counted)
    if options.tracks:
        return _PlannedTraffic()
    try:
        assumed = assumed_traffic.assume_traffic(network, streets, junction, options.traffic)
    except SumoInputError as error:
        lines = " ".join(line.strip() for line in str(error).splitlines()).rstrip(":.")
        hint = "Check the map, e.g. its traffic lights and connections in netedit."
        raise InputError(path, f"SUMO cannot simulate the network ({lines})", hint) from None
    return _PlannedTraffic(assumed_traffic.traffic_notes(assumed), assumed)


def _check_zero_height(height_m: float | None, maps: MapFiles) -> None:
    if height_m is None or LOWEST_M <= height_m <= HIGHEST_M:
        return
    paths = dict.fromkeys(file.path for file in (maps.roads, *maps.terrain, *maps.solids))
    problem = f"expected heights of {LOWEST_M:,.0f} to {HIGHEST_M:,.0f} m, got {height_m:g} m at the junction"
    raise InputError(", ".join(str(path) for path in paths), problem, "Check the heights in these maps.")


def _surface_model(surface: Terrain | None, ground: Terrain | None) -> SurfaceModel | None:
    if surface is None:
        return None
    if ground is None:
        hint = "Add a terrain, or a point cloud, to --from."
        raise InputError("--surface", "heights of buildings need the ground too, but no map contains it", hint)
    return SurfaceModel(surface, ground)


def _no_pole_error(
    junction: StreetJunction, options: NewScenarioOptions, path: Path, covering: Sequence[str]
) -> InputError:
    """Return the error where no pole fits; ``covering`` are the maps whose objects cover the kerbs."""
    problem = f"there is no free location for a pole along the kerbs of the {junction.title}"
    hint = "Choose another junction with --at LAT,LON."
    if covering:
        problem += f": the objects of {', '.join(covering)} cover them"
        hint = "Check the position of these maps, or choose another junction with --at LAT,LON."
    elif options.pole_spacing_m is not None:
        hint = "Choose a smaller spacing with --poles, or another junction with --at LAT,LON."
    return InputError(path, problem, hint)


def _site_columns(
    poles: Sequence[KerbsidePole], ground_m: FloatArray | None, relief: Relief, maps: Sequence[ReadMap],
    roi: JunctionRegion, zero_height_m: float,
) -> dict[str, FloatArray]:  # fmt: skip
    """Return further columns of the sites: z of the ground where it is not flat, and what a point cloud did not see."""
    columns = {}
    sensors_m = np.array([(pole.x_m, pole.y_m, junctions.HEIGHTS_M[1] + zero_height_m) for pole in poles])
    if ground_m is not None:
        columns["ground_m"] = ground_m
        sensors_m[:, 2] += ground_m
    low_m, high_m = relief.z_range_m
    center_m = *roi.center_m, (low_m + high_m) / 2 + zero_height_m
    unseen = static_objects.unseen_shares(maps, sensors_m, Roi.around(center_m, (*roi.size_m, high_m - low_m)))
    if unseen is not None and not np.isnan(unseen).all():
        columns["unseen_share"] = np.round(unseen, 3)
    return columns


def _terrain_points(terrain: Terrain, window: BaseGeometry, zero_height_m: float) -> FloatArray:
    """Return points (n, 3) of the ground in a window, world frame."""
    points_m = ground_heights.ground_points(terrain, window, TERRAIN_STEP_M)
    points_m[:, 2] -= zero_height_m
    return points_m


def _read_roads(file: MapFile, options: RoadOptions) -> RoadSource:
    module = file.module
    if hasattr(module, "open_roads"):
        roads: RoadSource = module.open_roads(file.path, options)
        return roads
    return NetworkRoads.read(module.read_roads(file.path, options), file.path)


def _find_tracks(paths: Sequence[Path], options: NewScenarioOptions) -> TrackFiles | None:
    """Return recorded tracks, if there are any."""
    if not paths:
        return None
    columns = None
    if options.track_columns is not None:
        columns = recorded_traffic.read_track_columns(options.track_columns)
    return TrackFiles.find(paths, options.track_crs, columns)


def _choose_junction(
    streets: Streets, at: tuple[float, float] | None, recording: TrackFiles | None, path: Path
) -> StreetJunction:
    """Return the junction at the requested position, or else that of the recording, or else the largest one."""
    if at is None and recording is not None:
        return _junction_at(streets, recording.middle_m(streets), str(recording.source.paths[0]))
    if at is None:
        return _require_junction(junctions.largest_junction(streets), path)
    return _junction_at(streets, _to_world(streets, at), "--at")


def _to_world(streets: Streets, at: tuple[float, float]) -> XY:
    """Return world-frame x, y of a position of ``--at``."""
    if streets.frame is None:
        return at
    return streets.to_xy([at[1]], [at[0]])[0]


def _distance_m(streets: Streets, junction: StreetJunction, at: tuple[float, float] | None) -> float | None:
    return None if at is None else junction.distance_m(_to_world(streets, at))


def _find_again(streets: Streets, junction: StreetJunction, former: Streets, path: Path) -> StreetJunction:
    """Return the same junction in streets that were built anew, in another frame."""
    location = former.to_degrees([junction.at_m])[0]
    at_m = streets.to_xy(*zip(location, strict=True))[0]
    return _require_junction(junctions.find_again(streets, junction, at_m), path)


def _ring_notes(streets: Streets, junction: StreetJunction) -> list[str]:
    notes = []
    for ring in streets.large_rings:
        if junction.id in ring.nodes:
            notes.append(
                f"The junction is one entry of a roundabout {ring.side_m:.0f} m wide, which is larger than the largest"
                f" region of interest ({junctions.ROI_MAX_M:g} m): the rest of the ring is not part of the ranking."
            )
    return notes


def _attributions(roads: RoadSource, objects: StaticObjects) -> tuple[str, ...]:
    names = dict.fromkeys([roads.attribution, *objects.attributions])
    return tuple(name for name in names if name)


def _check_pole_spacing(spacing_m: float | None) -> None:
    low_m, high_m = junctions.MIN_SPACING_M, junctions.MAX_SPACING_M
    if spacing_m is not None and not low_m <= spacing_m <= high_m:
        problem = f"expected a spacing of {low_m:g} to {high_m:g} m, got {spacing_m:g} m"
        raise InputError("--poles", problem, "Use a spacing such as every 20m.")


def _junction_at(streets: Streets, at_m: XY, where: str) -> StreetJunction:
    """Return the junction at a position; raise an InputError that names the nearest ones if it is far from any."""
    nearby = junctions.nearest_junctions(streets, at_m)
    chosen = junctions.choose_nearby(nearby)
    if chosen is not None:
        return chosen.junction
    problem = f"no junction of {junctions.MIN_ARMS} or more roads is within {junctions.MAX_FROM_POINT_M:g} m"
    if not nearby:
        raise InputError(where, problem, "The map has no such junction; choose another one.")
    titles = []
    for near in nearby[:_MOST_NAMED]:
        position = streets.format_position(near.junction.at_m)
        titles.append(f"{near.junction.title} at {position} ({near.distance_m:,.0f} m away)")
    raise InputError(where, problem, f"The nearest are: {'; '.join(titles)}.")


def _require_junction(junction: StreetJunction | None, path: Path) -> StreetJunction:
    if junction is None:
        raise InputError(path, "the streets of the map have no junction", "Choose a map with a junction.")
    return junction


def _surface_notes(surface: Terrain | None, counts: ImportCounts) -> list[str]:
    if surface is None or counts.heights.get("building", Counter())[SURFACE_MODEL]:
        return []
    return ["The surface model is not used: it is at least 2 m above the ground at no building without height."]


def _level_notes(roads: RoadSource, counts: ImportCounts) -> list[str]:
    notes = list(roads.level_notes)
    heights = counts.heights.get("bridge", Counter())
    if heights["default"]:
        shares = f"{heights['default']} of {heights.total()}"
        notes.append(
            f"No height is given for {shares} {by_number(heights.total(), 'bridge deck', 'bridge decks')}:"
            f" {DECK_BASE_M:g} m assumed."
        )
    return notes


def _range_notes(counts: ImportCounts) -> list[str]:
    dropped = counts.dropped.get(OUT_OF_RANGE, Counter())
    left_out = dropped.total() - dropped["point"]  # a point cloud counts its own
    if not left_out:
        return []
    total = left_out + counts.objects.total() - counts.objects["tree_crown"]
    range_m = CATALOGUE[SENSOR].range_m
    reason = f"they are beyond the range of a {SENSOR} ({range_m:g} m) from the region of interest and change no score."
    return [
        f"{left_out:,} of {number_of(total, 'static object')} {by_number(left_out, 'is', 'are')} left out: {reason}"
    ]


def scenario_notes(junction_fits: bool, counts: ImportCounts) -> list[str]:
    """Return what to know before trusting a scenario.

    Parameters
    ----------
    junction_fits
        Whether the junction is inside its region of interest.
    counts
        What happened to the objects of the map.
    """
    notes = []
    if not junction_fits:
        notes.append(f"The junction is larger than the region of interest (at most {junctions.ROI_MAX_M:g} m).")
    heights = counts.heights.get("building", Counter())
    if heights["default"]:
        notes.append(
            f"{heights['default']} of {number_of(heights.total(), 'building')}"
            f" {by_number(heights['default'], 'has', 'have')} neither height nor levels:"
            f" {DEFAULT_BUILDING_M:g} m assumed."
        )
    if heights[NEIGHBOURS]:
        notes.append(
            f"{heights[NEIGHBOURS]} of {number_of(heights.total(), 'building')}"
            f" {by_number(heights[NEIGHBOURS], 'has', 'have')} neither height nor levels: the median height of"
            " the buildings near by assumed."
        )
    if heights[SURFACE_MODEL]:
        notes.append(
            f"{heights[SURFACE_MODEL]} of {number_of(heights.total(), 'building')}"
            f" {by_number(heights[SURFACE_MODEL], 'has', 'have')} neither height nor levels: their heights are"
            " those of the surface model above the terrain."
        )
    return notes


def _scenario_toml(
    name: str, scenario: NewScenario, relief: Relief, statics: TomlTable, zero_height_m: float | None,
    recording: TrackFiles | None, people: TrackFiles | None, signals_end_s: float | None,
) -> str:  # fmt: skip
    title = scenario.junction.title
    values: dict[str, Any] = {
        "description": title[0].upper() + title[1:],
        "assumed": _assumptions(scenario, is_recorded=recording is not None or bool(scenario.signal_notes)),
        "seed": 1,
    }
    if name:
        values = {"name": name} | values

    roi_comment, roi = scenario_files.roi_table(scenario.roi, relief.z_range_m)
    sites_comment, sites = scenario_files.sites_table()
    traffic = {
        "network": NETWORK_FILE,
        "frames": DEFAULT_FRAMES,
        "frame_period_s": TrafficConfig.model_fields["frame_period_s"].default,
        "warmup_s": DEFAULT_WARMUP_S,
        "junction_blocker_s": JUNCTION_BLOCKER_S,
        "teleport_s": TELEPORT_S,
    }
    if people is not None:
        traffic |= people.pedestrian_table(signals_end_s)
    if recording is not None:
        traffic = recording.traffic_table()
    tables = {
        "roi": (roi_comment, roi | scenario_files.voxel_keys()),
        "traffic": ("SUMO" if recording is None else "recorded; nothing is simulated", traffic),
        "statics": statics,
        "sites": (sites_comment, sites | scenario_files.mount_keys()),
        "score": scenario_files.score_table(ZONES_FILE if scenario.zones else None),
        "placement": scenario_files.placement_table(),
    }
    if zero_height_m:
        zero = {"zero_height_m": round(zero_height_m, 3)}
        tables["crs"] = ("height of z = 0 above sea level, for measured scans that state their reference system", zero)
    ground = "flat ground" if relief.is_flat else "zero height of the network"
    comments = [
        *_origin_comments(scenario.attributions),
        f"World frame: x east, y north in metres as in {NETWORK_FILE}, z up from the {ground}.",
    ]
    document = scenario_files.toml_document(comments, values, tables)
    for note in scenario.signal_notes:
        document["traffic"].add(tomlkit.comment(f"{NETWORK_FILE}: {note}"))
    flows = scenario.flows
    if scenario.counted is not None:
        flows = tuple(flow for hour in scenario.counted.hours for flow in hour.flows)
    names = MovementNames(scenario.streets.network, scenario.junction.at_m, flows)
    if scenario.demand is not None:
        _add_demand(document["traffic"], scenario.demand, names)
    if scenario.counted is not None:
        _add_counts(document["traffic"], scenario.counted, names)
    if scenario.traffic is not None:
        document["traffic"].update({"counts": scenario_files.counts_array(scenario.traffic.flows, names)})
        origin = f"assumed from the road classes ({scenario.traffic.assumed_per_h:,} vehicles an hour)"
        if scenario.traffic.level is None:
            origin = "divided among the movements by the road classes"
        comment = f"{origin}; the network {scenario.traffic.summary}. Replace them by real counts"
        document["traffic"]["counts"].comment(comment)
        for line in scenario_files.periods_template(scenario.traffic.flows[0]):
            document["traffic"].add(tomlkit.comment(line))
    return tomlkit.dumps(document)


def _add_counts(table: Any, counted: StreetCounts, names: MovementNames) -> None:
    """Add the user's counts to ``[traffic]``; several hours become periods."""
    origin = f"vehicles an hour, from {counted.path.name}"
    if len(counted.hours) == 1:
        table.update({"counts": scenario_files.counts_array(counted.hours[0].flows, names)})
        table["counts"].comment(origin)
        return
    table.add(tomlkit.comment(f"{origin}; one period for each hour"))
    periods = tomlkit.aot()
    for hour in counted.hours:
        period = tomlkit.table()
        period.update({"name": hour.name, "weight": 1, "counts": scenario_files.counts_array(hour.flows, names)})
        periods.append(period)
    table.add("periods", periods)


def _add_demand(table: Any, demand: TrackDemand, names: MovementNames) -> None:
    """Add the demand that was estimated from recorded tracks to ``[traffic]``."""
    kinds = [estimate.kind for estimate in demand.fleet]
    table.update({"kinds": scenario_files.kinds_array(kinds, [estimate.comments for estimate in demand.fleet])})
    table["kinds"].comment("estimated from the recorded vehicles")
    comments = [movement.comment for movement in demand.movements]
    table.update({"counts": scenario_files.counts_array(demand.flows, names, comments)})
    table["counts"].comment(f"vehicles an hour, from {demand.duration_s:,.0f} s of recorded tracks")
    table.add(tomlkit.comment("The profile of the day is not extrapolated from the recording; it is yours to enter."))
    for line in scenario_files.periods_template(max(demand.flows, key=lambda flow: flow.per_hour)):
        table.add(tomlkit.comment(line))


def _origin_comments(attributions: Sequence[str]) -> list[str]:
    """Return lines that name the maps, for the head of ``scenario.toml``."""
    if list(attributions) == [ATTRIBUTION]:
        return [f"A scenario made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."]
    if not attributions:
        return ["A scenario made from maps."]
    return [f"A scenario made from maps. Map data: {'; '.join(attributions)}."]


def _assumptions(scenario: NewScenario, *, is_recorded: bool) -> list[str]:
    """Return what the map does not tell, for the key ``assumed``."""
    assumed = []
    traffic = scenario.traffic
    if traffic is not None and traffic.level is None:
        assumed.append(f"shares of the movements (of {traffic.per_h:,} vehicles an hour)")
    elif traffic is not None:
        assumed.append(f"traffic ({traffic.per_h:,} vehicles an hour, from the road classes)")
    if scenario.demand is not None:
        assumed += scenario.demand.assumptions
    if scenario.counted is not None:
        assumed += scenario.counted.assumptions
    if scenario.junction.signalised and not is_recorded:
        assumed.append(ASSUMED_PLANS)
    if scenario.are_lights_guessed:
        assumed.append("which recorded light governs which road")
    return [*assumed, *assumed_sizes(scenario.statics), "positions of the poles"]


def _assumed_buildings(heights: Counter[str]) -> int:
    return heights[ASSUMED] + heights[NEIGHBOURS]


def assumed_sizes(counts: ImportCounts) -> list[str]:
    """Return which sizes of static objects are assumed, for the key ``assumed``; objects that can hide vehicles."""
    heights = {kind: counts.heights.get(kind, Counter()) for kind in ("building", "tree", "bridge")}
    texts = [
        (_assumed_buildings(heights["building"]), heights["building"].total(), "heights of {}", "building"),
        (heights["tree"]["default"], heights["tree"].total(), "heights of {}", "tree"),
        (counts.assumed_crowns, heights["tree"].total(), "crown widths of {}", "tree"),
        (heights["bridge"]["default"], heights["bridge"].total(), "heights of {}", "bridge deck"),
    ]
    return [text.format(f"{number} of {number_of(total, noun)}") for number, total, text, noun in texts if number]
