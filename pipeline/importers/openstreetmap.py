"""A scenario is made from a town on OpenStreetMap.

Steps of :func:`new`: read the extract; netconvert makes the streets a SUMO network; choose a junction and lay the
region of interest round it; take buildings, trees, barriers and poles as solids; find candidate sites along the
kerbs; write

    network.net.xml    the streets                                       (traffic)
    statics.geojson    footprints with heights, and what was counted     (statics)
    sites.csv          candidate sites                                   (scan, score)
    scenario.toml      the scenario that names them

World frame: the network's x (east), y (north) in metres; the ground is z = 0 (hills, bridges and tunnels are flat).
The same extract gives the same bytes: no dates, no paths, objects sorted.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import TypeAdapter, ValidationError

from pipeline.core import files
from pipeline.core.errors import InputError, RunError
from pipeline.formats.osm import Extract, write_streets
from pipeline.formats.osm import read as read_extract
from pipeline.importers import assumed_traffic, junctions, solids, surroundings
from pipeline.importers.junctions import HEIGHTS_M, ROI_HEIGHT_M, Junction, KerbPlace, Region, Streets
from pipeline.importers.mapped_solids import BUILDING_M, ImportCounts, MappedSolid
from pipeline.importers.shapes import XY
from pipeline.scenario.loading import load
from pipeline.scenario.models import FILE, RoiModel
from pipeline.scenario.score import RECOMMENDED, ScoreModel
from pipeline.scenario.traffic import FRAMES, WARMUP_S, CountModel, TrafficModel
from pipeline.scenario.types import Name
from pipeline.traffic import sumo, sumo_folder

ATTRIBUTION = "(c) OpenStreetMap contributors, ODbL"
NETWORK, STATICS, SITES = "network.net.xml", "statics.geojson", "sites.csv"
SENSOR = "VLP-32C"

NETCONVERT = (
    "--geometry.remove", "--junctions.join", *sumo_folder.OSM_SIGNALS,
    "--keep-edges.by-vclass", "passenger,bus,truck", "--remove-edges.isolated",
    "--output.street-names", "--precision", "3",
)  # fmt: skip
"""How streets become a network."""

WALK = ("--sidewalks.guess", "--sidewalks.guess.max-speed", "28", "--crossings.guess")
"""Sidewalks, walking areas at their corners, and crossings between these.

