"""Does the traffic stage put every box where SUMO's vehicle is, keep its promises, and refuse what it cannot keep?

The end-to-end tests run real SUMO on small networks made here.
"""

import json
import math
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from pipeline.artefacts import tables
from pipeline.core.errors import InputError, MissingBackendError, RunError
from pipeline.scenario.loading import from_values
from pipeline.scenario.traffic import TrafficModel, VehicleKind
from pipeline.stages import traffic
from pipeline.traffic import boxes, demand, fcd, network, recording, sumo, tally
from pipeline.traffic.boxes import Size
from pipeline.traffic.frames import FrameGroup
from pipeline.traffic.tally import TrafficTally

SMALL = {"vehicles": 12, "frames": 240, "warmup_s": 60.0, "trips_per_s": 1.0}


def scenario(folder, seed=1, **keys):
    values = {
        "name": "trial",
        "seed": seed,
        "roi": {"center_m": [0, 0, 2.5], "size_m": [50, 100, 5]},
        "tpog": {"blocks": 1},
        "sites": {"grid": {"low_m": [0, 0], "high_m": [1, 1], "spacing_m": 1, "heights_m": [3]}},
        "traffic": {"frame_period_s": 0.25, **keys},
    }
    return from_values(values, folder, str(folder / "scenario.toml"))


def netgenerate(folder, *flags, name="net.xml"):
    folder.mkdir(parents=True, exist_ok=True)
    sumo.run("netgenerate", [*flags, "-o", name], folder)
    return folder / name


@pytest.fixture(scope="session")
def town(tmp_path_factory):
    """A folder with a signalised 2 x 2 grid of streets that lead out of town."""
    folder = tmp_path_factory.mktemp("town")
    netgenerate(
        folder, "--grid", "--grid.number", "2", "--grid.length", "90", "--grid.attach-length", "120", "-L", "2",
        "--default-junction-type", "traffic_light", "--no-turnarounds", "--offset.disable-normalization",
    )  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def recorded(town, tmp_path_factory):
    """The stage's result, table and folder for the town's drawn traffic."""
    out = tmp_path_factory.mktemp("recorded")
    result = traffic.run(scenario(town, network="net.xml", **SMALL), out)
    table, metadata = tables.read(out / "trajectories.parquet", "trajectories")
    return result, table, metadata, out


# ---- from a point on the bumper to a box


@pytest.mark.parametrize(
    ("angle", "centre", "yaw"),
    [
        (0, (0, 8), math.pi / 2),
        (90, (-2, 10), 0),
        (180, (0, 12), -math.pi / 2),
        (270, (2, 10), math.pi),
        (360, (0, 8), math.pi / 2),
    ],
    ids=["north", "east", "south", "west", "north again"],
)
def test_box_lies_half_a_length_behind_the_front_bumper(angle, centre, yaw):
    one = np.ones(1)
    x, y, z = boxes.centres(0 * one, 10 * one, 0 * one, angle * one, 0 * one, 4 * one, 1.5 * one)
    assert (x[0], y[0], z[0]) == (*centre, 0.75)
    assert not np.signbit([v for v in (x[0], y[0], z[0]) if v == 0]).any()
    assert boxes.yaw_rad(angle * one)[0] == pytest.approx(yaw, abs=1e-9)


def test_uphill_the_centre_is_lower_than_the_bumper():
    one = np.ones(1)
    x, y, z = boxes.centres(0 * one, 0 * one, 100 * one, 90 * one, 30 * one, 4 * one, 2 * one)
    assert (x[0], y[0], z[0]) == pytest.approx((-2 * math.cos(math.pi / 6), 0, 100 - 1 + 1), abs=1e-6)


@given(st.floats(-720, 720))
def test_yaw_is_in_its_interval_and_points_where_the_angle_points(angle):
    yaw = boxes.yaw_rad(np.array([angle]))[0]
    assert -math.pi < yaw <= math.pi
    assert math.cos(yaw) == pytest.approx(math.sin(math.radians(angle)), abs=2e-9)
    assert math.sin(yaw) == pytest.approx(math.cos(math.radians(angle)), abs=2e-9)


def group_of(rows):
    """rows of (frame, id, type, x, y, angle, speed) -> a FrameGroup."""
    frame, names, types, x, y, angle, speed = zip(*rows, strict=True)
    frame = np.array(frame, dtype=np.int64)
    numbers = [np.array(v, dtype=float) for v in (x, y, np.zeros(len(rows)), angle, np.zeros(len(rows)), speed)]
    table = pa.table([frame * 1000, pa.array(names), pa.array(types), *numbers], schema=fcd.SCHEMA)
    return FrameGroup(int(frame.min()), int(np.ptp(frame)) + 1, frame, table)


SIZES = {"car": Size(4.0, 2.0, 1.5, "passenger"), "bus": Size(12.0, 2.5, 3.0, "bus")}


