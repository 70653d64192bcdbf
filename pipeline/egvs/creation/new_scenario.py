"""Make a scenario from maps: roads, and what stands beside them.

Steps of :func:`create_scenario`: open the files (:mod:`egvs.creation.map_readers`); build the network; choose a
junction and put the region of interest around it; cut the network to its surroundings; collect buildings and other
static objects within sensor range (:mod:`egvs.creation.static_objects`); find candidate sites along the kerbs; assume
flows, and find how much of them the network carries; write

    network.net.xml    the streets                                       (traffic)
    statics.geojson    footprints with heights, and import counts        (statics)
    sites.csv          candidate sites                                   (scan, score)
    zones.geojson      crosswalks, stop lines, approaches                (score)
    counts.csv         movements with assumed numbers, to be overwritten (traffic)
    signals.csv        the assumed plan of the signal, to be overwritten (traffic)
    scenario.toml      the scenario that names them

and, where the maps have meshes, one PLY file for each kind of object.

World frame: the network's x (east), y (north) in metres. The ground is z = 0, or follows the network's lanes where they
have heights. The same maps give the same bytes: no dates, no paths, objects sorted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.core.grid import XY, FloatArray, Roi
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import by_number, number_of
from egvs.creation import (
    assumed_traffic,
    junction_zones,
    junctions,
    map_readers,
    new_traffic,
    scenario_files,
    static_objects,
)
from egvs.creation.alignment import PointPair, check_used, make_alignment
from egvs.creation.assumed_traffic import DEFAULT_TRAFFIC, JUNCTION_BLOCKER_S, TELEPORT_S, AssumedTraffic, NoTraffic
from egvs.creation.building_heights import ASSUMED, NEIGHBOURS, SURFACE_MODEL
from egvs.creation.driving_side import requested_left
from egvs.creation.junction_zones import Zone
from egvs.creation.junctions import JunctionRegion, KerbsidePole, StreetJunction, Streets
from egvs.creation.map_parts import (
    DECK_BASE_M,
    DEFAULT_BUILDING_M,
    OBJECT_KIND,
    OUT_OF_RANGE,
    ImportCounts,
    MapContext,
    RoadOptions,
    Terrain,
)
from egvs.creation.map_readers import MapFile, MapFiles
from egvs.creation.new_traffic import NewTraffic, RecordingOptions, RecordingPlan, ScenarioTraffic
from egvs.creation.openstreetmap import ATTRIBUTION
from egvs.creation.plain_network import NETWORK_FILE
from egvs.creation.road_source import NetworkRoads, RoadSource, network_file
from egvs.creation.scenario_files import (
    COUNTS_FILE,
    PITCHES_DEG,
    SENSOR,
    SIGNALS_FILE,
    SITES_FILE,
    STATICS_FILE,
    TERRAIN_FILE,
    ZONES_FILE,
    FileContent,
    TomlTable,
    reachable_area,
)
from egvs.creation.static_objects import MapSummary, ReadMap, StaticObjects, SurfaceModel
from egvs.creation.sumo_demand import SumoDemand, split_demand
from egvs.creation.terrain import ground_heights, ground_reference
from egvs.creation.terrain.ground_heights import HIGHEST_M, LOWEST_M
from egvs.creation.terrain.relief import Relief, ground_surface
from egvs.formats.archives import unpack_archives
from egvs.scenario.loading import load
from egvs.scenario.model import NO_SURROUNDINGS, POLE_POSITIONS, SCENARIO_FILE
from egvs.scenario.signal_config import ASSUMED_PLANS
from egvs.scenario.traffic_config import DEFAULT_FRAMES, DEFAULT_WARMUP_S, CountConfig, TrafficConfig
from egvs.sensors.sensor import CATALOGUE
from egvs.traffic.assumed_plans import assumed_plan, is_assumed
from egvs.traffic.movements import MovementNames
from egvs.traffic.signals import Signal, read_signals
from egvs.traffic.sumo import SumoInputError
from egvs.world.static_world import build_world
from egvs.world.terrain import TerrainSurface

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

_FEET_NOTE = (
    "The distance between the points of --align agrees in feet: point clouds, meshes and city models without a"
    " reference system are taken to be in feet, heights too."
)
_NO_SIGNALS_NOTE = (
    "No junction of three or more roads in the map has signals; the one with the most incoming lanes was chosen."
)


@dataclass(frozen=True)
class NewRegion:
    """The junction of a new scenario, and the region of interest around it.

    Attributes
    ----------
    junction, roi
        The junction, and the region around it.
    height_m
        Height of the region.
    zones
        Its zones, for which results are reported.
    from_at_m
        Distance of the junction from the requested position, 0 inside it; None without such a position.
    other_junctions
        The next junctions of the map by size, each with the option that chooses it; empty with such a position.
    """

    junction: StreetJunction
    roi: JunctionRegion
    height_m: float
    zones: tuple[Zone, ...]
    from_at_m: float | None
    other_junctions: tuple[str, ...] = ()

    @property
    def is_far_from_at(self) -> bool:
        """Whether the junction may be another one than the user meant."""
        return self.from_at_m is not None and self.from_at_m > FAR_FROM_AT_M


@dataclass(frozen=True)
class NewStatics:
    """The static objects of a new scenario.

    Attributes
    ----------
    counts
        What happened to the objects of the maps.
    maps
        What each map with static objects contributed.
    n_solids
        Number of solids of the static world, the ground included. A tree is two, an object that is cut may be several.
    """

    counts: ImportCounts
    maps: tuple[MapSummary, ...]
    n_solids: int

    @property
    def maps_have_notes(self) -> bool:
        """Whether there is something to know about single maps."""
        return any(summary.notes for summary in self.maps)


@dataclass(frozen=True, repr=False)
class NewScenario:
    """What :func:`create_scenario` made.

    Attributes
    ----------
    folder
        The scenario's folder.
    region
        The junction, and the region of interest around it.
    streets
        The simulated streets.
    statics
        The static objects.
    poles
        Number of locations for poles.
    traffic
        The vehicles: assumed, counted, or from recorded tracks.
    notes
        What to know before trusting the scenario.
    attributions
        Who made the maps.
    """

    folder: Path
    region: NewRegion
    streets: Streets
    statics: NewStatics
    poles: int
    traffic: ScenarioTraffic
    notes: tuple[str, ...]
    attributions: tuple[str, ...]

    def __repr__(self) -> str:
        vehicles_per_hour = sum(flow.per_hour for flow in self.flows)
        parts = (
            f"{self.junction.title}, {self.junction.arms} arms",
            f"{self.n_candidates} candidate sites on {self.poles} poles",
            f"{self.statics.n_solids} solids",
            f"{vehicles_per_hour:,.0f} vehicles an hour",
        )
        return f"NewScenario({self.folder.name}: {'; '.join(parts)})"

    @property
    def junction(self) -> StreetJunction:
        """The junction."""
        return self.region.junction

    @property
    def n_candidates(self) -> int:
        """Number of candidates: each pole with each height and each tilt."""
        return self.poles * len(junctions.HEIGHTS_M) * len(PITCHES_DEG)

    @property
    def flows(self) -> tuple[CountConfig, ...]:
        """The flows that are simulated."""
        return self.traffic.flows


@dataclass(frozen=True)
class NewScenarioOptions:
    """Options of :func:`create_scenario`.

    Attributes
    ----------
    lefthand, righthand
        Whether traffic drives on the left, or on the right; by default, the map and its position decide.
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
    existing_poles
        Whether the candidates are the lamps, signal masts and utility poles of the map instead.
    align
        Two points that place files without a reference system; empty if there are no such files.
    tracks
        Files of recorded tracks, or folders of them, which replace assumed traffic.
    like
        The same, but from which the demand of simulated traffic is estimated.
    pedestrian_tracks
        The same, of people on foot and on bicycles, who are put beside simulated vehicles.
    signals
        Files of recorded signals of the junction, and of what their groups govern.
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
    righthand: bool = False
    walk: bool = False
    surroundings_m: float | None = None
    traffic: str | int = DEFAULT_TRAFFIC
    pole_spacing_m: float | None = None
    existing_poles: bool = False
    align: tuple[PointPair, ...] = ()
    tracks: tuple[Path, ...] = ()
    like: tuple[Path, ...] = ()
    pedestrian_tracks: tuple[Path, ...] = ()
    signals: tuple[Path, ...] = ()
    track_crs: str | None = None
    track_columns: Path | None = None
    surface: tuple[Path, ...] = ()
    counts: Path | None = None

    @property
    def recordings(self) -> RecordingOptions:
        """The options that an extension reads."""
        return RecordingOptions(
            self.tracks, self.like, self.pedestrian_tracks, self.signals, self.track_crs, self.track_columns
        )

    def check(self) -> None:
        """Raise an InputError when a value is out of its limits, or no installed extension reads recordings."""
        assumed_traffic.check_traffic(self.traffic)
        requested_left(lefthand=self.lefthand, righthand=self.righthand)
        self.recordings.check()
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

    def check_without_demand(self) -> None:
        """Raise an InputError when an option contradicts the demand of SUMO files."""
        options = {
            "--counts": self.counts, "--tracks": self.tracks, "--like": self.like, "--surroundings": self.surroundings_m
        }  # fmt: skip
        for option, value in options.items():
            if value:
                raise InputError(
                    option, "cannot be combined with SUMO's demand, which is used as it is", "Leave it out."
                )