Up to 28 m/s instead of 13.89: that is what netconvert takes a main street without ``maxspeed`` for; not a motorway.
"""

PEOPLE = "people come with --set effects.pedestrians_bicycles.pedestrians_per_h=300 (bicycles_per_h for bicycles)"

PITCHES_DEG: tuple[float | str, ...] = (0.0, -10.0, "aim")
"""Tilts that each height is tried with; which is best at which height depends on sensor and junction."""

SURROUNDINGS_LEAST_M = 100.0
SURROUNDINGS_M = 300.0
"""How far from the junction streets are simulated: far enough for the queues and platoons that reach it."""


@dataclass(frozen=True)
class NewScenario:
    """What :func:`new` made; ``poles`` are places for one, ``notes`` say what to know before trusting it."""

    folder: Path
    junction: Junction
    roi: Region
    streets: Streets
    poles: int
    statics: ImportCounts
    notes: tuple[str, ...]

    @property
    def sites(self) -> int:
        """Candidates: each pole with each height and each tilt."""
        return self.poles * len(HEIGHTS_M) * len(PITCHES_DEG)

    @cached_property
    def flows(self) -> tuple[CountModel, ...]:
        """The assumed traffic through the region of interest; empty where no street leads through it."""
        return tuple(assumed_traffic.flows(self.streets, self.roi))

    def to_json(self) -> dict[str, Any]:
        """All of it as plain JSON, in the order of interest."""
        junction, streets = self.junction, self.streets
        return {
            "folder": str(self.folder),
            "attribution": ATTRIBUTION,
            "junction": {
                "title": junction.title, "id": junction.id, "signalised": junction.signalised,
                "x_m": junction.at_m[0], "y_m": junction.at_m[1], "lanes_in": junction.lanes_in, "arms": junction.arms,
            },
            "roi": {"center_m": [*self.roi.center_m, ROI_HEIGHT_M / 2], "size_m": [*self.roi.size_m, ROI_HEIGHT_M]},
            "network": {
                "edges": len(streets.network.edges), "lane_length_m": round(streets.lane_length_m),
                "signalised_junctions": sum(j.signalised for j in streets.junctions),
            },
            "assumed_traffic": {
                "flows": len(self.flows), "vehicles_per_hour": round(math.fsum(f.per_hour for f in self.flows)),
            },
            "poles": self.poles,
            "sites": self.sites,
            "statics": self.statics.to_json(),
            "notes": list(self.notes),
        }  # fmt: skip


def new(
    folder: Path, osm: Path, at: tuple[float, float] | None = None, lefthand: bool = False, walk: bool = False,
    surroundings_m: float | None = SURROUNDINGS_M,
) -> NewScenario:  # fmt: skip
    """Make a scenario folder from an OpenStreetMap extract.

    Parameters
    ----------
    folder
        Made by this function; may exist when it is empty.
    osm
        An OpenStreetMap file: XML (may be gzipped) or PBF.
    at
        Latitude, longitude in degrees: the signalised junction nearest to it is taken; without it, the largest.
    lefthand
        Whether one drives on the left there.
    walk
        Whether the network gets sidewalks and crossings, which people on foot need.
    surroundings_m
        Streets end so far from the junction; None for all that the extract has.

    Raises
    ------
    InputError
        When the folder is not empty, the file is no sound extract with drivable streets, ``at`` lies outside it, or no
        site is possible. Nothing is written then.
    """
    name = _check_folder(folder)
    if surroundings_m is not None and surroundings_m < SURROUNDINGS_LEAST_M:
        right = f"at least {SURROUNDINGS_LEAST_M:g}, so that they hold the junction with its approaches"
        raise InputError("--surroundings", f"{surroundings_m:g} m", right)
    extract = read_extract(osm)
    _check_at(extract, at)
    flags = [*NETCONVERT, *_boundary(extract), *(["--lefthand"] if lefthand else []), *(WALK if walk else [])]
    network, streets = _network(extract, osm, flags)
    junction, roi = _junction(streets, osm, at)
    mapped, counts = solids.collect(extract, streets)
    if surroundings_m is not None:
        network, streets = _cropped(extract, osm, flags, streets, junction, surroundings_m)
        junction, roi = _junction_at(streets, osm, junction.at_m)
    places = junctions.kerb_places(streets, junction, roi, [solid.area for solid in mapped])
    if not places:
        problem = f"no place for a pole is free along the kerbs of the {junction.title}"
        raise InputError(osm, problem, "another junction: --at LAT,LON")
    notes = (*_notes(junction, roi, counts), *([PEOPLE] if walk else []))
    made = NewScenario(folder, junction, roi, streets, len(places), counts, notes)
    texts = {NETWORK: network, STATICS: _geojson(mapped, counts), SITES: _sites(places), FILE: _toml(name, made)}
    _publish(folder, texts)
    return made


def _check_folder(folder: Path) -> str:
    """The scenario's name where the folder's own is none, else nothing."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "is a file", "a folder that does not exist yet")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(folder, "is not empty", "a folder that does not exist yet, so that nothing is overwritten")
    name = folder.resolve().name
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        return re.sub(r"[\s/\\:*?\"<>|]+", "-", name).strip("-") or "junction"
    return ""


def _check_at(extract: Extract, at: tuple[float, float] | None) -> None:
    if at is not None and not extract.bounds.holds(*at):
        b = extract.bounds
        right = f"latitude {b.south_deg:g} to {b.north_deg:g}, longitude {b.west_deg:g} to {b.east_deg:g}"
        raise InputError("--at", f"{at[0]:g},{at[1]:g} lies outside the extract", right)


