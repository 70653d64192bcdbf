"""Trajectories, statistics of the traffic, and its warnings."""

import json
import math
import re
import shutil
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import RunError
from egvs.core.grid import Roi
from egvs.stages import traffic
from egvs.traffic import network, sumo, trajectories, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.locks import DemandKey
from egvs.traffic.recording import Recording, demand_key
from egvs.traffic.trajectories import TrafficStatistics
from tests.stage_runner import run_stage
from tests.traffic.helpers import SIZES, SMALL, group_of, scenario, scenario_with_config


def test_every_frame_has_n_vehicles(recorded):
    result, table, _, _ = recorded
    assert Counter(table["frame"].to_pylist()) == dict.fromkeys(range(240), 12)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 12
    assert result["frames"] == 240
    assert result["vehicles"]["different"] == len(set(table["vehicle"].to_pylist())) > 12
    assert json.loads(json.dumps(result)) == result


def test_rows_are_sorted_and_rounded(recorded):
    _, table, metadata, _ = recorded
    keys = list(zip(*(table[c].to_pylist() for c in ("frame", "vehicle", "part")), strict=True))
    assert keys == sorted(keys)
    for name in ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad"):
        values = table[name].to_numpy()
        assert not np.signbit(values[values == 0]).any()
        digits = 9 if name.endswith("rad") else 6
        tidy = np.round(values, digits)
        assert np.all((values == tidy) | (values == np.pi))
    assert set(table["pitch_rad"].to_pylist()) == {0.0}
    assert np.array_equal(table["z_m"].to_numpy(), table["height_m"].to_numpy() / 2)
    assert set(table["kind"].to_pylist()) <= {"passenger", "delivery", "truck", "bus"}
    assert metadata["frames"] == 240 and metadata["seed"] == 1 and metadata["sumo"] == sumo.sumo_version()


def test_vehicles_stay_on_the_roads_and_do_not_jump(recorded):
    _, table, _, _ = recorded
    x, y, frame = (table[c].to_numpy() for c in ("x_m", "y_m", "frame"))
    vehicle = np.array(table["vehicle"].to_pylist())
    assert min(x.min(), y.min()) > 0 and max(x.max(), y.max()) < 120 + 90 + 120
    for name in set(vehicle):
        mine = vehicle == name
        assert np.array_equal(np.diff(frame[mine]), np.ones(mine.sum() - 1))
        assert np.hypot(np.diff(x[mine]), np.diff(y[mine])).max(initial=0) < 6  # 0.25 s at less than 24 m/s


