"""Lanelet2 files: what is read, which files are rejected, and the graph of lanelets against the library Lanelet2."""

from __future__ import annotations

import gzip
import random
import re
from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.extensions.maps.formats import lanelet2, lanelet2_projection
from egvs.extensions.maps.formats.lanelet2_graph import (
    MOTOR_VEHICLES,
    DirectedLanelet,
    LaneletGraph,
    LaneletKey,
    allowed_users,
    build_graph,
    is_one_way,
    split_lanelets,
)
from tests.extensions.maps.lanelet2_maps import MapWriter, make_crossing

REAL = Path(__file__).parents[5] / "shared" / "real"
REAL_MAPS = (
    "lanelet2/mapping_example.osm.gz", "karlsruhe_k733/k733_lanelet2.osm.gz", "sind/chongqing_lanelet2.osm",
    "sind/xian_lanelet2.osm",
)  # fmt: skip

NODES = "".join(
    f'<node id="{number}" lat="{lat}" lon="{lon}"/>'
    for number, lat, lon in [(1, "49.0", "8.0"), (2, "49.001", "8.0"), (3, "49.0", "8.0001"), (4, "49.001", "8.0001")]
)
WAYS = '<way id="10"><nd ref="1"/><nd ref="2"/></way><way id="11"><nd ref="3"/><nd ref="4"/></way>'
LANELET = (
    '<relation id="20"><member type="way" ref="10" role="left"/><member type="way" ref="11" role="right"/>'
    '<tag k="type" v="lanelet"/><tag k="subtype" v="road"/></relation>'
)


def osm_xml(inside: str) -> str:
    return f'<?xml version="1.0" encoding="UTF-8"?><osm version="0.6">{inside}</osm>'


def put(folder: Path, content: str, name: str = "map.osm") -> Path:
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


def graph_of(path: Path) -> LaneletGraph:
    lanelet_map = lanelet2.read_lanelet2(path)
    points = lanelet2_projection.project_points(lanelet_map, path)
    return build_graph(
        lanelet_map, points.xyz_m, lambda lanelet: not allowed_users(lanelet.tags).isdisjoint(MOTOR_VEHICLES)
    )


# ---- reading


def test_reads_points_bounds_lanelets_and_regulations(tmp_path: Path) -> None:
    light = (
        '<relation id="30"><member type="way" ref="10" role="refers"/><member type="way" ref="99" role="refers"/>'
        '<tag k="type" v="regulatory_element"/><tag k="subtype" v="traffic_light"/></relation>'
    )
    referring = LANELET.replace("<tag", '<member type="relation" ref="30" role="regulatory_element"/><tag', 1)
    read = lanelet2.read_lanelet2(put(tmp_path, osm_xml(NODES + WAYS + referring + light)))
    assert read.points[2].lat_deg == 49.001
    assert read.points[2].height_m is None
    assert read.lines[11].nodes == (3, 4)
    assert read.lanelets[20].regulations == (30,)
    assert read.regulations[30].ids("way", "refers") == [10]
    assert read.missing_members == 1
    assert not read.is_autoware


def test_reads_gzip_and_ignores_deleted_objects(tmp_path: Path) -> None:
    deleted = NODES.replace('id="4"', 'id="4" action="delete"') + '<node id="4" lat="49.001" lon="8.0002"/>'
    path = tmp_path / "map.osm.gz"
    path.write_bytes(gzip.compress(osm_xml(deleted + WAYS + LANELET).encode()))
    assert lanelet2.is_lanelet2(path)
    assert lanelet2.read_lanelet2(path).points[4].lon_deg == 8.0002


def test_lanelet_without_two_bounds_is_left_out(tmp_path: Path) -> None:
    half = '<relation id="21"><member type="way" ref="10" role="left"/><tag k="type" v="lanelet"/></relation>'
    read = lanelet2.read_lanelet2(put(tmp_path, osm_xml(NODES + WAYS + LANELET + half)))
    assert read.incomplete == (21,)
    assert list(read.lanelets) == [20]


