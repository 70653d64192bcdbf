"""A city is made from OpenStreetMap: one network, and a scenario for each junction.

Steps of :func:`new`: read the extract, its streets cut to a circle if one is asked for; netconvert makes them one SUMO
network; choose the junctions (:mod:`pipeline.city.choosing`); take buildings, trees, barriers, poles as solids, once;
for each junction lay the region of interest round it, find candidate sites along its kerbs, and keep the solids that a
sensor there can reach; write the folder (:mod:`pipeline.city.model`, :mod:`pipeline.city.texts`).

World frame: the network's x (east), y (north) in metres; the ground is z = 0. The same extract gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely
from shapely.geometry import MultiPoint, Point, box

from pipeline.city import choosing, model, texts
from pipeline.city.choosing import SIGNALISED
from pipeline.city.model import FILE, JUNCTIONS, TABLE, City, CityJunction
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.formats.osm import read as read_extract
from pipeline.importers import junctions, scenario_folder, solids, street_network, surroundings
from pipeline.importers.junctions import HEIGHTS_M, Junction, KerbPlace, Region, Streets
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid
from pipeline.importers.openstreetmap import check_at
from pipeline.importers.scenario_folder import PITCHES_DEG, SENSOR, SITES, STATICS
from pipeline.importers.street_network import ATTRIBUTION, NETWORK, Pieces
from pipeline.scenario.loading import load
from pipeline.scenario.models import FILE as SCENARIO_FILE
from pipeline.sensing.sensors import CATALOGUE

RADIUS_M = 2000.0
"""Of the circle, where a place is named and no radius."""

RIM_M = 100.0
"""Junctions that are nearer to the circle are left out: their approaches are cut."""

PEOPLE = f"people come with [effects.pedestrians_bicycles] pedestrians_per_h = 300 in {FILE} (and bicycles_per_h)"
NO_PLACE = "no place for a pole is free along the kerbs"
COUNTS = "import.json"
"""What was made, assumed and left out, in the city's folder."""

_LOCAL_M, _ROADS_M = 60.0, 100.0
"""How far round a region kerbs look at what is there, and streets are drawn."""


@dataclass(frozen=True)
class NewJunction:
    """A junction with what its scenario is made of."""

    id: str
    junction: Junction
    roi: Region
    places: list[KerbPlace]

    @property
    def sites(self) -> int:
        """Candidates: each pole with each height and each tilt."""
        return len(self.places) * len(HEIGHTS_M) * len(PITCHES_DEG)


@dataclass(frozen=True)
class NewCity:
    """What :func:`new` made; ``left_out`` are ids of the network's junctions, by why they have no scenario."""

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
            "traffic": texts.amount_of(streets),
            "poles": sum(len(j.places) for j in its),
            "sites": sum(j.sites for j in its),
            "statics": self.statics.to_json(),
            "notes": list(self.notes),
        }  # fmt: skip