# --- network --------------------------------------------------------------------------------------------------------


def _network(extract: Extract, osm: Path, flags: Sequence[str]) -> tuple[str, Streets]:
    """The SUMO network that netconvert makes with these flags, as text, and what is in it."""
    right = "an extract with streets for cars (ways with highway=...)"
    missing = InputError(osm, "has no drivable streets that meet", right)
    if not any("highway" in way.tags for way in extract.ways.values()):
        raise missing
    with files.scratch() as work:
        write_streets(extract, work / "streets.osm.xml")
        try:
            sumo.netconvert(["--osm-files", "streets.osm.xml", *flags], work, NETWORK)
            streets = junctions.read(work / NETWORK)
        except (RunError, InputError) as error:
            if re.search(r"No (nodes|edges) loaded|has no road", str(error)):
                raise missing from None
            if isinstance(error, sumo.RefusedError):
                raise InputError(osm, f"holds streets that cannot be used: {error}", "another extract") from None
            raise
        return _without_header((work / NETWORK).read_text(encoding="utf-8")), streets


def _cropped(
    extract: Extract, osm: Path, flags: Sequence[str], streets: Streets, junction: Junction, radius_m: float
) -> tuple[str, Streets]:
    """The network of a junction's surroundings, in the frame of the whole network ``streets``."""
    location = streets.network.location
    assert location is not None, "netconvert writes it"
    ((lon_deg, lat_deg),) = streets.to_degrees([junction.at_m])
    east_m, north_m = location.offset_m
    frame = ["--proj", location.projection, "--offset.disable-normalization", "--offset.x", f"{east_m!r}",
             "--offset.y", f"{north_m!r}"]  # fmt: skip
    return _network(surroundings.cut_out(extract, (lat_deg, lon_deg), radius_m), osm, [*flags, *frame])


def _boundary(extract: Extract) -> list[str]:
    """Streets that reach beyond the extract's bounds are left whole, those wholly outside are left out."""
    if not extract.declared:
        return []
    b = extract.bounds
    return ["--keep-edges.in-geo-boundary", f"{b.west_deg!r},{b.south_deg!r},{b.east_deg!r},{b.north_deg!r}"]


def _without_header(network: str) -> str:
    """netconvert's first comment holds the date and paths; the attribution takes its place."""
    return re.sub(r"<!-- generated on .*?-->", f"<!-- {ATTRIBUTION} -->", network, count=1, flags=re.DOTALL)


def _junction(streets: Streets, osm: Path, at: tuple[float, float] | None) -> tuple[Junction, Region]:
    return _junction_at(streets, osm, streets.to_xy([at[1]], [at[0]])[0] if at else None)


def _junction_at(streets: Streets, osm: Path, near: XY | None) -> tuple[Junction, Region]:
    junction = junctions.choose_junction(streets, near)
    if junction is None:
        raise InputError(osm, "its streets meet nowhere", "an extract with a junction")
    return junction, junctions.region_round(junction)


# --- what is written ------------------------------------------------------------------------------------------------


def _notes(junction: Junction, roi: Region, counts: ImportCounts) -> tuple[str, ...]:
    notes = []
    if not junction.signalised:
        notes.append("no junction in the extract has signals; the one with the most incoming lanes was taken")
    if not roi.area.covers(junction.area):
        notes.append(f"the junction is larger than the region of interest ({junctions.ROI_MOST_M:g} m at most)")
    heights = counts.heights.get("building", Counter())
    if guessed := heights["default"]:
        share = f"{guessed} of {heights.total()} buildings"
        notes.append(f"{share} name neither height nor levels: {BUILDING_M:g} m assumed")
    return tuple(notes)


