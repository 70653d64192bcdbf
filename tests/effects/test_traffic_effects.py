"""Do slopes, rear parts, and people on foot and on bicycles move as their models say, and is nothing changed where they
do not act?

Articulated vehicles are checked on finished FCD files made here, the rest with real SUMO on small networks made here.
"""

import itertools
import math
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.artefacts import parquet
from egvs.artefacts.traffic_frames import PITCHED_BOX_COLUMNS, FrameBoxes
from egvs.core.errors import InputError
from egvs.core.grid import Grid, Roi
from egvs.effects import articulated, pedestrians_bicycles, slope
from egvs.effects.articulated import Articulated
from egvs.effects.registry import find_effect_class
from egvs.effects.slope import Slope
from egvs.scenario.effects_config import ArticulatedParameters, SlopeParameters
from egvs.scenario.loading import load, scenario_from_dict
from egvs.scoring import occupancy
from egvs.sensors import sites
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.stages import inputs, statics, traffic
from egvs.traffic import fcd, network, sumo, trajectories, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.vehicle_boxes import VehicleSize
from egvs.world import terrain
from egvs.world.mesh import read_ply
from tests import processes
from tests.stages import inputs_of, run_stage

HILL = Path(__file__).resolve().parents[2] / "scenarios" / "hill"
GRADE = 0.04

NODES = """<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="150" y="0" z="0"/>
<node id="c" x="450" y="0" z="{top}"/><node id="d" x="600" y="0" z="{top}"/></nodes>"""
LANES = """<lane index="0" allow="pedestrian" width="2"/><lane index="1" allow="bicycle" width="1.5"/>
<lane index="2" disallow="pedestrian bicycle"/>"""
PLAIN_LANES = '<lane index="0" disallow="pedestrian bicycle"/>'
SMALL = {"network": "road.net.xml", "vehicles": 6, "frames": 240, "warmup_s": 90.0, "trips_per_s": 0.5}
KINDS = [
    {"name": "car", "length_m": 4.5, "width_m": 1.8, "height_m": 1.5},
    {"name": "bendy", "vclass": "bus", "length_m": 18.75, "width_m": 2.5, "height_m": 3.1},
]
SMALL["kinds"] = KINDS
CROWD = {"pedestrians_bicycles": {"pedestrians_per_h": 600, "bicycles_per_h": 400}}


def scenario(folder, effects=None, **keys):
    values = {
        "name": "trial",
        "seed": 1,
        "roi": {"center_m": [300, 0, 10], "size_m": [60, 40, 20], "voxel_m": 0.5},
        "tpog": {"blocks": 1},
        "sites": {"grid": {"low_m": [300, 10], "high_m": [300, 10], "spacing_m": 1, "heights_m": [12]}},
        "traffic": {"frame_period_s": 0.25, **keys},
        "effects": effects or {},
    }
    return scenario_from_dict(values, folder, str(folder / "scenario.toml"))


def build_road(folder, top, lanes=LANES):
    """A road from x = 0 to 600 m and back, flat, then up to ``top`` between 150 and 450 m, then flat."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "n.nod.xml").write_text(NODES.format(top=top))
    count = lanes.count("<lane")
    ways = [(a, b) for a, b in ("ab", "bc", "cd", "dc", "cb", "ba")]
    edges = "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="{count}" speed="14">{lanes}</edge>' for a, b in ways
    )
    (folder / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
    flags = ["--walkingareas", "--no-turnarounds", "--offset.disable-normalization"]
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", *flags, "-o", "road.net.xml"], folder)
    return folder


@pytest.fixture(scope="session")
def flat(tmp_path_factory):
    return build_road(tmp_path_factory.mktemp("flat"), 0)


@pytest.fixture(scope="session")
def hill(tmp_path_factory):
    return build_road(tmp_path_factory.mktemp("hill"), 300 * GRADE)


def rows(out):
    table, _ = parquet.read_artefact(out / "trajectories.parquet", "trajectories")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def bytes_of(scene, out):
    return run_stage(traffic, scene, out), (out / "trajectories.parquet").read_bytes()


@pytest.fixture(scope="session")
def climbed(hill, tmp_path_factory):
    """Result, rows and folder of the traffic on the hill road, with everything that acts there."""
    out = tmp_path_factory.mktemp("climbed")
    result = run_stage(traffic, scenario(hill, {"articulated": {}, **CROWD}, **SMALL), out)
    return result, rows(out), out


@pytest.fixture(scope="session")
def plain(flat, tmp_path_factory):
    """The bytes of the plain traffic on the flat road, and its rows."""
    out = tmp_path_factory.mktemp("plain")
    return bytes_of(scenario(flat, **SMALL), out)[1], rows(out)


# ---- what does not act changes nothing


IDLE = {
    "slope on a flat network": {"slope": {}},
    "no rear parts": {"articulated": {"auto": False}},
    "one part each": {"articulated": {"auto": False, "kinds": {"bendy": {"parts_m": [18.75]}}}},
    "nobody": {"pedestrians_bicycles": {"pedestrians_per_h": 0, "bicycles_per_h": 0}},
}


@pytest.mark.parametrize("effects", IDLE.values(), ids=IDLE.keys())
def test_an_effect_that_cannot_act_gives_the_bytes_of_the_plain_scene_and_says_so(flat, plain, tmp_path, effects):
    scene = scenario(flat, effects, **SMALL)
    result, made = bytes_of(scene, tmp_path)
    assert made == plain[0]
    name = next(iter(effects))
    assert re.fullmatch(rf"{name}: named, but .*: skipped, the result is the same", result["notes"][-1])
    reason = find_effect_class(name)(scene.effects.named[name]).why_idle(Scene(scene, None, ()))
    assert reason and reason in result["notes"][-1]
    assert inputs_of(traffic, scene, tmp_path) == inputs_of(traffic, scenario(flat, **SMALL), tmp_path)


def test_a_flat_network_imports_no_effect(flat, tmp_path):
    values = scenario(flat, **(SMALL | {"frames": 8})).model_dump(mode="json")
    code = f"""
