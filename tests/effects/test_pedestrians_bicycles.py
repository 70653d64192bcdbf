"""Pedestrians and bicycles, simulated by SUMO."""

import itertools
import re
import shutil
import subprocess
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.artefacts.frame_boxes import PITCHED_BOX_COLUMNS, FrameBoxes
from egvs.core.grid import Grid, Roi
from egvs.effects import pedestrians_bicycles
from egvs.scoring import occupancy
from egvs.stages import traffic
from egvs.traffic import sumo
from tests.effects.road_helpers import (
    CROWD,
    SMALL,
    read_rows,
    road_scenario,
    run_and_read,
)
from tests.stage_runner import run_stage


@pytest.fixture
def retry_connecting(monkeypatch):
    """A SUMO that was just started listens a moment later."""
    connect = sumo._connect

    def until_it_listens(host, port):
        return next(filter(None, (connect(host, port) for _ in range(200_000))), None)

    monkeypatch.setattr(sumo, "_connect", until_it_listens)


def kind_rows(r, *kinds):
    return {name: values[np.isin(r["kind"], kinds)] for name, values in r.items()}


def test_number_of_motor_vehicles_is_constant_with_bicycles(hill_run):
    result, r, _ = hill_run
    motor = (~np.isin(r["kind"], ["bicycle", "pedestrian"])) & (r["part"] == 0)
    assert Counter(r["frame"][motor].tolist()) == dict.fromkeys(range(240), 6)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 6
    extra = result["beside_vehicles"]
    assert extra["bicycle"]["fewest"] < extra["bicycle"]["most"] and extra["pedestrian"]["most"] > 5
    assert result["collisions"] == 0


@pytest.mark.slow
def test_every_bicycle_trip_starts_on_time(flat_road, tmp_path):
    scene = road_scenario(
        flat_road,
        {"pedestrians_bicycles": {"bicycles_per_h": 720}},
        **SMALL | {"warmup_s": 0.0, "frames": 600, "hold": "at_most"},
    )
    run_stage(traffic, scene, tmp_path)
    r = kind_rows(read_rows(tmp_path), "bicycle")
    drawn = [
        float(t)
        for line in (tmp_path / "sumo" / "others.rou.xml").read_text().splitlines()
        if "<vehicle" in line
        for t in re.findall(r'jumpUntil="([\d.]+)"', line)
    ]
    drawn = [t for t in drawn if t < 149]
    starts = 0
    for name in set(r["vehicle"]):
        frame = r["frame"][r["vehicle"] == name]
        x = r["x_m"][r["vehicle"] == name]
        jumps = (np.diff(frame) > 1) | (np.abs(np.diff(x)) > 10)
        starts += int(jumps.sum()) + 1
    slots = len(set(r["vehicle"]))
    assert len(drawn) == pytest.approx(720 * 150 / 3600, abs=1)
    assert len(drawn) <= starts <= len(drawn) + slots  # and each vehicle is seen for a moment where it first stands


@pytest.mark.slow
def test_pedestrians_walk_on_sidewalks_in_their_direction(hill_run):
    _, r, out = hill_run
    people = kind_rows(r, "pedestrian")
    east = np.abs(people["yaw_rad"]) < 1e-6
    on_lane = (people["x_m"] > 20) & (people["x_m"] < 130)
    assert np.all((np.abs(people["y_m"][on_lane]) > 4.6) & (np.abs(people["y_m"][on_lane]) < 6.8))
    for name in sorted(set(people["vehicle"][east & on_lane]))[:5]:
        mine = (people["vehicle"] == name) & on_lane
        assert np.all(np.diff(people["x_m"][mine]) >= -1e-6)
    assert {(0.8, 0.6, 1.73)} == set(zip(people["length_m"], people["width_m"], people["height_m"], strict=True))
    moved = out / "sumo"
    flags = [
        "--fcd-output",
        "all.xml",
        "--person-fcd-output",
        "again.xml",
        "--fcd-output.attributes",
        "id,x,y,z,angle,type",
        "--precision",
        "8",
    ]
    sumo.run_program("sumo", ["-c", "run.sumocfg", *flags], moved)
    text = (moved / "again.xml").read_text()
    step = re.search(r'<timestep time="90\.0+">(.*?)</timestep>', text, re.S)
    front = {
        m[1]: (float(m[2]), float(m[3]))
        for m in re.finditer(r'<person id="([^"]+)" x="([-\d.]+)" y="([-\d.]+)"[^>]*angle="90\.0', step[1])
    }
    first = {
        n: (x, y)
        for n, x, y, f in zip(people["vehicle"], people["x_m"], people["y_m"], people["frame"], strict=True)
        if f == 0
    }
    assert len(front) > 2
    for name, (x, y) in front.items():
        assert first[name] == pytest.approx((x - 0.4, y), abs=1e-6)


