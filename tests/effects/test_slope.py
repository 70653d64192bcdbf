"""Slopes, on networks of SUMO."""

import math
import re
import shutil

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.effects import slope
from egvs.effects.slope import Slope
from egvs.scenario.effects_config import SlopeParameters
from egvs.scenario.loading import scenario_from_dict
from egvs.sensors import sites
from egvs.sensors.scanner import Scanner
from egvs.stages import scene_inputs, statics
from egvs.traffic import fcd, network, sumo, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.vehicle_boxes import VehicleSize
from egvs.world import terrain
from egvs.world.mesh import read_ply
from tests.effects.road_helpers import GRADE, HILL, SMALL, height_m, road_scenario
from tests.stage_runner import inputs_of, run_stage


def test_flat_network_has_flat_ground(flat_road, tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    run_stage(statics, road_scenario(flat_road, **SMALL), one)
    result = run_stage(statics, road_scenario(flat_road, {"slope": {}}, **SMALL), other)
    assert (one / "statics.ply").read_bytes() == (other / "statics.ply").read_bytes() and "notes" not in result
    assert len(read_ply(one / "statics.ply")[0].faces) == 2


def slope_acts(scene):
    return Slope(SlopeParameters()).acts(scene)


def test_acts_on_networks_with_relief(flat_road, hill_road, tmp_path):
    assert slope_acts(road_scenario(flat_road, **SMALL)) == (False, "the network is flat")
    assert slope_acts(road_scenario(hill_road, **SMALL)) == (True, "the network has 12.0 m of relief")
    text = (hill_road / "road.net.xml").read_text()
    (tmp_path / "low.net.xml").write_text(
        re.sub(r",12\.00\b", ",0.05", re.sub(r"(,[-\d.]+),(?!12\.00)[\d.]+(?=[ \"])", r"\1", text))
    )
    on, why = slope_acts(road_scenario(tmp_path, **(SMALL | {"network": "low.net.xml"})))
    assert not on and "no more than 0.1 m" in why
    (tmp_path / "f.csv").write_text("x")
    assert slope_acts(road_scenario(tmp_path, fcd="f.csv"))[0] is False


def test_acts_on_one_uphill_lane_from_zero(tmp_path):
    """SUMO writes no z where it is 0, so the first point of a lane may have two coordinates only."""
    (tmp_path / "n.nod.xml").write_text(
        '<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="100" y="0" z="4"/></nodes>'
    )
    (tmp_path / "e.edg.xml").write_text('<edges><edge id="ab" from="a" to="b"/></edges>')
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "road.net.xml"], tmp_path)
    assert (
        network.may_have_slopes(tmp_path / "road.net.xml")
        and network.read_net_xml(tmp_path / "road.net.xml").has_heights
    )
    assert slope_acts(road_scenario(tmp_path, **SMALL))[0]


def test_surface_follows_the_road_and_continues_level_beside_it(hill_road):
    ground = terrain.triangulate_ground(network.read_net_xml(hill_road / "road.net.xml"))
    x = np.linspace(5, 595, 400)
    for y in (-6.0, 0.0, 3.0, 6.0):
        off = np.abs(ground.height_m(x, np.full(400, y)) - height_m(x))
        assert off.max() < 0.11 and off[np.abs(x - 300) < 140].max() < 2e-3  # junction areas round the grade's ends off
    extra = ground.height_m(np.array([300.0, 300, -1e4, 1e4]), np.array([60.0, -60, 0, 0]))
    assert extra == pytest.approx([6, 6, 0, 12], abs=0.3)
    (ax, ay), (bx, by), (cx, cy) = (ground.vertices_m[ground.faces[:, i], :2].T for i in range(3))
    assert np.all((bx - ax) * (cy - ay) > (by - ay) * (cx - ax))  # every face looks up


