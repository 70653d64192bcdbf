"""Turns of many random OpenDRIVE and Lanelet2 junctions: none is open that the map lacks, none is lost in silence."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest

from egvs.creation.map_parts import RoadMap, RoadOptions
from egvs.extensions.maps.lanelet2 import reader as lanelet2
from egvs.extensions.maps.lanelet2.network import read_network_text
from egvs.extensions.maps.opendrive import reader as opendrive
from egvs.formats.georeference import WorldFrame
from egvs.traffic.network import TURNAROUNDS
from tests.extensions.maps import opendrive_maps as maps
from tests.extensions.maps.lanelet2_maps import make_crossing
from tests.extensions.maps.opendrive_maps import geometry, lane, road, section
from tests.extensions.maps.test_lanelet2 import build

NEAR_M, LENGTH_M = 20.0, 100.0

LaneTurn = tuple[str, int, str, int]


def built_turns(road_map: RoadMap) -> set[LaneTurn]:
    """The turns of a network, without U-turns."""
    roads = read_network_text(road_map.network)
    return {
        (roads.edges[c.source].id, c.source_lane, roads.edges[c.target].id, c.target_lane)
        for c in roads.connections
        if c.direction not in TURNAROUNDS
    }


def random_opendrive(seed: int) -> tuple[str, set[LaneTurn], set[tuple[str, int]]]:
    """A junction of three or four roads; return its text, its turns, and the lanes that lead nowhere."""
    rng = random.Random(seed)
    arms = rng.sample(range(4), rng.choice([3, 4]))
    lanes = {arm: rng.choice([1, 1, 2, 3]) for arm in arms}
    parts = []
    for arm in arms:
        angle = arm * math.pi / 2
        plan = geometry(NEAR_M * math.cos(angle), NEAR_M * math.sin(angle), angle, LENGTH_M)
        numbers = range(1, lanes[arm] + 1)
        both = section([lane(-n) for n in numbers], [lane(n) for n in reversed(numbers)])
        parts.append(road(str(arm + 1), LENGTH_M, plan, both, "predecessor junction 9"))
    turns: set[LaneTurn] = set()
    connections: list[tuple[str, str, str, str]] = []
    for source in arms:
        for number in range(1, lanes[source] + 1):
            for target in arms:
                if target == source or rng.random() < 0.4:
                    continue
                other = rng.randrange(1, lanes[target] + 1)
                connecting = str(len(connections) + 50)
                start, end = (
                    (NEAR_M * math.cos(a * math.pi / 2), NEAR_M * math.sin(a * math.pi / 2)) for a in (source, target)
                )
                length = math.dist(start, end)
                plan = geometry(*start, math.atan2(end[1] - start[1], end[0] - start[0]), length)
                through = section([lane(-1, link=f"predecessor {number}, successor {-other}")])
                link = f"predecessor road {source + 1} start, successor road {target + 1} start"
                parts.append(road(connecting, length, plan, through, link, junction="9"))
                connections.append((str(source + 1), connecting, "start", f"{number}:-1"))
                turns.add((str(source + 1), lanes[source] - number, f"-{target + 1}", lanes[target] - other))
    parts.append(maps.junction("9", *connections))
    incoming = {(str(arm + 1), index) for arm in arms for index in range(lanes[arm])}
    return maps.opendrive(*parts), turns, incoming - {turn[:2] for turn in turns}


def check_opendrive(path: Path, seed: int) -> None:
    """Check a random OpenDRIVE map."""
    text, turns, unlinked = random_opendrive(seed)
    path.write_text(text, encoding="utf-8")
    road_map = opendrive.read_roads(path, RoadOptions())
    built, notes = built_turns(road_map), " ".join(road_map.notes)
    guessed = built - turns
    assert {turn[:2] for turn in guessed} <= unlinked, f"{seed}: open: {guessed}"
    if guessed:
        word = "connection is" if len(guessed) == 1 else "connections are"
        assert f"{len(guessed)} {word} guessed, from lanes that the map links to none" in notes, seed
    lost = turns - built
    for source, _, target, _ in lost:
        assert f"{source} to {target[1:]}" in notes, f"{seed}: lost: {lost}, {notes}"
    assert f"{len(turns) - len(lost)} of {len(turns)} turns of the map" in notes, seed


def check_lanelet2(path: Path, seed: int) -> None:
    """Check a random Lanelet2 map: a crossing with some of its turns."""
    rng = random.Random(seed)
    crossing = make_crossing(lefthand=rng.random() < 0.5)
    kept = {turn for turn in crossing.turns if rng.random() < 0.7}
    for turn, number in crossing.turns.items():
        if turn not in kept:
            del crossing.writer.lanelets[number]
    built = build(crossing.writer.write(path))
    expected = {(crossing.into[source], crossing.out_of[target]) for source, target in kept}
    actual = {(built.lanelet_of[a], built.lanelet_of[b]) for a, b in built.connections}
    assert actual <= expected, f"{seed}: open: {actual - expected}"
    if lost := expected - actual:
        (note,) = (note for note in built.roads.notes if "missing in the network" in note)
        assert note.startswith(f"{len(lost)} turn"), seed


@pytest.mark.slow
def test_random_maps_have_the_turns_of_the_map(tmp_path: Path) -> None:
    for seed in range(3):
        check_opendrive(tmp_path / "map.xodr", seed)
        check_lanelet2(tmp_path / "map.osm", seed)


@pytest.mark.slow
def test_many_random_maps_have_the_turns_of_the_map(tmp_path: Path) -> None:
    for seed in range(3, 30):
        check_opendrive(tmp_path / "map.xodr", seed)
        check_lanelet2(tmp_path / "map.osm", seed)


def test_turn_between_roads_that_do_not_meet_is_reported(tmp_path: Path) -> None:
    """Road 3, 0.01 mm long, lies before road 2 and names it as its successor; netconvert drops it."""
    joined = section([lane(-1, link="successor -1")])
    tiny = section([lane(-1, link="predecessor -1, successor -1")])
    after = section([lane(-1)])
    through = section([lane(-1, link="predecessor -1, successor -1")])
    parts = [
        road("1", 100, geometry(0, 0, 0, 100), joined, "successor junction 9"),
        road("2", 100, geometry(120, 0, 0, 100), after, "predecessor junction 9"),
        road("3", 1e-5, geometry(120, 0, 0, 1e-5), tiny, "predecessor junction 9, successor road 2 start"),
        road("5", 20, geometry(100, 0, 0, 20), through, "predecessor road 1 end, successor road 2 start", junction="9"),
        maps.junction("9", ("1", "5", "start", "-1:-1")),
    ]
    (tmp_path / "map.xodr").write_text(maps.opendrive(*parts))
    road_map = opendrive.read_roads(tmp_path / "map.xodr", RoadOptions())
    assert ("-1", 0, "-2", 0) in built_turns(road_map)
    assert "Turns between these roads are missing: 3 to 2." in road_map.notes


@pytest.mark.slow
def test_position_tells_the_side_of_lanelets_without_opposite_ones(tmp_path: Path) -> None:
    crossing = make_crossing()
    for number in (*crossing.out_of.values(), *crossing.turns.values()):
        del crossing.writer.lanelets[number]
    path = crossing.writer.write(tmp_path / "map.osm")
    notes = lanelet2.read_roads(path, RoadOptions()).notes
    assert "Traffic drives on the right: the map lies outside the countries with left-hand traffic." in notes
    frame = WorldFrame("+proj=utm +zone=54 +datum=WGS84 +units=m +no_defs", (-300_000.0, -3_900_000.0))
    notes = lanelet2.read_roads(crossing.writer.write(path, frame=frame), RoadOptions()).notes
    assert "Traffic drives on the left: the map lies in Japan." in notes