@dataclass
class _Draft:
    """A new scenario while the steps of :func:`create_scenario` complete it.

    Attributes
    ----------
    folder, name
        The scenario's folder, and its name.
    at, options
        As for :func:`create_scenario`.
    files, surface_files
        The opened maps, and rasters of the heights of roofs and trees.
    map_roads, recordings
        All roads of the map, and the recordings of its traffic.
    level, roads
        The roads on the level of the junction; those that the scenario keeps, on the ground.
    junction, other_junctions, window, context
        The junction, the next ones by size, the area within sensor range of its region, and how maps are read there.
    maps, surface
        The static objects of each map, and the heights of roofs and trees.
    terrain, terrain_m, zero, ground
        Heights of the ground: as read, as points (n, 3) in the world frame, the height of z = 0, and as a surface.
    objects
        The static objects.
    roi, relief, zones, poles
        The region of interest, its relief, its zones, and the locations for poles.
    plan, traffic, signal
        What the recordings give to the scenario, its vehicles, and the signal of the junction if its plan is assumed.
    demand
        The user's SUMO demand.
    notes
        What to know before trusting the scenario.
    """

    folder: Path
    name: str
    at: tuple[float, float] | None
    options: NewScenarioOptions
    files: MapFiles
    surface_files: tuple[MapFile, ...]
    map_roads: RoadSource = field(init=False)
    recordings: NewTraffic | None = field(init=False)
    level: RoadSource = field(init=False)
    roads: RoadSource = field(init=False)
    junction: StreetJunction = field(init=False)
    other_junctions: tuple[str, ...] = ()
    window: BaseGeometry = field(init=False)
    context: MapContext = field(init=False)
    maps: Sequence[ReadMap] = field(init=False)
    surface: Terrain | None = field(init=False)
    terrain: Terrain | None = field(init=False)
    terrain_m: FloatArray | None = field(init=False)
    zero: ground_reference.ZeroHeight = field(init=False)
    ground: TerrainSurface | None = field(init=False)
    objects: StaticObjects = field(init=False)
    roi: JunctionRegion = field(init=False)
    relief: Relief = field(init=False)
    zones: tuple[Zone, ...] = field(init=False)
    poles: Sequence[KerbsidePole] = field(init=False)
    known_poles: Sequence[str] | None = None
    plan: RecordingPlan = field(init=False)
    traffic: ScenarioTraffic = field(init=False)
    signal: Signal | None = None
    demand: SumoDemand | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def has_tracks(self) -> bool:
        """Whether recorded tracks show where the junction is."""
        return self.recordings is not None and self.recordings.path is not None

    @property
    def attributions(self) -> tuple[str, ...]:
        """Who made the maps."""
        return _attributions(self.roads, self.objects)


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
        Files, or folders and ZIP archives of files: one road map, and any number of maps of static objects. A SUMO
        configuration gives its network and its demand; route files give the demand for a SUMO network.
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
    given = [Path(path) for path in ([maps] if isinstance(maps, str | Path) else maps)]
    paths, demand = split_demand(Path(folder), given)
    if demand is not None:
        options.check_without_demand()
    with unpack_archives([*paths, *options.surface]) as unpacked:
        map_paths, surface = unpacked.paths[: len(paths)], unpacked.paths[len(paths) :]
        name = scenario_files.check_new_folder(Path(folder))
        files, surface_files = map_readers.open_maps(map_paths), map_readers.open_surface(surface)
        draft = _Draft(Path(folder), name, at, options, files, surface_files)
        draft.demand = demand
        _read_roads_and_recordings(draft)
        _choose_surroundings(draft)
        _read_maps(draft)
        _lay_on_ground(draft)
        _collect_objects(draft)
        _choose_region(draft)
        _choose_poles(draft)
        _add_notes(draft)
        _plan_traffic(draft)
        draft.notes = [unpacked.user_text(note) for note in draft.notes]
        return _write_scenario(draft)