import sys; from pathlib import Path; from egvs.stages import statics, traffic; from tests.stages import run_stage
from egvs.scenario.loading import scenario_from_dict
scene = scenario_from_dict({values!r}, Path({str(flat)!r}), "place")
run_stage(traffic, scene, Path({str(tmp_path)!r})); run_stage(statics, scene, Path({str(tmp_path)!r}))
print([m for m in sys.modules if m in ("egvs.effects.slope", "egvs.effects.articulated")])"""
    done = processes.python(code)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_a_flat_network_keeps_its_flat_ground(flat, tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    run_stage(statics, scenario(flat, **SMALL), one)
    result = run_stage(statics, scenario(flat, {"slope": {}}, **SMALL), other)
    assert (one / "statics.ply").read_bytes() == (other / "statics.ply").read_bytes() and "notes" not in result
    assert len(read_ply(one / "statics.ply")[0].faces) == 2


@pytest.mark.slow
def test_each_switch_acts(flat, plain, climbed, tmp_path):
    for number, effects in enumerate(({"articulated": {}}, CROWD)):
        assert bytes_of(scenario(flat, effects, **SMALL), tmp_path / str(number))[1] != plain[0]
    assert np.ptp(climbed[1]["z_m"]) > 10 and "slope: on, the network has 12.0 m of relief" in climbed[0]["notes"]


# ---- slope


def acts(scene):
    return Slope(SlopeParameters()).acts(scene)


def test_whether_a_network_has_relief_is_told(flat, hill, tmp_path):
    assert acts(scenario(flat, **SMALL)) == (False, "the network is flat")
    assert acts(scenario(hill, **SMALL)) == (True, "the network has 12.0 m of relief")
    text = (hill / "road.net.xml").read_text()
    (tmp_path / "low.net.xml").write_text(
        re.sub(r",12\.00\b", ",0.05", re.sub(r"(,[-\d.]+),(?!12\.00)[\d.]+(?=[ \"])", r"\1", text))
    )
    on, why = acts(scenario(tmp_path, **(SMALL | {"network": "low.net.xml"})))
    assert not on and "no more than 0.1 m" in why
    (tmp_path / "f.csv").write_text("x")
    assert acts(scenario(tmp_path, fcd="f.csv"))[0] is False


def test_one_uphill_lane_from_zero_is_relief(tmp_path):
    """SUMO writes no z where it is 0, so the first point of a lane may have two coordinates only."""
    (tmp_path / "n.nod.xml").write_text(
        '<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="100" y="0" z="4"/></nodes>'
    )
    (tmp_path / "e.edg.xml").write_text('<edges><edge id="ab" from="a" to="b"/></edges>')
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "road.net.xml"], tmp_path)
    assert (
        network.may_have_heights(tmp_path / "road.net.xml")
        and network.read_net_xml(tmp_path / "road.net.xml").has_heights
    )
    assert acts(scenario(tmp_path, **SMALL))[0]


def height_m(x):
    return np.interp(x, [150, 450], [0, 300 * GRADE])


def test_the_surface_is_the_road_and_goes_on_level_beside_it(hill):
    ground = terrain.triangulate_ground(network.read_net_xml(hill / "road.net.xml"))
    x = np.linspace(5, 595, 400)
    for y in (-6.0, 0.0, 3.0, 6.0):
        off = np.abs(ground.height_m(x, np.full(400, y)) - height_m(x))
        assert off.max() < 0.11 and off[np.abs(x - 300) < 140].max() < 2e-3  # junction areas round the grade's ends off
    beside = ground.height_m(np.array([300.0, 300, -1e4, 1e4]), np.array([60.0, -60, 0, 0]))
    assert beside == pytest.approx([6, 6, 0, 12], abs=0.3)
    (ax, ay), (bx, by), (cx, cy) = (ground.vertices_m[ground.faces[:, i], :2].T for i in range(3))
    assert np.all((bx - ax) * (cy - ay) > (by - ay) * (cx - ax))  # every face looks up


def test_on_the_grade_the_pitch_is_its_angle_and_the_centre_half_a_height_above_the_road(climbed):
    r = climbed[1]
    half = r["length_m"] / 2
    wheels = (r["kind"] != "pedestrian") & (np.abs(r["x_m"] - 300) < 130)
    uphill = np.cos(r["yaw_rad"]) > 0
    assert min((wheels & uphill).sum(), (wheels & ~uphill).sum()) > 100
    assert r["pitch_rad"][wheels & uphill] == pytest.approx(math.atan(GRADE), abs=2e-4)
    assert r["pitch_rad"][wheels & ~uphill] == pytest.approx(-math.atan(GRADE), abs=2e-4)
    base = (r["z_m"] - r["height_m"] / 2)[wheels]
    assert base == pytest.approx(height_m(r["x_m"][wheels]), abs=5e-3)
    assert half.max() > 5


def test_over_the_ends_of_the_grade_both_ends_of_every_box_are_on_the_road(climbed, hill):
    r, ground = climbed[1], terrain.triangulate_ground(network.read_net_xml(hill / "road.net.xml"))
    wheels = r["kind"] != "pedestrian"
    for side in (1, -1):
        reach = side * r["length_m"] / 2
        x, y = (r[k] + reach * np.cos(r["pitch_rad"]) * f(r["yaw_rad"]) for k, f in (("x_m", np.cos), ("y_m", np.sin)))
        bottom = r["z_m"] - r["height_m"] / 2 + reach * np.sin(r["pitch_rad"])
        assert np.abs(bottom - ground.height_m(x, y))[wheels].max() < 0.02


def test_people_stand_upright_on_the_slope(climbed):
    r = climbed[1]
    people = r["kind"] == "pedestrian"
    assert people.sum() > 1000 and set(r["pitch_rad"][people]) == {0.0}
    base = (r["z_m"] - r["height_m"] / 2)[people]
    assert np.abs(base - height_m(r["x_m"][people])).max() < 0.11


def test_footprints_stand_on_the_hill_and_sites_below_it_are_refused(hill, tmp_path):
    shutil.copy(hill / "road.net.xml", tmp_path)
    square = [[290, 15], [310, 15], [310, 25], [290, 25], [290, 15]]
    pole = {"type": "Point", "coordinates": [400, 8]}
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [square]},
            "properties": {"name": "h", "height_m": 5},
        },
        {"type": "Feature", "geometry": pole, "properties": {"name": "p", "height_m": 5, "base_m": 2, "radius_m": 0.1}},
    ]
    (tmp_path / "s.geojson").write_text(f'{{"crs": null, "features": {features}}}'.replace("'", '"'))
    values = scenario(tmp_path, **SMALL).model_dump(mode="json") | {"statics": {"footprints": ["s.geojson"]}}
    scene = scenario_from_dict(values, tmp_path, "place")
    result = run_stage(statics, scene, tmp_path / "out")
    assert result["notes"] == ["slope: on, the ground follows the network's roads"]
    assert "surface" in inputs_of(statics, scene, tmp_path).files
    world = read_ply(tmp_path / "out" / "statics.ply")[0]
    spans = {
        name: np.ptp(world.triangles_m[world.solid_of_face == i][:, :, 2]) for i, (name, _) in enumerate(world.solids)
    }
    tops = {
        name: world.triangles_m[world.solid_of_face == i][:, :, 2].max() for i, (name, _) in enumerate(world.solids)
    }
    assert tops["h"] == pytest.approx(6 + 5, abs=0.2) and spans["h"] == pytest.approx(5 + 10 * GRADE, abs=0.2)
    assert tops["p"] == pytest.approx(10 + 5, abs=0.1) and spans["p"] == pytest.approx(3)
    Scanner(inputs.resolve_scene(scene, world)).check(sites.candidate_sites(scene))
    low = values | {"sites": {"grid": {"low_m": [300, 10], "high_m": [300, 10], "spacing_m": 1, "heights_m": [5]}}}
    with pytest.raises(InputError, match=r"z_m = 5 is not above the ground \(z = (6|5\.9\d*)\)"):
        below = inputs.resolve_scene(scenario_from_dict(low, tmp_path, "place"), world)
        Scanner(below).check(below.sites)


def test_a_bridge_keeps_sumos_own_slope(climbed, hill):
    """A box well above the surface stands on something else."""
    table = fcd.FCD_SCHEMA.empty_table().from_pylist(
        [{"time_ms": 0, "id": "v", "type": "car", "x": 300, "y": 2, "z": 20, "angle": 90, "slope": 1.0, "speed": 1}],
        schema=fcd.FCD_SCHEMA,
    )
    group = FrameGroup(0, 1, np.zeros(1, np.int64), table)
    found = vehicle_boxes.boxes_from_bumpers(group, {"car": VehicleSize(4, 2, 1.5, "passenger")}, 1.0, "place")
    seated = slope.SurfaceFitter(terrain.triangulate_ground(network.read_net_xml(hill / "road.net.xml"))).change(found)
    assert (seated.z_m, seated.pitch_rad) == (found.z_m, found.pitch_rad)


# ---- articulated


def finished(folder, poses, effects, period_s=0.25, **keys):
    """A scenario of a finished file with one bendy bus at (x, y, angle in degrees) in each frame, None where it is
    missing."""
    folder.mkdir(exist_ok=True)
    head = (
        "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed;vehicle_slope;vehicle_z"
    )
    lines = [f"{i * period_s:.3f};car;-900;{i};0;car;1;0;0" for i in range(len(poses))]
    for i, pose in enumerate(poses):
        if pose is not None:
            x, y, angle, *slope_z = pose
            tail = ";".join(str(v) for v in slope_z or (0, 0))
            lines[i] += f"\n{i * period_s:.3f};v;{x:.9f};{y:.9f};{angle:.9f};bendy;5;{tail}"
    (folder / "f.csv").write_text("\n".join([head, *lines, ""]))
    about = {"fcd": "f.csv", "frames": len(poses), "frame_period_s": period_s, "warmup_s": 0, "kinds": KINDS}
    return scenario(folder, effects, **(about | keys))


def bus_rows(out, part):
    r = rows(out)
    mine = (r["vehicle"] == "v") & (r["part"] == part)
    return {name: values[mine] for name, values in r.items()}


PARTS = {"articulated": {"kinds": {"bendy": {"parts_m": [10.6, 7.5], "axles_m": [5.0]}}}}


@pytest.mark.parametrize("angle", [0, 90, 180, 270, 53.130102354])
def test_on_a_straight_road_parts_are_in_line_and_as_long_as_sumos_vehicle(tmp_path, angle):
    way = np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])
    poses = [(*(way * 1.3 * i), angle) for i in range(60)]
    run_stage(traffic, finished(tmp_path, poses, PARTS), tmp_path / "out")
    front, rear = bus_rows(tmp_path / "out", 0), bus_rows(tmp_path / "out", 1)
    assert np.abs(rear["yaw_rad"] - front["yaw_rad"]).max() < 2e-9
    assert set(front["length_m"]) == {10.6} and set(rear["length_m"]) == {7.5}
    ends = np.array([[p[0], p[1]] for p in poses])
    for part, middle in ((front, 5.3), (rear, 18.75 - 3.75)):
        assert np.column_stack([part["x_m"], part["y_m"]]) == pytest.approx(ends - middle * way, abs=2e-6)


@pytest.mark.parametrize("turn", [1, -1], ids=["left", "right"])
def test_on_a_circle_the_rear_settles_at_the_arcsine_of_axle_over_radius(tmp_path, turn):
    """The front part is fixed to the circle, so that its joint runs on a circle too: hand-checkable."""
    radius, step = 15.0, 0.06
    poses = []
    for i in range(400):
        phi = turn * step * i
        poses.append(
            (
                radius * math.cos(phi),
                radius * math.sin(phi),
                math.degrees(-phi) if turn > 0 else 180 - math.degrees(phi),
            )
        )
    run_stage(traffic, finished(tmp_path, poses, PARTS), tmp_path / "out")
    front, rear = bus_rows(tmp_path / "out", 0), bus_rows(tmp_path / "out", 1)
    hinge = 10.6 + 0.65 / 2
    # the joint lies on the tangent behind the bumper; its own direction is turned against the front's heading by
    # atan(hinge / R)
    joint_radius = math.hypot(radius, hinge)
    expected = math.asin(5.0 / joint_radius) + math.atan(hinge / radius)
    angle = np.angle(np.exp(1j * (front["yaw_rad"] - rear["yaw_rad"])))
    assert angle[0] == 0
    assert turn * angle[-50:] == pytest.approx(expected, abs=1e-4)


@given(st.floats(-3.1, 3.1), st.floats(-3, 3), st.floats(0.01, 5), st.floats(0.5, 12))
def test_the_solution_of_a_step_agrees_with_many_small_ones(heading, direction, way, axle):
    """The closed form against a plain integration of d theta = sin(psi - theta) ds / d (Heun, 4000 steps)."""
    theta, n = heading, 4000
    for _ in range(n):
        slope_1 = math.sin(direction - theta) / axle
        slope_2 = math.sin(direction - theta - slope_1 * way / n) / axle
        theta += (slope_1 + slope_2) / 2 * way / n
    found = articulated.follow(heading, way * math.cos(direction), way * math.sin(direction), 0.0, axle)
    assert abs(math.remainder(found - theta, math.tau)) < 1e-4


def test_cutting_an_arc_into_frames_changes_little():
    one = articulated.follow(
        0.0, 2 * math.sin(0.2) * 10 * math.cos(0.2), 2 * math.sin(0.2) * 10 * math.sin(0.2), 0.4, 6.0
    )
    two = 0.0
    for i in range(2):
        chord, along = 2 * 10 * math.sin(0.1), 0.2 * i + 0.1
        two = articulated.follow(two, chord * math.cos(along), chord * math.sin(along), 0.2, 6.0)
    assert one == pytest.approx(two, abs=1e-4)


def test_groups_of_frames_do_not_show_and_a_vehicle_that_was_away_starts_straight(tmp_path, monkeypatch):
    poses = [(20 * math.cos(0.05 * i), 20 * math.sin(0.05 * i), -math.degrees(0.05 * i)) for i in range(120)]
    poses[70] = None
    whole = bytes_of(finished(tmp_path, poses, PARTS), tmp_path / "whole")[0]
    front, rear = bus_rows(tmp_path / "whole", 0), bus_rows(tmp_path / "whole", 1)
    assert front["yaw_rad"][70] == rear["yaw_rad"][70] and abs(front["yaw_rad"][69] - rear["yaw_rad"][69]) > 0.2
    monkeypatch.setattr(trajectories, "GROUP_FRAMES", 7)
    assert bytes_of(finished(tmp_path, poses, PARTS), tmp_path / "cut")[0] == whole
    one, other = rows(tmp_path / "whole"), rows(tmp_path / "cut")
    assert all(np.array_equal(one[name], other[name]) for name in one)
    assert whole["articulated"]["vehicles"] == 1 and whole["vehicles"] == {"fewest": 1, "most": 2, "different": 2}
    assert whole["overlapping_pairs"] == 0  # parts of one vehicle, which touch at the joint, are no overlap


def test_longer_axles_cut_less_and_three_parts_follow_one_another(tmp_path):
    poses = [(20 * math.cos(0.05 * i), 20 * math.sin(0.05 * i), -math.degrees(0.05 * i)) for i in range(200)]
    angles = []
    for axle in (3.0, 6.0):
        kinds = {"bendy": {"parts_m": [8, 5, 5], "axles_m": [axle, axle]}}
        run_stage(traffic, finished(tmp_path, poses, {"articulated": {"kinds": kinds}}), tmp_path / "out")
        yaw = [bus_rows(tmp_path / "out", part)["yaw_rad"][-1] for part in range(3)]
        angles.append([math.remainder(yaw[i] - yaw[i + 1], math.tau) for i in range(2)])
    assert all(
        b > a > 0 for a, b in zip(*angles, strict=True)
    )  # the angle at each joint grows with the axle's distance


def test_a_long_bus_gets_parts_by_itself_and_a_short_one_does_not():
    sizes = {
        name: VehicleSize(length, 2.5, 3, vclass)
        for name, vclass, length in (
            ("a", "bus", 18.75),
            ("b", "bus", 12),
            ("c", "trailer", 16.5),
            ("d", "passenger", 20),
        )
    }
    found = Articulated(ArticulatedParameters()).geometries(sizes, "place")
    assert set(found) == {"a", "c"}
    assert found["a"].lengths_m == pytest.approx((10.6, 7.5)) and found["a"].starts_m[1] == pytest.approx(11.25)
    assert found["c"].lengths_m == pytest.approx((6, 10.5)) and found["c"].hinges_m == (4.5,)
    assert found["c"].axles_m == pytest.approx((7.7,))
    assert Articulated(ArticulatedParameters(auto=False)).geometries(sizes, "place") == {}


def test_parts_lie_on_the_slope_of_a_finished_file(tmp_path):
    """Without a network there is no surface: the parts lie along the slope that the file gives."""
    degrees, p = math.degrees(math.atan(GRADE)), math.atan(GRADE)
    poses = [(1.0 * i, 0, 90, degrees, 100 + GRADE * i) for i in range(20)]
    run_stage(traffic, finished(tmp_path, poses, PARTS), tmp_path / "out")
    rear = bus_rows(tmp_path / "out", 1)
    middle, front_x = 18.75 - 3.75, np.arange(20.0)
    assert rear["pitch_rad"] == pytest.approx(p, abs=1e-9)
    assert rear["x_m"] == pytest.approx(front_x - middle * math.cos(p), abs=2e-6)
    assert rear["z_m"] == pytest.approx(100 + GRADE * front_x - middle * math.sin(p) + 3.1 / 2, abs=2e-6)


def test_parts_on_the_hill_are_in_line_on_the_straight_road(climbed):
    """Composition: each part stands on the grade by itself, behind the one that pulls it."""
    r = climbed[1]
    rear = np.flatnonzero((r["part"] == 1) & (np.abs(r["x_m"] - 300) < 100))
    assert rear.size > 20 and climbed[0]["articulated"]["vehicles"] > 1
    front = rear - 1
    assert np.array_equal(r["vehicle"][rear], r["vehicle"][front])
    assert np.abs(r["pitch_rad"][rear]) == pytest.approx(math.atan(GRADE), abs=2e-4)
    apart = np.sqrt(sum((r[k][rear] - r[k][front]) ** 2 for k in ("x_m", "y_m", "z_m")))
    assert apart == pytest.approx((10.6 + 7.5) / 2 + 0.65, abs=2e-3)


# ---- pedestrians and bicycles


@pytest.fixture
def patient(monkeypatch):
    """A SUMO that was just started listens a moment later."""
    connect = sumo._connect

    def until_it_listens(host, port):
        return next(filter(None, (connect(host, port) for _ in range(200_000))), None)

    monkeypatch.setattr(sumo, "_connect", until_it_listens)


def kind_rows(r, *kinds):
    return {name: values[np.isin(r["kind"], kinds)] for name, values in r.items()}


def test_motor_vehicles_are_held_exactly_beside_bicycles_that_come_and_go(climbed):
    result, r, _ = climbed
    motor = (~np.isin(r["kind"], ["bicycle", "pedestrian"])) & (r["part"] == 0)
    assert Counter(r["frame"][motor].tolist()) == dict.fromkeys(range(240), 6)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 6
    beside = result["beside_vehicles"]
    assert beside["bicycle"]["fewest"] < beside["bicycle"]["most"] and beside["pedestrian"]["most"] > 5
    assert result["collisions"] == 0


def test_every_drawn_bicycle_trip_is_ridden_when_it_should_be(flat, tmp_path):
    scene = scenario(
        flat,
        {"pedestrians_bicycles": {"bicycles_per_h": 720}},
        **SMALL | {"warmup_s": 0.0, "frames": 600, "hold": "at_most"},
    )
    run_stage(traffic, scene, tmp_path)
    r = kind_rows(rows(tmp_path), "bicycle")
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


def test_people_walk_on_sidewalks_facing_their_way_half_a_length_behind_their_front(climbed):
    _, r, out = climbed
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
def test_a_bicycle_stops_on_its_lane_whatever_its_length(length_m: float, before_m: float) -> None:
    """SUMO refuses a stop that ends beyond the lane's end (175.53 of 175.526 m) or is shorter than 0.1 m."""
    end_m = max(length_m - before_m, length_m / 2)
    stop = pedestrians_bicycles._stop(pedestrians_bicycles._BicycleLane("lane", length_m), end_m - 12.0, end_m, 1.0)
    first, last = (float(re.search(f'{key}="([^"]*)"', stop)[1]) for key in ("startPos", "endPos"))
    assert 0 <= first <= last - 0.1 + 1e-9
    assert last <= length_m
    assert last == pytest.approx(end_m, abs=0.0101)


