"""Make a scenario from a town on OpenStreetMap.

Steps of :func:`create_scenario`: read the extract; run netconvert on its streets; choose a junction and put the region
of interest around it; leave out the roads that cross the region on another level; take buildings, trees, barriers,
bridge decks and poles within sensor range as solids; find candidate sites along the kerbs; assume flows, and find how
much of them the network carries; write

    network.net.xml    the streets                                       (traffic)
    statics.geojson    footprints with heights, and import counts        (statics)
    sites.csv          candidate sites                                   (scan, score)
    scenario.toml      the scenario that names them

World frame: the network's x (east), y (north) in metres; the ground is z = 0 (hills are flat, and so are bridges and
tunnels of the junction's own streets).
The same extract gives the same bytes: no dates, no paths, objects sorted.

The functions that make the parts of a scenario file are also used for the junctions of a city.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import TypeAdapter, ValidationError
from shapely.geometry.base import BaseGeometry

from egvs.core import files
from egvs.core.errors import InputError
from egvs.formats import osm as osm_files
from egvs.formats.osm import OsmExtract
from egvs.importers import junctions, osm_network, osm_solids, road_levels
from egvs.importers.junctions import JunctionRegion, KerbsidePole, StreetJunction, Streets
from egvs.importers.osm_network import ATTRIBUTION, NETWORK_FILE
from egvs.importers.osm_solids import ImportCounts, MappedSolid
from egvs.importers.road_levels import OtherLevels
from egvs.scenario.fields import Name
from egvs.scenario.loading import load
from egvs.scenario.model import SCENARIO_FILE, RoiConfig
from egvs.scenario.score_config import DEFAULT_SCORE, ScoreConfig
from egvs.scenario.traffic_config import DEFAULT_FRAMES, DEFAULT_WARMUP_S, CountConfig, TrafficConfig
from egvs.sensors.sensor import CATALOGUE
from egvs.traffic.capacity import Capacity, distribute_total, find_capacity, scale_flows
from egvs.traffic.movements import MovementNames

STATICS_FILE, SITES_FILE = "statics.geojson", "sites.csv"
SENSOR = "VLP-32C"

PITCHES_DEG: tuple[float | str, ...] = (0.0, -10.0, "aim")
"""Tilts to try at each height; the best one depends on sensor, height and junction."""

SURROUNDINGS_MIN_M = 100.0
SURROUNDINGS_M = 300.0
"""How far from the junction streets are simulated: enough for the queues and platoons that reach it."""

JUNCTION_BLOCKER_S, TELEPORT_S = 10.0, 120.0
"""What ends locks in new scenarios; the second is longer than any red phase and most waits to give way."""

TRAFFIC_LEVELS = {"light": 0.4, "medium": 0.75, "heavy": 1.0}
"""Shares of the carried flow. The queues of a junction get long, and rare locks possible, near its capacity."""

DEFAULT_TRAFFIC = "medium"

MAX_VEHICLES_PER_H = 100_000
"""More do not pass any junction."""

FAR_FROM_AT_M = 50.0
"""A junction farther than this from the requested position may be the wrong one."""

_MOST_NAMED = 3
"""Number of junctions that the message about a position without a junction names."""

PEOPLE_HINT = (
    "pedestrians are added with --set effects.pedestrians_bicycles.pedestrians_per_h=300 (bicycles: bicycles_per_h)."
)

_NO_SIGNALS_NOTE = "no junction in the extract has signals; the one with the most incoming lanes was chosen"

TomlTable = tuple[str, dict[str, Any]]
"""A comment, and the keys of a table."""

_KEY_COMMENTS = {  # of tables and keys; the table of a key above all tables is ""
    ("", "assumed"): "shown with the ranking; remove what you replace by measurements",
    (
        "traffic",
        "junction_blocker_s",
    ): "vehicles drive through one that blocks them on a junction; overlaps are counted",
    ("traffic", "teleport_s"): "the last resort against locks; vehicles that are moved on are counted",
    ("score", "rank_by"): "the expected share of vehicles that detectors find; docs/validity.md",
    ("sites", "aim"): "sensors face the centre of the region",
    ("sites", "pitch_deg"): "each height with each tilt is a candidate; 'aim': the central ray points at the centre",
}


@dataclass(frozen=True)
class AssumedTraffic:
    """The traffic of a new scenario.

    Attributes
    ----------
    assumed
        Flows from the classes of the streets, or in their proportions if their sum is given.
    capacity
        What the network carries of them.
    level
        A key of :data:`TRAFFIC_LEVELS`; None if the sum of the flows is given, and they are used in full.
    """

    assumed: tuple[CountConfig, ...]
    capacity: Capacity
    level: str | None

    @cached_property
    def flows(self) -> tuple[CountConfig, ...]:
        """The flows of the scenario."""
        if self.level is None:
            return self.assumed
        return tuple(scale_flows(self.assumed, self.capacity.share * TRAFFIC_LEVELS[self.level]))

    @property
    def assumed_per_h(self) -> int:
        """Sum of the assumed flows."""
        return round(math.fsum(flow.per_hour for flow in self.assumed))

    @property
    def carried_per_h(self) -> int:
        """Sum of the flows that the network carries, in steps of 10."""
        if self.capacity.is_everything:
            return self.assumed_per_h
        return round(self.capacity.share * self.assumed_per_h / 10) * 10

    @property
    def per_h(self) -> int:
        """Sum of the flows of the scenario."""
        return round(math.fsum(flow.per_hour for flow in self.flows))

    @property
    def summary(self) -> str:
        """What is carried and used, as a sentence."""
        if self.level is None:
            carried = "all" if self.capacity.is_everything else f"{self.carried_per_h:,}"
            return f"carries {carried} of the {self.assumed_per_h:,} requested vehicles an hour"
        at_least = "at least " if self.capacity.is_everything else ""
        share = f"{TRAFFIC_LEVELS[self.level]:.0%}".replace("%", " %")
        return f"carries {at_least}{self.carried_per_h:,} vehicles an hour; {self.level} {share} is used"


@dataclass(frozen=True)
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
    from_at_m
        Distance of the junction from the requested position, 0 inside it; None without such a position.
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
    from_at_m: float | None = None

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
        return () if self.traffic is None else self.traffic.flows


def create_scenario(
    folder: Path, osm: Path, at: tuple[float, float] | None = None, lefthand: bool = False, walk: bool = False,
    surroundings_m: float | None = SURROUNDINGS_M, traffic: str | int = DEFAULT_TRAFFIC,
    pole_spacing_m: float | None = None,
) -> NewScenario:  # fmt: skip
    """Make a scenario folder from an OpenStreetMap extract.

    Parameters
    ----------
    folder
        Created by this function; may exist if it is empty.
    osm
        An OpenStreetMap file: XML (plain or gzipped) or PBF.
    at
        Latitude, longitude in degrees: choose the junction there, see :func:`junctions.choose_nearby`; without it, the
        largest one with signals.
    lefthand
        Whether traffic drives on the left.
    walk
        Whether the network gets sidewalks and crossings, which pedestrians need.
    surroundings_m
        Distance from the junction at which streets end; None for the complete extract.
    traffic
        A key of :data:`TRAFFIC_LEVELS`: the share of the flow that the junction carries. Or vehicles per hour.
    pole_spacing_m
        Distance between candidate poles along the kerbs; None for a few poles near the junction.

    Returns
    -------
    NewScenario
        A summary of the new scenario.

    Raises
    ------
    InputError
        When the folder is not empty, the file is damaged or has no drivable streets, ``at`` is outside the extract or
        far from any junction, or no site is possible. Nothing is written then.
    """
    _check_traffic(traffic)
    _check_pole_spacing(pole_spacing_m)
    name = check_new_folder(folder)
    if surroundings_m is not None and surroundings_m < SURROUNDINGS_MIN_M:
        raise InputError(
            "--surroundings",
            f"expected at least {SURROUNDINGS_MIN_M:g} m, got {surroundings_m:g} m",
            "Choose a distance that includes the junction and its approaches.",
        )
    extract = osm_files.read_osm(osm)
    check_inside_extract(extract, at)

    flags = osm_network.netconvert_flags(extract, lefthand=lefthand, walk=walk)
    network, streets = osm_network.build_network(extract, osm, flags)
    junction = _junction_at(streets, at) if at else _require_junction(junctions.largest_junction(streets), osm)
    others = _other_levels(extract, streets, junction)
    if others.roads:
        location = streets.to_degrees([junction.at_m])[0]
        extract = osm_network.cut_out_roads(extract, streets, others.roads, _level_window(junction))
        network, streets = osm_network.build_network(extract, osm, flags)
        at_m = streets.to_xy(*zip(location, strict=True))[0]
        junction = _require_junction(junctions.find_again(streets, junction, at_m), osm)
    window = reachable_area(junctions.region_around(junction))
    solids, counts = osm_solids.map_solids(extract, streets, others.decks, window)

    if surroundings_m is not None:
        network, streets = osm_network.crop_network(extract, osm, flags, streets, junction, surroundings_m)
        junction = _require_junction(junctions.find_again(streets, junction, junction.at_m), osm)
    roi = junctions.region_around(junction)
    poles = junctions.kerbside_poles(streets, junction, roi, [solid.area for solid in solids], pole_spacing_m)
    if not poles:
        problem = f"there is no free location for a pole along the kerbs of the {junction.title}"
        hint = "Choose another junction with --at LAT,LON."
        if pole_spacing_m is not None:
            hint = "Choose a smaller spacing with --poles, or another junction with --at LAT,LON."
        raise InputError(osm, problem, hint)

    notes = []
    if at is None and not junction.signalised:
        notes.append(_NO_SIGNALS_NOTE)
    for ring in streets.large_rings:
        if junction.id in ring.nodes:
            notes.append(
                f"the junction is one entry of a roundabout {ring.side_m:.0f} m wide, which is larger than the largest"
                f" region of interest ({junctions.ROI_MAX_M:g} m): the rest of the ring is not part of the ranking"
            )
    notes += scenario_notes(roi.area.covers(junction.area), counts) + _level_notes(others, counts)
    notes += _range_notes(counts)
    if walk:
        notes.append(PEOPLE_HINT)
    assumed = _assumed_traffic(network, streets, junction, traffic)
    if assumed is not None:
        notes += _traffic_notes(assumed)
    from_at_m = None
    if at is not None:
        from_at_m = junction.distance_m(streets.to_xy([at[1]], [at[0]])[0])
    n_solids = len(solids) + 1
    scenario = NewScenario(
        folder, junction, roi, streets, len(poles), counts, n_solids, assumed, tuple(notes), from_at_m
    )  # fmt: skip
    texts = {
        NETWORK_FILE: network,
        STATICS_FILE: solids_geojson(solids, counts),
        SITES_FILE: sites_csv(poles),
        SCENARIO_FILE: _scenario_toml(name, scenario),
    }
    publish_folder(folder, texts.items(), load)
    return scenario


def check_traffic_level(level: str) -> None:
    """Raise an InputError unless a text is a key of :data:`TRAFFIC_LEVELS`."""
    if level not in TRAFFIC_LEVELS:
        raise InputError("--traffic", f"expected light, medium or heavy, got {level!r}", "Use --traffic medium.")


def _check_traffic(traffic: str | int) -> None:
    if isinstance(traffic, str):
        check_traffic_level(traffic)
    elif not 1 <= traffic <= MAX_VEHICLES_PER_H:
        problem = f"expected 1 to {MAX_VEHICLES_PER_H:,} vehicles an hour, got {traffic:,}"
        raise InputError("--vehicles-per-hour", problem, "Give the vehicles that pass the junction from all sides.")


def _check_pole_spacing(spacing_m: float | None) -> None:
    low_m, high_m = junctions.MIN_SPACING_M, junctions.MAX_SPACING_M
    if spacing_m is not None and not low_m <= spacing_m <= high_m:
        problem = f"expected a spacing of {low_m:g} to {high_m:g} m, got {spacing_m:g} m"
        raise InputError("--poles", problem, "Use a spacing such as every 20m.")


def reachable_area(roi: JunctionRegion) -> BaseGeometry:
    """Return where beams end that start at a candidate pole, or that reach the region of interest from anywhere."""
    margin_m = junctions.BEYOND_ROI_M + CATALOGUE[SENSOR].range_m
    return roi.area.buffer(margin_m, join_style="mitre")


def check_new_folder(folder: Path) -> str:
    """Check that a new folder can be made.

    Parameters
    ----------
    folder
        Where the scenario or city will be.

    Returns
    -------
    str
        A name for the scenario if the folder's own name is not a valid one, otherwise an empty string.

    Raises
    ------
    InputError
        When there is a file or a folder with content.
    """
    hint = "Choose a folder that does not exist yet; no file is ever overwritten."
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "expected a new folder, got an existing file", hint)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(folder, "expected a new folder, got one that is not empty", hint)
    name = folder.resolve().name
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        return re.sub(r"[\s/\\:*?\"<>|]+", "-", name).strip("-") or "junction"
    return ""


def check_inside_extract(extract: OsmExtract, at: tuple[float, float] | None, option: str = "--at") -> None:
    """Raise an InputError if a position (latitude, longitude in degrees) of an option is outside the extract."""
    if at is None or extract.bounds.contains(*at):
        return
    b = extract.bounds
    bounds = f"latitude {b.south_deg:g} to {b.north_deg:g}, longitude {b.west_deg:g} to {b.east_deg:g}"
    hint = f"Choose a position inside the extract: {bounds}."
    if extract.bounds.contains(at[1], at[0]):
        hint = f"Latitude comes first: did you mean {option} {at[1]!r},{at[0]!r}?"
    raise InputError(option, f"{at[0]:g},{at[1]:g} is outside the extract", hint)


def _junction_at(streets: Streets, at: tuple[float, float]) -> StreetJunction:
    """Return the junction at a position; raise an InputError that names the nearest ones if it is far from any."""
    nearby = junctions.nearest_junctions(streets, streets.to_xy([at[1]], [at[0]])[0])
    chosen = junctions.choose_nearby(nearby)
    if chosen is not None:
        return chosen.junction
    problem = f"no junction of {junctions.MIN_ARMS} or more roads is within {junctions.MAX_FROM_POINT_M:g} m"
    if not nearby:
        raise InputError("--at", problem, "The extract has no such junction; choose another one.")
    titles = []
    for near in nearby[:_MOST_NAMED]:
        ((lon_deg, lat_deg),) = streets.to_degrees([near.junction.at_m])
        titles.append(f"{near.junction.title} at {lat_deg:.5f},{lon_deg:.5f} ({near.distance_m:,.0f} m away)")
    raise InputError("--at", problem, f"The nearest are: {'; '.join(titles)}.")


def _require_junction(junction: StreetJunction | None, osm: Path) -> StreetJunction:
    if junction is None:
        raise InputError(osm, "the streets of the extract have no junction", "Choose an extract with a junction.")
    return junction


def _other_levels(extract: OsmExtract, streets: Streets, junction: StreetJunction) -> OtherLevels:
    """Find what is above or below the region of a junction."""
    return road_levels.find_other_levels(extract, streets, junction, _level_window(junction))


def _level_window(junction: StreetJunction) -> BaseGeometry:
    """Return the region of a junction with a margin."""
    return junctions.region_around(junction).area.buffer(road_levels.MARGIN_M, join_style="mitre")


def _level_notes(others: OtherLevels, counts: ImportCounts) -> list[str]:
    notes = []
    if others.roads:
        titles = ", ".join(others.road_titles)
        notes.append(f"roads on another level are left out of the traffic in the region of interest: {titles}")
    heights = counts.heights.get("bridge", Counter())
    if heights["default"]:
        shares = f"{heights['default']} of {heights.total()}"
        notes.append(f"no height is given for {shares} bridge decks: {osm_solids.DECK_BASE_M:g} m assumed")
    return notes


def _range_notes(counts: ImportCounts) -> list[str]:
    left_out = counts.dropped.get(osm_solids.OUT_OF_RANGE, Counter()).total()
    if not left_out:
        return []
    total = left_out + counts.objects.total() - counts.objects["tree_crown"]
    range_m = CATALOGUE[SENSOR].range_m
    reason = f"they are beyond the range of a {SENSOR} ({range_m:g} m) from the region of interest and change no score"
    return [f"{left_out:,} of {total:,} static objects are left out: {reason}"]


def _assumed_traffic(
    network: str, streets: Streets, junction: StreetJunction, traffic: str | int
) -> AssumedTraffic | None:
    """Assume flows through the region of a junction, and find how much of them the network carries."""
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    if isinstance(traffic, int):
        if not flows:
            problem = "no street leads vehicles through the region of interest"
            raise InputError("--vehicles-per-hour", problem, "Choose another junction with --at LAT,LON.")
        flows = distribute_total(flows, traffic)
    if not flows:
        return None
    level = traffic if isinstance(traffic, str) else None
    return AssumedTraffic(tuple(flows), find_capacity(network, flows, JUNCTION_BLOCKER_S), level)


def _traffic_notes(traffic: AssumedTraffic) -> list[str]:
    capacity = traffic.capacity
    jam = f"; {capacity.jam}" if capacity.jam else ""
    hint = "Lower per_hour of traffic.counts, or check the signals and connections there"
    if traffic.level is None:
        if capacity.is_everything:
            return []
        return [f"traffic jams are likely: the network {traffic.summary}{jam}. {hint}"]
    if not capacity.is_confirmed:
        return [f"traffic jams in all {len(capacity.runs)} trials{jam}. {hint}"]
    if not capacity.is_everything:
        return [f"the junction does not carry the {traffic.assumed_per_h:,} vehicles an hour of its road classes"]
    return []


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
        notes.append(f"the junction is larger than the region of interest (at most {junctions.ROI_MAX_M:g} m)")
    heights = counts.heights.get("building", Counter())
    if heights["default"]:
        notes.append(
            f"{heights['default']} of {heights.total()} buildings have neither height nor levels:"
            f" {osm_solids.DEFAULT_BUILDING_M:g} m assumed"
        )
    return notes


def solids_geojson(solids: Sequence[MappedSolid], counts: ImportCounts) -> str:
    """Return GeoJSON in world-frame metres, one feature per line, with the import counts in its head."""
    head = {
        "type": "FeatureCollection",
        "attribution": ATTRIBUTION,
        "frame": f"metres, x and y of {NETWORK_FILE}; not longitude and latitude",
        "crs": None,
        "summary": counts.to_json(),
    }
    opening = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
    lines = ",\n".join(json.dumps(solid.to_geojson(), ensure_ascii=False) for solid in solids)
    return f'{opening},\n "features": [\n{lines}\n]}}\n'


def sites_csv(poles: Sequence[KerbsidePole]) -> str:
    """Return the table of candidate sites."""
    digits = max(2, len(str(len(poles))))
    rows = [f"k{number:0{digits}d},{pole.x_m},{pole.y_m}" for number, pole in enumerate(poles, 1)]
    return "\n".join(["site,x_m,y_m", *rows, ""])


def roi_table(roi: JunctionRegion) -> TomlTable:
    """Return ``[roi]`` without the voxel size."""
    comment = "the box in which visibility counts; its size is a whole number of voxels along each axis"
    height_m = junctions.ROI_HEIGHT_M
    return comment, {"center_m": [*roi.center_m, height_m / 2], "size_m": [*roi.size_m, height_m]}


def voxel_keys() -> dict[str, Any]:
    """Return the keys of ``[roi]`` that set the voxel size."""
    return {"voxel_m": RoiConfig.model_fields["voxel_m"].default}


def statics_table() -> TomlTable:
    """Return ``[statics]``."""
    comment = "buildings, trees, barriers, poles; the summary in the file counts what was assumed about them"
    return comment, {"footprints": [STATICS_FILE]}


def sites_table() -> TomlTable:
    """Return ``[sites]`` without the keys of :func:`mount_keys`."""
    position = "columns longitude, latitude (degrees) work as well as x_m, y_m"
    poles = f"poles {junctions.KERB_M:g} m behind the kerbs of the junction"
    return f"{poles}; add or remove rows as you like; {position}", {"file": SITES_FILE}


def mount_keys() -> dict[str, Any]:
    """Return the keys of ``[sites]`` that set sensor, heights and tilts of the candidates."""
    return {"sensor": SENSOR, "heights_m": list(junctions.HEIGHTS_M), "aim": "roi", "pitch_deg": list(PITCHES_DEG)}


def score_table() -> TomlTable:
    """Return ``[score]``."""
    return "", {"gamma": ScoreConfig.model_fields["gamma"].default, "rank_by": DEFAULT_SCORE}


def placement_table() -> TomlTable:
    """Return ``[placement]``: without a limit, a plan may put two sensors in the same place."""
    return "rules for egvs place", {"most_per_pole": 1}


def toml_document(comments: Sequence[str], values: Mapping[str, Any], tables: Mapping[str, TomlTable]) -> Any:
    """Make a TOML document.

    Parameters
    ----------
    comments
        Lines at the top.
    values
        Keys above all tables.
    tables
        Tables by name.

    Returns
    -------
    tomlkit.TOMLDocument
    """
    document = tomlkit.document()
    for comment in comments:
        document.add(tomlkit.comment(comment))
    document.add(tomlkit.nl())
    document.update(values)
    for key in values:
        if ("", key) in _KEY_COMMENTS:
            document[key].comment(_KEY_COMMENTS["", key])
    for table_name, (comment, keys) in tables.items():
        table = tomlkit.item(keys)
        if comment:
            table.comment(comment)
        document.add(tomlkit.nl()).add(table_name, table)
        for key in keys:
            if (table_name, key) in _KEY_COMMENTS:
                table[key].comment(_KEY_COMMENTS[table_name, key])
    return document


def _scenario_toml(name: str, scenario: NewScenario) -> str:
    title = scenario.junction.title
    values: dict[str, Any] = {
        "description": title[0].upper() + title[1:],
        "assumed": _assumptions(scenario),
        "seed": 1,
    }
    if name:
        values = {"name": name} | values

    roi_comment, roi = roi_table(scenario.roi)
    sites_comment, sites = sites_table()
    traffic = {
        "network": NETWORK_FILE,
        "frames": DEFAULT_FRAMES,
        "frame_period_s": TrafficConfig.model_fields["frame_period_s"].default,
        "warmup_s": DEFAULT_WARMUP_S,
        "junction_blocker_s": JUNCTION_BLOCKER_S,
        "teleport_s": TELEPORT_S,
    }
    tables = {
        "roi": (roi_comment, roi | voxel_keys()),
        "traffic": ("SUMO", traffic),
        "statics": statics_table(),
        "sites": (sites_comment, sites | mount_keys()),
        "score": score_table(),
        "placement": placement_table(),
    }
    comments = [
        f"A scenario made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright).",
        f"World frame: x east, y north in metres as in {NETWORK_FILE}, z up from the flat ground.",
    ]
    document = toml_document(comments, values, tables)
    if scenario.traffic is not None:
        names = MovementNames(scenario.streets.network, scenario.junction.at_m)
        document["traffic"].update({"counts": _counts_array(scenario.traffic.flows, names)})
        origin = f"assumed from the road classes ({scenario.traffic.assumed_per_h:,} vehicles an hour)"
        if scenario.traffic.level is None:
            origin = "divided among the movements by the road classes"
        comment = f"{origin}; the network {scenario.traffic.summary}. Replace them by real counts"
        document["traffic"]["counts"].comment(comment)
        for line in _periods_template(scenario.traffic.flows[0]):
            document["traffic"].add(tomlkit.comment(line))
    return tomlkit.dumps(document)


def _assumptions(scenario: NewScenario) -> list[str]:
    """Return what the map does not tell, for the key ``assumed``."""
    assumed = []
    traffic = scenario.traffic
    if traffic is not None and traffic.level is None:
        assumed.append(f"shares of the movements (of {traffic.per_h:,} vehicles an hour)")
    elif traffic is not None:
        assumed.append(f"traffic ({traffic.per_h:,} vehicles an hour, from the road classes)")
    if scenario.junction.signalised:
        assumed.append("signal plans")
    return [*assumed, *assumed_sizes(scenario.statics), "positions of the poles"]


def assumed_sizes(counts: ImportCounts) -> list[str]:
    """Return which sizes of static objects are assumed, for the key ``assumed``; objects that can hide vehicles."""
    heights = {kind: counts.heights.get(kind, Counter()) for kind in ("building", "tree", "bridge")}
    texts = [
        (heights["building"]["default"], heights["building"].total(), "heights of {} buildings"),
        (heights["tree"]["default"], heights["tree"].total(), "heights of {} trees"),
        (counts.assumed_crowns, heights["tree"].total(), "crown widths of {} trees"),
        (heights["bridge"]["default"], heights["bridge"].total(), "heights of {} bridge decks"),
    ]
    return [text.format(f"{number} of {total}") for number, total, text in texts if number]


def _counts_array(flows: Sequence[CountConfig], names: MovementNames) -> Any:
    """Return a TOML array with one flow per line, and its movement in words."""
    rows = tomlkit.array()
    for flow in flows:
        movement = names.describe(flow.edge or flow.from_edge or "", flow.to_edge)
        rows.add_line(_count_row(flow), comment=movement)
    rows.add_line(indent="")
    return rows


def _count_row(flow: CountConfig) -> Any:
    row = tomlkit.inline_table()
    row.update(flow.model_dump(exclude_defaults=True))
    return row


def _periods_template(example: CountConfig) -> list[str]:
    """Return comment lines that show how parts of the day are written."""
    return [
        "Parts of the day (peaks): one such table for each, with counts in rows as above; docs/scenarios.md, Periods",
        "[[traffic.periods]]",
        'name = "morning"',
        "weight = 3 # hours",
        f"counts = [{_count_row(example).as_string()}]",
    ]


def publish_folder(folder: Path, texts: Iterable[tuple[str, str]], check: Callable[[Path], object]) -> None:
    """Write files to a temporary folder, check it, and rename it: the folder appears complete or not at all.

    Parameters
    ----------
    folder
        Does not exist yet, or is empty.
    texts
        Name and content of each file.
    check
        Called with the temporary folder; raises if something is wrong with it.
    """
    target = folder.resolve()
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, text in texts:
            files.write_text(partial / name, text)
        check(partial)
        if folder.is_dir():
            folder.rmdir()
        partial.replace(target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
