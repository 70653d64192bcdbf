"""What does not look like traffic is told with its place: who stands too long, collides, overlaps, or cannot start."""

from types import SimpleNamespace

import pytest

from egvs.core.grid import Roi
from egvs.stages import traffic
from egvs.traffic import network, recording, sumo_folder, trajectories, vehicle_boxes
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics
from tests.stages import run_stage
from tests.traffic.helpers import SIZES, group_of, scenario

ROI = Roi.around((0, 0, 2.5), (50, 100, 5))


def recorded(**keys):
    window = SimpleNamespace(period_ms=1000, count=300)
    return Recording((), window, SIZES, "s.toml: traffic", **keys)


def counted(rows, frames=300, on_purpose=frozenset()):
    tally = TrafficStatistics(frames, stopped_on_purpose=on_purpose)
    tally.add(vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place"))
    return tally


def test_who_stands_longer_than_a_signal_keeps_it_is_told_with_the_place():
    rows = [(f, "stuck", "car", 100, 62, 0, 0.0 if 10 <= f < 210 else 5.0) for f in range(300)]
    rows += [(f, "parked", "car", 0, 20 if f < 299 else 30, 0, 0.0) for f in range(300)]
    tally = counted(rows, on_purpose={"parked"})
    (found,) = trajectories.traffic_warnings(tally, recorded(standing_limit_s=180.0), ROI)
    assert found.rule == "standing" and not found.is_error
    assert found.where == "s.toml: traffic: x 100 m, y 60 m (76 m from the region of interest)"  # the box's centre
    assert found.problem.startswith("vehicle 'stuck' was standing for 199 s")
    assert tally.to_json(1.0)["longest_standing_s"] == 299
    short = counted([row for row in rows if row[0] < 130])
    assert [d.rule for d in trajectories.traffic_warnings(short, recorded(standing_limit_s=180.0), ROI)] == ["standing"]
    brief = counted([row for row in rows if row[0] < 100])
    assert trajectories.traffic_warnings(brief, recorded(standing_limit_s=180.0), ROI) == []
    assert trajectories.traffic_warnings(tally, recorded(), ROI) == []  # of a finished file nothing is promised


def test_overlaps_in_many_frames_are_told_where_most_are():
    rows = [(f, name, "car", 10.0, 31.0 + i, 0, 5.0) for f in range(20) for i, name in enumerate("ab")]
    rows += [(f, name, "car", 90.0, 31.0 + i, 0, 5.0) for f in range(5) for i, name in enumerate("cd")]
    rows += [(299, "e", "car", 0.0, 0.0, 0, 5.0)]
    (found,) = trajectories.traffic_warnings(counted(sorted(rows)), recorded(), ROI)
    assert found.rule == "overlaps"
    assert found.where == "s.toml: traffic: x 10 m, y 30 m (in the region of interest)"
    assert found.problem == "vehicles overlap in 7% of the frames; 20 of 25 overlaps are here"


COLLISION = '<collision time="{}" lane="{}" collider="{}" victim="{}"{}/>'


def test_collisions_are_told_with_junction_and_edge(tmp_path):
    seen = [
        ("9", ":J_1_0", "x", "y", ""), ("10", ":J_1_2_0", "a", "b", ' colliderFront="1,2"'),
        ("11", "out_0", "a", "b", ""), ("12", ":J_1_3_0", "c", "d", ' colliderFront="2,2"'),
        ("13", "out_1", "e", "f", ' colliderFront="325,0,3"'), ("14", "old_1", "g", "h", ""),
    ]  # fmt: skip
    text = "".join(COLLISION.format(*one) for one in seen)
    (tmp_path / sumo_folder.COLLISIONS_FILE).write_text(f"<collisions>{text}</collisions>")
    prepared = SimpleNamespace(folder=tmp_path, timing=SimpleNamespace(first_ms=10_000))
    crashes = recording._read_collisions(prepared)
    assert len(crashes) == 4
    (found,) = recording._collision_warning(crashes, scenario(tmp_path, network="net.xml"))
    assert found.problem == (
        "4 pairs of vehicles collided and drove through each other: 2 at junction J_1 (in the region of interest), "
        "1 at edge out (300 m from the region of interest), 1 at edge old"
    )
    assert recording._collision_warning({}, scenario(tmp_path, network="net.xml")) == []


def test_a_demand_that_does_not_fit_is_told(town, tmp_path):
    """Six hundred cars an hour too many for one street."""
    roads = network.read_net_xml(town / "net.xml")
    way_in = next(edge for edge in roads.edges if edge.from_node.startswith("left"))
    flow = f'<flow id="f" begin="0" end="100" number="900" from="{way_in.id}" to="{way_in.id}"/>'
    (tmp_path / "own.rou.xml").write_text(f"<routes>{flow}</routes>")
    keys = {"network": str(town / "net.xml"), "routes": ["own.rou.xml"], "frames": 60, "warmup_s": 10.0}
    result = run_stage(traffic, scenario(tmp_path, **keys), tmp_path / "out")
    found = [warning for warning in result["warnings"] if warning["rule"] == "waiting"]
    assert len(found) == 1 and "vehicles could not start" in found[0]["problem"]
    assert not (tmp_path / "out" / "sumo" / "statistics.xml").exists()


@pytest.mark.parametrize(
    ("at_m", "words"),
    [
        ((0.0, 0.0), "x 0 m, y 0 m (in the region of interest)"),
        ((28.0, 54.0), "x 28 m, y 54 m (5 m from the region of interest)"),
    ],
)
def test_a_place_is_told_with_its_distance(at_m, words):
    assert trajectories.describe_location(at_m, ROI) == words