def test_bicycles_ride_on_their_lanes_with_their_riders_size(climbed):
    riders = kind_rows(climbed[1], "bicycle")
    on_lane = (riders["x_m"] > 170) & (riders["x_m"] < 430)
    assert on_lane.sum() > 100
    assert np.all((np.abs(riders["y_m"][on_lane]) > 3.1) & (np.abs(riders["y_m"][on_lane]) < 4.8))
    assert {(1.76, 0.6, 1.73)} == set(zip(riders["length_m"], riders["width_m"], riders["height_m"], strict=True))


def test_people_never_lower_a_voxels_count(climbed):
    """With the same vehicles, each person and bicycle can only add: the monotonic truth of this effect."""
    grid = Grid.over(Roi.around((100, 0, 10), (60, 40, 20)), 0.5)
    counts = []
    for kinds in ([], ["bicycle"], ["bicycle", "pedestrian"]):
        r = climbed[1]
        kept = ~np.isin(r["kind"], ["bicycle", "pedestrian"]) | np.isin(r["kind"], kinds)
        values = np.column_stack([r[name][kept] for name in PITCHED_BOX_COLUMNS])
        values[:, :3] = grid.to_grid_m(values[:, :3])
        counts.append(occupancy.count_occupancy(FrameBoxes(r["frame"][kept].astype(np.int64), values), grid, 240))
    assert all(np.all(more >= less) and more.sum() > less.sum() for less, more in itertools.pairwise(counts))


