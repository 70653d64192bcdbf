"""Egvs city new.

Chooses the junctions of a city.

Either all with signals, or all, or those nearest to places of a table. A junction is where at least three streets meet,
so that the signals of a mere crossing for pedestrians are none. The largest come first: by incoming lanes, then by
area. World frame, metres; places of tables in degrees (WGS 84).

The texts that a new city is made of: ``city.toml``, its table, what junctions have in common, each one's scenario.

The traffic is drawn for the whole network, by the length of its lanes: flows that are assumed for each junction alone
would count whoever passes several of them more than once.

A city is made from OpenStreetMap: one network, and a scenario for each junction.

Steps of :func:`create_city`: read the extract, its streets cut to a circle if one is asked for; netconvert makes them
one SUMO
network; choose the junctions (:mod:`egvs.city.creation`); take buildings, trees, barriers, poles as solids, once;
for each junction lay the region of interest round it, find candidate sites along its kerbs, and keep the solids that a
sensor there can reach; write the folder (:mod:`egvs.city.model`, :mod:`egvs.city.creation`).

World frame: the network's x (east), y (north) in metres; the ground is z = 0. The same extract gives the same bytes.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely
import tomlkit
from pydantic import TypeAdapter, ValidationError
from shapely.geometry import MultiPoint, Point, box
from shapely.geometry.base import BaseGeometry

from egvs.city import model
from egvs.city.model import (
    CITY_FILE,
    COLUMNS,
    JUNCTIONS_FILE,
    JUNCTIONS_FOLDER,
    TRAFFIC_FOLDER,
    City,
    CityJunction,
    csv_rows,
    parse_number,
)
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.formats.osm import read_osm as read_extract
from egvs.importers import junctions, openstreetmap, osm_network, osm_solids
from egvs.importers.junctions import HEIGHTS_M, JunctionRegion, KerbsidePole, StreetJunction, Streets
from egvs.importers.openstreetmap import PITCHES_DEG, SENSOR, SITES_FILE, STATICS_FILE, TomlTable, check_inside_extract
from egvs.importers.osm_network import ATTRIBUTION, NETWORK_FILE, NetworkExcerpts
from egvs.importers.osm_solids import ImportCounts, MappedSolid
from egvs.scenario.fields import NAME_DESCRIPTION, Name
from egvs.scenario.loading import load
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.traffic_config import DEFAULT_FRAMES, DEFAULT_WARMUP_S, TrafficConfig
from egvs.sensors.sensor import CATALOGUE
from egvs.traffic import demand

SIGNALISED, ALL = "signalised", "all"
REQUIRED_COLUMNS = ("junction", "lat_deg", "lon_deg")
"""Columns of a table of junctions; those of a city's own table may be there too."""

MAX_DISTANCE_M = 50.0
"""A place of a table is so near to its junction."""

_MIN_ARMS = 3
NEAR_RIM, NO_SIGNALS, TOO_FEW_ARMS = "too near to the rim", "without signals", "fewer than three streets meet"


@dataclass(frozen=True)
class JunctionChoice:
    """The junctions that were chosen, by the names of their folders; and those that were not, by why."""

    junctions: dict[str, StreetJunction]
    left_out: dict[str, list[str]]


def choose_junctions(streets: Streets, which: str, within: BaseGeometry | None) -> JunctionChoice:
    """The junctions of a network: ``"signalised"``, ``"all"``, or those of a table, given its path.

    InputError where the table is wrong, or no junction is left. Those that ``within`` does not hold are left out.
    """
    if which not in (SIGNALISED, ALL):
        return JunctionChoice(dict(_junctions_from_table(streets, Path(which))), {})
    chosen: list[StreetJunction] = []
    left_out: dict[str, list[str]] = {}
    for junction in sorted(streets.junctions, key=lambda j: (-j.lanes_in, -j.area.area, j.id)):
        if which == SIGNALISED and not junction.signalised:
            why = NO_SIGNALS
        elif junction.arms < _MIN_ARMS:
            why = TOO_FEW_ARMS
        elif within is not None and not within.contains(Point(junction.at_m)):
            why = NEAR_RIM
        else:
            chosen.append(junction)
            continue
        left_out.setdefault(why, []).append(junction.id)
    width = max(2, len(str(len(chosen))))
    return JunctionChoice({f"j{number:0{width}d}": junction for number, junction in enumerate(chosen, 1)}, left_out)


