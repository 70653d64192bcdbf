"""Create a city from an OpenStreetMap extract: one network, and a scenario for each junction.

Steps of :func:`create_city`: read the extract, with its streets cut to a circle on request; run netconvert on the
streets; choose junctions (:func:`choose_junctions`); map buildings, trees, barriers and poles to solids; for each
junction set the region of interest, find pole locations along its kerbs, and select the solids that a sensor there can
reach; write the folder that :mod:`egvs.extensions.city.model` describes.

Traffic is drawn for the complete network, as much as a trial shows that it carries (:func:`find_flow` of
:mod:`egvs.extensions.city.town_flow`): flows assumed for each junction alone would count a vehicle several times that
passes several junctions. It is simulated in steps of 0.5 s and without sublanes; with them, vehicles of a whole town
lock.

World frame: x (east), y (north) of the network in metres; the ground is z = 0. Tables have degrees (WGS 84). The same
extract gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import shapely
import tomlkit
from shapely.geometry import Point, box
from shapely.geometry.base import BaseGeometry

from egvs.core import files
from egvs.core.errors import InputError, parse_each
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import format_percent
from egvs.creation import assumed_traffic, junctions, new_scenario, scenario_files
from egvs.creation.assumed_traffic import DEFAULT_TRAFFIC, JUNCTION_BLOCKER_S, TELEPORT_S, TRAFFIC_LEVELS
from egvs.creation.driving_side import requested_left
from egvs.creation.junctions import HEIGHTS_M, JunctionRegion, KerbsidePole, NearbyJunction, StreetJunction, Streets
from egvs.creation.map_parts import ImportCounts, MappedSolid
from egvs.creation.map_readers import open_maps
from egvs.creation.openstreetmap import ATTRIBUTION
from egvs.creation.openstreetmap import solids as osm_solids
from egvs.creation.openstreetmap import street_network as osm_network
from egvs.creation.openstreetmap.reader import check_inside_extract
from egvs.creation.openstreetmap.side_evidence import choose_map_side, exceptions_note
from egvs.creation.plain_network import NETWORK_FILE
from egvs.creation.scenario_files import PITCHES_DEG, SITES_FILE, STATICS_FILE, TomlTable, reachable_area
from egvs.extensions.city import model
from egvs.extensions.city.model import CITY_FILE, JUNCTIONS_FILE, JUNCTIONS_FOLDER, TRAFFIC_FOLDER, CityJunction
from egvs.extensions.city.network_excerpts import NetworkExcerpts
from egvs.extensions.city.town_flow import FlowCapacity, find_flow
from egvs.formats.archives import unpack_archives
from egvs.formats.osm import read_osm as read_extract
from egvs.scenario.loading import load
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.traffic_config import DEFAULT_FRAMES, DEFAULT_WARMUP_S, TrafficConfig

SIGNALISED, ALL = "signalised", "all"
REQUIRED_COLUMNS = ("junction", "lat_deg", "lon_deg")
"""Columns that a table of junctions must have; it may have the other columns of ``junctions.csv`` as well."""

MAX_DISTANCE_M = 50.0
"""Maximum distance from the coordinates in a table to the junction that they select."""

DEFAULT_RADIUS_M = 2000.0
RIM_WIDTH_M = 100.0
"""Junctions nearer to the rim of the circle are left out, because their approaches are cut."""

NEAR_RIM, NO_SIGNALS, TOO_FEW_ARMS = "too near to the rim", "without signals", "fewer than three streets meet"
NO_FREE_KERB = "no place for a pole is free along the kerbs"
OVERLAPPING_REGION = "too near to a larger junction"
"""Reasons to leave a junction out."""

PEDESTRIANS_NOTE = (
    f"For pedestrians, add [effects.pedestrians_bicycles] pedestrians_per_h = 300 to {CITY_FILE} (and bicycles_per_h)."
)
ROADS_FILE = "roads.net.xml"
"""The streets near a junction, for its maps, lanes and checks."""

IMPORT_FILE = "import.json"
"""What was created, assumed and left out."""

_CROSSING_SPEED_M_S, _WARMUP_STEP_S = 8.0, 60.0
"""The warm-up lasts until a vehicle could have crossed the network at this speed, in whole steps."""

CITY_STEP_S, CITY_LATERAL_RESOLUTION_M = 0.5, 0.0

_KERB_MARGIN_M, _ROADS_MARGIN_M = 60.0, 100.0
"""Distances from the region of interest within which solids can block kerbs, and streets are written."""

_OVERLAP_TOLERANCE_M2 = 1e-6
"""Regions that share no more than this only touch."""

_SIDE_TOLERANCE_M = 1e-6
"""A junction may extend beyond its side of a line by this."""

_MIN_REGION_SIDE_M = 20.0
"""A region of interest is not cut to less."""

_SOURCE_COMMENT = f"Made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."
_FRAME_COMMENT = f"World frame: x east, y north in metres as in {NETWORK_FILE}, z up from the flat ground."


@dataclass(frozen=True)
class JunctionChoice:
    """The chosen junctions by the names of their folders, and the ids of the others by reason."""

    junctions: dict[str, StreetJunction]
    left_out: dict[str, list[str]]


@dataclass(frozen=True)
class NewJunction:
    """A junction and the parts of its scenario; ``id`` is the name of its folder."""

    id: str
    junction: StreetJunction
    roi: JunctionRegion
    poles: list[KerbsidePole]

    @property
    def n_candidates(self) -> int:
        """Number of candidates: each pole with each height and each tilt."""
        return len(self.poles) * len(HEIGHTS_M) * len(PITCHES_DEG)


@dataclass(frozen=True)
class CityFlow:
    """The traffic of a new city: what the network carries, and a key of :data:`TRAFFIC_LEVELS`."""

    capacity: FlowCapacity
    level: str

    @property
    def vehicles_per_h(self) -> int:
        """Vehicles that start per hour, in steps of 10."""
        return max(10, 10 * round(self.capacity.vehicles_per_h * TRAFFIC_LEVELS[self.level] / 10))

    @property
    def summary(self) -> str:
        """What is carried and used, as a sentence."""
        share = format_percent(TRAFFIC_LEVELS[self.level], 0)
        return f"carries {self.capacity.vehicles_per_h:,} vehicles an hour; {self.level} {share} is used"

    def to_json(self) -> dict[str, Any]:
        """Return a summary as plain JSON."""
        return {
            "vehicles_per_hour": self.vehicles_per_h, "level": self.level,
            "carried_per_hour": self.capacity.vehicles_per_h, "trial_runs": len(self.capacity.runs),
        }  # fmt: skip


@dataclass(frozen=True)
class NewCity:
    """What :func:`create_city` made; ``left_out`` are ids of junctions without scenario, by reason."""

    folder: Path
    junctions: tuple[NewJunction, ...]
    left_out: dict[str, list[str]]
    streets: Streets
    statics: ImportCounts
    traffic: CityFlow
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return a summary as plain JSON, the most interesting keys first."""
        streets, made = self.streets, self.junctions
        return {
            "attribution": ATTRIBUTION,
            "junctions": {"made": len(made), "signalised": sum(j.junction.signalised for j in made)},
            "left_out": {reason: len(ids) for reason, ids in self.left_out.items()},
            "network": {
                "edges": len(streets.network.edges), "lane_length_m": round(streets.lane_length_m),
                "signalised_junctions": sum(j.signalised for j in streets.junctions),
            },
            "traffic": self.traffic.to_json() | {"warmup_s": warmup_s(streets)},
            "poles": sum(len(j.poles) for j in made),
            "sites": sum(j.n_candidates for j in made),
            "statics": self.statics.to_json(),
            "notes": list(self.notes),
        }  # fmt: skip


