"""A roundabout is one junction: a hand-made one with four arms, and a real one."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import pytest
from shapely.geometry import LineString, Point

from egvs.creation import assumed_traffic, junctions
from egvs.creation.junctions import Streets
from egvs.creation.openstreetmap import street_network
from egvs.formats import osm
from egvs.scenario import loading
from egvs.traffic.capacity import Capacity, TrialRun
from egvs.traffic.movements import MovementNames
from tests.creation.new_scenarios import create_scenario
from tests.creation.small_maps import XY, MapWay, degrees, street, write_map
from tests.creation.test_openstreetmap import check_sites, sites_of
from tests.stage_runner import run_stage

REAL = Path(__file__).parents[3] / "shared" / "real" / "bad_hersfeld_east.osm.gz"

RING = [10, 11, 12, 13, 14, 15, 16, 17]
"""Nodes of the ring, counter-clockwise from the east."""

ENDS = {1: 0, 2: 2, 3: 4, 4: 6}
"""The nodes at the ends of the arms in the east, north, west and south, and the position of their nodes on the ring."""


def ring_map(path: Path, radius_m: float = 15.0, *, divided: bool = False) -> Path:
    """Write a roundabout with four arms; those in the east may be two carriageways."""
    nodes: dict[int, XY] = {}
    for position, node in enumerate(RING):
        angle = math.radians(45.0 * position)
        nodes[node] = radius_m * math.cos(angle), radius_m * math.sin(angle)
    for node, position in ENDS.items():
        angle = math.radians(45.0 * position)
        nodes[node] = 400.0 * math.cos(angle), 400.0 * math.sin(angle)
    ring_tags = {"highway": "tertiary", "junction": "roundabout", "name": "Ring"}
    ways = [
        MapWay((*RING, RING[0]), ring_tags),
        street("B Street", 2, RING[2]), street("A Street", 3, RING[4]), street("C Street", 4, RING[6]),
    ]  # fmt: skip
    if divided:  # traffic drives on the right, so vehicles enter in the north
        nodes[1], nodes[5] = (400.0, 8.0), (400.0, -8.0)
        entry, way_out = street("A Street", 1, RING[1], oneway="yes"), street("A Street", RING[7], 5, oneway="yes")
        ways += [entry, way_out]
    else:
        ways.append(street("A Street", 1, RING[0]))
    return write_map(path, nodes, ways)


def read(path: Path) -> Streets:
    """The streets of a map."""
    extract = osm.read_osm(path)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    return street_network.build_network(extract, path, flags)[1]


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Streets:
    """The streets of the roundabout with four arms."""
    return read(ring_map(tmp_path_factory.mktemp("ring") / "ring.osm"))


def test_roundabout_is_one_junction(streets: Streets) -> None:
    (ring,) = (j for j in streets.junctions if j.is_crossing)
    assert ring.title == "roundabout of A Street, B Street and C Street"
    assert (ring.arms, ring.lanes_in, ring.signalised) == (4, 4, False)
    assert ring.area.covers(Point(ring.at_m)) and len(ring.area.interiors) == 0
    assert set(ring.nodes) <= {str(node) for node in RING}


@pytest.mark.parametrize("at_m", [(0.0, 0.0), (15.0, 0.0), (-10.0, 11.0), (30.0, 5.0)])
def test_any_point_on_or_near_the_ring_chooses_it(streets: Streets, at_m: XY) -> None:
    lat_deg, lon_deg = degrees(at_m)
    chosen = junctions.choose_nearby(junctions.nearest_junctions(streets, streets.to_xy([lon_deg], [lat_deg])[0]))
    assert chosen is not None and chosen.junction.ring is not None
    assert (chosen.distance_m == 0.0) == (math.hypot(*at_m) < 16.0)


def test_region_holds_ring_and_approaches(streets: Streets) -> None:
    ring = junctions.largest_junctions(streets)[0]
    assert ring is not None
    roi = junctions.region_around(ring)
    assert roi.area.buffer(1.0 - junctions.APPROACH_M, join_style="mitre").covers(ring.area)


@pytest.mark.parametrize(("radius_m", "divided"), [(15.0, False), (15.0, True), (9.0, False)])
def test_flows_lead_from_each_arm_to_each_other_arm(tmp_path: Path, radius_m: float, divided: bool) -> None:
    """Also around a small ring, whose edges are a few metres long."""
    streets = read(ring_map(tmp_path / "ring.osm", radius_m, divided=divided))
    junction = junctions.largest_junctions(streets)[0]
    assert junction is not None and junction.ring is not None and junction.arms == 4
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    assert len({(flow.from_edge, flow.to_edge) for flow in flows}) == len(flows) == 12
    gates = {flow.from_edge for flow in flows} | {flow.to_edge for flow in flows}
    assert len(gates) == 8 and not gates & set(junction.ring.edges)
    per_entry: Counter[str] = Counter()
    for flow in flows:
        assert flow.from_edge is not None
        per_entry[flow.from_edge] += round(flow.per_hour)
    assert set(per_entry.values()) == {150}


def test_movements_have_the_directions_of_the_arms(streets: Streets) -> None:
    junction = junctions.largest_junctions(streets)[0]
    assert junction is not None
    names = MovementNames(streets.network, junction.at_m)
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    words = {names.describe(flow.from_edge or "", flow.to_edge) for flow in flows}
    assert words == {
        "A Street (west), straight on", "A Street (west), left to B Street",
        "A Street (west), right to C Street", "A Street (east), straight on",
        "A Street (east), right to B Street", "A Street (east), left to C Street",
        "B Street (north), straight on to C Street", "B Street (north), left to A Street",
        "B Street (north), right to A Street", "C Street (south), straight on to B Street",
        "C Street (south), left to A Street", "C Street (south), right to A Street",
    }  # fmt: skip


@pytest.fixture
def carries_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """No trial simulations: they take longer than all the rest."""
    capacity = Capacity(1.0, (TrialRun(1.0, 100, 100, 20.0, 0),))
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: capacity)


@pytest.mark.slow
@pytest.mark.usefixtures("carries_everything")
def test_poles_stand_around_the_ring_at_all_arms(tmp_path: Path) -> None:
    summary = create_scenario(tmp_path / "out", ring_map(tmp_path / "ring.osm"), at=degrees((0.0, 0.0)))
    check_sites(tmp_path / "out", 12)
    (x, y), area = summary.junction.at_m, summary.junction.area
    quadrants: Counter[tuple[bool, bool]] = Counter()
    for row in sites_of(tmp_path / "out"):
        pole = float(row["x_m"]), float(row["y_m"])
        assert not area.covers(Point(pole))
        quadrants[pole[0] > x, pole[1] > y] += 1
    assert len(quadrants) == 4 and min(quadrants.values()) >= 2


@pytest.mark.slow
@pytest.mark.usefixtures("carries_everything")
def test_entry_of_a_ring_larger_than_the_region_has_a_note(tmp_path: Path) -> None:
    path = ring_map(tmp_path / "large.osm", radius_m=80.0)
    summary = create_scenario(tmp_path / "out", path, at=degrees((80.0, 0.0)))
    assert summary.junction.ring is None
    (note,) = (note for note in summary.notes if "roundabout" in note)
    assert note.startswith("The junction is one entry of a roundabout 16") and "(120 m)" in note


@pytest.mark.slow
def test_vehicles_follow_the_flows_around_a_ring(tmp_path: Path) -> None:
    from egvs.stages import traffic

    create_scenario(tmp_path / "out", ring_map(tmp_path / "ring.osm"), at=degrees((0.0, 0.0)))
    scenario = loading.load(tmp_path / "out", ["traffic.frames=900"])
    summary = run_stage(traffic, scenario, tmp_path / "run")
    counted = math.fsum(count["counted_per_h"] for count in summary["counts"])
    simulated = math.fsum(count["simulated_per_h"] for count in summary["counts"])
    assert len(summary["counts"]) == 12 and simulated == pytest.approx(counted, rel=0.05)
    assert all(count["geh"] < 5 for count in summary["counts"])
    assert not summary["warnings"]


@pytest.mark.slow
@pytest.mark.usefixtures("carries_everything")
def test_real_roundabout_is_one_junction(tmp_path: Path) -> None:
    if not REAL.is_file():
        pytest.skip(f"{REAL.name} is not beside the checkout (shared/real)")
    summary = create_scenario(tmp_path / "out", REAL, at=(50.8600, 9.7100))
    assert summary.junction.title == "roundabout of Berliner Straße and Europaallee"
    assert (summary.junction.arms, summary.region.from_at_m) == (4, 0.0)
    assert len(summary.flows) == 12
    check_sites(tmp_path / "out", 12)
    poles = [Point(float(row["x_m"]), float(row["y_m"])) for row in sites_of(tmp_path / "out")]
    around = LineString([*poles, poles[0]]).convex_hull
    assert around.buffer(-5.0).covers(Point(summary.junction.at_m))


def test_neighbouring_two_way_arms_without_names_are_different_streets(tmp_path: Path) -> None:
    nodes: dict[int, XY] = {}
    for number, angle_deg in enumerate(range(0, 360, 20)):
        angle = math.radians(angle_deg)
        nodes[10 + number] = 20.0 * math.cos(angle), 20.0 * math.sin(angle)
    ends = {1: 10, 2: 12, 3: 19}  # in the east, 40 degrees north of it, and in the west
    for end, on_ring in ends.items():
        nodes[end] = 20.0 * nodes[on_ring][0], 20.0 * nodes[on_ring][1]
    ring = MapWay((*range(10, 28), 10), {"highway": "tertiary", "junction": "roundabout"})
    arms = [MapWay((end, on_ring), {"highway": "tertiary"}) for end, on_ring in ends.items()]
    streets = read(write_map(tmp_path / "ring.osm", nodes, [ring, *arms]))
    (junction,) = (junction for junction in streets.junctions if junction.is_crossing)
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    assert junction.arms == 3
    assert len(flows) == 6