@dataclass(frozen=True)
class ListedJunction:
    """A junction of a map: its description, arms and incoming lanes, signals, and the value of ``--at`` there.

    ``distance_m`` is from the position that was asked for; None without one.
    """

    title: str
    arms: int
    lanes_in: int
    signalised: bool
    at: str
    distance_m: float | None = None


MOST_LISTED_NEARBY = 20
"""Most junctions around a position that are listed."""

_LISTED_REACH_M = 2000.0
"""Of an OpenStreetMap extract, only streets up to this far from the position are read."""


def list_junctions(
    maps: Sequence[str | Path],
    options: NewScenarioOptions | None = None,
    progress: ProgressCallback = no_progress,
    at: tuple[float, float] | None = None,
) -> list[ListedJunction]:
    """Return the junctions of a road map of which a scenario can be made; nothing is written.

    The largest come first; with ``at``, the nearest, at most :data:`MOST_LISTED_NEARBY`. Parameters and errors are
    those of :func:`read_map_roads`.
    """
    streets = read_map_roads(maps, options, progress, at).streets
    progress("lists the junctions", 0, 0)
    listed = [
        ListedJunction(
            junction.title, junction.arms, junction.lanes_in, junction.signalised,
            _at_option(streets, junction.at_m), _distance_m(streets, junction, at),
        )
        for junction in junctions.distinct_crossings(streets)
    ]  # fmt: skip
    if at is None:
        return listed
    return sorted(listed, key=lambda junction: junction.distance_m or 0.0)[:MOST_LISTED_NEARBY]


