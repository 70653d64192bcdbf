"""Which junction ``egvs new`` takes with and without ``--at``: signals, distance, junctions at the point."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from shapely.geometry import LineString, MultiLineString, Point

from egvs.cli.new_summary import describe_streets
from egvs.core.errors import InputError
from egvs.creation import assumed_traffic
from egvs.creation.new_scenario import NewScenario
from egvs.traffic.capacity import Capacity, TrialRun
from tests.creation.new_scenarios import create_scenario
from tests.creation.small_maps import XY, degrees, street, write_map
from tests.creation.test_openstreetmap import sites_of

SIGNALISED = "signalised junction of A Street and B Street"
PLAIN = "junction without signals of A Street and C Street"
"""60 m east of the signalised one."""

NODES = {1: (-400.0, 0.0), 2: (0.0, 0.0), 3: (60.0, 0.0), 4: (400.0, 0.0), 5: (0.0, 300.0), 6: (60.0, -300.0)}
WAYS = [street("A Street", 1, 2, 3, 4), street("B Street", 2, 5), street("C Street", 3, 6)]
SIGNALS = {2: {"highway": "traffic_signals"}}


@pytest.fixture(autouse=True)
def carries_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """No trial simulations: they take longer than all the rest."""
    capacity = Capacity(1.0, (TrialRun(1.0, 100, 100, 20.0, 0),))
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: capacity)


def create(folder: Path, at_m: XY | None, signals: bool = True) -> NewScenario:
    """A scenario of the map, with the junction at a position in metres."""
    osm = write_map(folder / "map.osm", NODES, WAYS, SIGNALS if signals else None)
    at = None if at_m is None else degrees(at_m)
    return create_scenario(folder / "out", osm, at)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at_m", "title"),
    [
        ((0.0, 0.0), SIGNALISED),
        ((60.0, 0.0), PLAIN),
        ((61.0, -1.0), PLAIN),
        ((32.0, 0.0), SIGNALISED),  # nearer to the other one, but signals are within 40 m
        ((60.0, 25.0), PLAIN),  # signals are more than 40 m away
        ((150.0, 0.0), PLAIN),
        (None, SIGNALISED),
    ],
)
def test_takes_junction_at_point_then_near_signals_then_the_nearest(
    tmp_path: Path, at_m: XY | None, title: str
) -> None:
    summary = create(tmp_path, at_m)
    assert summary.junction.title == title
    assert not any("has signals" in note for note in summary.notes)


@pytest.mark.slow
def test_largest_junction_without_any_signals_has_a_note(tmp_path: Path) -> None:
    notes = create(tmp_path, None, signals=False).notes
    assert (
        "No junction of three or more roads in the map has signals; the one with the most incoming lanes was chosen."
        in notes
    )


@pytest.mark.slow
def test_junction_without_signals_at_the_point_has_no_note(tmp_path: Path) -> None:
    assert not any("signals" in note for note in create(tmp_path, (60.0, 0.0), signals=False).notes)


@pytest.mark.slow
def test_point_far_from_all_junctions_is_an_error_that_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        create(tmp_path, (180.0, 100.0))
    message = str(caught.value)
    assert message.startswith("--at: no junction of 3 or more roads is within 100 m")
    lat_deg, lon_deg = degrees((60.0, 0.0))
    assert f"The nearest are: {PLAIN} at {lat_deg:.5f},{lon_deg:.5f} (149 m away)" in message
    assert message.index(PLAIN) < message.index(SIGNALISED)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_point_far_from_all_junctions_ends_the_program_with_2(tmp_path: Path, run_egvs) -> None:
    osm = write_map(tmp_path / "map.osm", NODES, WAYS, SIGNALS)
    lat_deg, lon_deg = degrees((180.0, 100.0))
    code, _, error = run_egvs("new", tmp_path / "out", "--osm", osm, "--at", f"{lat_deg},{lon_deg}")
    assert code == 2 and "--at: no junction of 3 or more roads" in error


@pytest.mark.slow
def test_poles_are_spread_over_the_arms_of_a_fork(tmp_path: Path) -> None:
    """Two arms leave eastwards with an angle of 50 degrees between them, a third one westwards."""
    nodes = {1: (-300.0, 0.0), 2: (0.0, 0.0), 3: (270.0, 126.0), 4: (270.0, -126.0)}
    ways = [street("West", 1, 2), street("North", 2, 3), street("South", 2, 4)]
    osm = write_map(tmp_path / "fork.osm", nodes, ways)
    summary = create_scenario(tmp_path / "out", osm, degrees((0.0, 0.0)))
    arms: dict[str, MultiLineString] = {}
    for edge in summary.streets.network.edges:
        arms[edge.name] = arms.get(edge.name, MultiLineString()).union(LineString(edge.lanes[0].shape_m[:, :2]))
    nearest = Counter()
    for row in sites_of(tmp_path / "out"):
        pole = Point(float(row["x_m"]), float(row["y_m"]))
        nearest[min(arms, key=lambda name: arms[name].distance(pole))] += 1
    assert nearest == {"West": 4, "North": 4, "South": 4}


# ---- what a junction is

CROSSING = {"highway": "traffic_signals", "crossing": "traffic_signals"}


@pytest.mark.slow
@pytest.mark.parametrize("distance_m", [150.0, 400.0])
def test_signals_of_a_pedestrian_crossing_are_no_junction(tmp_path: Path, distance_m: float) -> None:
    """The T-junction without signals is the junction, also where the crossing is too far away for its surroundings."""
    nodes = {1: (-200.0, 0.0), 2: (0.0, 0.0), 4: (distance_m, 0.0), 5: (distance_m + 200, 0.0), 6: (distance_m, 200.0)}
    osm = write_map(
        tmp_path / "map.osm", nodes, [street("Main Street", 1, 2, 4, 5), street("Side Street", 4, 6)], {2: CROSSING}
    )
    summary = create_scenario(tmp_path / "out", osm, None)
    assert summary.junction.title == "junction without signals of Main Street and Side Street"
    assert (summary.junction.arms, summary.junction.lanes_in) == (3, 3)


@pytest.mark.slow
def test_carriageways_of_divided_roads_are_one_arm_each(tmp_path: Path) -> None:
    """Two divided roads cross: eight one-way streets, four arms."""
    nodes = {1: (-300.0, -6.0), 2: (300.0, -6.0), 3: (300.0, 6.0), 4: (-300.0, 6.0)}
    nodes |= {5: (-6.0, 300.0), 6: (-6.0, -300.0), 7: (6.0, -300.0), 8: (6.0, 300.0)}
    nodes |= {11: (-6.0, -6.0), 12: (6.0, -6.0), 13: (6.0, 6.0), 14: (-6.0, 6.0)}
    one_way = {"oneway": "yes"}
    ways = [
        street("A Street", 1, 11, 12, 2, **one_way),
        street("A Street", 3, 13, 14, 4, **one_way),
        street("B Street", 5, 14, 11, 6, **one_way),
        street("B Street", 7, 12, 13, 8, **one_way),
    ]
    signals = {node: {"highway": "traffic_signals"} for node in (11, 12, 13, 14)}
    summary = create_scenario(tmp_path / "out", write_map(tmp_path / "map.osm", nodes, ways, signals), None)
    assert summary.junction.title == SIGNALISED
    assert (summary.junction.arms, summary.junction.lanes_in) == (4, 4)


@pytest.mark.slow
def test_lane_for_turning_belongs_to_the_arm_of_its_road(tmp_path: Path) -> None:
    """Main Street has a lane of its own for right turns, from 90 m before the junction on; Lane meets it beside it."""
    nodes = {1: (-300.0, 0.0), 2: (-90.0, 0.0), 3: (-60.0, -6.0), 4: (-20.0, -6.0), 5: (0.0, 0.0), 6: (300.0, 0.0)}
    nodes |= {7: (0.0, -200.0), 8: (-50.0, 0.0), 9: (-50.0, 200.0)}
    turning = street("", 2, 3, 4, 5, oneway="yes")
    ways = [street("Main Street", 1, 2, 8, 5, 6), turning, street("Side Street", 5, 7), street("Lane", 8, 9)]
    osm = write_map(tmp_path / "map.osm", nodes, ways, {5: {"highway": "traffic_signals"}})
    summary = create_scenario(tmp_path / "out", osm, None)
    assert (summary.junction.arms, summary.junction.lanes_in) == (3, 4)


@pytest.mark.slow
def test_road_that_becomes_divided_is_no_junction(tmp_path: Path) -> None:
    nodes = {1: (-300.0, 0.0), 2: (0.0, 0.0), 3: (30.0, 6.0), 4: (300.0, 6.0), 5: (30.0, -6.0), 6: (300.0, -6.0)}
    nodes |= {7: (-200.0, 0.0), 8: (-200.0, 150.0)}
    ways = [
        street("A Street", 1, 7, 2),
        street("A Street", 2, 5, 6, oneway="yes"),
        street("A Street", 4, 3, 2, oneway="yes"),
        street("B Street", 7, 8),
    ]
    summary = create_scenario(tmp_path / "out", write_map(tmp_path / "map.osm", nodes, ways, None), None)
    assert summary.junction.title == "junction without signals of A Street and B Street"
    assert not summary.region.other_junctions


@pytest.mark.slow
def test_next_junctions_are_listed_with_the_option_that_chooses_them(tmp_path: Path) -> None:
    summary = create(tmp_path, None)
    (other,) = summary.region.other_junctions
    title, _, at = other.removesuffix(")").partition(" (--at ")
    assert title == PLAIN
    lat_deg, lon_deg = map(float, at.split(","))
    again = create_scenario(tmp_path / "other", tmp_path / "map.osm", (lat_deg, lon_deg))
    assert again.junction.title == PLAIN
    assert not again.region.other_junctions


@pytest.mark.slow
def test_second_carriageway_is_no_further_junction(tmp_path: Path) -> None:
    """B Street meets both carriageways of A Street, 30 m apart; there are signals at both, and at a stop line."""
    nodes = {1: (-300.0, 0.0), 2: (0.0, 0.0), 3: (300.0, 0.0), 4: (300.0, 30.0), 5: (0.0, 30.0), 6: (-300.0, 30.0)}
    nodes |= {7: (0.0, -200.0), 8: (0.0, 200.0), 9: (-60.0, 0.0)}
    ways = [
        street("A Street", 1, 9, 2, 3, oneway="yes"),
        street("A Street", 4, 5, 6, oneway="yes"),
        street("B Street", 7, 2, 5, 8),
    ]
    signals = {node: {"highway": "traffic_signals"} for node in (2, 5, 9)}
    summary = create_scenario(tmp_path / "out", write_map(tmp_path / "map.osm", nodes, ways, signals), None)
    assert summary.junction.title == SIGNALISED
    assert not summary.region.other_junctions
    assert describe_streets(summary.streets).endswith(", 1 junction with signals")


@pytest.mark.slow
@pytest.mark.parametrize("access", ["road", "carriageways", "none"])
def test_network_with_at_most_one_end_has_traffic_through_the_junction(tmp_path: Path, access: str) -> None:
    """A block of streets with a cross in its middle: 4 approaches with 3 turns each, with or without an access road."""
    nodes = {1: (0.0, 0.0), 2: (100.0, 0.0), 3: (-100.0, 0.0), 4: (0.0, 100.0), 5: (0.0, -100.0)}
    nodes |= {6: (100.0, 100.0), 7: (-100.0, 100.0), 8: (-100.0, -100.0), 9: (100.0, -100.0), 10: (250.0, 100.0)}
    ways = [street("East Street", 3, 1, 2), street("North Street", 4, 1, 5), street("Block", 6, 4, 7, 3, 8, 5, 9, 2, 6)]
    if access == "road":
        ways.append(street("Access", 6, 10))
    elif access == "carriageways":
        nodes[11] = (250.0, 110.0)
        ways += [street("Access", 6, 10, oneway="yes"), street("Access", 11, 6, oneway="yes")]
    osm = write_map(tmp_path / "map.osm", nodes, ways, {1: {"highway": "traffic_signals"}})
    summary = create_scenario(tmp_path / "out", osm, None)
    assert len(summary.flows) == 12
    assert not any("no street leads vehicles" in note for note in summary.notes)