@pytest.mark.slow
def test_more_departures_bring_more_people(flat, tmp_path):
    means = []
    for rate in (0, 200, 1000):
        scene = scenario(flat, {"pedestrians_bicycles": {"pedestrians_per_h": rate, "bicycles_per_h": 100}}, **SMALL)
        run_stage(traffic, scene, tmp_path)
        means.append(np.count_nonzero(rows(tmp_path)["kind"] == "pedestrian"))
    assert means[0] == 0 < means[1] < means[2]


@pytest.mark.slow
def test_same_seed_same_bytes_and_the_same_over_traci(hill, climbed, tmp_path, patient):
    from sumolib.miscutils import getFreeSocketPort

    scene = scenario(hill, {"articulated": {}, **CROWD}, **SMALL)
    assert bytes_of(scene, tmp_path / "again")[1] == (climbed[2] / "trajectories.parquet").read_bytes()
    port, quiet = getFreeSocketPort(), subprocess.DEVNULL
    command = [str(sumo.sumo_binary("sumo")), "-c", "run.sumocfg", "--remote-port", str(port)]
    with subprocess.Popen(
        command, cwd=tmp_path / "again" / "sumo", env=sumo.sumo_environment(), stdout=quiet, stderr=quiet
    ) as process:
        try:
            run_stage(traffic, scene, tmp_path / "polled", traci=("localhost", port))
        finally:
            process.kill()
    one, other = rows(tmp_path / "again"), rows(tmp_path / "polled")
    assert all(np.array_equal(one[name], other[name]) for name in one)