def read_map_roads(
    maps: Sequence[str | Path],
    options: NewScenarioOptions | None = None,
    progress: ProgressCallback = no_progress,
    at: tuple[float, float] | None = None,
) -> RoadSource:
    """Return the roads of a map, and who made it; nothing is written.

    Parameters
    ----------
    maps
        As for :func:`create_scenario`.
    options
        ``lefthand``, ``righthand`` and ``walk`` are used.
    progress
        Called at the beginning of each step.
    at
        As for :func:`create_scenario`: of an OpenStreetMap extract, only streets near it are read.

    Raises
    ------
    InputError
        When a file is damaged or of an unknown format, the road map has no drivable streets, or ``at`` is outside.
    """
    options = options or NewScenarioOptions()
    with unpack_archives([Path(path) for path in maps]) as unpacked:
        progress("opens the maps", 0, 0)
        files = map_readers.open_maps(unpacked.paths)
        progress("reads the roads", 0, 0)
        road_options = RoadOptions(
            options.lefthand, options.walk, bool(files.terrain), at, options.righthand, _LISTED_REACH_M
        )  # fmt: skip
        return _read_roads(files.roads, road_options)


def _read_roads_and_recordings(draft: _Draft) -> None:
    """Read all roads of the map, and find the reader of each recording."""
    options, has_terrain = draft.options, bool(draft.files.terrain)
    road_options = RoadOptions(
        options.lefthand, options.walk, has_terrain, draft.at, options.righthand, options.surroundings_m
    )
    draft.map_roads = _read_roads(draft.files.roads, road_options)
    draft.recordings = new_traffic.find_recordings(draft.options.recordings)


def _choose_surroundings(draft: _Draft) -> None:
    """Choose the junction, the roads on its level, and the area within sensor range."""
    path = draft.files.roads.path
    junction = _choose_junction(draft.map_roads.streets, draft.at, draft.recordings, path)
    if draft.at is None and (draft.recordings is None or draft.recordings.path is None):
        draft.other_junctions = _describe_others(draft.map_roads.streets)
    level = draft.map_roads.on_level_of(junction)
    if level.streets is not draft.map_roads.streets:
        junction = _find_again(level.streets, junction, draft.map_roads.streets, path)

    frame = level.streets.frame
    alignment = make_alignment(draft.options.align, frame) if draft.options.align else None
    draft.junction, draft.level = junction, level
    draft.window = reachable_area(junctions.region_around(junction))
    draft.context = MapContext(frame, draft.window, alignment, level.streets)
    draft.roads = level.around(junction, draft.options.surroundings_m)