def _junctions_from_table(streets: Streets, path: Path) -> Iterator[tuple[str, StreetJunction]]:
    seen: dict[str, str] = {}
    names = set[str]()
    for place, row in csv_rows(path, REQUIRED_COLUMNS, COLUMNS):
        name = row["junction"]
        try:
            TypeAdapter(Name).validate_python(name)
        except ValidationError:
            raise InputError(f"{place}: junction", repr(name)[:80], NAME_DESCRIPTION) from None
        if name.casefold() in names:
            raise InputError(place, "stands there twice", "a name of its own for each junction")
        names.add(name.casefold())
        lat_deg, lon_deg = (
            parse_number(f"{place}: {key}", row[key], most) for key, most in (("lat_deg", 90), ("lon_deg", 180))
        )
        junction = _nearest_junction(streets, Point(streets.to_xy([lon_deg], [lat_deg])[0]), place)
        if junction.id in seen:
            raise InputError(place, f"is the same junction as {seen[junction.id]}", "one row for each junction")
        seen[junction.id] = name
        yield name, junction
    if not names:
        raise InputError(path, "names no junction", "a row for each, or --junctions signalised or all")


def _nearest_junction(streets: Streets, at: Point, location: str) -> StreetJunction:
    met = [junction for junction in streets.junctions if junction.arms >= _MIN_ARMS]
    away = {junction.id: at.distance(junction.area) if math.isfinite(at.x + at.y) else math.inf for junction in met}
    nearest = min(met, key=lambda j: (away[j.id], j.id), default=None)
    if nearest is None or not away[nearest.id] <= MAX_DISTANCE_M:
        far = "there is none" if nearest is None else f"the nearest is {away[nearest.id]:,.0f} m away"
        raise InputError(
            location, f"no junction of three streets or more is there ({far})", f"one within {MAX_DISTANCE_M:g} m"
        )
    return nearest


_CROSSING_SPEED_M_S, _ROUND_TO_S = 8.0, 60.0
"""A network is full once one could have crossed it at this speed."""

_MIN_TRIP_S = 100.0
"""Trips last longer than this: so many a second keep the vehicles of a network."""

ROADS_FILE = "roads.net.xml"
"""Of a junction: the streets near it, for maps, lanes and checks."""

_SOURCE_COMMENT = f"Made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."
_FRAME_COMMENT = f"World frame: x east, y north in metres as in {NETWORK_FILE}, z up from the flat ground."


def traffic_amount(streets: Streets) -> dict[str, Any]:
    """How much is simulated, and for how long: what of ``[traffic]`` depends on the network's size."""
    vehicles = demand.target_vehicle_count(TrafficConfig(network=NETWORK_FILE), streets.network)
    fill_s = _ROUND_TO_S * math.ceil(streets.network.diagonal_m / _CROSSING_SPEED_M_S / _ROUND_TO_S)
    own = float(TrafficConfig.model_fields["trips_per_s"].default)
    return {
        "vehicles": vehicles,
        "warmup_s": max(DEFAULT_WARMUP_S, fill_s),
        "trips_per_s": max(own, vehicles / _MIN_TRIP_S),
    }


def city_toml(name: str, streets: Streets, count: int) -> str:
    """``city.toml``."""
    amount, fields = traffic_amount(streets), TrafficConfig.model_fields
    values = ({"name": name} if name else {}) | {
        "description": f"{count} junctions", "attribution": ATTRIBUTION, "seed": 1,
    }  # fmt: skip
    traffic = {
        "network": NETWORK_FILE, "vehicles_per_lane_km": fields["vehicles_per_lane_km"].default,
        "frames": DEFAULT_FRAMES,
        "frame_period_s": fields["frame_period_s"].default, "warmup_s": amount["warmup_s"],
        "trips_per_s": amount["trips_per_s"],
    }  # fmt: skip
    about = "one simulation for all junctions, trips drawn through the whole network; or your own sumocfg, counts, fcd"
    document = openstreetmap.toml_document(
        [f"A city. {_SOURCE_COMMENT}", _FRAME_COMMENT], values, {"traffic": (about, traffic)}
    )
    shown = f"{amount['vehicles']} vehicles in this network"
    document["traffic"]["vehicles_per_lane_km"].comment(shown)
    return tomlkit.dumps(document)


def common_toml() -> str:
    """``junctions/scenario.toml``: what every junction's scenario extends."""
    period_s = TrafficConfig.model_fields["frame_period_s"].default
    tables: dict[str, TomlTable] = {
        "roi": ("", openstreetmap.voxel_keys()),
        "traffic": (f"as in {model.CITY_FILE}, or a multiple of it", {"frame_period_s": period_s}),
        "sites": ("", openstreetmap.mount_keys()),
        "scan": ("sites are scanned as they are scored; true keeps their scans, 0.7 MB a site", {"keep": False}),
        "score": openstreetmap.score_table(),
    }
    about = "What the scenarios of all junctions have in common; each may say otherwise."
    return tomlkit.dumps(openstreetmap.toml_document([about], {"seed": 1}, tables))