def test_boxes_on_the_grade_have_its_pitch_and_height(hill_run):
    r = hill_run[1]
    half = r["length_m"] / 2
    wheels = (r["kind"] != "pedestrian") & (np.abs(r["x_m"] - 300) < 130)
    uphill = np.cos(r["yaw_rad"]) > 0
    assert min((wheels & uphill).sum(), (wheels & ~uphill).sum()) > 100
    assert r["pitch_rad"][wheels & uphill] == pytest.approx(math.atan(GRADE), abs=2e-4)
    assert r["pitch_rad"][wheels & ~uphill] == pytest.approx(-math.atan(GRADE), abs=2e-4)
    base = (r["z_m"] - r["height_m"] / 2)[wheels]
    assert base == pytest.approx(height_m(r["x_m"][wheels]), abs=5e-3)
    assert half.max() > 5


def test_both_ends_of_boxes_are_on_the_road_at_ends_of_the_grade(hill_run, hill_road):
    r, ground = hill_run[1], terrain.triangulate_ground(network.read_net_xml(hill_road / "road.net.xml"))
    wheels = r["kind"] != "pedestrian"
    for side in (1, -1):
        reach = side * r["length_m"] / 2
        x, y = (r[k] + reach * np.cos(r["pitch_rad"]) * f(r["yaw_rad"]) for k, f in (("x_m", np.cos), ("y_m", np.sin)))
        bottom = r["z_m"] - r["height_m"] / 2 + reach * np.sin(r["pitch_rad"])
        assert np.abs(bottom - ground.height_m(x, y))[wheels].max() < 0.02


def test_pedestrians_are_upright_on_a_slope(hill_run):
    r = hill_run[1]
    people = r["kind"] == "pedestrian"
    assert people.sum() > 1000 and set(r["pitch_rad"][people]) == {0.0}
    base = (r["z_m"] - r["height_m"] / 2)[people]
    assert np.abs(base - height_m(r["x_m"][people])).max() < 0.11


def test_footprints_are_on_the_hill_and_sites_below_it_rejected(hill_road, tmp_path):
    shutil.copy(hill_road / "road.net.xml", tmp_path)
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
    values = road_scenario(tmp_path, **SMALL).model_dump(mode="json") | {"statics": {"footprints": ["s.geojson"]}}
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
    Scanner(scene_inputs.resolve_scene(scene, world)).check(sites.candidate_sites(scene))
    low = values | {"sites": {"grid": {"low_m": [300, 10], "high_m": [300, 10], "spacing_m": 1, "heights_m": [5]}}}
    with pytest.raises(InputError, match=r"z_m = 5 is not above the ground \(z = (6|5\.9\d*)\)"):
        below = scene_inputs.resolve_scene(scenario_from_dict(low, tmp_path, "place"), world)
        Scanner(below).check(below.sites)


def test_boxes_on_a_bridge_keep_the_slope_of_sumo(hill_run, hill_road):
    """A box well above the surface is on a bridge."""
    table = fcd.FCD_SCHEMA.empty_table().from_pylist(
        [{"time_ms": 0, "id": "v", "type": "car", "x": 300, "y": 2, "z": 20, "angle": 90, "slope": 1.0, "speed": 1}],
        schema=fcd.FCD_SCHEMA,
    )
    group = FrameGroup(0, 1, np.zeros(1, np.int64), table)
    result = vehicle_boxes.boxes_from_bumpers(group, {"car": VehicleSize(4, 2, 1.5, "passenger")}, 1.0, "place")
    seated = slope.SurfaceFitter(terrain.triangulate_ground(network.read_net_xml(hill_road / "road.net.xml"))).change(
        result
    )
    assert (seated.z_m, seated.pitch_rad) == (result.z_m, result.pitch_rad)


def test_hill_sources_give_the_committed_network(tmp_path):
    for source in (HILL / "network").iterdir():
        shutil.copy(source, tmp_path)
    names = {"-n": "network.nod.xml", "-e": "network.edg.xml", "-x": "network.con.xml", "-i": "network.tll.xml"}
    flags = ["--walkingareas", "--offset.disable-normalization", "--no-turnarounds"]
    flags += ["--junctions.internal-link-detail", "10", "--precision", "3", "-o", "made.net.xml"]
    sumo.run_program("netconvert", [*(word for pair in names.items() for word in pair), *flags], tmp_path)
    actual = [
        re.sub(r"<!--.*?-->", "", text, flags=re.S).split()
        for text in ((tmp_path / "made.net.xml").read_text(), (HILL / "network.net.xml").read_text())
    ]
    assert actual[0] == actual[1]