def _read_maps(draft: _Draft) -> None:
    """Read static objects, the ground, and the heights of roofs and trees within sensor range."""
    files, context = draft.files, draft.context
    draft.maps = static_objects.read_maps(files.solids, draft.level, files.roads, context)
    draft.terrain = ground_reference.read_terrain(
        files.terrain, ground_reference.with_roads(context, draft.roads.streets)
    )
    draft.surface = ground_reference.read_terrain(draft.surface_files, context)
    check_used(context)
    if context.alignment is not None and context.alignment.unit_m != 1.0:
        draft.notes.append(_FEET_NOTE)


def _lay_on_ground(draft: _Draft) -> None:
    """Find the ground and the height of z = 0, and lay the roads on the ground."""
    measured = static_objects.ground_mesh(draft.maps)
    ground_notes = []
    if draft.terrain is None and measured is not None:
        draft.terrain = ground_reference.measured_ground(measured)
    elif measured is not None:
        ground_notes.append("The ground of the point cloud is not used, since a terrain file is given.")
    terrain, files = draft.terrain, draft.files
    draft.zero = ground_reference.find_zero(draft.roads, files.roads, draft.junction, terrain, files.terrain)
    draft.roads = ground_reference.lay_on_ground(draft.roads, files.roads, draft.junction, terrain, files.terrain)
    draft.terrain_m = None
    if terrain is not None:
        points_m = ground_heights.ground_points(terrain, draft.window, TERRAIN_STEP_M)
        points_m[:, 2] -= draft.zero.height_m or 0.0
        draft.terrain_m = points_m
    draft.ground = ground_surface(draft.roads.streets, draft.terrain_m)
    draft.notes += [*draft.roads.notes, *draft.zero.notes, *(() if terrain is None else terrain.notes), *ground_notes]


def _collect_objects(draft: _Draft) -> None:
    """Collect the static objects of all maps, and the decks of bridges."""
    terrain, zero_height_m = draft.terrain, draft.zero.height_m
    draft.objects = static_objects.collect_objects(
        draft.maps, draft.level.streets, draft.junction.at_m, zero_height_m, draft.ground,
        _surface_model(draft.surface, terrain),
    )  # fmt: skip
    _check_zero_height(draft.objects.zero_height_m, draft.files)
    if draft.files.terrain and terrain is not None and zero_height_m is not None:
        from egvs.creation.terrain.bridge_decks import bridge_decks

        decks = bridge_decks(draft.roads.network, terrain, zero_height_m)
        draft.objects = replace(draft.objects, meshes=(*draft.objects.meshes, *decks))


def _choose_region(draft: _Draft) -> None:
    """Put the region of interest around the junction, in the streets that the scenario keeps."""
    streets = draft.roads.streets
    if streets is not draft.level.streets:
        found = junctions.find_again(streets, draft.junction, draft.junction.at_m)
        draft.junction = _require_junction(found, draft.files.roads.path)
    draft.roi = junctions.region_around(draft.junction)
    draft.relief = Relief.of_region(streets, draft.junction, draft.roi)
    draft.zones = junction_zones.junction_zones(streets, draft.junction, draft.roi)


def _choose_poles(draft: _Draft) -> None:
    """Choose poles of the map, or locations for poles along the kerbs; InputError if there are none."""
    streets, spacing_m = draft.roads.streets, draft.options.pole_spacing_m
    if draft.options.existing_poles:
        from egvs.creation import existing_poles

        mapped = [pole for read in draft.maps for pole in read.objects.poles]
        found = existing_poles.find_existing_poles(mapped, streets, draft.junction, draft.roi, draft.objects.solids)
        if not found.poles:
            problem = f"no map has a street lamp, signal mast or utility pole near the {draft.junction.title}"
            raise InputError("--poles existing", problem, "Leave it out for locations along the kerbs.")
        draft.poles, draft.known_poles = found.poles, found.as_mapped
        draft.notes += found.notes
        return
    draft.poles = junctions.kerbside_poles(streets, draft.junction, draft.roi, draft.objects.areas, spacing_m)
    if not draft.poles:
        has_free_poles = bool(junctions.kerbside_poles(streets, draft.junction, draft.roi, [], spacing_m))
        covering = draft.objects.file_names if has_free_poles else ()
        raise _no_pole_error(draft.junction, draft.options, draft.files.roads.path, covering)