def test_boxes_are_sorted_by_frame_and_vehicle_and_carry_their_types_size():
    rows = [
        (0, "b", "car", 0, 0, 0, 1),
        (0, "a10", "bus", 9, 0, 0, 1),
        (0, "a9", "car", 20, 0, 0, 1),
        (1, "b", "car", 0, 1, 0, 1),
    ]
    found = boxes.from_bumpers(group_of(rows), SIZES, 1.0, "place")
    columns = found.columns()
    assert columns["vehicle"].to_pylist() == ["a10", "a9", "b", "b"]
    assert columns["kind"].to_pylist() == ["bus", "passenger", "passenger", "passenger"]
    assert found.length_m.tolist() == [12, 4, 4, 4]
    assert found.height_m.tolist() == [3, 1.5, 1.5, 1.5]
    assert found.z_m.tolist() == [1.5, 0.75, 0.75, 0.75]


def test_a_type_without_a_size_is_named():
    with pytest.raises(InputError, match=r"vehicle type 'tram' has no known size; .*known: bus, car"):
        boxes.from_bumpers(group_of([(0, "v", "tram", 0, 0, 0, 1)]), SIZES, 1.0, "place")


def test_a_vehicle_twice_in_a_frame_is_named():
    with pytest.raises(InputError, match="vehicle 'v' is twice in frame 3"):
        boxes.from_bumpers(group_of([(3, "v", "car", 0, 0, 0, 1)] * 2), SIZES, 1.0, "place")


def test_speed_comes_from_the_way_where_the_file_gives_none():
    nan = float("nan")
    rows = [
        (0, "v", "car", 0, 0, 0, nan),
        (1, "v", "car", 0, 3, 0, nan),
        (2, "v", "car", 0, 4, 0, nan),
        (2, "w", "car", 9, 9, 0, nan),
    ]
    found = boxes.from_bumpers(group_of(rows), SIZES, 0.5, "place")
    assert found.speed_m_s[:3].tolist() == [6, 2, 2]
    assert np.isnan(found.speed_m_s[3])


# ---- overlaps and standing


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
    assert len(tally.overlapping(boxes.from_bumpers(group_of(rows), SIZES, 1.0, "place"))) == expected


def test_vehicles_on_a_bridge_and_below_it_do_not_overlap():
    group = group_of([(0, "a", "car", 0, 0, 0, 1), (0, "b", "car", 0, 0, 90, 1)])
    raised = group.rows.set_column(5, "z", pa.array([0.0, 5.0]))
    assert len(tally.overlapping(boxes.from_bumpers(FrameGroup(0, 1, group.frame, raised), SIZES, 1.0, "place"))) == 0


