"""The junctions of the study, their roles, and their sites.

*Training* junctions are used for choices (gamma, the best score, a detector's weights); *held-out* junctions are used
for the reported results; the *unseen* junction was first evaluated after all choices were made, and is reported for the
recommended score. Junctions from OpenStreetMap are made from extracts that the user names, since none is shipped;
without them the study uses the others, and its tables say so.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.validity import poses
from egvs.core import files
from egvs.core.errors import InputError
from egvs.creation import new_scenario
from egvs.runs.run import ensure_stages
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario, SitesConfig
from egvs.sensors.sites import Site
from egvs.traffic import network, sumo_folder
from egvs.world.carriageway import Carriageway

Role = Literal["training", "held out", "unseen"]
ROLES: tuple[Role, ...] = ("training", "held out", "unseen")

SHIPPED: dict[str, Role] = {
    "ingolstadt": "training",
    "hill": "training",
    "roundabout": "training",
    "nishishinjuku": "held out",
}
OSM: dict[Role, str] = {"training": "osm_training", "held out": "osm_held_out", "unseen": "osm_unseen"}
"""Names of junctions from OpenStreetMap."""

APART_M = 700.0
"""Smallest distance between junctions from OpenStreetMap of different roles: twice the surroundings of one."""

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"


@dataclass(frozen=True)
class StudyJunction:
    """A junction of the study.

    Attributes
    ----------
    given, grid
        Its own upright sites, and those of :mod:`benchmarks.validity.poses`.
    """

    name: str
    role: Role
    scenario: Scenario
    given: tuple[Site, ...]
    grid: tuple[Site, ...]


def shipped(names: Sequence[str] = ()) -> list[tuple[str, Role, Path]]:
    """Return the shipped scenarios of the study, and their folders."""
    return [
        (n, role, SCENARIOS / n) for n, role in SHIPPED.items() if (SCENARIOS / n).is_dir() and n in (names or (n,))
    ]


def from_osm(role: Role, extract: Path, at: tuple[float, float] | None, folder: Path) -> tuple[str, Role, Path]:
    """Return the scenario made from an extract, in a folder of the study; it is made once per extract and location."""
    name = OSM[role]
    scenario_folder, note = folder / name, folder / f"{name}.json"
    if not extract.is_file():
        raise InputError(_option(role), f"no such file ({extract})", "Give an OpenStreetMap extract.")
    key = files.canonical_json({"extract": files.hash_file(extract), "at": at})
    if not (scenario_folder.is_dir() and note.is_file() and note.read_bytes() == key):
        if scenario_folder.is_dir():
            raise InputError(scenario_folder, "was made from another extract or location", "Remove it.")
        folder.mkdir(parents=True, exist_ok=True)
        new_scenario.create_scenario(scenario_folder, extract, at)
        note.write_bytes(key)
    return name, role, scenario_folder


def check_unseen(scenario: Scenario) -> None:
    """Reject traffic that scores and detectors would share.

    Raises
    ------
    InputError
        For traffic that is a finished file.
    """
    if scenario.is_recorded:
        problem = "the traffic is a finished file, so scores and detectors would use the same frames"
        raise InputError(
            f"{scenario.file}: traffic.fcd", problem, "Use a network, whose traffic can have another seed."
        )


def check_apart(folders: Sequence[tuple[str, Role, Path]]) -> None:
    """Reject two junctions from OpenStreetMap whose surroundings may overlap.

    Raises
    ------
    InputError
        For regions of interest nearer than :data:`APART_M`.
    """
    places = [(role, _on_map(scenario_folder)) for name, role, scenario_folder in folders if name in OSM.values()]
    for (first, one), (second, other) in itertools.combinations(places, 2):
        away_m = math.hypot(one[1] - other[1], one[2] - other[2])
        if one[0] == other[0] and away_m < APART_M:
            problem = f"expected at least {APART_M:g} m to the junction of {_option(first)}, got {away_m:.0f} m"
            raise InputError(_option(second), problem, "Use another junction.")


def _option(role: Role) -> str:
    return f"--osm-{role.replace(' ', '-')}"


def _on_map(scenario_folder: Path) -> tuple[str, float, float]:
    """Return the projection of a scenario from OpenStreetMap, and the position of its region of interest, in metres."""
    scenario = load(scenario_folder)
    location = network.read_location(scenario_folder / "network.net.xml")
    assert location is not None, "netconvert says where a map's network lies"
    x, y, _ = scenario.roi.center_m
    return location.projection, x - location.offset_m[0], y - location.offset_m[1]


def ready(name: str, role: Role, scenario_folder: Path, folder: Path, places: int = poses.PLACES) -> StudyJunction:
    """Return a junction with its sites: its own upright ones, and the grid.

    Parameters
    ----------
    folder
        For the static world, from the store where it is there.
    """
    scenario = load(scenario_folder)
    folder.mkdir(parents=True, exist_ok=True)
    work = open_folder(scenario, folder)
    ensure_stages(work, "statics")
    scene = work.scene
    given = tuple(site for site in scene.sites if site.pose.pitch_deg == site.pose.roll_deg == 0.0 and not site.points)
    roads = sumo_folder.read_network(scenario)
    carriageway = None if roads is None else Carriageway.of(roads)
    grid = poses.grid_poses(scene, carriageway, scenario.sites.sensor, places)
    return StudyJunction(name, role, scenario, given, grid)


def with_sites(scenario: Scenario, sites: Sequence[Site], file: Path, sensor: str | None = None) -> Scenario:
    """Return the scenario with these sites, written as CSV; all with another sensor if one is given."""
    with files.atomic_write(file) as partial, partial.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor"])
        for site in sites:
            rows.writerow(
                [site.name, *map(repr, (*site.pose.position_m, *site.pose.angles_deg)), sensor or site.sensor]
            )
    model = SitesConfig(file=str(file.resolve()), sensor=sensor or scenario.sites.sensor)
    return scenario.model_copy(update={"sites": model})
