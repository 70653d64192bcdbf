"""Build the scenarios of the study, draw their candidates, and look at their traffic in a short simulation."""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from benchmarks.across_junctions.candidates import draw_candidates
from benchmarks.across_junctions.protocol import FOLDER, WORLDS_FILE, Junction, Protocol
from benchmarks.across_junctions.worlds import BASE, WITH_TABLES, make_world
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core import files
from egvs.core.errors import EgvsError, InputError
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.runs.run import ensure_stages
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario
from egvs.sensors.sites import Site
from egvs.traffic import sumo_folder
from egvs.world.carriageway import Carriageway

TRIAL_FRAMES, TRIAL_APART_S = 40, 7.0
"""Traffic that is looked at: 280 s after the warm-up."""

QUEUE_GAP_M = 1.6
"""Vehicles whose boxes are nearer than this to another one count as dense."""


@dataclass(frozen=True)
class BuiltJunction:
    """A scenario that was made, or the reason why not.

    Attributes
    ----------
    digest
        Of the files of the scenario.
    candidates
        With their heights above the ground in metres.
    vehicles
        Mean number in the region of interest.
    different
        Different vehicles there in the trial.
    dense
        Share of vehicle-frames with another vehicle nearer than :data:`QUEUE_GAP_M`.
    problem
        Why it is not complete; empty where it is.
    """

    junction: Junction
    digest: str = ""
    candidates: Mapping[Site, float] | None = None
    vehicles: float = float("nan")
    different: int = 0
    dense: float = float("nan")
    problem: str = ""


def build(protocol: Protocol, junction: Junction, maps: Path | None, folder: Path) -> BuiltJunction:
    """Make a scenario, draw its candidates, and simulate its traffic for a short time."""
    try:
        scenario_folder = make_world(protocol, junction, maps, folder)
        digest = world_digest(scenario_folder)
        scenario = load(scenario_folder)
        candidates = candidates_of(protocol, junction, scenario, folder)
        vehicles, different, dense = _traffic(scenario, folder)
    except EgvsError as error:
        return BuiltJunction(junction, problem=str(error))
    problem = "" if vehicles >= 1.0 else f"only {vehicles:.1f} vehicles in the region on average"
    return BuiltJunction(junction, digest, candidates, vehicles, different, dense, problem)


def candidates_of(protocol: Protocol, junction: Junction, scenario: Scenario, folder: Path) -> dict[Site, float]:
    """Draw the candidates of a junction whose scenario was made, with their heights above the ground in metres."""
    with tempfile.TemporaryDirectory(prefix=".work-", dir=_existing(folder)) as temporary:
        work = open_folder(scenario, Path(temporary))
        ensure_stages(work, "statics")
        scene = work.scene
        roads = sumo_folder.read_network(scenario)
        return draw_candidates(protocol, junction, scene, None if roads is None else Carriageway.of(roads))


def _existing(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _traffic(scenario: Scenario, folder: Path) -> tuple[float, int, float]:
    """Return mean number of vehicles in the region, number of different ones, and share that is dense."""
    with tempfile.TemporaryDirectory(prefix=".work-", dir=_existing(folder)) as temporary:
        held_out = prepare_held_out_traffic(scenario, Path(temporary), TRIAL_FRAMES, apart_s=TRIAL_APART_S)
        frames = list(held_out.read())
        rows = [frame.target_rows(held_out.scene.roi) for frame in frames]
        dense = [is_dense(frame, targets) for frame, targets in zip(frames, rows, strict=True)]
        each = np.concatenate(dense)
        return (
            float(np.mean([len(targets) for targets in rows])),
            len(held_out.vehicles_in_region(frames)),
            float(each.mean()) if len(each) else float("nan"),
        )


def is_dense(frame: TrafficFrame, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each of these vehicles whether another one is nearer than :data:`QUEUE_GAP_M` in plan, (n,) bool."""
    if not len(rows):
        return np.zeros(0, dtype=np.bool_)
    outlines = [
        affinity.translate(affinity.rotate(shapely.box(-length / 2, -width / 2, length / 2, width / 2),
                                           yaw, use_radians=True), x, y)
        for x, y, _, length, width, _, yaw in frame.boxes.tolist()
    ]  # fmt: skip
    names = np.array(frame.vehicles, dtype=np.str_)
    tree = shapely.STRtree(outlines)
    pairs = tree.query([outlines[row] for row in rows], "dwithin", distance=QUEUE_GAP_M)
    others = (names[rows[pairs[0]]] != names[pairs[1]]) & frame.are_vehicles()[pairs[1]]
    dense = np.zeros(len(rows), dtype=np.bool_)
    dense[pairs[0][others]] = True
    return dense


def print_table(built: Sequence[BuiltJunction], report: Callable[[str], None] = print) -> None:
    """Print one row per junction."""
    report("junction         role        vehicles  different  dense   candidates  by height")
    for entry in built:
        if entry.candidates is None:
            report(f"{entry.junction.name:16} {entry.junction.role:11} {entry.problem}")
            continue
        heights = sorted(set(entry.candidates.values()))
        by_height = ", ".join(f"{list(entry.candidates.values()).count(h)} at {h:g} m" for h in heights)
        report(
            f"{entry.junction.name:16} {entry.junction.role:11} {entry.vehicles:8.1f} {entry.different:10d}"
            f" {100 * entry.dense:5.0f} % {len(entry.candidates):11d}  {by_height} {entry.problem}".rstrip()
        )
    report(
        f"vehicles: in the region, mean of {TRIAL_FRAMES} frames {TRIAL_APART_S:g} s apart; dense: nearer than"
        f" {QUEUE_GAP_M} m to another vehicle"
    )


_TABLES = ("seed", "roi", "traffic", "statics", "effects", "sensors")
"""Tables and keys of a scenario on which detection depends. Candidates are listed elsewhere."""

_OTHER_FILES = ("scenario.toml", "sites.csv", "zones.geojson", "README.md")


def world_digest(scenario_folder: Path) -> str:
    """Return the hash of a scenario: of its tables, without defaults, and of its files; its base scenario included."""
    folders = [scenario_folder]
    if scenario_folder.name == WITH_TABLES:
        folders.append(scenario_folder.parent / BASE)
    values = load(scenario_folder).model_dump(mode="json", exclude_defaults=True)
    inputs = {
        f"{folder.name}/{path.relative_to(folder).as_posix()}": files.hash_file(path)
        for folder in folders
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in _OTHER_FILES
    }
    return files.hash_json({"tables": {name: values[name] for name in _TABLES if name in values}, "files": inputs})


def write_worlds(digests: Mapping[str, str], folder: Path = FOLDER) -> None:
    """Write the hash of each scenario by the name of its junction."""
    with files.atomic_write(folder / WORLDS_FILE) as partial, partial.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["junction", "sha256"])
        rows.writerows(digests.items())


def read_worlds(folder: Path = FOLDER) -> dict[str, str]:
    """Return the hash of each scenario by the name of its junction."""
    path = folder / WORLDS_FILE
    if not path.is_file():
        raise InputError(path, "no such file", "Write it with: python -m benchmarks.across_junctions build --write")
    with path.open(encoding="utf-8", newline="") as lines:
        return {row["junction"]: row["sha256"] for row in csv.DictReader(lines)}
