"""Junctions of a city whose traffic locks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.city.region_locks import RegionLocks
from egvs.core.grid import Roi
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.locks import Teleport
from egvs.traffic.network import read_net_xml
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics

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


@pytest.mark.parametrize(("since", "locked"), [(49, ["west"]), (50, [])])
def test_vehicle_that_stands_for_300_s_locks_its_region(since: int, locked: list[str]) -> None:
    locks = RegionLocks(REGIONS, recording())
    locks.add(standing(a=(since, 5.0), b=(0, 50.0)), 200)  # b stands between the regions
    assert list(locks.found) == locked
    if locked:
        assert (
            locks.found["west"] == "its traffic is locked: vehicle 'a' stood at x 5 m, y 5 m for 300 s, from 198 s on"
        )


def test_long_signal_cycles_need_longer_stands(tmp_path: Path) -> None:
    (tmp_path / "net.xml").write_text(NET)
    roads = read_net_xml(tmp_path / "net.xml")
    object.__setattr__(roads, "cycle_s", 200.0)
    locks = RegionLocks(REGIONS, recording(roads=roads))
    locks.add(standing(a=(0, 5.0)), 200)  # 398 s
    assert not locks.found
    locks.add(standing(a=(0, 5.0)), 201)
    assert "junction W, Main Street (x 5 m, y 5 m) for 400 s" in locks.found["west"]


def test_planned_stop_is_no_lock() -> None:
    locks = RegionLocks(REGIONS, recording(stopped_on_purpose={"a"}))
    locks.add(standing(a=(0, 5.0)), 900)
    assert not locks.found


@pytest.mark.parametrize(("teleports", "vehicles", "locked"), [(10, 199, True), (10, 200, False), (9, 20, False)])
def test_region_with_many_teleports_is_locked(tmp_path: Path, teleports: int, vehicles: int, locked: bool) -> None:
    (tmp_path / "net.xml").write_text(NET)
    moved = [Teleport(f"v{i}", "yield", "a_0", 150.0) for i in range(teleports)]
    locks = RegionLocks(REGIONS, recording(roads=read_net_xml(tmp_path / "net.xml"), teleports=moved))
    locks.add_teleports({"west": vehicles, "east": vehicles})
    assert list(locks.found) == (["west"] if locked else [])
    if locked:
        assert locks.found["west"] == (
            "its traffic is locked: 10 of 199 vehicles had to be moved on, 10 of them at junction W, Main Street"
        )


def test_region_without_vehicles_is_left_out() -> None:
    """In 100 frames, two vehicles are in the west and one is in the east."""
    locks = RegionLocks(REGIONS, recording())
    locks.add_boxes(np.array([0.0, 10.0, 105.0, 50.0]), np.array([0.0, 10.0, 5.0, 5.0]))
    locks.add_empty(["west", "east"], 100)
    assert locks.found == {"east": "only 0.01 vehicles are in its region of interest at a time (at least 0.02)"}