@dataclass(frozen=True)
class NewCityOptions:
    """Options of :func:`create_city`.

    Attributes
    ----------
    around, radius_m
        Latitude, longitude in degrees, and the distance within which streets are used; the complete extract if
        ``around`` is None.
    which
        ``"signalised"``, ``"all"``, or the path of a table, see :func:`choose_junctions`.
    lefthand, righthand, walk
        As in :func:`egvs.creation.new_scenario.NewScenarioOptions`.
    traffic
        A key of :data:`egvs.creation.assumed_traffic.TRAFFIC_LEVELS`: the share of the flow that the network carries.
    progress
        Called at the beginning of each step, and with the number of finished junctions.
    """

    around: tuple[float, float] | None = None
    radius_m: float | None = None
    which: str = SIGNALISED
    lefthand: bool = False
    walk: bool = False
    traffic: str = DEFAULT_TRAFFIC
    progress: ProgressCallback = no_progress
    righthand: bool = False


def create_city(folder: Path, osm: Path, options: NewCityOptions | None = None) -> NewCity:
    """Make the folder of a city from an OpenStreetMap extract.

    Parameters
    ----------
    folder
        Created by this function; may exist if it is empty.
    osm
        An OpenStreetMap file: XML (plain or gzipped) or PBF; or a folder or ZIP archive with one.
    options
        Options; the defaults when None.

    Raises
    ------
    InputError
        When the folder is not empty, the file is damaged or has no drivable streets, ``around`` is outside the extract,
        the side of traffic is unclear, a table is wrong or selects junctions with overlapping regions, or no junction
        is left. Nothing is written then.
    """
    with unpack_archives([osm]) as unpacked:
        (path,) = unpacked.paths
        return _create_city(
            folder, open_maps([path]).roads.path if path.is_dir() else path, options or NewCityOptions()
        )