@pytest.mark.slow
def test_rejects_permanent_jam(town, tmp_path):
    """All signals of the town stay red."""
    text = (town / "net.xml").read_text()
    red = [
        f'<tlLogic id="{name}" type="static" programID="red" offset="0">'
        f'<phase duration="60" state="{"r" * len(state)}"/></tlLogic>'
        for name, state in re.findall(r'<tlLogic id="([^"]+)".*?state="([^"]+)"', text, re.S)
    ]
    assert len(red) == 4
    scene = scenario_with_config(town, tmp_path / "in", f"<additional>{''.join(red)}</additional>")
    with pytest.raises(RunError, match=r"vehicles stand for more than 180 s up to the last frame, .* for 2\d\d s"):
        run_stage(traffic, scene, tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()
    assert not (tmp_path / "out" / "sumo" / "fcd.csv").exists()


@pytest.mark.slow
def test_rejects_more_vehicles_than_fit(town, tmp_path):
    keys = SMALL | {"vehicles": 200, "frames": 40}
    with pytest.raises(
        RunError, match=r"traffic: expected 200 vehicles in every frame, got them in 0 of 40 frames \(min \d+, max \d+;"
    ):
        run_stage(traffic, scenario(town, network="net.xml", **keys), tmp_path)
    result = run_stage(traffic, scenario(town, network="net.xml", **keys, hold="at_most"), tmp_path)
    assert 0 < result["vehicles"]["most"] < 200


@pytest.mark.slow
def test_rejects_traffic_without_vehicles(town, tmp_path):
    (tmp_path / "none.rou.xml").write_text("<routes/>")
    keys = SMALL | {"routes": ["none.rou.xml"], "hold": "at_most"}
    keys.pop("trips_per_s")
    shutil.copy(town / "net.xml", tmp_path)
    with pytest.raises(RunError, match=r"no vehicle of none\.rou\.xml is in any of 240 frames"):
        run_stage(traffic, scenario(tmp_path, network="net.xml", **keys), tmp_path / "out")


@pytest.mark.slow
def test_rejects_density_above_the_capacity_of_the_network(town, tmp_path):
    keys = {"network": "net.xml", "frames": 40, "warmup_s": 60.0, "vehicles_per_lane_km": 100.0}
    with pytest.raises(
        RunError, match=r"expected 4\d\d vehicles in every frame, got them in 0 of 40 frames.*vehicles_per_lane_km"
    ):
        run_stage(traffic, scenario(town, **keys), tmp_path)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((0, 4, 0), 0),  # bumper to bumper
        ((0, 3.99, 0), 1),
        ((2, 0, 0), 0),  # side by side
        ((1.99, 0, 0), 1),
        ((3, 0, 90), 1),  # its front bumper 1 m inside
        ((6, 0, 90), 0),
    ],
)
def test_overlap_of_two_cars(other, expected):
    x, y, angle = other
    if angle == 90:
        y -= 2  # level with the first car's middle
    rows = [(0, "a", "car", 0, 0, 0, 1), (0, "b", "car", x, y, angle, 1)]
    assert (
        len(trajectories.find_overlaps(vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")))
        == expected
    )


def test_vehicles_on_and_below_a_bridge_do_not_overlap():
    group = group_of([(0, "a", "car", 0, 0, 0, 1), (0, "b", "car", 0, 0, 90, 1)])
    raised = group.rows.set_column(5, "z", pa.array([0.0, 5.0]))
    assert (
        len(
            trajectories.find_overlaps(
                vehicle_boxes.boxes_from_bumpers(FrameGroup(0, 1, group.frame, raised), SIZES, 1.0, "place")
            )
        )
        == 0
    )


def footprint(boxes, i):
    cos, sin = math.cos(boxes.yaw_rad[i]), math.sin(boxes.yaw_rad[i])
    half_l, half_w = boxes.length_m[i] / 2 - 1e-3, boxes.width_m[i] / 2 - 1e-3
    corners = [(a * half_l, b * half_w) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return shapely.Polygon([(boxes.x_m[i] + cos * u - sin * v, boxes.y_m[i] + sin * u + cos * v) for u, v in corners])


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_overlaps_agree_with_polygons(seed):
    rng = np.random.default_rng(seed)
    rows = [
        (f, str(i), rng.choice(["car", "bus"]), rng.uniform(0, 25), rng.uniform(0, 25), rng.uniform(0, 360), 1)
        for f in range(3)
        for i in range(10)
    ]
    result = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")
    shapes = [footprint(result, i) for i in range(30)]
    expected = {
        (i, j)
        for i in range(30)
        for j in range(i)
        if result.frame[i] == result.frame[j] and shapes[i].intersection(shapes[j]).area > 1e-7
    }
    got = {(int(b), int(a)) for a, b in trajectories.find_overlaps(result)}
    for i, j in got ^ expected:  # a contact thinner than the polygons' own rounding may go either way
        assert shapes[i].distance(shapes[j]) < 1e-6
        assert shapes[i].intersection(shapes[j]).area < 1e-5


@pytest.mark.parametrize("spread_m", [10.0, 300.0, 1e8])
def test_overlaps_agree_with_all_pairs(spread_m):
    """Wherever vehicles are, those in neighbouring cells are found, and none of another frame."""
    rng = np.random.default_rng(7)
    near = rng.uniform(-spread_m, spread_m, (40, 2))
    places = np.concatenate([near, near + rng.uniform(-8, 8, (40, 2)), [[-spread_m, -spread_m], [spread_m, spread_m]]])
    rows = [
        (f, str(i), ["car", "bus"][i % 2], x, y, rng.uniform(0, 360), 1)
        for f in range(3)
        for i, (x, y) in enumerate(places.tolist())
    ]
    result = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")
    a, b = np.triu_indices(result.frame.size, 1)
    a, b = a[result.frame[a] == result.frame[b]], b[result.frame[a] == result.frame[b]]
    hit = trajectories._boxes_overlap(result, a, b)
    expected = set(zip(a[hit].tolist(), b[hit].tolist(), strict=True))
    got = [tuple(pair) for pair in trajectories.find_overlaps(result).tolist()]
    assert len(got) == len(set(got)) > 20
    assert set(got) == expected


def test_standing_is_followed_across_groups():
    counted = TrafficStatistics(6)
    for frames in ((0, 1), (2, 3), (4, 5)):
        rows = [(f, "still", "car", 0, 0, 0, 0.0) for f in frames]
        rows += [(f, "goes", "car", 50, 0, 0, 5.0 if f == 4 else 0.0) for f in frames]
        counted.add(vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place"))
    assert counted.standing_since == {"still": 0, "goes": 5}
    assert counted.longest_standing_frames == 5
    result = counted.to_json(0.5)
    assert result["vehicles"] == {"fewest": 2, "most": 2, "different": 2}
    assert result["longest_standing_s"] == 2.5
    assert result["share_standing"] == round(11 / 12, 4)


ROI = Roi.around((0, 0, 2.5), (50, 100, 5))


DEMAND = DemandKey("s.toml: traffic.counts (period evening)", "Lower per_hour of the counts.")


def recording_with(**keys):
    window = SimpleNamespace(period_ms=1000, count=300, first_ms=0)
    return Recording((), window, SIZES, "s.toml: traffic", **keys)


def statistics_of(rows, frames=300, on_purpose=frozenset()):
    tally = TrafficStatistics(frames, stopped_on_purpose=on_purpose)
    tally.add(vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place"))
    return tally


def test_warns_about_vehicle_standing_longer_than_a_signal_cycle():
    rows = [(f, "stuck", "car", 100, 62, 0, 0.0 if 10 <= f < 210 else 5.0) for f in range(300)]
    rows += [(f, "parked", "car", 0, 20 if f < 299 else 30, 0, 0.0) for f in range(300)]
    tally = statistics_of(rows, on_purpose={"parked"})
    (result,) = trajectories.traffic_warnings(tally, recording_with(standing_limit_s=180.0), ROI, DEMAND)
    assert result.rule == "standing" and not result.is_error
    assert (result.where, result.hint) == DEMAND
    assert result.problem == (
        "vehicle 'stuck' was standing for 199 s, longer than any usual red phase, at x 100 m, y 60 m (76 m from the"
        " region of interest), from 10 s on"
    )  # the box's centre
    assert tally.to_json(1.0)["longest_standing_s"] == 299
    short = statistics_of([row for row in rows if row[0] < 130])
    assert [
        d.rule for d in trajectories.traffic_warnings(short, recording_with(standing_limit_s=180.0), ROI, DEMAND)
    ] == ["standing"]
    brief = statistics_of([row for row in rows if row[0] < 100])
    assert trajectories.traffic_warnings(brief, recording_with(standing_limit_s=180.0), ROI, DEMAND) == []
    assert (
        trajectories.traffic_warnings(tally, recording_with(), ROI, DEMAND) == []
    )  # of a finished file nothing is promised


def test_warns_about_overlaps_in_many_frames_with_location():
    rows = [(f, name, "car", 10.0, 31.0 + i, 0, 5.0) for f in range(20) for i, name in enumerate("ab")]
    rows += [(f, name, "car", 90.0, 31.0 + i, 0, 5.0) for f in range(5) for i, name in enumerate("cd")]
    rows += [(299, "e", "car", 0.0, 0.0, 0, 5.0)]
    (result,) = trajectories.traffic_warnings(statistics_of(sorted(rows)), recording_with(), ROI, DEMAND)
    assert result.rule == "overlaps"
    assert result.where == "s.toml: traffic: x 10 m, y 30 m (in the region of interest)"
    assert result.problem == "vehicles overlap in 7 % of the frames; 20 of 25 overlaps are here"


def test_overlaps_with_blockers_in_region_are_counted():
    """Both a and d stand from the beginning, and are blockers from frame 4 on; b and e drive through them."""
    rows = [(f, name, "car", 10.0, 31.0 + i, 0, 5.0 * i) for f in range(7) for i, name in enumerate("ab")]
    rows += [(f, name, "car", 90.0, 31.0 + i, 0, 5.0 * i) for f in range(9) for i, name in enumerate("de")]
    tally = TrafficStatistics(300, region=ROI, blocker_frames=4)
    tally.add(vehicle_boxes.boxes_from_bumpers(group_of(sorted(rows)), SIZES, 1.0, "place"))
    assert (tally.rows_in_region, tally.overlaps_in_region, tally.overlapping_pairs) == (14, 3, 16)
    assert tally.to_json(1.0)["overlapping_pairs_in_roi"] == 3
    (result,) = trajectories.traffic_warnings(tally, recording_with(), ROI, DEMAND)
    assert (result.rule, result.where) == ("overlaps in roi", "s.toml: traffic.junction_blocker_s")
    assert result.problem.startswith(
        "vehicles overlap 3 times in the region of interest (214.3 per 1,000 vehicles and frames)"
    )
    assert "overlapping_pairs_in_roi" not in statistics_of(sorted(rows)).to_json(1.0)

    tally.rows_in_region = 3001
    assert trajectories.traffic_warnings(tally, recording_with(), ROI, DEMAND) == []
    assert tally.to_json(1.0)["overlapping_pairs_in_roi"] == 3
    tally.rows_in_region = 3000
    assert len(trajectories.traffic_warnings(tally, recording_with(), ROI, DEMAND)) == 1


@pytest.mark.parametrize(
    ("x_m", "vehicles", "locked", "jammed"),
    [(0.0, None, None, True), (0.0, None, {}, False), (100.0, None, None, False), (100.0, 1, {}, True)],
    ids=["in the region", "in a watched region", "elsewhere", "where a number is maintained"],
)
def test_jam_at_the_end_matters_in_region_or_where_a_number_is_maintained(tmp_path, x_m, vehicles, locked, jammed):
    tally = statistics_of([(f, "stuck", "car", x_m, 0, 0, 0.0) for f in range(300)])
    counts = [{"edge": "e", "per_hour": 10}]
    model = scenario(tmp_path, network="net.xml", counts=counts, vehicles=vehicles, hold="at_most")
    recorded = recording_with(standing_limit_s=180.0, vehicles=vehicles, locked=locked)
    if not jammed:
        trajectories.check_recording(model, tally, recorded)
        return
    message = r"traffic\.counts: the traffic is jammed: 1 vehicle stands .* at x .*, from 0 s on\. Lower per_hour of"
    with pytest.raises(RunError, match=message):
        trajectories.check_recording(model, tally, recorded)


def test_jam_is_named_with_street_period_and_time(tmp_path):
    tally = statistics_of([(f, "stuck", "car", 0.0, 0, 0, 0.0 if f >= 60 else 5.0) for f in range(300)])
    (tmp_path / "n.net.xml").write_text(STREET)
    counts = [{"edge": "in", "per_hour": 10}]
    periods = [{"name": "noon"}, {"name": "evening", "counts": counts}]
    by_period = scenario(tmp_path, network="n.net.xml", counts=counts, periods=periods, hold="at_most").by_period()
    recorded = recording_with(standing_limit_s=180.0, roads=network.read_net_xml(tmp_path / "n.net.xml"))
    stand = (
        r"239 s at junction j, Main Street, x 0 m, y -2 m \(in the region of interest\), from 60 s on\. Lower per_hour"
    )
    with pytest.raises(RunError, match=r"scenario\.toml: traffic\.counts \(period noon\): the traffic is .*" + stand):
        trajectories.check_recording(by_period["noon"], tally, recorded)
    with pytest.raises(RunError, match=r"scenario\.toml: traffic\.periods \(evening\)\.counts: the traffic .*" + stand):
        trajectories.check_recording(by_period["evening"], tally, recorded)


STREET = """<net version="1.20">
  <edge id="in" from="a" to="j" name="Main Street"><lane id="in_0" index="0" shape="-100,0 0,0"/></edge>
</net>
"""


@pytest.mark.parametrize(
    ("keys", "where", "hint"),
    [
        ({"counts": [{"edge": "e", "per_hour": 10}]}, "traffic.counts", "Lower per_hour of the counts"),
        ({"vehicles": 9}, "traffic.vehicles", "Lower vehicles,"),
        ({"vehicles_per_h": 90}, "traffic.vehicles_per_h", "Lower vehicles_per_h,"),
        ({"vehicles_per_lane_km": 9}, "traffic.vehicles_per_lane_km", "Lower vehicles_per_lane_km,"),
        ({}, "traffic.network", "Set traffic.vehicles_per_lane_km below 4,"),
    ],
)
def test_demand_key_is_one_that_the_scenario_sets(tmp_path, keys, where, hint):
    key = demand_key(scenario(tmp_path, network="n.net.xml", **keys))
    assert key.where == f"{tmp_path / 'scenario.toml'}: {where}" and key.hint.startswith(hint)


@pytest.mark.parametrize(
    ("at_m", "words"),
    [
        ((0.0, 0.0), "x 0 m, y 0 m (in the region of interest)"),
        ((28.0, 54.0), "x 28 m, y 54 m (5 m from the region of interest)"),
    ],
)
def test_location_is_described_with_its_distance(at_m, words):
    assert trajectories.describe_location(at_m, ROI) == words
