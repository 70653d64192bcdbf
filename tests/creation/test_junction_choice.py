"""Which junction ``egvs new`` takes with and without ``--at``: signals, distance, junctions at the point."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from shapely.geometry import LineString, MultiLineString, Point

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
    assert not any("No junction in the map has signals" in note for note in summary.notes)


def test_largest_junction_without_any_signals_has_a_note(tmp_path: Path) -> None:
    notes = create(tmp_path, None, signals=False).notes
    assert "No junction in the map has signals; the one with the most incoming lanes was chosen." in notes


def test_junction_without_signals_at_the_point_has_no_note(tmp_path: Path) -> None:
    assert not any("signals" in note for note in create(tmp_path, (60.0, 0.0), signals=False).notes)


def test_point_far_from_all_junctions_is_an_error_that_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        create(tmp_path, (180.0, 100.0))
    message = str(caught.value)
    assert message.startswith("--at: no junction of 3 or more roads is within 100 m")
    lat_deg, lon_deg = degrees((60.0, 0.0))
    assert f"The nearest are: {PLAIN} at {lat_deg:.5f},{lon_deg:.5f} (149 m away)" in message
    assert message.index(PLAIN) < message.index(SIGNALISED)
    assert not (tmp_path / "out").exists()


def test_point_far_from_all_junctions_ends_the_program_with_2(tmp_path: Path, run_egvs) -> None:
    osm = write_map(tmp_path / "map.osm", NODES, WAYS, SIGNALS)
    lat_deg, lon_deg = degrees((180.0, 100.0))
    code, _, error = run_egvs("new", tmp_path / "out", "--osm", osm, "--at", f"{lat_deg},{lon_deg}")
    assert code == 2 and "--at: no junction of 3 or more roads" in error


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