def _create_city(folder: Path, osm: Path, options: NewCityOptions) -> NewCity:
    around, radius_m, which = options.around, options.radius_m, options.which
    assumed_traffic.check_traffic_level(options.traffic)
    side_option = requested_left(lefthand=options.lefthand, righthand=options.righthand)
    name = scenario_files.check_new_folder(folder)
    if radius_m is not None and around is None:
        raise InputError("--radius", "given without --around", "Add --around LAT,LON.")
    progress = options.progress
    progress("reads the map", 0, 0)
    extract = read_extract(osm)
    check_inside_extract(extract, around, "--around")

    street_extract, rim_m = extract, radius_m or DEFAULT_RADIUS_M
    if around is not None:
        street_extract = osm_network.cut_surroundings(extract, around, rim_m)
    side = choose_map_side(extract, side_option, around, str(osm))
    flags = osm_network.netconvert_flags(extract, lefthand=side.lefthand, walk=options.walk)
    progress("makes the network", 0, 0)
    network, streets, turn_notes = osm_network.build_network(street_extract, osm, flags)
    within = None
    if around is not None:
        within = Point(streets.to_xy([around[1]], [around[0]])[0]).buffer(rim_m - RIM_WIDTH_M)
    choice = choose_junctions(streets, which, within)

    progress("maps buildings and trees", 0, 0)
    solids, counts = osm_solids.map_solids(extract, streets)
    areas = shapely.STRtree([solid.area for solid in solids])
    made: list[NewJunction] = []
    left_out = dict(choice.left_out)
    divided = divided_regions(choice.junctions)
    for number, (junction_id, street_junction) in enumerate(choice.junctions.items(), 1):
        if junction_id in divided.regions:
            junction = _make_junction(junction_id, street_junction, divided.regions[junction_id], streets, areas)
            if junction.poles:
                made.append(junction)
            else:
                left_out.setdefault(NO_FREE_KERB, []).append(street_junction.id)
        elif which in (SIGNALISED, ALL):
            left_out.setdefault(OVERLAPPING_REGION, []).append(street_junction.id)
        else:
            raise _overlap_error(which, divided.too_near[junction_id], junction_id)
        progress("finds poles: junction", number, len(choice.junctions))
    if not made:
        reasons = ", ".join(f"{len(ids)} {reason}" for reason, ids in left_out.items()) or "no streets meet"
        hint = "Choose another extract, or a larger --radius."
        if which == SIGNALISED:
            hint = "Try --junctions all."
        raise InputError(osm, f"no junction is left ({reasons})", hint)

    flow = CityFlow(find_flow(network, JUNCTION_BLOCKER_S, progress), options.traffic)
    side_notes = side.note, *exceptions_note(extract, lefthand=side.lefthand)
    notes = (*side_notes, *turn_notes, *_import_notes(made, counts, flow, options.walk))
    city = NewCity(folder, tuple(made), left_out, streets, counts, flow, notes)
    progress("writes the scenarios", 0, 0)
    scenario_files.publish_folder(folder, _city_files(city, name, network, solids, areas), _check_city)
    return city


def _import_notes(made: Sequence[NewJunction], counts: ImportCounts, flow: CityFlow, walk: bool) -> tuple[str, ...]:
    """Return what to know before trusting the city."""
    notes = new_scenario.scenario_notes(True, counts)
    if not flow.capacity.is_confirmed:
        runs = len(flow.capacity.runs)
        notes.append(f"Traffic jams occur in all {runs} trials; check the signals and connections of the network.")
    n_larger = sum(not junction.roi.area.covers(junction.junction.area) for junction in made)
    if n_larger:
        limit = f"at most {junctions.ROI_MAX_M:g} m"
        notes.append(f"{n_larger} junctions are larger than their regions of interest ({limit}).")
    if walk:
        notes.append(PEDESTRIANS_NOTE)
    return tuple(notes)


