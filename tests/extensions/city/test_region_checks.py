"""Junctions of a city that cannot be ranked."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from egvs.core.grid import Roi
from egvs.extensions.city.region_checks import RegionChecks, empty_regions
from egvs.scenario.loading import load
from egvs.traffic.fcd import FrameGroup, FrameWindow
from egvs.traffic.locks import Teleport
from egvs.traffic.network import read_net_xml
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics
from egvs.traffic.vehicle_boxes import VehicleBoxes, VehicleSize, boxes_from_bumpers

REGIONS = {
    "west": Roi((0.0, 0.0, 0.0), (10.0, 10.0, 5.0)),
    "east": Roi((100.0, 0.0, 0.0), (10.0, 10.0, 5.0)),
}
NET = """<net>
  <edge id="a" from="s" to="W" name="Main Street"><lane id="a_0" index="0" length="5" shape="0,5 5,5"/></edge>
  <junction id="W" type="priority" x="5" y="5" shape="4,4 6,4 6,6"/>
</net>"""


def recording(**keys: Any) -> Recording:
    """A recording of a frame every 2 s, from 100 s on."""
    window = FrameWindow(1000, 2000, 100_000, complete=True)
    return Recording(rows=(), window=window, sizes={}, where="city.toml: traffic", **keys)


def standing(**vehicles: tuple[int, float]) -> TrafficStatistics:
    """Vehicles that stand since a frame at an x."""
    statistics = TrafficStatistics(1000)
    statistics.standing_since = {name: since for name, (since, _) in vehicles.items()}
    statistics.standing_at_m = {name: (x_m, 5.0) for name, (_, x_m) in vehicles.items()}
    return statistics


def frames_until(end: int, x_m: tuple[float, ...] = ()) -> VehicleBoxes:
    """The last frame before an end, with vehicles whose front bumpers are at some x and at y 5 m, heading east."""
    rows = pa.table(
        {
            "id": [f"v{i}" for i in range(len(x_m))],
            "type": pa.array(["car"] * len(x_m), pa.string()),
            "x": pa.array(x_m, pa.float64()),
            "y": pa.array([5.0] * len(x_m), pa.float64()),
            "z": pa.array([0.0] * len(x_m), pa.float64()),
            "angle": pa.array([90.0] * len(x_m), pa.float64()),
            "slope": pa.array([0.0] * len(x_m), pa.float64()),
            "speed": pa.array([0.0] * len(x_m), pa.float64()),
        }
    )
    group = FrameGroup(end - 1, 1, np.full(len(x_m), end - 1), rows)
    return boxes_from_bumpers(group, {"car": VehicleSize(4.0, 2.0, 1.5, "passenger")}, 2.0, "fcd.csv")


@pytest.mark.parametrize(("since", "locked"), [(49, ["west"]), (50, [])])
def test_vehicle_that_stands_for_300_s_locks_its_region(since: int, locked: list[str]) -> None:
    checks = RegionChecks(REGIONS, recording())
    checks.add_frames(frames_until(200), standing(a=(since, 5.0), b=(0, 50.0)))  # b stands between the regions
    assert list(checks.locked) == locked
    if locked:
        assert (
            checks.locked["west"] == "its traffic is locked: vehicle 'a' stood at x 5 m, y 5 m for 300 s, from 198 s on"
        )


def test_long_signal_cycles_need_longer_stands(tmp_path: Path) -> None:
    (tmp_path / "net.xml").write_text(NET)
    roads = read_net_xml(tmp_path / "net.xml")
    object.__setattr__(roads, "cycle_s", 200.0)
    checks = RegionChecks(REGIONS, recording(roads=roads))
    checks.add_frames(frames_until(200), standing(a=(0, 5.0)))  # 398 s
    assert not checks.locked
    checks.add_frames(frames_until(201), standing(a=(0, 5.0)))
    assert "junction W, Main Street (x 5 m, y 5 m) for 400 s" in checks.locked["west"]


def test_planned_stop_is_no_lock() -> None:
    checks = RegionChecks(REGIONS, recording(stopped_on_purpose={"a"}))
    checks.add_frames(frames_until(900), standing(a=(0, 5.0)))
    assert not checks.locked


@pytest.mark.parametrize(("teleports", "vehicles", "locked"), [(10, 199, True), (10, 200, False), (9, 20, False)])
def test_region_with_many_teleports_is_locked(tmp_path: Path, teleports: int, vehicles: int, locked: bool) -> None:
    (tmp_path / "net.xml").write_text(NET)
    moved = [Teleport(f"v{i}", "yield", "a_0", 150.0) for i in range(teleports)]
    checks = RegionChecks(REGIONS, recording(roads=read_net_xml(tmp_path / "net.xml"), teleports=lambda: moved))
    checks.check_teleports({"west": vehicles, "east": vehicles})
    assert list(checks.locked) == (["west"] if locked else [])
    if locked:
        assert checks.locked["west"] == (
            "its traffic is locked: 10 of 199 vehicles had to be moved on, 10 of them at junction W, Main Street"
        )


def test_watched_regions_are_not_checked_again(tmp_path: Path) -> None:
    (tmp_path / "net.xml").write_text(NET)
    moved = [Teleport(f"v{i}", "yield", "a_0", 150.0) for i in range(100)]
    roads = read_net_xml(tmp_path / "net.xml")
    watched = recording(roads=roads, teleports=lambda: moved, locked={"east": "vehicle 'a' stood at junction W"})
    checks = RegionChecks(REGIONS, watched)
    checks.add_frames(frames_until(900), standing(a=(0, 5.0)))
    checks.check_teleports({"west": 100, "east": 100})
    assert checks.locked == {"east": "its traffic is locked: vehicle 'a' stood at junction W"}


def test_counts_vehicles_whose_centres_are_in_region() -> None:
    checks = RegionChecks(REGIONS, recording())
    for end in (1, 2):
        checks.add_frames(frames_until(end, (2.0, 11.9, 12.1, 107.0)), standing())  # centres 0, 9.9, 10.1 and 105
    assert checks.vehicles == {"west": 4, "east": 2}


@pytest.mark.parametrize(("rank_by", "empty"), [("expected_detections", ["east"]), ("egvs", [])])
def test_region_without_vehicles_has_no_ranking_by_detections(mini: Path, rank_by: str, empty: list[str]) -> None:
    scenario = load(mini, [f"score.rank_by={rank_by}"])
    reasons = empty_regions({"west": 0.02, "east": 0.01}, {"west": scenario, "east": scenario})
    assert list(reasons) == empty
    if empty:
        assert reasons["east"] == "only 0.01 vehicles are in its region of interest at a time (at least 0.02)"