def new(
    folder: Path, osm: Path, *, around: tuple[float, float] | None = None, radius_m: float | None = None,
    which: str = SIGNALISED, lefthand: bool = False, walk: bool = False, progress: Progress = silent,
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
        ``"signalised"``, ``"all"``, or the path of a table of junctions, see :func:`pipeline.city.choosing.choose`.
    lefthand, walk
        As :func:`pipeline.importers.openstreetmap.new`.

    Raises
    ------
    InputError
        When the folder is not empty, the file is no sound extract with drivable streets, ``around`` lies outside it, a
        table is wrong, or no junction is left. Nothing is written then.
    """
    name = scenario_folder.check_new_folder(folder)
    if radius_m is not None and around is None:
        raise InputError("--radius", f"{radius_m:g} m round no place", "--around LAT,LON as well")
    extract = read_extract(osm)
    check_at(extract, around, "--around")
    reach_m = radius_m or RADIUS_M
    cut = extract if around is None else surroundings.cut_out(extract, around, reach_m)
    network, streets = street_network.network(cut, osm, street_network.flags(extract, lefthand=lefthand, walk=walk))
    within = None if around is None else Point(streets.to_xy([around[1]], [around[0]])[0]).buffer(reach_m - RIM_M)
    choice = choosing.choose(streets, which, within)
    mapped, counts = solids.collect(extract, streets)
    areas = shapely.STRtree([solid.area for solid in mapped])
    made, blocked = [], []
    for number, (its_id, junction) in enumerate(choice.junctions.items(), 1):
        its = _junction(its_id, junction, streets, areas)
        made += [its] if its.places else []
        blocked += [] if its.places else [junction.id]
        progress("junctions", number, len(choice.junctions))
    left_out = choice.left_out | ({NO_PLACE: blocked} if blocked else {})
    if not made:
        right = "--junctions all" if which == SIGNALISED else "another extract, or a wider --radius"
        raise InputError(osm, f"no junction is left ({_told(left_out)})", right)
    larger = sum(not its.roi.area.covers(its.junction.area) for its in made)
    notes = (*texts.notes(larger, counts), *([PEOPLE] if walk else []))
    city = NewCity(folder, tuple(made), left_out, streets, counts, notes)
    scenario_folder.publish(folder, _texts(city, name, network, mapped, areas), _check)
    return city


def _told(left_out: dict[str, list[str]]) -> str:
    return ", ".join(f"{len(ids)} {why}" for why, ids in left_out.items()) or "its streets meet nowhere"


def _junction(its_id: str, junction: Junction, streets: Streets, areas: shapely.STRtree) -> NewJunction:
    """The region round a junction, and places for poles; the solids are those of ``areas``."""
    roi = junctions.region_round(junction)
    local = _window(roi, _LOCAL_M)
    objects = list(areas.geometries[sorted(areas.query(local))])
    return NewJunction(its_id, junction, roi, junctions.kerb_places(streets.near(local), junction, roi, objects))


def _window(roi: Region, margin_m: float) -> shapely.Geometry:
    return box(*roi.area.bounds).buffer(margin_m, join_style="mitre")


def _texts(
    city: NewCity, name: str, network: str, mapped: list[MappedSolid], areas: shapely.STRtree
) -> Iterator[tuple[str, str]]:
    """Every file of the folder, one after another."""
    yield FILE, texts.city(name, city.streets, len(city.junctions))
    yield NETWORK, network
    yield TABLE, texts.table(_rows(city))
    yield COUNTS, files.json_text(city.to_json() | {"left_out": city.left_out}, indent=1) + "\n"
    yield f"{JUNCTIONS}/{SCENARIO_FILE}", texts.common()
    pieces = Pieces(network)
    for its in city.junctions:
        near = [mapped[i] for i in sorted(areas.query(_reach(its), predicate="intersects"))]
        folder = f"{JUNCTIONS}/{its.id}"
        yield f"{folder}/{STATICS}", scenario_folder.geojson(near, texts.counts_of(near))
        yield f"{folder}/{SITES}", scenario_folder.sites_csv(its.places)
        yield f"{folder}/{texts.ROADS}", pieces.near(city.streets.near(_window(its.roi, _ROADS_M)))
        yield f"{folder}/{SCENARIO_FILE}", texts.junction(its.id, its.junction.title, its.roi)


def _reach(its: NewJunction) -> shapely.Geometry:
    """Where the beams of any of its sites may end."""
    spots = MultiPoint([(place.x_m, place.y_m) for place in its.places]).union(its.roi.area)
    return box(*spots.bounds).buffer(CATALOGUE[SENSOR].range_m, join_style="mitre")


def _rows(city: NewCity) -> Iterator[CityJunction]:
    places = city.streets.to_degrees([its.junction.at_m for its in city.junctions])
    for its, (lon_deg, lat_deg) in zip(city.junctions, places, strict=True):
        x_m, y_m = its.junction.at_m
        yield CityJunction(
            its.id, its.junction.title, x_m, y_m, round(lat_deg, 7), round(lon_deg, 7), its.junction.signalised
        )


def _check(folder: Path) -> City:
    city = model.load(folder)
    for junction in city.junctions:
        load(junction.scenario_folder(city))
    return city