def choose_junctions(streets: Streets, which: str, within: BaseGeometry | None) -> JunctionChoice:
    """Choose the junctions of a city.

    A junction connects at least three streets, so pedestrian-only signals are ignored. The largest come first: by
    incoming lanes, then by area.

    Parameters
    ----------
    streets
        The network.
    which
        ``"signalised"``, ``"all"``, or the path of a table, each row of which selects the nearest junction.
    within
        Junctions outside this area are left out; None for no limit. It does not apply to a table.

    Raises
    ------
    InputError
        When the table is wrong.
    """
    if which not in (SIGNALISED, ALL):
        return JunctionChoice(dict(_junctions_from_table(streets, Path(which))), {})
    chosen: list[StreetJunction] = []
    left_out: dict[str, list[str]] = {}
    for junction in sorted(streets.junctions, key=lambda j: (-j.lanes_in, -j.area.area, j.id)):
        if which == SIGNALISED and not junction.signalised:
            left_out.setdefault(NO_SIGNALS, []).append(junction.id)
        elif not junction.is_crossing:
            left_out.setdefault(TOO_FEW_ARMS, []).append(junction.id)
        elif within is not None and not within.contains(Point(junction.at_m)):
            left_out.setdefault(NEAR_RIM, []).append(junction.id)
        else:
            chosen.append(junction)
    width = max(2, len(str(len(chosen))))
    return JunctionChoice({f"j{number:0{width}d}": junction for number, junction in enumerate(chosen, 1)}, left_out)


def _junctions_from_table(streets: Streets, path: Path) -> list[tuple[str, StreetJunction]]:
    names_by_id: dict[str, str] = {}

    def find(located: tuple[str, dict[str, str]]) -> tuple[str, StreetJunction]:
        where, row = located
        lat_deg, lon_deg = model.parse_number(where, row, "lat_deg"), model.parse_number(where, row, "lon_deg")
        junction = _junction_at(streets, lat_deg, lon_deg, where)
        if junction.id in names_by_id:
            problem = f"these coordinates select the same junction as {names_by_id[junction.id]}"
            raise InputError(where, problem, "Use one row per junction.")
        names_by_id[junction.id] = row["junction"]
        return row["junction"], junction

    return parse_each(model.read_junction_rows(path, REQUIRED_COLUMNS), find, "junctions")


def _junction_at(streets: Streets, lat_deg: float, lon_deg: float, where: str) -> StreetJunction:
    """Return the junction nearest to a position; raise an InputError if it is too far away."""
    nearest = _nearest_junction(streets, lat_deg, lon_deg)
    if nearest is not None and nearest.distance_m <= MAX_DISTANCE_M:
        return nearest.junction
    problem = "the streets have no junction of three or more streets"
    if nearest is not None:
        problem = f"the nearest junction of three or more streets is {nearest.distance_m:,.0f} m away"
    hint = f"Use coordinates within {MAX_DISTANCE_M:g} m of a junction."
    swapped = _nearest_junction(streets, lon_deg, lat_deg)
    if swapped is not None and swapped.distance_m <= MAX_DISTANCE_M:
        hint = f"Latitude and longitude are swapped: did you mean lat_deg {lon_deg!r}, lon_deg {lat_deg!r}?"
    raise InputError(where, problem, hint)


def _nearest_junction(streets: Streets, lat_deg: float, lon_deg: float) -> NearbyJunction | None:
    """Return the nearest junction of three or more streets; None without one, or for an impossible position."""
    x_m, y_m = streets.to_xy([lon_deg], [lat_deg])[0]
    if not math.isfinite(x_m + y_m):
        return None
    nearby = junctions.nearest_junctions(streets, (x_m, y_m))
    return nearby[0] if nearby else None


class DividedRegions(NamedTuple):
    """Regions of interest that do not overlap.

    Attributes
    ----------
    regions
        Region of each junction that has one, by name.
    too_near
        The others by name: the junction from which no line divides them.
    """

    regions: dict[str, JunctionRegion]
    too_near: dict[str, str]


def divided_regions(chosen: Mapping[str, StreetJunction]) -> DividedRegions:
    """Return regions of interest of junctions that do not overlap.

    In a city, vehicles in two regions would count twice. Two regions that overlap are therefore cut along a line
    between them, in whole metres, so that each junction keeps its side.

    Parameters
    ----------
    chosen
        The junctions by name, the most important first.
    """
    regions: dict[str, JunctionRegion] = {}
    too_near: dict[str, str] = {}
    for name, junction in chosen.items():
        region = junctions.region_around(junction)
        changed: dict[str, JunctionRegion] = {}
        for other_name, other in regions.items():
            if not _overlap(region, other):
                continue
            halves = _divide(region, other, junction, chosen[other_name])
            if halves is None:
                too_near[name] = other_name
                break
            region = halves[0]
            changed[other_name] = halves[1]
        if name not in too_near:
            regions |= changed
            regions[name] = region
    return DividedRegions(regions, too_near)


