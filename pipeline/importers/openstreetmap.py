"""How does a town on OpenStreetMap become a scenario?

Steps of :func:`new`: read the extract; netconvert makes the streets a SUMO network; choose a junction and lay the
region of interest round it; take buildings, trees, barriers and poles as footprints; find candidate sites along the
kerbs; write

    network.net.xml    the streets                                       (traffic)
    statics.geojson    footprints with heights, and what was counted     (statics)
    sites.csv          candidate sites                                   (scan, score)
    scenario.toml      the scenario that names them

World frame: the network's x (east), y (north) in metres; the ground is z = 0 (hills, bridges and tunnels are flat).
The same extract gives the same bytes: no dates, no paths, objects sorted.
"""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline.core.errors import InputError, RunError
from pipeline.formats import osm as osm_reader
from pipeline.formats.osm import Extract
from pipeline.importers import junctions as osm_junction
from pipeline.importers import solids as osm_footprints
from pipeline.importers.junctions import Junction, Region, Spot, Streets
from pipeline.importers.solids import Footprint
from pipeline.scenario.loading import load
from pipeline.scenario.models import FILE, RoiModel, ScoreModel
from pipeline.scenario.traffic import TrafficModel
from pipeline.scenario.types import Name
from pipeline.traffic import sumo

ATTRIBUTION = "(c) OpenStreetMap contributors, ODbL"
NETWORK, STATICS, SITES = "network.net.xml", "statics.geojson", "sites.csv"
SENSOR = "VLP-32C"

NETCONVERT = (
    "--geometry.remove", "--junctions.join", "--tls.guess-signals", "--tls.join",
    "--keep-edges.by-vclass", "passenger,bus,truck", "--remove-edges.isolated",
    "--output.street-names", "--precision", "3",
)  # fmt: skip
"""How streets become a network.

Measured on a town with 19 km of lanes: 50 and 80 vehicles are held for 5000 frames without grid-lock. Without
turnarounds, or with larger junctions, there are more overlaps, and grid-locks. """

LANE_PER_VEHICLE_M = 250.0
VEHICLES_LEAST, VEHICLES_MOST = 5, 50


def new(folder: Path, osm: Path, at: tuple[float, float] | None = None, lefthand: bool = False) -> dict[str, Any]:
    """Make a scenario folder from an OpenStreetMap extract.

    Parameters
    ----------
    folder
        Made by this function; may exist when it is empty.
    osm
        An ``.osm`` file (XML, may be gzipped).
    at
        Latitude, longitude in degrees: the signalised junction nearest to it is taken; without it, the largest.
    lefthand
        Whether one drives on the left there.

    Returns
    -------
    dict
        JSON: the junction, region, vehicles, sites; ``statics`` with what was counted; ``notes`` for the user.

    Raises
    ------
    InputError
        When the folder is not empty, the file is no sound extract with drivable streets, ``at`` lies outside it, or no
        site is possible. Nothing is written then.
    """
    name = _check_folder(folder)
    extract = osm_reader.read(osm)
    _check_at(extract, at)
    network, streets = _network(extract, osm, lefthand)
    junction, roi = _junction(streets, osm, at)
    footprints, counted = osm_footprints.collect(extract, streets.to_xy, streets.lane_areas)
    spots = osm_junction.kerb_sites(streets, junction, roi, [f.area for f in footprints])
    if not spots:
        raise InputError(
            osm,
            f"no place for a pole is free along the kerbs of the {junction.title}",
            "another junction: --at LAT,LON",
        )
    summary = _summary(streets, junction, roi, spots, counted)
    _publish(folder, {
        NETWORK: network,
        STATICS: _geojson(footprints, counted),
        SITES: _sites(spots),
        FILE: _toml(name, summary),
    })  # fmt: skip
    return {"folder": str(folder), **summary}


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
        raise InputError(
            "--at", f"{at[0]:g},{at[1]:g} lies outside the extract",
            f"latitude {b.south_deg:g} to {b.north_deg:g}, longitude {b.west_deg:g} to {b.east_deg:g}",
        )  # fmt: skip


# --- network --------------------------------------------------------------------------------------------------------


def _network(extract: Extract, osm: Path, lefthand: bool) -> tuple[str, Streets]:
    """The SUMO network as text, and what is in it."""
    missing = InputError(
        osm, "has no drivable streets that meet", "an extract with streets for cars (ways with highway=...)"
    )
    if not any("highway" in way.tags for way in extract.ways.values()):
        raise missing
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        (work / "streets.osm.xml").write_text(osm_reader.streets_xml(extract), encoding="utf-8")
        flags = [*NETCONVERT, *_boundary(extract), *(["--lefthand"] if lefthand else [])]
        try:
            sumo.run("netconvert", ["--osm-files", "streets.osm.xml", *flags, "-o", NETWORK], work)
        except RunError as error:
            if re.search(r"No (nodes|edges) loaded", str(error)):
                raise missing from None
            raise
        streets = osm_junction.read(work / NETWORK)
        if not streets.streets:
            raise missing
        return _without_header((work / NETWORK).read_text(encoding="utf-8")), streets


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
    near = streets.to_xy([at[1]], [at[0]])[0] if at else None
    junction = osm_junction.choose(streets, near)
    if junction is None:
        raise InputError(osm, "its streets meet nowhere", "an extract with a junction")
    return junction, osm_junction.region(junction)