def _add_notes(draft: _Draft) -> None:
    """Note what to know about the junction and its static objects before trusting the scenario."""
    counts, junction = draft.objects.counts, draft.junction
    draft.notes += _surface_notes(draft.surface, counts)
    if draft.at is None and not draft.has_tracks and not junction.signalised:
        draft.notes.append(_NO_SIGNALS_NOTE)
    draft.notes += _ring_notes(draft.roads.streets, junction)
    draft.notes += scenario_notes(draft.roi.area.covers(junction.area), counts)
    draft.notes += _level_notes(draft.level, counts) + _range_notes(counts)
    if draft.options.walk:
        draft.notes.append(PEOPLE_HINT)


def _plan_traffic(draft: _Draft) -> None:
    """Plan recorded signals and vehicles; where vehicles are not recorded, count or assume them."""
    streets = draft.roads.streets
    draft.plan = RecordingPlan(draft.roads.network)
    if draft.recordings is not None:
        draft.plan = draft.recordings.plan(draft.roads.network, streets, draft.junction)
    if draft.options.signals:
        draft.junction = replace(draft.junction, signalised=True)
    draft.traffic = _choose_vehicles(draft)
    draft.signal = _find_assumed_signal(draft)
    draft.notes += [*draft.plan.notes, *draft.traffic.notes]
    if draft.relief.other_levels:
        titles = ", ".join(draft.relief.other_levels)
        draft.notes.append(f"Lanes on another level cross the region of interest: {titles}.")


def _find_assumed_signal(draft: _Draft) -> Signal | None:
    """Return the signal of the junction if its plan is assumed, rather than recorded or a program of the user."""
    if not draft.junction.signalised or draft.plan.is_finished or draft.plan.signal_notes:
        return None
    with network_file(draft.plan.network, draft.roads.path) as network:
        signals = read_signals(network, draft.roads.streets.network)
    of_junction = [signal for signal in signals if not set(signal.nodes).isdisjoint(draft.junction.nodes)]
    return of_junction[0] if len(of_junction) == 1 and is_assumed(of_junction[0]) else None


def _choose_vehicles(draft: _Draft) -> ScenarioTraffic:
    """Return recorded vehicles, or else the user's counts, or else assumed ones."""
    options, streets = draft.options, draft.roads.streets
    if draft.demand is not None:
        return draft.demand
    if draft.plan.traffic is not None:
        return draft.plan.traffic
    if draft.plan.is_finished:
        return NoTraffic()  # none is simulated; the recorded ones are read back from the finished scenario
    if options.counts is not None:
        from egvs.creation import street_counts

        return street_counts.read_junction_counts(options.counts, streets, draft.junction)
    try:
        return assumed_traffic.assume_traffic(draft.plan.network, streets, draft.junction, options.traffic)
    except SumoInputError as error:
        hint = "Check the map, e.g. its traffic lights and connections in netedit."
        raise error.for_input(draft.files.roads.path, "SUMO cannot simulate the network", hint) from None


def _write_scenario(draft: _Draft) -> NewScenario:
    """Write all files, and check that the finished folder can be read."""
    zero_height_m = draft.zero.height_m or 0.0
    ground_m = draft.relief.ground_m(draft.ground, draft.poles)
    columns = _site_columns(draft.poles, ground_m, draft.relief, draft.maps, draft.roi, zero_height_m)
    solid_meshes = [mesh for mesh in draft.objects.meshes if mesh.kind != static_objects.GROUND]
    meshes = static_objects.mesh_files(solid_meshes)
    terrain_files = {}
    if draft.terrain_m is not None:
        from egvs.formats import ply

        terrain_files[TERRAIN_FILE] = partial(ply.write, points_m=draft.terrain_m)
    statics = scenario_files.statics_table(list(meshes), *terrain_files)
    contents: dict[str, FileContent] = {
        NETWORK_FILE: draft.plan.network,
        STATICS_FILE: scenario_files.solids_geojson(draft.objects.solids, draft.objects.counts, draft.attributions),
        SITES_FILE: scenario_files.sites_csv(draft.poles, columns),
        **({ZONES_FILE: junction_zones.zones_geojson(draft.zones)} if draft.zones else {}),
        **meshes,
        **terrain_files,
        **draft.plan.files,
        **_templates(draft),
        SCENARIO_FILE: _scenario_toml(draft, statics),
    }
    created: list[NewScenario] = []

    def check(partial_folder: Path) -> None:
        loaded = load(partial_folder)
        world, _ = build_world(loaded)
        traffic = draft.traffic if draft.plan.read_back is None else draft.plan.read_back(loaded)
        created.append(_summarise(draft, traffic, len(world.solids)))

    scenario_files.publish_folder(draft.folder, contents.items(), check)
    return created[0]