def own_demand(flat, folder):
    """A user's route file with vehicles and one person who walks from the road's west end."""
    shutil.copy(flat / "road.net.xml", folder)
    trips = "".join(f'<trip id="{i}" depart="{2 * i}" from="ab" to="cd"/>' for i in range(80))
    person = '<person id="own" depart="0"><walk from="ab" to="cd"/></person>'
    (folder / "own.rou.xml").write_text(f"<routes>{person}{trips}</routes>")
    keys = {k: v for k, v in SMALL.items() if k not in ("trips_per_s", "kinds")}
    return keys | {"routes": ["own.rou.xml"], "vehicles": 4, "hold": "at_most"}


def test_a_users_own_routes_get_people_beside_them(flat, tmp_path):
    keys = own_demand(flat, tmp_path)
    result = run_stage(traffic, scenario(tmp_path, CROWD, **keys), tmp_path / "out")
    assert result["vehicles"]["most"] == 4 and result["vehicles"]["fewest"] >= 3
    assert set(result["beside_vehicles"]) == {"bicycle", "pedestrian", "overlapping_pairs"}
    assert "own" in rows(tmp_path / "out")["vehicle"]


def test_in_the_plain_scene_a_users_own_persons_are_no_vehicles(flat, tmp_path):
    """Without a file of their own, SUMO writes persons among the vehicles."""
    result = run_stage(traffic, scenario(tmp_path, **own_demand(flat, tmp_path)), tmp_path / "out")
    assert result["vehicles"]["most"] == 4
    assert set(rows(tmp_path / "out")["kind"]) == {"passenger"}