def footprint(found, i):
    cos, sin = math.cos(found.yaw_rad[i]), math.sin(found.yaw_rad[i])
    half_l, half_w = found.length_m[i] / 2 - 1e-3, found.width_m[i] / 2 - 1e-3
    corners = [(a * half_l, b * half_w) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return shapely.Polygon([(found.x_m[i] + cos * u - sin * v, found.y_m[i] + sin * u + cos * v) for u, v in corners])


@given(st.integers(0, 2**32 - 1))
def test_overlaps_are_those_that_polygons_find(seed):
    rng = np.random.default_rng(seed)
    rows = [
        (f, str(i), rng.choice(["car", "bus"]), rng.uniform(0, 25), rng.uniform(0, 25), rng.uniform(0, 360), 1)
        for f in range(3)
        for i in range(10)
    ]
    found = boxes.from_bumpers(group_of(rows), SIZES, 1.0, "place")
    shapes = [footprint(found, i) for i in range(30)]
    expected = {
        (i, j)
        for i in range(30)
        for j in range(i)
        if found.frame[i] == found.frame[j] and shapes[i].intersection(shapes[j]).area > 1e-7
    }
    got = {(int(b), int(a)) for a, b in tally.overlapping(found)}
    for i, j in got ^ expected:  # a contact thinner than the polygons' own rounding may go either way
        assert shapes[i].distance(shapes[j]) < 1e-6
        assert shapes[i].intersection(shapes[j]).area < 1e-5


@pytest.mark.parametrize("spread_m", [10.0, 300.0, 1e8])
def test_overlaps_are_those_of_all_pairs(spread_m):
    """Wherever vehicles are, those in neighbouring cells are found, and none of another frame."""
    rng = np.random.default_rng(7)
    near = rng.uniform(-spread_m, spread_m, (40, 2))
    places = np.concatenate([near, near + rng.uniform(-8, 8, (40, 2)), [[-spread_m, -spread_m], [spread_m, spread_m]]])
    rows = [
        (f, str(i), ["car", "bus"][i % 2], x, y, rng.uniform(0, 360), 1)
        for f in range(3)
        for i, (x, y) in enumerate(places.tolist())
    ]
    found = boxes.from_bumpers(group_of(rows), SIZES, 1.0, "place")
    a, b = np.triu_indices(found.frame.size, 1)
    a, b = a[found.frame[a] == found.frame[b]], b[found.frame[a] == found.frame[b]]
    hit = tally._share_space(found, a, b)
    expected = set(zip(a[hit].tolist(), b[hit].tolist(), strict=True))
    got = [tuple(pair) for pair in tally.overlapping(found).tolist()]
    assert len(got) == len(set(got)) > 20
    assert set(got) == expected


def test_standing_is_followed_across_groups():
    counted = TrafficTally(6)
    for frames in ((0, 1), (2, 3), (4, 5)):
        rows = [(f, "still", "car", 0, 0, 0, 0.0) for f in frames]
        rows += [(f, "goes", "car", 50, 0, 0, 5.0 if f == 4 else 0.0) for f in frames]
        counted.add(boxes.from_bumpers(group_of(rows), SIZES, 1.0, "place"))
    assert counted.stands_since == {"still": 0, "goes": 5}
    assert counted.longest_standing_frames == 5
    result = counted.counts(0.5).to_json()
    assert result["vehicles"] == {"fewest": 2, "most": 2, "different": 2}
    assert result["longest_standing_s"] == 2.5
    assert result["share_standing"] == round(11 / 12, 4)


# ---- networks and drawn trips


NET = """<net version="1.20">
  <edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" speed="9" length="9" shape="0,0 1,1"/></edge>
  <edge id="in" from="a" to="j"><lane id="in_0" index="0" disallow="bus" shape="-100,0 0,0"/></edge>
  <edge id="back" from="j" to="a"><lane id="back_0" index="0" shape="0,3 -100,3"/></edge>
  <edge id="out" from="j" to="b"><lane id="out_0" index="0" shape="0,0 100,0"/>
    <lane id="out_1" index="1" allow="bicycle" shape="0,-3 100,-3"/></edge>
  <tlLogic id="j" type="actuated" programID="0" offset="0">
    <phase duration="30" maxDur="50" state="GG"/><phase duration="5" state="yy"/></tlLogic>
  <connection from="in" to="out" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="o"/>
  <connection from="in" to="back" fromLane="0" toLane="0" dir="t" state="o"/>
  <connection from=":j_0" to="out" fromLane="0" toLane="0" dir="s" state="o"/>
</net>
"""


def car(**keys):
    return VehicleKind(**({"name": "car", "length_m": 4, "width_m": 2, "height_m": 1.5} | keys))


def drawn(**keys):
    return TrafficModel(network="net.xml", **keys)


def test_network_is_read(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    roads = network.read(path)
    assert [e.id for e in roads.edges] == ["in", "back", "out"]
    assert roads.cycle_s == 55
    assert not roads.has_heights
    assert [e.lanes_for("passenger") for e in roads.edges] == [1, 1, 1]
    assert [e.lanes_for("bus") for e in roads.edges] == [0, 1, 1]
    assert roads.links("passenger").tolist() == [[0, 2, 0], [0, 1, 1]]
    assert roads.links("bus").tolist() == []


def test_trips_join_the_fringe_and_do_not_turn_back(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    found = demand.pairs(network.read(path), car(), drawn(), np.random.default_rng(0), "place")
    assert (found.origin.tolist(), found.target.tolist(), found.fringe) == ([0], [2], True)


def test_edge_weights_go_before_lanes(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    roads, rng = network.read(path), np.random.default_rng(0)
    assert demand.pairs(roads, car(), drawn(), rng, "place").weight.tolist() == [1]
    assert demand.pairs(roads, car(), drawn(edge_weights={"out": 7}), rng, "place").weight.tolist() == [7]
    with pytest.raises(InputError, match=r"edge_weights: the network has no edge 'away'"):
        demand.pairs(roads, car(), drawn(edge_weights={"away": 7}), rng, "place")


def test_a_kind_that_can_go_nowhere_is_refused(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    roads, rng = network.read(path), np.random.default_rng(0)
    with pytest.raises(InputError, match=r"kind 'boat' \(vClass ship\) can go from no edge to another"):
        demand.pairs(roads, car(name="boat", vclass="ship"), drawn(min_trip_m=300), rng, "place")
    roads = network.Network(tuple(e for e in roads.edges if e.id == "in"), ())
    with pytest.raises(InputError, match=r"kind 'bus' \(vClass bus\) may use no lane"):
        demand.pairs(roads, car(name="bus", vclass="bus"), drawn(), rng, "place")


def test_trips_follow_shares_lanes_and_the_least_length(town):
    roads = network.read(town / "net.xml")
    rng = np.random.default_rng(0)
    kinds = [car(share=3), car(name="van", vclass="delivery")]
    pairs = [demand.pairs(roads, kind, drawn(min_trip_m=200), rng, "place") for kind in kinds]
    departs_s = np.arange(4000) / 4
    trips = demand.draw(roads, kinds, pairs, departs_s, rng)
    assert Counter(kind for kind, _, _ in trips)["car"] == pytest.approx(3000, abs=150)
    edges = {e.id: e for e in roads.edges}
    assert {len(edges) for _ in trips} == {24}
    for _, origin, target in trips:
        assert math.dist(edges[origin].start_m, edges[target].end_m) >= 200
        assert edges[origin].from_node != edges[target].to_node
    assert len({(a, b) for _, a, b in trips}) == 8 * 7 - 2 * (
        4 + 4
    )  # neighbours at a corner and along a side lie closer


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (car(vclass="car"), r"kind 'car' has the vClass 'car'; one of .*passenger"),
        (car(attributes={"length": 3}), r"kind 'car' has length among its attributes"),
    ],
)
def test_a_wrong_kind_is_refused(kind, message):
    with pytest.raises(InputError, match=message):
        demand.check_kinds([kind], sumo.vehicle_classes(), "place")


def test_a_kinds_attributes_go_before_ours():
    text = demand.vtypes_xml([car(attributes={"maxSpeedLat": 2, "color": "1,0,0"})])
    assert 'maxSpeedLat="2.0"' in text and 'color="1,0,0"' in text and 'lcMaxSpeedLatFactor="0.2"' in text


# ---- end to end


def test_n_vehicles_are_in_every_frame(recorded):
    result, table, _, _ = recorded
    assert Counter(table["frame"].to_pylist()) == dict.fromkeys(range(240), 12)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 12
    assert result["frames"] == 240
    assert result["vehicles"]["different"] == len(set(table["vehicle"].to_pylist())) > 12
    assert json.loads(json.dumps(result)) == result


def test_rows_are_sorted_and_tidy(recorded):
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
    assert metadata["frames"] == 240 and metadata["seed"] == 1 and metadata["sumo"] == sumo.version()


def test_vehicles_stay_on_the_roads_and_do_not_jump(recorded):
    _, table, _, _ = recorded
    x, y, frame = (table[c].to_numpy() for c in ("x_m", "y_m", "frame"))
    vehicle = np.array(table["vehicle"].to_pylist())
    assert min(x.min(), y.min()) > 0 and max(x.max(), y.max()) < 120 + 90 + 120
    for name in set(vehicle):
        mine = vehicle == name
        assert np.array_equal(np.diff(frame[mine]), np.ones(mine.sum() - 1))
        assert np.hypot(np.diff(x[mine]), np.diff(y[mine])).max(initial=0) < 6  # 0.25 s at less than 24 m/s


def test_flags_name_no_place_of_this_machine_and_the_fcd_file_is_gone(recorded):
    result, _, _, out = recorded
    assert "--max-num-vehicles" in result["flags"] and "--seed" in result["flags"]
    assert not [flag for flag in result["flags"] if Path(flag).is_absolute()]
    assert result["sumo_seconds"] > 0
    names = {p.name for p in (out / "sumo").iterdir()}
    assert {"run.sumocfg", "network.net.xml", "trips.rou.xml", "vtypes.add.xml"} <= names
    assert "fcd.csv" not in names


def test_same_seed_same_bytes_and_another_seed_other_traffic(town, recorded, tmp_path):
    traffic.run(scenario(town, network="net.xml", **SMALL), tmp_path / "again", jobs=1)
    traffic.run(scenario(town, seed=2, network="net.xml", **SMALL), tmp_path / "other")
    first = (recorded[3] / "trajectories.parquet").read_bytes()
    assert (tmp_path / "again" / "trajectories.parquet").read_bytes() == first
    assert (tmp_path / "other" / "trajectories.parquet").read_bytes() != first


def test_the_folder_can_be_moved_and_gives_the_same_traffic_as_a_finished_file(recorded, tmp_path):
    """A user opens run.sumocfg elsewhere, records FCD there, and names that file in a scenario."""
    _, table, _, out = recorded
    moved = tmp_path / "moved"
    shutil.copytree(out / "sumo", moved)
    sumo.run("sumo", ["-c", "run.sumocfg", "--fcd-output", "all.xml.gz", "--precision", "8"], moved)
    values = {k: v for k, v in SMALL.items() if k in ("frames", "warmup_s")}
    finished = scenario(moved, fcd="all.xml.gz", **values)
    result = traffic.run(finished, tmp_path / "out")
    again, metadata = tables.read(tmp_path / "out" / "trajectories.parquet", "trajectories")
    assert again.equals(table.cast(again.schema))
    assert metadata["sumo"] is None
    assert result["vehicles"]["most"] == 12 and "flags" not in result


def serve(folder, *flags):
    """Start SUMO as a co-simulating user would; its port. (What it prints waits in a buffer: nothing tells when it
    listens.)"""
    from sumolib.miscutils import getFreeSocketPort

    port = getFreeSocketPort()
    command = [str(sumo.binary("sumo")), "-c", "run.sumocfg", *flags, "--remote-port", str(port)]
    devnull = subprocess.DEVNULL
    process = subprocess.Popen(
        command, cwd=folder, env=sumo.environment(), stdin=devnull, stdout=devnull, stderr=devnull
    )
    return process, port


def over_traci(scene, out, folder, *flags):
    process, port = serve(folder, *flags)
    with process:
        try:
            return traffic.run(scene, out, traci=("localhost", port))
        finally:
            process.kill()


@pytest.fixture
def patient(monkeypatch):
    """SUMO listens a moment after it was started."""
    connect = sumo._connect

    def again(host, port):
        return next(filter(None, (connect(host, port) for _ in range(1_000_000))))

    monkeypatch.setattr(sumo, "_connect", again)


@pytest.mark.usefixtures("patient")
def test_traci_records_the_same_bytes(town, recorded, tmp_path):
    result, _, _, out = recorded
    polled = over_traci(scenario(town, network="net.xml", **SMALL), tmp_path, out / "sumo")
    assert (tmp_path / "trajectories.parquet").read_bytes() == (out / "trajectories.parquet").read_bytes()
    assert {k: v for k, v in polled.items() if k not in ("flags", "sumo_seconds")} == {
        k: v for k, v in result.items() if k not in ("flags", "sumo_seconds")
    }


@pytest.mark.usefixtures("patient")
def test_traci_refuses_another_step_and_a_clock_that_is_too_late(town, recorded, tmp_path):
    folder = recorded[3] / "sumo"
    with pytest.raises(InputError, match=r"that SUMO's step is 0\.25 s; traffic\.step_s = 0\.125"):
        over_traci(scenario(town, network="net.xml", **SMALL, step_s=0.125), tmp_path, folder)
    with pytest.raises(RunError, match=r"that SUMO is at 70 s already, after the first frame at 60 s"):
        over_traci(scenario(town, network="net.xml", **SMALL), tmp_path, folder, "--begin", "70")
    assert not (tmp_path / "trajectories.parquet").exists()


def test_traci_to_nobody_is_refused(town, tmp_path):
    from sumolib.miscutils import getFreeSocketPort

    with pytest.raises(InputError, match="no SUMO answers there"):
        traffic.run(scenario(town, network="net.xml", **SMALL), tmp_path, traci=("localhost", getFreeSocketPort()))


ROUTES = """<routes>
  <vType id="lorry" vClass="trailer"/>
  <vType id="mini" length="3" width="1.5" height="1.4"/>
  <flow id="l" type="lorry" from="{0}" to="{1}" begin="0" end="100" period="6"/>
  <flow id="m" type="mini" from="{1b}" to="{0b}" begin="0" end="100" period="3"/>
  <vehicle id="parked" type="mini" depart="0"><route edges="{0}"/><stop lane="{0}_0" endPos="60" duration="900"/></vehicle>
</routes>
"""


def routes_for(town):
    roads = network.read(town / "net.xml")
    found = demand.pairs(roads, car(), drawn(min_trip_m=200), np.random.default_rng(0), "place")
    origin, target = roads.edges[found.origin[0]], roads.edges[found.target[0]]

    def reverse(edge):
        return next(e.id for e in roads.edges if (e.from_node, e.to_node) == (edge.to_node, edge.from_node))

    text = ROUTES.replace("{1b}", reverse(target)).replace("{0b}", reverse(origin))
    return text.replace("{0}", origin.id).replace("{1}", target.id)


def test_own_routes_get_their_sizes_from_sumo(town, tmp_path):
    (tmp_path / "own.rou.xml").write_text(routes_for(town))
    shutil.copy(town / "net.xml", tmp_path)
    keys = {
        "network": "net.xml",
        "routes": ["own.rou.xml"],
        "vehicles": 30,
        "hold": "at_most",
        "step_s": 1,
        "frame_period_s": 1,
    }
    result = traffic.run(scenario(tmp_path, **keys, frames=300, warmup_s=10), tmp_path / "out")
    table, _ = tables.read(tmp_path / "out" / "trajectories.parquet", "trajectories")
    sizes = {(r["kind"], r["length_m"], r["width_m"], r["height_m"]) for r in table.to_pylist()}
    assert sizes == {("trailer", 16.5, 2.55, 4.0), ("passenger", 3.0, 1.5, 1.4)}
    assert result["longest_standing_s"] > 200  # parked on purpose, which is no jam
    assert set(traffic.inputs(scenario(tmp_path, **keys), tmp_path)["files"]) == {"net.xml", "own.rou.xml"}


CONFIG = """<configuration>
  <input><net-file value="net.xml"/><route-files value="own.rou.xml"/><additional-files value="more/red.add.xml"/></input>
  <output><tripinfo-output value="/nowhere/trips.xml"/><fcd-output.geo value="true"/></output>
  <time><begin value="25200"/><end value="25300"/><step-length value="0.1"/></time>
  <processing><device.rerouting.threads value="4"/><time-to-teleport value="5"/></processing>
</configuration>
"""


def configured(town, folder, additional="<additional/>", routes=None):
    (folder / "more").mkdir(parents=True)
    (folder / "own.rou.xml").write_text(
        (routes or routes_for(town)).replace('begin="0" end="100"', 'begin="25200" end="25300"')
    )
    (folder / "more" / "red.add.xml").write_text(additional)
    (folder / "town.sumocfg").write_text(CONFIG)
    shutil.copy(town / "net.xml", folder)
    keys = {"vehicles": 40, "hold": "at_most", "frames": 300, "warmup_s": 10.0, "step_s": 1.0, "frame_period_s": 1.0}
    return scenario(folder, sumocfg="town.sumocfg", **keys)


def test_own_configuration_runs_with_the_scenarios_times_and_outputs(town, tmp_path):
    scene = configured(town, tmp_path / "in")
    result = traffic.run(scene, tmp_path / "out")
    text = " ".join(result["flags"])
    assert "--begin 25200.000" in text and "--end 25510.000" in text and "--step-length 1.000" in text
    assert "--time-to-teleport -1" in text
    for dropped in ("tripinfo", "geo", "rerouting.threads", "nowhere"):
        assert dropped not in text
    assert set(traffic.inputs(scene, tmp_path)["files"]) == {
        "town.sumocfg",
        "net.xml",
        "own.rou.xml",
        "more/red.add.xml",
    }
    assert result["vehicles"]["different"] > 20


def test_a_jam_without_end_fails_with_its_numbers(town, tmp_path):
    """All signals of the town stay red."""
    text = (town / "net.xml").read_text()
    red = [
        f'<tlLogic id="{name}" type="static" programID="red" offset="0"><phase duration="60" state="{"r" * len(state)}"/></tlLogic>'
        for name, state in re.findall(r'<tlLogic id="([^"]+)".*?state="([^"]+)"', text, re.S)
    ]
    assert len(red) == 4
    scene = configured(town, tmp_path / "in", f"<additional>{''.join(red)}</additional>")
    with pytest.raises(
        RunError, match=r"vehicles stand for more than 180 s and through to the last frame, .* for 2\d\d s"
    ):
        traffic.run(scene, tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()
    assert not (tmp_path / "out" / "sumo" / "fcd.csv").exists()


def test_patience_is_two_cycles_and_three_minutes_at_least():
    assert recording.patience_s(70) == 180
    assert recording.patience_s(120) == 240


def test_more_vehicles_than_the_town_holds_fail_with_the_numbers(town, tmp_path):
    keys = SMALL | {"vehicles": 200, "frames": 40}
    with pytest.raises(
        RunError, match=r"traffic: 200 vehicles are in 0 of 40 frames only; the fewest are \d+, the most \d+"
    ):
        traffic.run(scenario(town, network="net.xml", **keys), tmp_path)
    result = traffic.run(scenario(town, network="net.xml", **keys, hold="at_most"), tmp_path)
    assert 0 < result["vehicles"]["most"] < 200


def test_no_vehicle_at_all_fails(town, tmp_path):
    (tmp_path / "none.rou.xml").write_text("<routes/>")
    keys = SMALL | {"routes": ["none.rou.xml"], "hold": "at_most"}
    keys.pop("trips_per_s")
    shutil.copy(town / "net.xml", tmp_path)
    with pytest.raises(RunError, match="no vehicle is in any of 240 frames"):
        traffic.run(scenario(tmp_path, network="net.xml", **keys), tmp_path / "out")


NODES = """<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="400" y="0" z="40"/><node id="c" x="800" y="0" z="40"/></nodes>"""
EDGES = """<edges><edge id="ab" from="a" to="b" numLanes="2"/><edge id="bc" from="b" to="c" numLanes="2"/></edges>"""


def test_uphill_boxes_are_pitched_and_stand_on_the_road(tmp_path):
    (tmp_path / "n.nod.xml").write_text(NODES)
    (tmp_path / "e.edg.xml").write_text(EDGES)
    sumo.run("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "hill.net.xml"], tmp_path)
    keys = SMALL | {"network": "hill.net.xml", "vehicles": 8, "frames": 120, "hold": "at_most"}
    traffic.run(scenario(tmp_path, **keys), tmp_path / "out")
    table, _ = tables.read(tmp_path / "out" / "trajectories.parquet", "trajectories")
    uphill = [r for r in table.to_pylist() if 20 < r["x_m"] < 380]
    assert len(uphill) > 50
    for r in uphill:
        assert r["pitch_rad"] == pytest.approx(math.atan(0.1), abs=1e-3)
        assert r["z_m"] - r["height_m"] / 2 == pytest.approx(0.1 * r["x_m"], abs=0.05)
        assert r["yaw_rad"] == pytest.approx(0, abs=1e-2)


def test_a_ring_gets_trips_between_any_edges_and_says_so(tmp_path):
    netgenerate(
        tmp_path,
        "--spider",
        "--spider.arm-number",
        "6",
        "--spider.circle-number",
        "1",
        "--spider.omit-center",
        name="ring.net.xml",
    )
    result = traffic.run(scenario(tmp_path, **(SMALL | {"network": "ring.net.xml", "vehicles": 5})), tmp_path / "out")
    assert result["notes"] and "no trip between fringe edges" in result["notes"][0]


OSM = """<osm version="0.6"><bounds minlat="52.0" minlon="10.0" maxlat="52.004" maxlon="10.004"/>
{nodes}
<way id="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="secondary"/></way>
<way id="2"><nd ref="4"/><nd ref="2"/><nd ref="5"/><tag k="highway" v="secondary"/></way></osm>
"""


def test_a_map_of_openstreetmap_becomes_a_network(tmp_path):
    where = [(52.002, 10.0), (52.002, 10.002), (52.002, 10.004), (52.0, 10.002), (52.004, 10.002)]
    nodes = "".join(f'<node id="{i}" lat="{lat}" lon="{lon}"/>' for i, (lat, lon) in enumerate(where, 1))
    (tmp_path / "cross.osm").write_text(OSM.replace("{nodes}", nodes))
    result = traffic.run(scenario(tmp_path, **(SMALL | {"network": "cross.osm", "vehicles": 6})), tmp_path / "out")
    assert result["vehicles"]["fewest"] == 6
    assert (tmp_path / "out" / "sumo" / "network.net.xml").is_file()


# ---- wrong input


def nothing(folder):
    """No change."""


def write(name, text):
    return lambda folder: (folder / name).write_text(text)


CAR_ROUTE = '<routes><vehicle id="v" depart="0"><route edges="nowhere"/></vehicle></routes>'
BOMB = '<!DOCTYPE net [<!ENTITY a "b">]><net>&a;</net>'
BAD = {
    "period between steps": (
        nothing,
        {"network": "net.xml", "frame_period_s": 0.3},
        InputError,
        r"traffic\.frame_period_s = 0\.3: is no whole number of steps of 0\.25 s; for example 0\.25 or 0\.5",
    ),
    "warm-up between steps": (nothing, {"network": "net.xml", "warmup_s": 10.1}, InputError, r"warmup_s = 10\.1: is no whole"),
    "step below a millisecond": (
        nothing, {"network": "net.xml", "step_s": 0.0004}, InputError, r"step_s = 0\.0004: is no whole number of milliseconds",
    ),
    "no network": (nothing, {"network": "none.net.xml"}, InputError, r"traffic\.network = 'none\.net\.xml': no such file"),
    "no routes": (nothing, {"network": "net.xml", "routes": ["r.xml"]}, InputError, r"traffic\.routes = 'r\.xml': no such file"),
    "empty network": (write("e.xml", "<net/>"), {"network": "e.xml"}, InputError, r"e\.xml: the network has no road"),
    "no network inside": (write("e.xml", "<routes/>"), {"network": "e.xml"}, InputError, r"e\.xml: its root is <routes>"),
    "malformed network": (write("e.xml", "<net><edge"), {"network": "e.xml"}, InputError, r"e\.xml: is not well-formed XML"),
    "network with entities": (write("e.xml", BOMB), {"network": "e.xml"}, InputError, r"e\.xml: declares XML entities"),
    "damaged edge": (
        write("e.xml", '<net><edge id="a" from="b"/></net>'), {"network": "e.xml"}, InputError, r"<edge id='a'> is not as in a",
    ),
    "kind unknown to SUMO": (
        nothing,
        {"network": "net.xml", "kinds": [car(vclass="saucer").model_dump()]},
        InputError, r"kind 'car' has the vClass 'saucer'",
    ),
    "trips too long": (nothing, {"network": "net.xml", "min_trip_m": 5000}, InputError, r"to another that is 5000 m"),
    "routes off the network": (
        write("r.xml", CAR_ROUTE), {"network": "net.xml", "routes": ["r.xml"]}, RunError, r"sumo ended with exit code 1:\n.*nowh",
    ),
    "configuration names no network": (
        write("c.sumocfg", "<configuration/>"), {"sumocfg": "c.sumocfg"}, InputError, r"c\.sumocfg: names no net-file",
    ),
    "configuration names a missing file": (
        write("c.sumocfg", '<configuration><net-file value="gone.xml"/></configuration>'),
        {"sumocfg": "c.sumocfg"}, InputError, r"c\.sumocfg: net-file = 'gone\.xml': no such file",
    ),
    "configuration lets vehicles jump": (
        write("c.sumocfg", '<configuration><net-file value="net.xml"/><no-internal-links value="true"/></configuration>'),
        {"sumocfg": "c.sumocfg"}, InputError, r"no-internal-links = 'true': lets vehicles jump",
    ),
    "unknown type in a finished file": (
        write("f.csv", "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type\n0;v;1;2;3;tram\n1;v;1;2;3;tram\n"),
        {"fcd": "f.csv", "frames": 1, "warmup_s": 0, "frame_period_s": 1}, InputError, r"vehicle type 'tram' has no known size",
    ),
    "too few frames in a finished file": (
        write("f.csv", "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type\n0;v;1;2;3;car\n1;v;1;2;3;car\n"),
        {"fcd": "f.csv", "frames": 9, "warmup_s": 0, "frame_period_s": 1}, InputError, r"frames = 9: the file has 2 frames",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("prepare", "keys", "error", "message"), BAD.values(), ids=BAD.keys())
def test_wrong_input_is_answered_with_what_would_be_right(town, tmp_path, prepare, keys, error, message):
    shutil.copy(town / "net.xml", tmp_path)
    prepare(tmp_path)
    with pytest.raises(error, match=message):
        traffic.run(scenario(tmp_path, **keys), tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


def test_traci_beside_a_finished_file_is_refused(tmp_path):
    (tmp_path / "f.csv").write_text("x")
    with pytest.raises(InputError, match="--traci: the scenario names a finished FCD file"):
        traffic.run(scenario(tmp_path, fcd="f.csv"), tmp_path, traci=("localhost", 1))


# ---- SUMO itself


def fake_sumo(folder, monkeypatch, script):
    path = folder / "sumo"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setenv("SUMO_BINARY", str(path))


def test_a_missing_system_library_is_named_with_its_packages(tmp_path, monkeypatch):
    says = "sumo: error while loading shared libraries: libX11.so.6: cannot open shared object file: No such file"
    fake_sumo(tmp_path, monkeypatch, f"echo '{says}' >&2; exit 127")
    with pytest.raises(MissingBackendError, match=r"libX11\.so\.6 is missing; on Debian: apt-get install .*libx11-6"):
        sumo.run("sumo", ["--version"], tmp_path)


def test_sumo_killed_from_outside_is_told(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "kill -9 $$")
    with pytest.raises(RunError, match="sumo was killed by signal 9"):
        sumo.run("sumo", [], tmp_path)


def test_a_binary_that_is_none_is_told(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "")
    (tmp_path / "sumo").write_bytes(b"\x00not a program")
    with pytest.raises(MissingBackendError, match="sumo cannot be started"):
        sumo.run("sumo", [], tmp_path)


def test_another_sumos_version_is_asked(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "echo 'Eclipse SUMO sumo v1_27_0+0045-abc'")
    sumo.version.cache_clear()
    try:
        assert sumo.version() == "1.27.0+0045-abc"
    finally:
        sumo.version.cache_clear()


def test_progress_goes_on_to_the_end(town, tmp_path):
    heard = []
    traffic.run(scenario(town, network="net.xml", **SMALL), tmp_path, progress=lambda *what: heard.append(what))
    assert heard[-1] == ("frames written", 240, 240)


def test_the_time_of_a_growing_file_is_that_of_its_last_whole_row(tmp_path):
    path = tmp_path / "fcd.csv"
    assert recording._last_time_ms(path) is None
    path.write_text("timestep_time;vehicle_id\n")
    assert recording._last_time_ms(path) is None
    path.write_text("timestep_time;vehicle_id\n1.250;a\n1.5")
    assert recording._last_time_ms(path) == 1250


def test_inputs_depend_on_what_the_stage_reads_and_on_nothing_else(town, tmp_path):
    def about(folder, **keys):
        return traffic.inputs(scenario(folder, network="net.xml", **keys), tmp_path)

    shutil.copytree(town, tmp_path / "elsewhere")
    assert about(town, frames=10) == about(tmp_path / "elsewhere", frames=10)
    assert about(town, frames=10) != about(town, frames=11)
    with (tmp_path / "elsewhere" / "net.xml").open("a") as file:
        file.write("\n")
    assert about(town, frames=10) != about(tmp_path / "elsewhere", frames=10)


def test_importing_the_stage_loads_no_tool_of_sumo():
    code = "import sys, pipeline.stages.traffic; print([m for m in ('sumolib', 'traci') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