def _templates(draft: _Draft) -> dict[str, str]:
    """Return tables with the assumed numbers, which the user overwrites: counts, and the plan of the signal."""
    tables = {}
    if isinstance(draft.traffic, AssumedTraffic):
        names = MovementNames(draft.roads.streets.network, draft.junction.at_m, draft.traffic.flows)
        tables[COUNTS_FILE] = scenario_files.counts_csv(draft.traffic.flows, names)
    if draft.signal is not None:
        tables[SIGNALS_FILE] = scenario_files.signals_csv(assumed_plan(draft.signal))
    return tables


def _summarise(draft: _Draft, traffic: ScenarioTraffic, n_solids: int) -> NewScenario:
    """Return what was made."""
    low_m, high_m = draft.relief.z_range_m
    from_at_m = _distance_m(draft.roads.streets, draft.junction, draft.at)
    return NewScenario(
        draft.folder,
        NewRegion(draft.junction, draft.roi, high_m - low_m, draft.zones, from_at_m, draft.other_junctions),
        draft.roads.streets,
        NewStatics(draft.objects.counts, draft.objects.maps, n_solids),
        len(draft.poles),
        traffic,
        tuple(draft.notes),
        draft.attributions,
    )


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


def _read_roads(file: MapFile, options: RoadOptions) -> RoadSource:
    module = file.module
    with map_readers.reading([file]):
        if hasattr(module, "open_roads"):
            roads: RoadSource = module.open_roads(file.path, options)
            return roads
        road_map = module.read_roads(file.path, options)
    return NetworkRoads.read(road_map, file.path)


def _choose_junction(
    streets: Streets, at: tuple[float, float] | None, recordings: NewTraffic | None, path: Path
) -> StreetJunction:
    """Return the junction at the requested position, or else that of recorded tracks, or else the largest one."""
    if at is None and recordings is not None and recordings.path is not None:
        return _junction_at(streets, recordings.middle_m(streets), str(recordings.path))
    if at is None:
        return _require_junction(next(iter(junctions.largest_junctions(streets)), None), path)
    return _junction_at(streets, _to_world(streets, at), "--at")


def _describe_others(streets: Streets) -> tuple[str, ...]:
    """Return the junctions that follow the largest one, each with the option that chooses it."""
    largest = junctions.distinct_crossings(streets)
    return tuple(f"{junction.title} (--at {_at_option(streets, junction.at_m)})" for junction in largest[1:])


def _at_option(streets: Streets, at_m: XY) -> str:
    return streets.format_position(at_m) if streets.frame is not None else "{:.1f},{:.1f}".format(*at_m)


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
    reason = f"more than {range_m:g} m (the range of a {SENSOR}) from the region of interest."
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
    origins = {
        "default": f"{DEFAULT_BUILDING_M:g} m assumed",
        NEIGHBOURS: "the median height of the buildings near by assumed",
        SURFACE_MODEL: "the surface model above the terrain used",
    }
    used = {origin: heights[key] for key, origin in origins.items() if heights[key]}
    if used:
        number, total = sum(used.values()), number_of(heights.total(), "building")
        sources = [f"{origin} for {count}" if len(used) > 1 else origin for origin, count in used.items()]
        have = by_number(number, "has", "have")
        notes.append(f"{number} of {total} {have} neither height nor levels: {', '.join(sources)}.")
    return notes