# ---- wrong input


def crowd(**rates):
    return {"pedestrians_bicycles": rates}


def parts(kind, **lists):
    return {"articulated": {"kinds": {kind: lists}}}


BAD = {
    "no sidewalks": (
        PLAIN_LANES,
        crowd(pedestrians_per_h=9),
        r"no connected sidewalks.*--sidewalks\.guess --crossings\.guess",
    ),
    "no bicycle lanes": (PLAIN_LANES, crowd(bicycles_per_h=9), r"no lane that bicycles may use.*--bikelanes\.guess"),
    "an unknown kind": (LANES, parts("tram", parts_m=[5, 5]), r"no vehicle type 'tram'. Use one of bendy, car"),
    "too long parts": (
        LANES,
        parts("bendy", parts_m=[10, 9]),
        r"bendy\.parts_m: .*at most the type's 18\.75 m, got 19 m",
    ),
    "one short part": (LANES, parts("bendy", parts_m=[10]), r"exactly the type's .*, got 10 m"),
    "a hinge behind": (LANES, parts("bendy", parts_m=[9, 9], hinges_m=[19]), r"hinges_m: .*18\.75 m, got 19 m"),
}


@pytest.mark.parametrize(("lanes", "effects", "message"), BAD.values(), ids=BAD.keys())
def test_what_does_not_fit_the_network_or_the_fleet_is_told(tmp_path, lanes, effects, message):
    build_road(tmp_path, 0, lanes)
    with pytest.raises(InputError, match=message):
        run_stage(traffic, scenario(tmp_path, effects, **SMALL), tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


WRONG = {
    "slope takes nothing": ("effects.slope.grade=1", r"effects\.slope\.grade: unknown key"),
    "a negative rate": ("effects.pedestrians_bicycles.pedestrians_per_h=-1", r"pedestrians_per_h: -1"),
    "a flat person": ("effects.pedestrians_bicycles.pedestrian_m=[0.8,0.6,0]", r"pedestrian_m"),
    "no parts": ("effects.articulated.kinds.car.parts_m=[]", r"articulated\.kinds\.car\.parts_m"),
    "too many hinges": (
        "effects.articulated.kinds.car={parts_m=[2,2],hinges_m=[2,3]}",
        r"hinges_m has 2 values for 2 parts, 1",
    ),
    "a wrong word": ("effects.articulated.kind=1", r"articulated\.kind: unknown key. Did you mean kinds\?"),
    "people beside a finished file": (
        "effects.pedestrians_bicycles.bicycles_per_h=9",
        r"cannot be added to a finished FCD file",
    ),
}


@pytest.mark.parametrize(("override", "message"), WRONG.values(), ids=WRONG.keys())
def test_bad_parameters_are_refused(mini, run_egvs, tmp_path, override, message):
    code, _, said = run_egvs("traffic", mini, "--out", tmp_path / "out", "--set", override)
    assert code == 2 and re.search(message, " ".join(said.split())), said


# ---- the scenario that shows them


def test_the_hill_scenario_holds_its_vehicles_and_has_everybody_on_the_road(tmp_path):
    scene = load(HILL, ["traffic.frames=120", "traffic.warmup_s=150", "tpog.blocks=1"])
    result = run_stage(traffic, scene, tmp_path)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 24 and result["collisions"] == 0
    assert "slope: on, the network has 16.0 m of relief" in result["notes"]
    r = rows(tmp_path)
    assert {"passenger", "pedestrian", "bicycle"} < set(r["kind"]) and r["part"].max() == 1
    assert pedestrians_bicycles.PEDESTRIAN.startswith("egvs")


def test_the_hill_networks_sources_give_the_committed_network(tmp_path):
    for source in (HILL / "network").iterdir():
        shutil.copy(source, tmp_path)
    names = {"-n": "network.nod.xml", "-e": "network.edg.xml", "-x": "network.con.xml", "-i": "network.tll.xml"}
    flags = ["--walkingareas", "--offset.disable-normalization", "--no-turnarounds"]
    flags += ["--junctions.internal-link-detail", "10", "--precision", "3", "-o", "made.net.xml"]
    sumo.run_program("netconvert", [*(word for pair in names.items() for word in pair), *flags], tmp_path)
    made = [
        re.sub(r"<!--.*?-->", "", text, flags=re.S).split()
        for text in ((tmp_path / "made.net.xml").read_text(), (HILL / "network.net.xml").read_text())
    ]
    assert made[0] == made[1]