def junction_toml(junction_id: str, title: str, roi: JunctionRegion) -> str:
    """A junction's ``scenario.toml``."""
    values = {"extends": "..", "description": title[0].upper() + title[1:]}
    tables = {
        "roi": openstreetmap.roi_table(roi),
        "traffic": (
            "the city's, cut to this junction: egvs city traffic makes it",
            {
                "fcd": f"../../{TRAFFIC_FOLDER}/{junction_id}.parquet",
                "roads": ROADS_FILE,
            },
        ),
        "statics": openstreetmap.statics_table(),
        "sites": openstreetmap.sites_table(),
    }
    return tomlkit.dumps(openstreetmap.toml_document([f"A junction of a city. {_SOURCE_COMMENT}"], values, tables))


def junctions_csv(rows: Iterable[CityJunction]) -> str:
    """``junctions.csv``."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(model.table_rows(tuple(rows)))
    return text.getvalue()


def import_counts(solids: Sequence[MappedSolid]) -> ImportCounts:
    """The objects of one junction, and where their heights are from."""
    counts = ImportCounts()
    for solid in solids:
        counts.keep(solid)
    return counts


def import_notes(larger: int, counts: ImportCounts) -> list[str]:
    """What to know before trusting a city of which so many junctions are larger than their regions."""
    found = openstreetmap.scenario_notes(True, counts)
    if larger:
        found.append(
            f"{larger} junctions are larger than their regions of interest ({junctions.ROI_MAX_M:g} m at most)"
        )
    return found


DEFAULT_RADIUS_M = 2000.0
"""Of the circle, where a place is named and no radius."""

RIM_WIDTH_M = 100.0
"""Junctions that are nearer to the circle are left out: their approaches are cut."""

PEDESTRIANS_NOTE = (
    f"people come with [effects.pedestrians_bicycles] pedestrians_per_h = 300 in {CITY_FILE} (and bicycles_per_h)"
)
NO_FREE_KERB = "no place for a pole is free along the kerbs"
IMPORT_FILE = "import.json"
"""What was made, assumed and left out, in the city's folder."""

_LOCAL_M, _ROADS_M = 60.0, 100.0
"""How far round a region kerbs look at what is there, and streets are drawn."""


@dataclass(frozen=True)
class NewJunction:
    """A junction with what its scenario is made of."""

    id: str
    junction: StreetJunction
    roi: JunctionRegion
    places: list[KerbsidePole]

    @property
    def sites(self) -> int:
        """Candidates: each pole with each height and each tilt."""
        return len(self.places) * len(HEIGHTS_M) * len(PITCHES_DEG)


@dataclass(frozen=True)
class NewCity:
    """What :func:`create_city` made; ``left_out`` are ids of the network's junctions, by why they have no scenario."""

    folder: Path
    junctions: tuple[NewJunction, ...]
    left_out: dict[str, list[str]]
    streets: Streets
    statics: ImportCounts
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """All of it as plain JSON, in the order of interest."""
        streets, its = self.streets, self.junctions
        return {
            "attribution": ATTRIBUTION,
            "junctions": {"made": len(its), "signalised": sum(j.junction.signalised for j in its)},
            "left_out": {why: len(ids) for why, ids in self.left_out.items()},
            "network": {
                "edges": len(streets.network.edges), "lane_length_m": round(streets.lane_length_m),
                "signalised_junctions": sum(j.signalised for j in streets.junctions),
            },
            "traffic": traffic_amount(streets),
            "poles": sum(len(j.places) for j in its),
            "sites": sum(j.sites for j in its),
            "statics": self.statics.to_json(),
            "notes": list(self.notes),
        }  # fmt: skip


