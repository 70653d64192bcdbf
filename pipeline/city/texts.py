"""The texts that a new city is made of: ``city.toml``, its table, what junctions have in common, each one's scenario.

The traffic is drawn for the whole network, by the length of its lanes: flows that are assumed for each junction alone
would count whoever passes several of them more than once.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Any

import tomlkit

from pipeline.city import model
from pipeline.city.model import TRAFFIC, CityJunction
from pipeline.importers import junctions, scenario_folder
from pipeline.importers.junctions import Region, Streets
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid
from pipeline.importers.scenario_folder import Table
from pipeline.importers.street_network import ATTRIBUTION, NETWORK
from pipeline.scenario.traffic import FRAMES, WARMUP_S, TrafficModel
from pipeline.traffic.demand import trips

_ACROSS_M_S, _ROUND_S = 8.0, 60.0
"""A network is full once one could have crossed it at this speed."""

_TRIP_S = 100.0
"""Trips last longer than this: so many a second keep the vehicles of a network."""

ROADS = "roads.net.xml"
"""Of a junction: the streets near it, for maps, lanes and checks."""

_SOURCE = f"Made from OpenStreetMap. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."
_FRAME = f"World frame: x east, y north in metres as in {NETWORK}, z up from the flat ground."


def amount_of(streets: Streets) -> dict[str, Any]:
    """How much is simulated, and for how long: what of ``[traffic]`` depends on the network's size."""
    vehicles = trips.vehicles_to_hold(TrafficModel(network=NETWORK), streets.network)
    fill_s = _ROUND_S * math.ceil(streets.network.diagonal_m / _ACROSS_M_S / _ROUND_S)
    own = float(TrafficModel.model_fields["trips_per_s"].default)
    return {"vehicles": vehicles, "warmup_s": max(WARMUP_S, fill_s), "trips_per_s": max(own, vehicles / _TRIP_S)}


def city(name: str, streets: Streets, count: int) -> str:
    """``city.toml``."""
    amount, fields = amount_of(streets), TrafficModel.model_fields
    values = ({"name": name} if name else {}) | {
        "description": f"{count} junctions", "attribution": ATTRIBUTION, "seed": 1,
    }  # fmt: skip
    traffic = {
        "network": NETWORK, "vehicles_per_lane_km": fields["vehicles_per_lane_km"].default, "frames": FRAMES,
        "frame_period_s": fields["frame_period_s"].default, "warmup_s": amount["warmup_s"],
        "trips_per_s": amount["trips_per_s"],
    }  # fmt: skip
    about = "one simulation for all junctions, trips drawn through the whole network; or your own sumocfg, counts, fcd"
    document = scenario_folder.toml([f"A city. {_SOURCE}", _FRAME], values, {"traffic": (about, traffic)})
    shown = f"{amount['vehicles']} vehicles in this network"
    document["traffic"]["vehicles_per_lane_km"].comment(shown)
    return tomlkit.dumps(document)


def common() -> str:
    """``junctions/scenario.toml``: what every junction's scenario extends."""
    period_s = TrafficModel.model_fields["frame_period_s"].default
    tables: dict[str, Table] = {
        "roi": ("", scenario_folder.voxels()),
        "traffic": (f"as in {model.FILE}, or a multiple of it", {"frame_period_s": period_s}),
        "sites": ("", scenario_folder.mounts()),
        "scan": ("sites are scanned as they are scored; true keeps their scans, 0.7 MB a site", {"keep": False}),
        "score": scenario_folder.score_table(),
    }
    about = "What the scenarios of all junctions have in common; each may say otherwise."
    return tomlkit.dumps(scenario_folder.toml([about], {"seed": 1}, tables))


def junction(its_id: str, title: str, roi: Region) -> str:
    """A junction's ``scenario.toml``."""
    values = {"extends": "..", "description": title[0].upper() + title[1:]}
    tables = {
        "roi": scenario_folder.roi_table(roi),
        "traffic": (
            "the city's, cut to this junction: egvs city traffic makes it",
            {
                "fcd": f"../../{TRAFFIC}/{its_id}.parquet",
                "roads": ROADS,
            },
        ),
        "statics": scenario_folder.statics_table(),
        "sites": scenario_folder.sites_table(),
    }
    return tomlkit.dumps(scenario_folder.toml([f"A junction of a city. {_SOURCE}"], values, tables))


def table(rows: Iterable[CityJunction]) -> str:
    """``junctions.csv``."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(model.table(tuple(rows)))
    return text.getvalue()


def counts_of(solids: Sequence[MappedSolid]) -> ImportCounts:
    """The objects of one junction, and where their heights are from."""
    counts = ImportCounts()
    for solid in solids:
        counts.keep(solid)
    return counts


def notes(larger: int, counts: ImportCounts) -> list[str]:
    """What to know before trusting a city of which so many junctions are larger than their regions."""
    found = scenario_folder.notes(True, counts)
    if larger:
        found.append(
            f"{larger} junctions are larger than their regions of interest ({junctions.ROI_MOST_M:g} m at most)"
        )
    return found
