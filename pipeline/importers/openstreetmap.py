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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit

from pipeline.core.errors import InputError
from pipeline.formats.osm import Extract
from pipeline.formats.osm import read as read_extract
from pipeline.importers import assumed_traffic, junctions, scenario_folder, solids, street_network
from pipeline.importers.junctions import HEIGHTS_M, ROI_HEIGHT_M, Junction, Region, Streets
from pipeline.importers.mapped_solids import ImportCounts
from pipeline.importers.scenario_folder import PITCHES_DEG, SITES, STATICS
from pipeline.importers.shapes import XY
from pipeline.importers.street_network import ATTRIBUTION, NETWORK
from pipeline.scenario.loading import load
from pipeline.scenario.models import FILE
from pipeline.scenario.traffic import FRAMES, WARMUP_S, CountModel, TrafficModel

PEOPLE = "people come with --set effects.pedestrians_bicycles.pedestrians_per_h=300 (bicycles_per_h for bicycles)"

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
    name = scenario_folder.check_new_folder(folder)
    if surroundings_m is not None and surroundings_m < SURROUNDINGS_LEAST_M:
        right = f"at least {SURROUNDINGS_LEAST_M:g}, so that they hold the junction with its approaches"
        raise InputError("--surroundings", f"{surroundings_m:g} m", right)
    extract = read_extract(osm)
    check_at(extract, at)
    flags = street_network.flags(extract, lefthand=lefthand, walk=walk)
    network, streets = street_network.network(extract, osm, flags)
    junction, roi = _junction(streets, osm, at)
    mapped, counts = solids.collect(extract, streets)
    if surroundings_m is not None:
        network, streets = street_network.cropped(extract, osm, flags, streets, junction, surroundings_m)
        junction, roi = _junction_at(streets, osm, junction.at_m)
    places = junctions.kerb_places(streets, junction, roi, [solid.area for solid in mapped])
    if not places:
        problem = f"no place for a pole is free along the kerbs of the {junction.title}"
        raise InputError(osm, problem, "another junction: --at LAT,LON")
    notes = (*_notes(junction, roi, counts), *([PEOPLE] if walk else []))
    made = NewScenario(folder, junction, roi, streets, len(places), counts, notes)
    texts = {
        NETWORK: network,
        STATICS: scenario_folder.geojson(mapped, counts),
        SITES: scenario_folder.sites_csv(places),
        FILE: _toml(name, made),
    }
    scenario_folder.publish(folder, texts.items(), load)
    return made


def check_at(extract: Extract, at: tuple[float, float] | None, option: str = "--at") -> None:
    """InputError where a place of an option lies outside the extract."""
    if at is not None and not extract.bounds.holds(*at):
        b = extract.bounds
        right = f"latitude {b.south_deg:g} to {b.north_deg:g}, longitude {b.west_deg:g} to {b.east_deg:g}"
        raise InputError(option, f"{at[0]:g},{at[1]:g} lies outside the extract", right)


def _junction(streets: Streets, osm: Path, at: tuple[float, float] | None) -> tuple[Junction, Region]:
    return _junction_at(streets, osm, streets.to_xy([at[1]], [at[0]])[0] if at else None)


def _junction_at(streets: Streets, osm: Path, near: XY | None) -> tuple[Junction, Region]:
    junction = junctions.choose_junction(streets, near)
    if junction is None:
        raise InputError(osm, "its streets meet nowhere", "an extract with a junction")
    return junction, junctions.region_round(junction)


# --- what is written ------------------------------------------------------------------------------------------------


def _notes(junction: Junction, roi: Region, counts: ImportCounts) -> tuple[str, ...]:
    unsigned = "no junction in the extract has signals; the one with the most incoming lanes was taken"
    return (
        *([] if junction.signalised else [unsigned]),
        *scenario_folder.notes(roi.area.covers(junction.area), counts),
    )


def _toml(name: str, made: NewScenario) -> str:
    title = made.junction.title
    values = ({"name": name} if name else {}) | {"description": title[0].upper() + title[1:], "seed": 1}
    period_s = TrafficModel.model_fields["frame_period_s"].default
    traffic = {"network": NETWORK, "frames": FRAMES, "frame_period_s": period_s, "warmup_s": WARMUP_S}
    about_roi, roi = scenario_folder.roi_table(made.roi)
    about_sites, sites = scenario_folder.sites_table()
    tables = {
        "roi": (about_roi, roi | scenario_folder.voxels()),
        "traffic": ("SUMO", traffic),
        "statics": scenario_folder.statics_table(),
        "sites": (about_sites, sites | scenario_folder.mounts()),
        "score": scenario_folder.score_table(),
    }
    source = f"A scenario made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."
    frame = f"World frame: x east, y north in metres as in {NETWORK}, z up from the flat ground."
    document = scenario_folder.toml([source, frame], values, tables)
    if made.flows:
        document["traffic"].update({"counts": _counts(made.flows)})
        document["traffic"]["counts"].comment(
            "assumed by the class of the streets: put what was counted in their place"
        )
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
