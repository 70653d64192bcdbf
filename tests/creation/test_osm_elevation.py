"""Heights of roads from ``ele``: only where most nodes have one; the others by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from egvs.creation.openstreetmap import street_network
from egvs.creation.openstreetmap.elevation import ELEVATION_FLAGS, MIN_SHARE, add_elevations, read_elevations
from egvs.creation.terrain.network_heights import find_shapes
from egvs.formats.osm import OsmExtract, read_osm
from tests.creation.small_maps import degrees, street, write_map

# a street along x every 50 m (nodes 1 to 9), another that begins at its node 5 and leads north (10, 11)
NODES = {number: (50.0 * (number - 5), 0.0) for number in range(1, 10)} | {10: (0.0, 100.0), 11: (0.0, 200.0)}
WAYS = [street("Main", *range(1, 10)), street("North", 5, 10, 11)]


def grade_m(node: int) -> float:
    """Five percent up to the east, level to the north."""
    return 200 + 0.05 * NODES[node][0]


def extract(folder: Path, ele: Mapping[int, object]) -> OsmExtract:
    tags = {node: {"ele": str(value)} for node, value in ele.items()}
    return read_osm(write_map(folder / "map.osm", NODES, WAYS, tags))


def test_no_height_is_no_note(tmp_path: Path) -> None:
    found = read_elevations(extract(tmp_path, {}))
    assert (found.known, found.total, found.note, dict(found.heights_m)) == (0, 11, "", {})


def test_few_heights_are_ignored_and_counted(tmp_path: Path) -> None:
    few = {node: grade_m(node) for node in list(NODES)[: int(MIN_SHARE * 11)]}
    found = read_elevations(extract(tmp_path, few))
    assert found.note == "The heights (ele) of 8 of 11 road nodes are ignored, since too many have none."
    assert not found.heights_m and found.known == 8


def test_single_heights_have_no_note(tmp_path: Path) -> None:
    nodes = {number: (10.0 * number, 0.0) for number in range(1, 201)}
    path = write_map(tmp_path / "map.osm", nodes, [street("Main", *nodes)], {7: {"ele": "200"}})
    found = read_elevations(read_osm(path))
    assert (found.known, found.total, found.note, dict(found.heights_m)) == (1, 200, "", {})


def test_missing_heights_lie_between_their_neighbours(tmp_path: Path) -> None:
    some = {node: grade_m(node) for node in NODES if node not in (3, 11)}
    found = read_elevations(extract(tmp_path, {**some, 2: f"{grade_m(2)} m"}))
    assert {node: round(height, 2) for node, height in found.heights_m.items()} == {n: grade_m(n) for n in NODES}
    assert found.note == "Roads have the heights of the map (ele); 2 of 11 nodes without were interpolated."


@pytest.mark.parametrize("text", ["high", "", "1e9", "nan", "12;13"])
def test_other_texts_are_no_heights(text: str, tmp_path: Path) -> None:
    found = read_elevations(extract(tmp_path, {node: grade_m(node) for node in NODES} | {9: text}))
    assert found.known == 10 and found.heights_m[9] == pytest.approx(grade_m(8))  # the end of the street is level


def test_height_of_a_junction_is_the_mean_of_its_roads(tmp_path: Path) -> None:
    """Node 5: 200 m between its neighbours on Main, 230 m at the next node of North."""
    some: dict[int, object] = {node: grade_m(node) for node in NODES if node != 5}
    found = read_elevations(extract(tmp_path, {**some, 10: 230}))
    assert found.heights_m[5] == pytest.approx((200 + 230) / 2)


def test_other_tags_stay(tmp_path: Path) -> None:
    path = write_map(tmp_path / "map.osm", NODES, WAYS, {1: {"highway": "stop", "ele": "5"}, 2: {"ele": "7"}})
    changed = add_elevations(read_osm(path), {1: 6.25})
    assert changed.node_tags == {1: {"highway": "stop", "ele": "6.250"}}


@pytest.mark.system
def test_network_has_the_heights_also_where_streets_are_cut(tmp_path: Path) -> None:
    """A grade of 30 %, which netconvert levels by default; the cut lies between the nodes 8 and 9."""
    steep = {node: 200 + 0.3 * NODES[node][0] for node in NODES}
    raw = extract(tmp_path, steep)
    elevated = add_elevations(raw, read_elevations(raw).heights_m)
    cut = street_network.cut_surroundings(elevated, degrees((0.0, 0.0)), 170.0)
    flags = [*street_network.netconvert_flags(cut, lefthand=False, walk=False), *ELEVATION_FLAGS]
    text, streets, _ = street_network.build_network(cut, tmp_path / "map.osm", flags)
    middle = np.array(streets.node_positions({5: degrees((0.0, 0.0))})[5])
    ends = []
    for shape in find_shapes(text):
        if shape.tag == "lane" and not shape.id.startswith(":"):
            x, _, z = (shape.points_m - [*middle, 0]).T
            assert z == pytest.approx(200 + 0.3 * x, abs=2.5)  # SUMO's junctions are level
            ends += zip(x.tolist(), z.tolist(), strict=True)
    assert max(ends) == pytest.approx((170, 251), abs=0.5) and streets.network.has_heights