def create_city(
    folder: Path, osm: Path, *, around: tuple[float, float] | None = None, radius_m: float | None = None,
    which: str = SIGNALISED, lefthand: bool = False, walk: bool = False, progress: ProgressCallback = no_progress,
) -> NewCity:  # fmt: skip
    """Make a city's folder from an OpenStreetMap extract.

    Parameters
    ----------
    folder
        Made by this function; may exist when it is empty.
    osm
        An OpenStreetMap file: XML (may be gzipped) or PBF.
    around, radius_m
        Streets within so many metres of a latitude, longitude; without a place, all of the extract.
    which
        ``"signalised"``, ``"all"``, or the path of a table of junctions, see
        :func:`egvs.city.creation.choose_junctions`.
    lefthand, walk
        As :func:`egvs.importers.openstreetmap.create_scenario`.

    Raises
    ------
    InputError
        When the folder is not empty, the file is no sound extract with drivable streets, ``around`` lies outside it, a
        table is wrong, or no junction is left. Nothing is written then.
    """
    name = openstreetmap.check_new_folder(folder)
    if radius_m is not None and around is None:
        raise InputError("--radius", f"{radius_m:g} m round no place", "--around LAT,LON as well")
    extract = read_extract(osm)
    check_inside_extract(extract, around, "--around")
    reach_m = radius_m or DEFAULT_RADIUS_M
    cut = extract if around is None else osm_network.cut_surroundings(extract, around, reach_m)
    network, streets = osm_network.build_network(
        cut, osm, osm_network.netconvert_flags(extract, lefthand=lefthand, walk=walk)
    )
    within = None if around is None else Point(streets.to_xy([around[1]], [around[0]])[0]).buffer(reach_m - RIM_WIDTH_M)
    choice = choose_junctions(streets, which, within)
    mapped, counts = osm_solids.map_solids(extract, streets)
    areas = shapely.STRtree([solid.area for solid in mapped])
    made, blocked = [], []
    for number, (its_id, junction) in enumerate(choice.junctions.items(), 1):
        its = _make_junction(its_id, junction, streets, areas)
        made += [its] if its.places else []
        blocked += [] if its.places else [junction.id]
        progress("junctions", number, len(choice.junctions))
    left_out = choice.left_out | ({NO_FREE_KERB: blocked} if blocked else {})
    if not made:
        right = "--junctions all" if which == SIGNALISED else "another extract, or a wider --radius"
        raise InputError(osm, f"no junction is left ({_format_left_out(left_out)})", right)
    larger = sum(not its.roi.area.covers(its.junction.area) for its in made)
    notes = (*import_notes(larger, counts), *([PEDESTRIANS_NOTE] if walk else []))
    city = NewCity(folder, tuple(made), left_out, streets, counts, notes)
    openstreetmap.publish_folder(folder, _city_files(city, name, network, mapped, areas), _check_city)
    return city


def _format_left_out(left_out: dict[str, list[str]]) -> str:
    return ", ".join(f"{len(ids)} {why}" for why, ids in left_out.items()) or "its streets meet nowhere"


def _make_junction(junction_id: str, junction: StreetJunction, streets: Streets, areas: shapely.STRtree) -> NewJunction:
    """The region round a junction, and places for poles; the solids are those of ``areas``."""
    roi = junctions.region_around(junction)
    local = _window(roi, _LOCAL_M)
    objects = list(areas.geometries[sorted(areas.query(local))])
    return NewJunction(
        junction_id, junction, roi, junctions.kerbside_poles(streets.near(local), junction, roi, objects)
    )


def _window(roi: JunctionRegion, margin_m: float) -> shapely.Geometry:
    return box(*roi.area.bounds).buffer(margin_m, join_style="mitre")


def _city_files(
    city: NewCity, name: str, network: str, mapped: list[MappedSolid], areas: shapely.STRtree
) -> Iterator[tuple[str, str]]:
    """Every file of the folder, one after another."""
    yield CITY_FILE, city_toml(name, city.streets, len(city.junctions))
    yield NETWORK_FILE, network
    yield JUNCTIONS_FILE, junctions_csv(_table_junctions(city))
    yield IMPORT_FILE, files.to_json_text(city.to_json() | {"left_out": city.left_out}, indent=1) + "\n"
    yield f"{JUNCTIONS_FOLDER}/{SCENARIO_FILE}", common_toml()
    pieces = NetworkExcerpts(network)
    for its in city.junctions:
        near = [mapped[i] for i in sorted(areas.query(_reachable_area(its), predicate="intersects"))]
        folder = f"{JUNCTIONS_FOLDER}/{its.id}"
        yield f"{folder}/{STATICS_FILE}", openstreetmap.solids_geojson(near, import_counts(near))
        yield f"{folder}/{SITES_FILE}", openstreetmap.sites_csv(its.places)
        yield f"{folder}/{ROADS_FILE}", pieces.near(city.streets.near(_window(its.roi, _ROADS_M)))
        yield f"{folder}/{SCENARIO_FILE}", junction_toml(its.id, its.junction.title, its.roi)


def _reachable_area(junction: NewJunction) -> shapely.Geometry:
    """Where the beams of any of its sites may end."""
    spots = MultiPoint([(place.x_m, place.y_m) for place in junction.places]).union(junction.roi.area)
    return box(*spots.bounds).buffer(CATALOGUE[SENSOR].range_m, join_style="mitre")


def _table_junctions(city: NewCity) -> Iterator[CityJunction]:
    places = city.streets.to_degrees([its.junction.at_m for its in city.junctions])
    for its, (lon_deg, lat_deg) in zip(city.junctions, places, strict=True):
        x_m, y_m = its.junction.at_m
        yield CityJunction(
            its.id, its.junction.title, x_m, y_m, round(lat_deg, 7), round(lon_deg, 7), its.junction.signalised
        )


def _check_city(folder: Path) -> City:
    city = model.load_city(folder)
    for junction in city.junctions:
        load(junction.scenario_folder(city))
    return city