def _geojson(mapped: Sequence[MappedSolid], counts: ImportCounts) -> str:
    """GeoJSON in world-frame metres, one feature a line."""
    head = {
        "type": "FeatureCollection",
        "attribution": ATTRIBUTION,
        "frame": f"metres, x and y of {NETWORK}; not longitude and latitude",
        "crs": None,
        "summary": counts.to_json(),
    }
    opening = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
    lines = ",\n".join(json.dumps(solid.to_geojson(), ensure_ascii=False) for solid in mapped)
    return f'{opening},\n "features": [\n{lines}\n]}}\n'


def _sites(places: Sequence[KerbPlace]) -> str:
    rows = (f"k{number:02d},{place.x_m},{place.y_m}" for number, place in enumerate(places, 1))
    return "\n".join(["site,x_m,y_m", *rows, ""])


def _toml(name: str, made: NewScenario) -> str:
    document = tomlkit.document()
    source = f"A scenario made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."
    document.add(tomlkit.comment(source))
    document.add(tomlkit.comment(f"World frame: x east, y north in metres as in {NETWORK}, z up from the flat ground."))
    document.add(tomlkit.nl())
    title = made.junction.title
    document.update({"name": name} if name else {})
    document.update({"description": title[0].upper() + title[1:], "seed": 1})
    period_s = TrafficModel.model_fields["frame_period_s"].default
    traffic = {"frames": FRAMES, "frame_period_s": period_s, "warmup_s": WARMUP_S}
    tables: dict[str, tuple[str, dict[str, Any]]] = {
        "roi": ("the box whose visibility counts; its size is a whole number of voxels along each axis", {
            "center_m": [*made.roi.center_m, ROI_HEIGHT_M / 2], "size_m": [*made.roi.size_m, ROI_HEIGHT_M],
            "voxel_m": RoiModel.model_fields["voxel_m"].default,
        }),
        "traffic": ("SUMO", {"network": NETWORK, **traffic}),
        "statics": ("buildings, trees, barriers, poles; what was assumed about them is counted in the file's summary", {
            "footprints": [STATICS],
        }),
        "sites": (f"poles {junctions.KERB_M:g} m behind the kerbs of the junction; add or remove rows at will", {
            "file": SITES, "sensor": SENSOR, "heights_m": list(HEIGHTS_M), "aim": "roi", "pitch_deg": list(PITCHES_DEG),
        }),
        "score": ("", {"gamma": ScoreModel.model_fields["gamma"].default, "rank_by": RECOMMENDED}),
    }  # fmt: skip
    for key, (comment, values) in tables.items():
        table = tomlkit.item(values)
        if comment:
            table.comment(comment)
        document.add(tomlkit.nl()).add(key, table)
    if made.flows:
        document["traffic"].update({"counts": _counts(made.flows)})
        document["traffic"]["counts"].comment(
            "assumed by the class of the streets: put what was counted in their place"
        )
    document["score"]["rank_by"].comment("the share of vehicles that detectors are expected to find; docs/validity.md")
    document["sites"]["aim"].comment("sensors are turned towards the middle of the region")
    document["sites"]["pitch_deg"].comment("each height with each tilt is a candidate; 'aim': the middle ray meets it")
    return tomlkit.dumps(document)


def _counts(flows: Sequence[CountModel]) -> Any:
    """One flow a line."""
    rows = tomlkit.array()
    for flow in flows:
        row = tomlkit.inline_table()
        row.update(flow.model_dump(exclude_defaults=True))
        rows.add_line(row)
    rows.add_line(indent="")
    return rows


def _publish(folder: Path, texts: dict[str, str]) -> None:
    """Write the files aside, check the scenario, and rename the folder: it appears whole or not at all."""
    partial = folder.resolve().with_name(f".{folder.resolve().name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, text in texts.items():
            files.write_text(partial / name, text)
        load(partial)
        if folder.is_dir():
            folder.rmdir()
        partial.replace(folder.resolve())
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