# --- what is written ------------------------------------------------------------------------------------------------


def _summary(
    streets: Streets, junction: Junction, roi: Region, spots: Sequence[Spot], counted: dict[str, Any]
) -> dict[str, Any]:
    vehicles = round(streets.lane_length_m / LANE_PER_VEHICLE_M)
    return {
        "attribution": ATTRIBUTION,
        "junction": {
            "title": junction.title, "id": junction.id, "signalised": junction.signalised,
            "x_m": junction.at_m[0], "y_m": junction.at_m[1], "lanes_in": junction.lanes_in, "arms": junction.arms,
        },
        "roi": {
            "center_m": [*roi.center_m, osm_junction.ROI_HEIGHT_M / 2],
            "size_m": [*roi.size_m, osm_junction.ROI_HEIGHT_M],
        },
        "network": {
            "edges": len(streets.streets), "lane_length_m": round(streets.lane_length_m),
            "signalised_junctions": sum(j.signalised for j in streets.junctions),
        },
        "vehicles": min(max(vehicles, VEHICLES_LEAST), VEHICLES_MOST),
        "sites": len(spots) * len(osm_junction.HEIGHTS_M),
        "statics": counted,
        "notes": _notes(junction, roi, counted),
    }  # fmt: skip


def _notes(junction: Junction, roi: Region, counted: dict[str, Any]) -> list[str]:
    """What a user should know before trusting the scenario."""
    notes = []
    if not junction.signalised:
        notes.append("no junction in the extract has signals; the one with the most incoming lanes was taken")
    if not roi.area.covers(junction.area):
        notes.append(f"the junction is larger than the region of interest ({osm_junction.ROI_MOST_M:g} m at most)")
    heights = counted["heights"].get("building", {})
    if guessed := heights.get("default", 0):
        share = f"{guessed} of {sum(heights.values())} buildings"
        notes.append(f"{share} name neither height nor levels: {osm_footprints.BUILDING_M:g} m assumed")
    return notes


def _geojson(footprints: Sequence[Footprint], counted: dict[str, Any]) -> str:
    """GeoJSON in world-frame metres, one feature a line."""
    head = {
        "type": "FeatureCollection",
        "attribution": ATTRIBUTION,
        "frame": f"metres, x and y of {NETWORK}; not longitude and latitude",
        "summary": counted,
    }
    opening = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
    lines = ",\n".join(json.dumps(f.to_geojson(), ensure_ascii=False) for f in footprints)
    return f'{opening},\n "features": [\n{lines}\n]}}\n'


def _sites(spots: Sequence[Spot]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor"))
    rows = [(spot, z_m) for spot in spots for z_m in osm_junction.HEIGHTS_M]
    for number, (spot, z_m) in enumerate(rows, 1):
        table.writerow((f"k{number:02d}", spot.x_m, spot.y_m, z_m, spot.yaw_deg, 0.0, 0.0, SENSOR))
    return text.getvalue()


def _toml(name: str, summary: dict[str, Any]) -> str:
    defaults = {key: field.default for key, field in TrafficModel.model_fields.items()}
    title = summary["junction"]["title"]
    lines = [
        f"# A scenario made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright).",
        f"# World frame: x east, y north in metres as in {NETWORK}, z up from the flat ground.",
        "",
        *([f"name = {_quoted(name)}"] if name else []),
        f"description = {_quoted(title[0].upper() + title[1:])}",
        "seed = 1",
        "",
        "[roi]  # the box whose visibility counts; its size is a whole number of voxels along each axis",
        f"center_m = {_floats(summary['roi']['center_m'])}",
        f"size_m = {_floats(summary['roi']['size_m'])}",
        f"voxel_m = {RoiModel.model_fields['voxel_m'].default}",
        "",
        "[traffic]  # SUMO; trips are drawn between the ends of the network's streets",
        f"network = {_quoted(NETWORK)}",
        f"vehicles = {summary['vehicles']}  # in the whole network, in every frame"
        f" ({summary['network']['lane_length_m'] / 1000:.1f} km of lanes)",
        f"frames = {defaults['frames']}",
        f"frame_period_s = {defaults['frame_period_s']}",
        f"warmup_s = {defaults['warmup_s']}",
        "",
        "[statics]  # buildings, trees, barriers, poles; what was assumed about them is counted in the file's summary",
        f"footprints = [{_quoted(STATICS)}]",
        "",
        f"[sites]  # poles {osm_junction.KERB_M:g} m behind the kerbs of the junction; add or remove rows at will",
        f"file = {_quoted(SITES)}",
        "",
        "[score]",
        f"gamma = {ScoreModel.model_fields['gamma'].default}",
        "",
    ]
    return "\n".join(lines)


def _quoted(text: str) -> str:
    """A TOML basic string."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _floats(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"


def _publish(folder: Path, files: dict[str, str]) -> None:
    """Write the files aside, check the scenario, and rename the folder: it appears whole or not at all."""
    partial = folder.resolve().with_name(f".{folder.resolve().name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, text in files.items():
            (partial / name).write_bytes(text.encode("utf-8"))
        load(partial)
        if folder.is_dir():
            folder.rmdir()
        partial.replace(folder.resolve())
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