def _overlap(region: JunctionRegion, other: JunctionRegion) -> bool:
    return bool(region.area.intersection(other.area).area > _OVERLAP_TOLERANCE_M2)


def _divide(
    region: JunctionRegion, other: JunctionRegion, junction: StreetJunction, other_junction: StreetJunction
) -> tuple[JunctionRegion, JunctionRegion] | None:
    """Cut two overlapping regions along a line; None if every line would cut a junction, or leave too little."""
    overlap_m = region.area.intersection(other.area).bounds
    axes = sorted((0, 1), key=lambda axis: overlap_m[axis + 2] - overlap_m[axis])  # the thinner overlap first
    for axis in axes:
        line_m = round((overlap_m[axis] + overlap_m[axis + 2]) / 2)
        halves = _side_of(region, junction, axis, line_m), _side_of(other, other_junction, axis, line_m)
        if halves[0] is None or halves[1] is None or _overlap(halves[0], halves[1]):
            continue
        return halves[0], halves[1]
    return None


def _side_of(region: JunctionRegion, junction: StreetJunction, axis: int, line_m: float) -> JunctionRegion | None:
    """Return the part of a region on the junction's side of a line; None if it does not contain the junction."""
    bounds = list(region.area.bounds)
    bounds[axis if junction.at_m[axis] > line_m else axis + 2] = line_m
    part = box(*bounds)
    sides_m = bounds[2] - bounds[0], bounds[3] - bounds[1]
    fits = region.area.intersection(junction.area).within(part.buffer(_SIDE_TOLERANCE_M))
    if not fits or min(sides_m) < _MIN_REGION_SIDE_M:
        return None
    return JunctionRegion(((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2), sides_m)


def _make_junction(
    junction_id: str, junction: StreetJunction, roi: JunctionRegion, streets: Streets, areas: shapely.STRtree
) -> NewJunction:
    """Find pole locations of a junction that are free of solids (``areas``)."""
    surroundings = _surroundings(roi, _KERB_MARGIN_M)
    obstacles = list(areas.geometries[sorted(areas.query(surroundings))])
    poles = junctions.kerbside_poles(streets.near(surroundings), junction, roi, obstacles)
    return NewJunction(junction_id, junction, roi, poles)


def _overlap_error(table: str, first: str, second: str) -> InputError:
    """Return the error for two rows of a table."""
    problem = "no line divides their regions of interest, so vehicles in both would count twice"
    hint = "Remove one of the two rows. egvs new makes a scenario of a single junction."
    return InputError(f"{table}: junctions {first} and {second}", problem, hint)


def _surroundings(roi: JunctionRegion, margin_m: float) -> shapely.Geometry:
    return box(*roi.area.bounds).buffer(margin_m, join_style="mitre")


def _city_files(
    city: NewCity, name: str, network: str, solids: list[MappedSolid], areas: shapely.STRtree
) -> Iterator[tuple[str, str]]:
    """Yield path and text of every file of the folder."""
    yield CITY_FILE, city_toml(name, city.streets, city.traffic, len(city.junctions))
    yield NETWORK_FILE, network
    yield JUNCTIONS_FILE, model.junctions_csv(_table_junctions(city))
    yield IMPORT_FILE, files.to_json_text(city.to_json() | {"left_out": city.left_out}, indent=1) + "\n"
    yield f"{JUNCTIONS_FOLDER}/{SCENARIO_FILE}", common_toml()
    excerpts = NetworkExcerpts(network)
    for junction in city.junctions:
        reachable = reachable_area(junction.roi)
        near = [solids[i] for i in sorted(areas.query(reachable, predicate="intersects"))]
        roads = excerpts.near(city.streets.near(_surroundings(junction.roi, _ROADS_MARGIN_M)))
        folder = f"{JUNCTIONS_FOLDER}/{junction.id}"
        yield f"{folder}/{STATICS_FILE}", scenario_files.solids_geojson(near, _count_solids(near), (ATTRIBUTION,))
        yield f"{folder}/{SITES_FILE}", scenario_files.sites_csv(junction.poles)
        yield f"{folder}/{ROADS_FILE}", roads
        yield f"{folder}/{SCENARIO_FILE}", junction_toml(junction.id, junction.junction.title, junction.roi)


def _table_junctions(city: NewCity) -> Iterator[CityJunction]:
    degrees = city.streets.to_degrees([new.junction.at_m for new in city.junctions])
    for new, (lon_deg, lat_deg) in zip(city.junctions, degrees, strict=True):
        junction = new.junction
        lat_deg, lon_deg = round(lat_deg, 7), round(lon_deg, 7)
        yield CityJunction(new.id, junction.title, *junction.at_m, lat_deg, lon_deg, junction.signalised)


def _check_city(folder: Path) -> None:
    city = model.load_city(folder)
    for junction in city.junctions:
        load(junction.scenario_folder(city))


def _count_solids(solids: Sequence[MappedSolid]) -> ImportCounts:
    counts = ImportCounts()
    for solid in solids:
        counts.keep(solid)
    return counts


def warmup_s(streets: Streets) -> float:
    """Return a warm-up in which a vehicle can cross the network, in seconds."""
    crossing_steps = math.ceil(streets.network.diagonal_m / _CROSSING_SPEED_M_S / _WARMUP_STEP_S)
    return max(DEFAULT_WARMUP_S, _WARMUP_STEP_S * crossing_steps)


def city_toml(name: str, streets: Streets, flow: CityFlow, n_junctions: int) -> str:
    """Return the text of ``city.toml``.

    Parameters
    ----------
    name
        The name of the city; "" if it is that of the folder.
    streets
        The network.
    flow
        The traffic.
    n_junctions
        Number of junctions.
    """
    values: dict[str, Any] = {"description": f"{n_junctions} junctions", "attribution": ATTRIBUTION, "seed": 1}
    if name:
        values = {"name": name, **values}
    traffic: dict[str, Any] = {"network": NETWORK_FILE, "vehicles_per_h": flow.vehicles_per_h}
    if flow.capacity.reroute:
        traffic["reroute_at_departure"] = True
    traffic |= {
        "frames": DEFAULT_FRAMES,
        "frame_period_s": TrafficConfig.model_fields["frame_period_s"].default, "warmup_s": warmup_s(streets),
        "step_s": CITY_STEP_S, "lateral_resolution_m": CITY_LATERAL_RESOLUTION_M,
        "junction_blocker_s": JUNCTION_BLOCKER_S, "teleport_s": TELEPORT_S,
    }  # fmt: skip
    comment = "one simulation for all junctions, trips drawn in the whole network; or your own sumocfg, counts, fcd"
    comments = [f"A city. {_SOURCE_COMMENT}", _FRAME_COMMENT]
    document = scenario_files.toml_document(comments, values, {"traffic": (comment, traffic)})
    document["traffic"]["vehicles_per_h"].comment(f"the network {flow.summary}")
    return tomlkit.dumps(document)


def common_toml() -> str:
    """Return the text of ``junctions/scenario.toml``, which the scenarios of all junctions extend."""
    period_s = TrafficConfig.model_fields["frame_period_s"].default
    tables: dict[str, TomlTable] = {
        "roi": ("", scenario_files.voxel_keys()),
        "traffic": (f"as in {CITY_FILE}, or a multiple of it", {"frame_period_s": period_s}),
        "sites": ("", scenario_files.mount_keys()),
        "scan": ("sites are scanned while they are scored; true keeps the scans, 0.7 MB per site", {"keep": False}),
        "score": scenario_files.score_table(),
        "placement": scenario_files.placement_table(),
    }
    comment = "Common settings of all junctions; the scenario of a junction may override them."
    return tomlkit.dumps(scenario_files.toml_document([comment], {"seed": 1}, tables))


def junction_toml(junction_id: str, title: str, roi: JunctionRegion) -> str:
    """Return the text of a junction's ``scenario.toml``."""
    traffic = {"fcd": f"../../{TRAFFIC_FOLDER}/{junction_id}.parquet", "roads": ROADS_FILE}
    tables = {
        "roi": scenario_files.roi_table(roi),
        "traffic": ("the city's traffic near this junction, written by egvs city traffic", traffic),
        "statics": scenario_files.statics_table(),
        "sites": scenario_files.sites_table(),
    }
    values = {"extends": "..", "description": title[0].upper() + title[1:]}
    return tomlkit.dumps(scenario_files.toml_document([f"A junction of a city. {_SOURCE_COMMENT}"], values, tables))