def _scenario_toml(draft: _Draft, statics: TomlTable) -> str:
    """Return the text of ``scenario.toml``."""
    title = draft.junction.title
    values: dict[str, Any] = {
        "description": title[0].upper() + title[1:],
        "assumed": _assumptions(draft),
        "seed": 1,
    }
    if draft.name:
        values = {"name": draft.name} | values

    roi_comment, roi = scenario_files.roi_table(draft.roi, draft.relief.z_range_m)
    sites_comment, sites = scenario_files.sites_table(draft.known_poles)
    traffic = {
        "network": NETWORK_FILE,
        "frames": DEFAULT_FRAMES,
        "frame_period_s": TrafficConfig.model_fields["frame_period_s"].default,
        "warmup_s": DEFAULT_WARMUP_S,
        "junction_blocker_s": JUNCTION_BLOCKER_S,
        "teleport_s": TELEPORT_S,
    }
    if draft.demand is not None:
        traffic = {key: value for key, value in traffic.items() if key not in ("junction_blocker_s", "teleport_s")}
    traffic = ({} if draft.plan.is_finished else traffic) | dict(draft.plan.keys)
    tables = {
        "roi": (roi_comment, roi | scenario_files.voxel_keys()),
        "traffic": ("recorded; nothing is simulated" if draft.plan.is_finished else "SUMO", traffic),
        "statics": statics,
        "sites": (sites_comment, sites | scenario_files.mount_keys()),
        "score": scenario_files.score_table(ZONES_FILE if draft.zones else None),
        "placement": scenario_files.placement_table(),
    }
    if draft.objects.zero_height_m:
        zero = {"zero_height_m": round(draft.objects.zero_height_m, 3)}
        tables["crs"] = ("height of z = 0 above sea level, for measured scans that state their reference system", zero)
    ground = "flat ground" if draft.relief.is_flat else "zero height of the network"
    comments = [
        *_origin_comments(draft.attributions),
        f"World frame: x east, y north in metres as in {NETWORK_FILE}, z up from the {ground}.",
    ]
    document = scenario_files.toml_document(comments, values, tables)
    for note in draft.plan.signal_notes:
        document["traffic"].add(tomlkit.comment(f"{NETWORK_FILE}: {note}"))
    draft.traffic.add_keys(document["traffic"], draft.roads.streets, draft.junction)
    if draft.signal is not None:
        keys = {"file": SIGNALS_FILE, "type": "actuated"}
        document["traffic"]["signals"] = {draft.signal.id: keys}
        document["traffic"]["signals"][draft.signal.id]["file"].comment("assumed. Replace it by the real plan")
    return tomlkit.dumps(document)


def _origin_comments(attributions: Sequence[str]) -> list[str]:
    """Return lines that name the maps, for the head of ``scenario.toml``."""
    if list(attributions) == [ATTRIBUTION]:
        return [f"A scenario made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."]
    if not attributions:
        return ["A scenario made from maps."]
    return [f"A scenario made from maps. Map data: {'; '.join(attributions)}."]


def _assumptions(draft: _Draft) -> list[str]:
    """Return what the map does not tell, for the key ``assumed``."""
    assumed = list(draft.traffic.assumptions)
    is_given = draft.demand is not None or draft.plan.is_finished or bool(draft.plan.signal_notes)
    if draft.junction.signalised and not is_given:
        assumed.append(ASSUMED_PLANS)
    assumed += [*draft.plan.assumptions, *assumed_sizes(draft.objects.counts)]
    kinds = {solid.kind for solid in draft.objects.solids} | {mesh.kind for mesh in draft.objects.meshes}
    if not any(kind.startswith(_SURROUNDINGS) for kind in kinds):
        assumed.append(NO_SURROUNDINGS)
    return [*assumed, POLE_POSITIONS]


_SURROUNDINGS = ("building", "roof", "tree", "vegetation", "mesh", OBJECT_KIND)
"""Kinds of solids, or their beginnings, that can hide vehicles; a map without any probably has roads only."""


def assumed_sizes(counts: ImportCounts) -> list[str]:
    """Return which sizes of static objects are assumed, for the key ``assumed``; objects that can hide vehicles."""
    heights = {kind: counts.heights.get(kind, Counter()) for kind in ("building", "tree", "bridge")}
    building_heights = heights["building"]
    assumed_buildings = building_heights[ASSUMED] + building_heights[NEIGHBOURS]
    texts = [
        (assumed_buildings, heights["building"].total(), "heights of {}", "building"),
        (heights["tree"]["default"], heights["tree"].total(), "heights of {}", "tree"),
        (counts.assumed_crowns, heights["tree"].total(), "crown widths of {}", "tree"),
        (heights["bridge"]["default"], heights["bridge"].total(), "heights of {}", "bridge deck"),
    ]
    return [text.format(f"{number} of {number_of(total, noun)}") for number, total, text, noun in texts if number]