@given(length_m=st.floats(0.2, 500), before_m=st.floats(0, 20))
def test_stop_is_within_the_lane_for_any_length(length_m: float, before_m: float) -> None:
    """SUMO refuses a stop that ends beyond the lane's end (175.53 of 175.526 m) or is shorter than 0.1 m."""
    end_m = max(length_m - before_m, length_m / 2)
    stop = pedestrians_bicycles._stop(pedestrians_bicycles._BicycleLane("lane", length_m), end_m - 12.0, end_m, 1.0)
    first, last = (float(re.search(f'{key}="([^"]*)"', stop)[1]) for key in ("startPos", "endPos"))
    assert 0 <= first <= last - 0.1 + 1e-9
    assert last <= length_m
    assert last == pytest.approx(end_m, abs=0.0101)


def test_bicycles_ride_on_bicycle_lanes_with_their_size(hill_run):
    riders = kind_rows(hill_run[1], "bicycle")
    on_lane = (riders["x_m"] > 170) & (riders["x_m"] < 430)
    assert on_lane.sum() > 100
    assert np.all((np.abs(riders["y_m"][on_lane]) > 3.1) & (np.abs(riders["y_m"][on_lane]) < 4.8))
    assert {(1.76, 0.6, 1.73)} == set(zip(riders["length_m"], riders["width_m"], riders["height_m"], strict=True))


def test_people_never_lower_occupancy_counts(hill_run):
    """With the same vehicles, each person and bicycle can only add: the monotonic truth of this effect."""
    grid = Grid.over(Roi.around((100, 0, 10), (60, 40, 20)), 0.5)
    counts = []
    for kinds in ([], ["bicycle"], ["bicycle", "pedestrian"]):
        r = hill_run[1]
        remaining = ~np.isin(r["kind"], ["bicycle", "pedestrian"]) | np.isin(r["kind"], kinds)
        values = np.column_stack([r[name][remaining] for name in PITCHED_BOX_COLUMNS])
        values[:, :3] = grid.to_grid_m(values[:, :3])
        counts.append(occupancy.count_occupancy(FrameBoxes(r["frame"][remaining].astype(np.int64), values), grid, 240))
    assert all(np.all(more >= less) and more.sum() > less.sum() for less, more in itertools.pairwise(counts))


@pytest.mark.slow
def test_higher_rates_add_more_people(flat_road, tmp_path):
    means = []
    for rate in (0, 200, 1000):
        scene = road_scenario(
            flat_road, {"pedestrians_bicycles": {"pedestrians_per_h": rate, "bicycles_per_h": 100}}, **SMALL
        )
        run_stage(traffic, scene, tmp_path)
        means.append(np.count_nonzero(read_rows(tmp_path)["kind"] == "pedestrian"))
    assert means[0] == 0 < means[1] < means[2]


@pytest.mark.slow
def test_same_seed_gives_the_same_people_also_over_traci(hill_road, hill_run, tmp_path, retry_connecting):
    from sumolib.miscutils import getFreeSocketPort

    scene = road_scenario(hill_road, {"articulated": {}, **CROWD}, **SMALL)
    assert run_and_read(scene, tmp_path / "again")[1] == (hill_run[2] / "trajectories.parquet").read_bytes()
    port, quiet = getFreeSocketPort(), subprocess.DEVNULL
    command = [str(sumo.sumo_binary("sumo")), "-c", "run.sumocfg", "--remote-port", str(port)]
    with subprocess.Popen(
        command, cwd=tmp_path / "again" / "sumo", env=sumo.sumo_environment(), stdout=quiet, stderr=quiet
    ) as process:
        try:
            run_stage(traffic, scene, tmp_path / "polled", traci=("localhost", port))
        finally:
            process.kill()
    one, other = read_rows(tmp_path / "again"), read_rows(tmp_path / "polled")
    assert all(np.array_equal(one[name], other[name]) for name in one)


def write_user_demand(flat_road, folder):
    """Write a route file with vehicles and one pedestrian."""
    shutil.copy(flat_road / "road.net.xml", folder)
    trips = "".join(f'<trip id="{i}" depart="{2 * i}" from="ab" to="cd"/>' for i in range(80))
    person = '<person id="own" depart="0"><walk from="ab" to="cd"/></person>'
    (folder / "own.rou.xml").write_text(f"<routes>{person}{trips}</routes>")
    keys = {k: v for k, v in SMALL.items() if k not in ("trips_per_s", "kinds")}
    return keys | {"routes": ["own.rou.xml"], "vehicles": 4, "hold": "at_most"}


@pytest.mark.slow
def test_people_are_added_to_user_routes(flat_road, tmp_path):
    keys = write_user_demand(flat_road, tmp_path)
    result = run_stage(traffic, road_scenario(tmp_path, CROWD, **keys), tmp_path / "out")
    assert result["vehicles"]["most"] == 4 and result["vehicles"]["fewest"] >= 3
    assert set(result["beside_vehicles"]) == {"bicycle", "pedestrian", "overlapping_pairs"}
    assert "own" in read_rows(tmp_path / "out")["vehicle"]


@pytest.mark.slow
def test_persons_of_user_routes_do_not_count_as_vehicles(flat_road, tmp_path):
    """Without a file of their own, SUMO writes persons among the vehicles."""
    result = run_stage(traffic, road_scenario(tmp_path, **write_user_demand(flat_road, tmp_path)), tmp_path / "out")
    assert result["vehicles"]["most"] == 4
    assert set(read_rows(tmp_path / "out")["kind"]) == {"passenger"}