def test_recognises_lanelets_across_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, osm_xml(NODES + WAYS + LANELET))
    monkeypatch.setattr(lanelet2, "_CHUNK_BYTES", 7)
    assert lanelet2.is_lanelet2(path)
    assert not lanelet2.is_lanelet2(put(tmp_path, osm_xml(NODES + WAYS), "streets.osm"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (NODES.replace('lat="49.001"', 'lat="abc"', 1) + WAYS + LANELET, "node 2: lat: expected degrees .*, got 'abc'"),
        (NODES.replace('lat="49.001"', 'lat="nan"', 1) + WAYS + LANELET, "node 2: lat: expected degrees .*, got 'nan'"),
        (NODES.replace('lon="8.0"', 'lon="181"', 1) + WAYS + LANELET, "node 1: lon: expected degrees .*, got '181'"),
        (NODES.replace(' lon="8.0"', "", 1) + WAYS + LANELET, "node 1: lon: expected degrees .*, got None"),
        (NODES.replace('id="3"', 'id="x"') + WAYS + LANELET, "node: id: expected a whole number, got 'x'"),
        (NODES.replace('id="3"', 'id="2"') + WAYS + LANELET, "node 2: the identifier occurs twice"),
        (NODES + WAYS.replace('"4"', '"5"') + LANELET, "way 11: node 5 is not in the file"),
        (NODES + WAYS.replace("11", "12") + LANELET, "lanelet 20: its right bound, way 11, is not in the file"),
        (NODES + WAYS, "has no lanelets with two bounds"),
        ("", "has no lanelets with two bounds"),
    ],
)
def test_rejects_invalid_map_by_identifier(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        lanelet2.read_lanelet2(put(tmp_path, osm_xml(content)))


def test_rejects_local_coordinate_that_is_no_number(tmp_path: Path) -> None:
    tags = '<tag k="local_x" v="1"/><tag k="local_y" v="1,5"/></node>'
    content = NODES.replace('lon="8.0"/>', f'lon="8.0">{tags}', 1)
    with pytest.raises(InputError, match="node 1: local_y: expected metres, got '1,5'"):
        lanelet2.read_lanelet2(put(tmp_path, osm_xml(content + WAYS + LANELET)))


@pytest.mark.parametrize("data", [b"", b"<osm", b"<html></html>", b"\x1f\x8b\x08\x00", b"\x00" * 100])
def test_rejects_what_is_no_xml(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "map.osm"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"map\.osm"):
        lanelet2.read_lanelet2(path)


def test_rejects_external_entities(tmp_path: Path) -> None:
    content = '<!DOCTYPE osm [<!ENTITY e SYSTEM "file:///etc/passwd">]>' + osm_xml("&e;")[38:]
    with pytest.raises(InputError, match="entities"):
        lanelet2.read_lanelet2(put(tmp_path, content))


def test_limits_number_of_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_MAP_OBJECTS", "5")
    with pytest.raises(InputError, match="has more than 5 objects"):
        lanelet2.read_lanelet2(put(tmp_path, osm_xml(NODES + WAYS + LANELET)))


# ---- tags


@pytest.mark.parametrize(
    ("tags", "users"),
    [
        ({}, {*MOTOR_VEHICLES}),
        ({"subtype": "road"}, {*MOTOR_VEHICLES, "bicycle"}),
        ({"subtype": "highway"}, {*MOTOR_VEHICLES}),
        ({"subtype": "crosswalk"}, {"pedestrian"}),
        ({"subtype": "road", "participant:vehicle": "yes"}, {*MOTOR_VEHICLES}),
        ({"subtype": "road", "participant:vehicle:bus": "yes"}, {"bus"}),
        ({"subtype": "road", "participant:pedestrian": "yes"}, {"pedestrian"}),
        ({"subtype": "road", "participant:vehicle": "no"}, set()),
        ({"subtype": "road_shoulder"}, set()),
    ],
)
def test_users_of_lanelet(tags: dict[str, str], users: set[str]) -> None:
    assert allowed_users(tags) == users


def test_one_way_unless_tagged() -> None:
    assert is_one_way({})
    assert not is_one_way({"one_way": "no"})
    assert is_one_way({"one_way": "no", "one_way:vehicle": "yes"})


# ---- directions and relations


def test_bounds_are_turned_however_they_are_stored(tmp_path: Path) -> None:
    crossing = make_crossing()
    graphs = [graph_of(crossing.writer.write(tmp_path / f"{seed}.osm", turn_lines=seed)) for seed in (None, 1, 2, 3)]
    for graph in graphs[1:]:
        assert graph.followers == graphs[0].followers
    key = LaneletKey(crossing.into[0])
    turns = [crossing.turns[0, arm] for arm in (1, 2, 3)]
    assert sorted(other.id for other in graphs[0].followers[key]) == sorted(turns)
    assert sum(map(len, graphs[0].followers.values())) == 24  # 4 ways in x 3 turns, and 12 turns x 1 way out


def test_centre_line_and_width_of_straight_lanelet(tmp_path: Path) -> None:
    crossing = make_crossing()
    graph = graph_of(crossing.writer.write(tmp_path / "map.osm", local=True))
    lanelet = graph.lanelets[LaneletKey(crossing.into[0])]  # from x = 72 to x = 12, between y = 0 and y = 3.5
    np.testing.assert_allclose(lanelet.center_m[[0, -1], :2], [[72.0, 1.75], [12.0, 1.75]], atol=1e-3)
    assert lanelet.width_m == pytest.approx(3.5, abs=1e-3)
    assert lanelet.length_m == pytest.approx(60.0, abs=1e-3)


def test_two_way_lanelet_runs_in_both_directions(tmp_path: Path) -> None:
    writer = MapWriter()
    a = writer.lanelet(writer.line([[0, 3], [50, 3]]), writer.line([[0, 0], [50, 0]]), one_way="no")
    b = writer.lanelet(writer.line([[50, 3], [90, 3]]), writer.line([[50, 0], [90, 0]]), one_way="no")
    graph = graph_of(writer.write(tmp_path / "map.osm"))
    assert graph.followers[LaneletKey(a)] == (LaneletKey(b),)
    assert graph.followers[LaneletKey(b, True)] == (LaneletKey(a, True),)
    assert graph.followers[LaneletKey(b)] == ()
    assert str(LaneletKey(b, True)) == f"{b} (reversed)"


def test_neighbours_share_a_bound_in_the_same_direction(tmp_path: Path) -> None:
    writer = MapWriter()
    bounds = [writer.line([[0, y], [50, y]]) for y in (0, 3, 6, 9)]
    right, left = writer.lanelet(bounds[1], bounds[0]), writer.lanelet(bounds[2], bounds[1])
    opposite = writer.lanelet(bounds[2], bounds[3])
    writer.lines[bounds[2]] = writer.lines[bounds[2]][0][::-1], {}
    writer.lines[bounds[3]] = writer.lines[bounds[3]][0][::-1], {}
    graph = graph_of(writer.write(tmp_path / "map.osm"))
    assert graph.left_of[LaneletKey(right)] == (LaneletKey(left),)
    assert graph.left_of[LaneletKey(left)] == ()
    assert graph.left_of[LaneletKey(opposite)] == ()


def test_cut_lanelets_stay_neighbours_and_followers(tmp_path: Path) -> None:
    writer = MapWriter()
    bounds = [writer.line([[0, y], [50, y]]) for y in (0, 3, 6)]
    right, left = (writer.lanelet(bounds[i + 1], bounds[i], one_way="no") for i in (0, 1))
    graph = graph_of(writer.write(tmp_path / "map.osm", local=True))
    cut = split_lanelets(graph, {key: 0.8 if key.is_reversed else 0.2 for key in graph.lanelets})
    for reverse in (False, True):
        before, after = LaneletKey(right, reverse, 1), LaneletKey(right, reverse, 2)
        assert cut.followers[before] == (after,)
        beside = LaneletKey(left, reverse, 1)
        assert (cut.left_of[before] == (beside,)) != (cut.left_of[beside] == (before,))
    assert cut.lanelets[LaneletKey(right, False, 1)].length_m == pytest.approx(10.0, abs=1e-3)
    assert cut.lanelets[LaneletKey(right, True, 2)].length_m == pytest.approx(10.0, abs=1e-3)
    shared = cut.lanelets[LaneletKey(right, False, 1)].left_ends[1]
    assert cut.lanelets[LaneletKey(right, True, 2)].right_ends[0] == shared


# ---- against the library


def library_relations(
    path: Path, folder: Path
) -> tuple[set[int], set[tuple[int, bool, int, bool]], dict[int, np.ndarray]]:
    """Passable lanelets, following relations, and centre lines as the library Lanelet2 sees them."""
    library = pytest.importorskip("lanelet2", reason="the library Lanelet2 is not installed")
    plain = folder / "plain.osm"
    data = path.read_bytes()
    plain.write_bytes(gzip.decompress(data) if data.startswith(b"\x1f\x8b") else data)
    read = lanelet2.read_lanelet2(path)
    projector = library.projection.LocalCartesianProjector(library.io.Origin(*_middle_deg(read)))
    the_map, errors = library.io.loadRobust(str(plain), projector)
    assert not errors
    rules = library.traffic_rules.create(
        library.traffic_rules.Locations.Germany, library.traffic_rules.Participants.Vehicle
    )
    graph = library.routing.RoutingGraph(the_map, rules)
    passable, relations, lines = set(), set(), {}
    for lanelet in the_map.laneletLayer:
        if rules.canPass(lanelet):
            passable.add(lanelet.id)
            lines[lanelet.id] = np.array([[point.x, point.y] for point in lanelet.centerline])
            for directed in [lanelet] if rules.isOneWay(lanelet) else [lanelet, lanelet.invert()]:
                for after in graph.following(directed):
                    relations.add((lanelet.id, directed.inverted(), after.id, after.inverted()))
    return passable, relations, lines


def check_against_library(path: Path, folder: Path) -> LaneletGraph:
    passable, relations, _ = library_relations(path, folder)
    graph = graph_of(path)
    assert {key.id for key in graph.lanelets} == passable
    own = {(a.id, a.is_reversed, b.id, b.is_reversed) for a, after in graph.followers.items() for b in after}
    assert own == relations
    return graph


def test_small_map_has_the_graph_of_the_library(tmp_path: Path) -> None:
    crossing = make_crossing()
    for key, tags in ((0, {"one_way": "no"}), (1, {"participant:vehicle": "no"}), (2, {"subtype": "bicycle_lane"})):
        crossing.writer.lanelets[crossing.out_of[key]][2].update(tags)
    graph = check_against_library(crossing.writer.write(tmp_path / "map.osm", turn_lines=5), tmp_path)
    assert len(graph.lanelets) == 20 - 2 + 1


@pytest.mark.parametrize(("name", "relations"), [*zip(REAL_MAPS, (378, 33, 43, 48), strict=True)])
def test_real_map_has_the_graph_of_the_library(name: str, relations: int, tmp_path: Path) -> None:
    if not (REAL / name).is_file():
        pytest.skip(f"{name} is not beside the checkout (shared/real)")
    graph = check_against_library(REAL / name, tmp_path)
    assert sum(map(len, graph.followers.values())) == relations


@pytest.mark.parametrize("name", ["", *REAL_MAPS])
def test_centre_lines_are_as_near_to_the_middle_as_those_of_the_library(name: str, tmp_path: Path) -> None:
    """The library connects nearest points of the bounds; ours lie at equal shares of their lengths."""
    path = REAL / name if name else make_crossing().writer.write(tmp_path / "map.osm")
    if not path.is_file():
        pytest.skip(f"{name} is not beside the checkout (shared/real)")
    _, _, lines = library_relations(path, tmp_path)
    lanelet_map = lanelet2.read_lanelet2(path)
    frame = lanelet2_projection.project_points(lanelet_map, path).frame
    assert frame is not None
    library_frame = lanelet2_projection.local_cartesian_frame(*_middle_deg(lanelet_map))
    own_m, library_m = [], []
    for key, lanelet in graph_of(path).lanelets.items():
        expected = frame.from_lon_lat(library_frame.to_degrees(lines[key.id]))
        own_m.append(_distance_from_middle_m(lanelet.center_m, lanelet))
        library_m.append(_distance_from_middle_m(expected, lanelet))
    for share in (0.5, 0.9, 0.95):
        assert np.quantile(own_m, share) <= np.quantile(library_m, share) + 0.05
    assert np.quantile(own_m, 0.9) < 0.3


def _distance_from_middle_m(line: np.ndarray, lanelet: DirectedLanelet) -> float:
    """Return half the largest difference of the distances to both bounds, of the inner 80 % of a line."""
    shares = np.linspace(0.1, 0.9, 30)
    points = shapely.line_interpolate_point(shapely.LineString(line[:, :2]), shares, normalized=True)
    left, right = (shapely.LineString(bound[:, :2]) for bound in (lanelet.left_m, lanelet.right_m))
    return float(np.abs(shapely.distance(points, left) - shapely.distance(points, right)).max()) / 2


def _middle_deg(lanelet_map: lanelet2.LaneletMap) -> tuple[float, float]:
    """Return the median latitude and longitude of the points."""
    points = lanelet_map.points.values()
    return float(np.median([p.lat_deg for p in points])), float(np.median([p.lon_deg for p in points]))


def test_direction_of_random_lanelets_is_that_of_their_bounds(tmp_path: Path) -> None:
    draw = random.Random(1)
    writer = MapWriter()
    expected = {}
    for number in range(30):
        angle = draw.uniform(0, 2 * np.pi)
        u, v = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        start = np.array([100.0 * number, 0.0])
        left, right = (writer.line([start + side * v, start + 30 * u + side * v]) for side in (1.5, -1.5))
        expected[writer.lanelet(left, right)] = u
    graph = graph_of(writer.write(tmp_path / "map.osm", turn_lines=2, local=True))
    for key, lanelet in graph.lanelets.items():
        np.testing.assert_allclose(_direction(lanelet), expected[key.id], atol=1e-3)


def _direction(lanelet: DirectedLanelet) -> np.ndarray:
    along = (lanelet.center_m[-1] - lanelet.center_m[0])[:2]
    return along / np.hypot(*along)


def test_messages_about_areas_name_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, osm_xml(NODES + WAYS + LANELET))
    (lanelet,) = graph_of(path).lanelets.values()
    monkeypatch.setenv("EGVS_MAX_CORNERS", "3")
    with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: lanelet 20: has 4 corners\. The limit is 3"):
        _ = lanelet.area
