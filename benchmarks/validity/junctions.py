"""The junctions of the study, what each is there for, and its sites.

*Training* junctions may choose (gamma, the best score, a detector's weights); *held-out* ones are what is quoted; the
*unseen* one was not looked at before all was chosen and answered, and is quoted for the score that came of it.
Junctions from OpenStreetMap are made from extracts that the user names, since none is shipped; without them the study
runs on the others, and its tables say so.
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
from egvs.importers import openstreetmap
from egvs.runs.run import ensure_stages
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario, SitesConfig
from egvs.sensors.sites import Site
from egvs.stages.inputs import get_scene, open_folder
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
"""What junctions from OpenStreetMap are called."""

APART_M = 700.0
"""Between junctions from OpenStreetMap of different roles, at least: twice what is seen round one."""

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
    """The scenarios of this project that the study looks at, and their folders."""
    return [
        (n, role, SCENARIOS / n) for n, role in SHIPPED.items() if (SCENARIOS / n).is_dir() and n in (names or (n,))
    ]


def from_osm(role: Role, extract: Path, at: tuple[float, float] | None, folder: Path) -> tuple[str, Role, Path]:
    """The scenario made from an extract, in a folder of the study; made once for the same extract and place."""
    name = OSM[role]
    home, note = folder / name, folder / f"{name}.json"
    if not extract.is_file():
        raise InputError(_option(role), f"no such file ({extract})", "an OpenStreetMap extract")
    key = files.canonical_json({"extract": files.hash_file(extract), "at": at})
    if not (home.is_dir() and note.is_file() and note.read_bytes() == key):
        if home.is_dir():
            raise InputError(home, "is of another extract or place", "to remove it, so that it is made anew")
        folder.mkdir(parents=True, exist_ok=True)
        openstreetmap.create_scenario(home, extract, at)
        note.write_bytes(key)
    return name, role, home


def check_unseen(scenario: Scenario) -> None:
    """Refuse traffic that scores and detectors would share.

    Raises
    ------
    InputError
        For traffic that is a finished file.
    """
    if scenario.is_recorded:
        found = "the traffic is a finished file: scores and detectors would see the same"
        raise InputError(f"{scenario.file}: traffic.fcd", found, "a network, whose traffic has another seed")


def check_apart(homes: Sequence[tuple[str, Role, Path]]) -> None:
    """Refuse two junctions from OpenStreetMap whose surroundings may meet.

    Raises
    ------
    InputError
        For regions of interest nearer than :data:`APART_M`.
    """
    places = [(role, _on_map(home)) for name, role, home in homes if name in OSM.values()]
    for (first, one), (second, other) in itertools.combinations(places, 2):
        away_m = math.hypot(one[1] - other[1], one[2] - other[2])
        if one[0] == other[0] and away_m < APART_M:
            found = f"{away_m:.0f} m from the junction of {_option(first)}"
            raise InputError(_option(second), found, f"one at least {APART_M:g} m from it, which nothing was chosen on")


def _option(role: Role) -> str:
    return f"--osm-{role.replace(' ', '-')}"


def _on_map(home: Path) -> tuple[str, float, float]:
    """The projection of a scenario from OpenStreetMap, and where its region of interest is in it, in metres."""
    scenario = load(home)
    location = network.read_location(home / "network.net.xml")
    assert location is not None, "netconvert says where a map's network lies"
    x, y, _ = scenario.roi.center_m
    return location.projection, x - location.offset_m[0], y - location.offset_m[1]


def ready(name: str, role: Role, home: Path, folder: Path, places: int = poses.PLACES) -> StudyJunction:
    """A junction with its sites: its own upright ones, and the grid.

    Parameters
    ----------
    folder
        For the static world, from the store where it is there.
    """
    scenario = load(home)
    folder.mkdir(parents=True, exist_ok=True)
    work = open_folder(scenario, folder)
    ensure_stages(work, "statics")
    scene = get_scene(work)
    given = tuple(site for site in scene.sites if site.pose.pitch_deg == site.pose.roll_deg == 0.0 and not site.points)
    roads = sumo_folder.read_network(scenario)
    carriageway = None if roads is None else Carriageway.of(roads)
    grid = poses.grid_poses(scene, carriageway, scenario.sites.sensor, places)
    return StudyJunction(name, role, scenario, given, grid)


def posed(scenario: Scenario, sites: Sequence[Site], file: Path, sensor: str | None = None) -> Scenario:
    """The scenario with these sites, written as a CSV; all with another sensor where one is named."""
    with files.atomic_write(file) as partial, partial.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor"])
        for site in sites:
            rows.writerow(
                [site.name, *map(repr, (*site.pose.position_m, *site.pose.angles_deg)), sensor or site.sensor]
            )
    model = SitesConfig(file=str(file.resolve()), sensor=sensor or scenario.sites.sensor)
    return scenario.model_copy(update={"sites": model})
