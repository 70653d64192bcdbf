"""Roads laid on a terrain: a plane is exact, a valley is followed, bridges stay up, unknown ground is refused."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import box

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.creation import road_levels
from egvs.creation.map_parts import MapContext, RoadOptions
from egvs.creation.openstreetmap import street_network
from egvs.creation.terrain.draping import STEP_M, TOLERANCE_M, drape_network, level_difference_m, roads_above_others
from egvs.creation.terrain.ground_heights import ground_points
from egvs.creation.terrain.network_heights import find_shapes, node_of_internal, shift_heights
from egvs.extensions.maps.opendrive import reader as opendrive
from egvs.extensions.maps.terrain import rasters
from egvs.formats import ply
from egvs.formats.georeference import WorldFrame
from egvs.formats.osm import read_osm
from egvs.traffic import network, sumo
from tests.creation.draped_roads import NODES, PLANE, VALLEY, Function, build
from tests.creation.small_maps import degrees, street, write_map
from tests.extensions.maps.formats.test_rasters import write_tiff
from tests.extensions.maps.test_opendrive import TOWN01


def read(text: str, folder: Path) -> network.Network:
    (folder / "draped.net.xml").write_text(text)
    return network.read_net_xml(folder / "draped.net.xml")


def all_lanes(roads: network.Network) -> dict[str, FloatArray]:
    return {f"{edge.id}_{i}": lane.shape_m for edge in roads.all_edges for i, lane in enumerate(edge.lanes)}


def densified(shape_m: FloatArray, step_m: float = 0.5) -> FloatArray:
    pieces = [shape_m[:1]]
    for start, end in itertools.pairwise(shape_m):
        steps = max(1, int(np.ceil(np.hypot(*(end - start)[:2]) / step_m)))
        pieces.append(start + (end - start) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(pieces)


@pytest.mark.slow
@pytest.mark.system
def test_heights_on_a_plane_are_exact(tmp_path: Path) -> None:
    draped = drape_network(build(tmp_path), PLANE, (150.0, 0.0))
    assert draped.zero_height_m == pytest.approx(206.0)
    for shape in find_shapes(draped.text):
        expected = 0.04 * (shape.points_m[:, 0] - 150) - 0.02 * shape.points_m[:, 1]
        assert shape.points_m[:, 2] == pytest.approx(expected, abs=6e-4)
    before, after = all_lanes(read(build(tmp_path), tmp_path)), all_lanes(read(draped.text, tmp_path))
    assert {name: shape[:, :2].tolist() for name, shape in after.items()} == {
        name: shape[:, :2].tolist() for name, shape in before.items()
    }  # no points are added on a plane
    assert "z = 0 is a height of 206.00 m, the ground at (150.0, 0.0)." in draped.notes[0]


@pytest.mark.system
def test_long_straight_lanes_follow_the_relief(tmp_path: Path) -> None:
    draped = drape_network(build(tmp_path, "ad"), VALLEY, (0.0, 0.0))
    lanes = all_lanes(read(draped.text, tmp_path))
    for shape in lanes.values():
        points = densified(shape)
        off = np.abs(points[:, 2] + draped.zero_height_m - VALLEY.of(points[:, 0], points[:, 1]))
        # between points 5 m apart, a curve of radius R is off by 5^2 / 8R; here R is above 65 m
        assert off.max() < TOLERANCE_M + STEP_M**2 / 8 / 65
    assert 8 < len(lanes["ad_0"]) < 300 / STEP_M
    assert lanes["ad_0"][:, 1] == pytest.approx(np.full(len(lanes["ad_0"]), lanes["ad_0"][0, 1]), abs=1e-5)


@pytest.mark.slow
@pytest.mark.system
def test_sumo_drives_on_it(tmp_path: Path) -> None:
    """SUMO writes z and slope of the draped lane: at 4 %, 2.29 degrees."""
    (tmp_path / "draped.net.xml").write_text(drape_network(build(tmp_path), PLANE, (0.0, 0.0)).text)
    (tmp_path / "r.rou.xml").write_text('<routes><trip id="t" depart="0" from="ab" to="cd"/></routes>')
    sumo.run_program("sumo", ["-n", "draped.net.xml", "-r", "r.rou.xml", "--fcd-output", "fcd.xml"], tmp_path)
    text = (tmp_path / "fcd.xml").read_text()
    rows = [dict(re.findall(r'(\w+)="([^"]*)"', line)) for line in text.splitlines() if "<vehicle" in line]
    assert len(rows) > 10
    for row in rows[1:-1]:
        x, y, z, slope = (float(row[key]) for key in ("x", "y", "z", "slope"))
        assert z == pytest.approx(0.04 * x - 0.02 * y, abs=0.02)
        assert slope == pytest.approx(np.degrees(np.arctan(0.04)), abs=0.1)


@pytest.mark.system
def test_bridge_runs_straight_over_the_valley(tmp_path: Path) -> None:
    """From b to c, 9.5 m above the ground in the middle; the road below it stays in the valley."""
    text = build(tmp_path)
    levels = {"bc": 1, "-bc": 1}
    draped = drape_network(text, VALLEY, (0.0, 0.0), levels)
    lanes = all_lanes(read(draped.text, tmp_path))
    bridge, below = lanes["bc_0"], lanes["uv_0"]
    ends = VALLEY.of(bridge[[0, -1], 0], np.zeros(2)) - draped.zero_height_m
    assert bridge[[0, -1], 2] == pytest.approx(ends, abs=1e-3)
    assert bridge[:, 2] == pytest.approx(np.interp(bridge[:, 0], bridge[[0, -1], 0], ends), abs=1e-3)
    ground = VALLEY.of(below[:, 0], np.zeros(len(below))) - draped.zero_height_m
    assert len(bridge) == 2 and below[:, 2] == pytest.approx(ground, abs=1e-3) and ground.max() < -11
    assert "2 edges on bridges or in tunnels run straight between their ends." in draped.notes
    assert not any("cross without a junction" in note for note in draped.notes)
    on_ground = drape_network(text, VALLEY, (0.0, 0.0))
    assert any("In 4 places, roads cross without a junction" in note for note in on_ground.notes)


@pytest.mark.slow
@pytest.mark.system
def test_node_amid_a_bridge_hangs_between_its_ends(tmp_path: Path) -> None:
    """A bridge of 100 m and 200 m from b over c to d: c lies a third of the way down from b to d."""
    ground = Function(
        lambda x, y: np.where(x < 250, 10 - 0.08 * (x - 100), 1.0) - 30 * np.exp(-(((x - 200) / 20) ** 2))
    )
    nodes = NODES.replace('id="d" x="300"', 'id="d" x="400"')
    text = build(tmp_path, "ab bc cd")
    (tmp_path / "n.nod.xml").write_text(nodes.replace("</nodes>", '<node id="e" x="500" y="0"/></nodes>'))
    edges = "".join(f'<edge id="{e}" from="{e[0]}" to="{e[1]}"/>' for e in ("ab", "bc", "cd", "de"))
    (tmp_path / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
    flags = ["--offset.disable-normalization", "--precision", "3"]
    sumo.run_netconvert(["-n", "n.nod.xml", "-e", "e.edg.xml", *flags], tmp_path, "net.net.xml")
    text = (tmp_path / "net.net.xml").read_text()
    draped = drape_network(text, ground, (0.0, 0.0), {"bc": 1, "cd": 1})
    high, low = (float(ground.height_m(np.array([[x, 0.0]]))[0]) for x in (100.0, 400.0))
    nodes_m = {shape.id: shape.points_m[0, 2] for shape in find_shapes(draped.text) if shape.is_node}
    assert nodes_m["c"] + draped.zero_height_m == pytest.approx((2 * high + low) / 3, abs=0.05)
    lanes = all_lanes(read(draped.text, tmp_path))
    assert lanes["bc_0"][-1, 2] == pytest.approx(nodes_m["c"], abs=1e-3)
    assert lanes["cd_0"][0, 2] == pytest.approx(nodes_m["c"], abs=1e-3)
    inside = next(shape for name, shape in lanes.items() if name.startswith(":c_"))
    assert set(inside[:, 2]) == {nodes_m["c"]}


@pytest.mark.system
def test_unknown_ground_is_refused_with_its_share(tmp_path: Path) -> None:
    text = build(tmp_path)
    west = Function(lambda x, y: np.where(x < 250, x, np.nan))
    with pytest.raises(
        InputError, match=r"no height at \d+ of \d+ \(\d+\.\d %\) points of the roads, such as \((?:2[5-9]|30)\d"
    ):
        drape_network(text, west, (0.0, 0.0))
    with pytest.raises(InputError, match=r"no height at \(260\.0, 0\.0\)"):
        drape_network(text, west, (260.0, 0.0))


@pytest.mark.system
def test_roads_with_heights_are_compared_with_the_terrain(tmp_path: Path) -> None:
    text = drape_network(build(tmp_path), PLANE, (150.0, 0.0)).text
    median_m, spread_m = level_difference_m(text, PLANE)
    assert median_m == pytest.approx(206.0, abs=1e-3) and spread_m < 1e-3
    assert level_difference_m(shift_heights(text, 5.5), PLANE)[0] == pytest.approx(200.5, abs=1e-3)
    with pytest.raises(InputError, match="heights at 0 of"):
        level_difference_m(text, Function(lambda x, y: np.full(len(x), np.nan)))


@pytest.mark.system
def test_shifted_heights_change_nothing_else(tmp_path: Path) -> None:
    text = build(tmp_path)
    there = shift_heights(text, 12.5)
    heights = {z for shape in find_shapes(there) for z in shape.points_m[:, 2]}
    assert heights == {12.5} and read(there, tmp_path).has_heights
    without = re.sub(r",12\.500(?=[ \"])", "", there).replace(' z="12.500"', "")
    assert without == text


@pytest.mark.slow
@pytest.mark.system
def test_bridge_of_a_map_is_an_edge_of_its_own(tmp_path: Path) -> None:
    """Main leads over Low by the bridge 2, which netconvert would merge with the streets 1 and 3."""
    nodes = {1: (0.0, 0.0), 2: (100.0, 0.0), 3: (200.0, 0.0), 4: (300.0, 0.0), 5: (0.0, 90.0), 6: (0.0, -90.0)}
    nodes |= {7: (300.0, 90.0), 8: (300.0, -90.0), 9: (150.0, 90.0), 10: (150.0, -90.0)}
    ways = [
        street("Main", 1, 2), street("Main", 2, 3, bridge="yes"), street("Main", 3, 4), street("Low", 9, 10),
        street("West", 5, 1, 6), street("East", 7, 4, 8), street("North", 5, 9, 7), street("South", 6, 10, 8),
    ]  # fmt: skip
    extract = read_osm(write_map(tmp_path / "map.osm", nodes, ways))
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    merged = street_network.build_network(extract, tmp_path / "map.osm", flags)[1].network.edges
    assert not road_levels.edge_levels([edge.id for edge in merged], extract)
    flags += road_levels.keep_levels_flags(extract)
    text, streets, _ = street_network.build_network(extract, tmp_path / "map.osm", flags)
    levels = road_levels.edge_levels([edge.id for edge in streets.network.edges], extract)
    assert levels == {"2": 1, "-2": 1}
    west_m = np.array(streets.node_positions({1: degrees((0.0, 0.0))})[1])
    valley = Function(lambda x, y: VALLEY.of(x - west_m[0], y))
    draped = drape_network(text, valley, tuple(west_m), levels)
    assert set(roads_above_others(draped.text)) == {("2", "4"), ("2", "-4"), ("-2", "4"), ("-2", "-4")}
    ids = [edge.id for edge in streets.network.edges if edge.id.lstrip("-") not in "24"]
    assert road_levels.edge_levels([*ids, "x", ":2_0", "2#x"], extract) == {}


def test_nodes_of_internal_elements() -> None:
    names = {":a_b_3": "a_b", ":a_b_3_0": "a_b", ":a_w0": "a", ":a_c1_0": "a", "a_0": ""}
    assert {name: node_of_internal(name) for name in names} == names


def test_rejects_damaged_shapes() -> None:
    with pytest.raises(InputError, match="<lane id='a_0'>: invalid coordinates"):
        list(find_shapes('<lane id="a_0" shape="0,0 x,1"/>'))


@pytest.mark.system
@pytest.mark.slow
def test_town01_on_a_raster(tmp_path: Path) -> None:
    """A made-up hill of 20 m, on a grid of 5 m; the road map has no reference system, and gets one for the test."""
    if not TOWN01.is_file():
        pytest.skip(f"{TOWN01.name} is not beside the checkout (shared/real)")
    road_map = opendrive.read_roads(TOWN01, RoadOptions())
    frame = WorldFrame("EPSG:32632", (-500_000.0, -5_400_000.0))
    x, y = np.meshgrid(-100 + 5.0 * (np.arange(120) + 0.5), 100 - 5.0 * (np.arange(100) + 0.5))
    hill = 300 + 20 * np.exp(-(((x - 200) ** 2 + (y + 150) ** 2) / 120**2))
    rasterio = pytest.importorskip("rasterio")
    transform = rasterio.Affine(5, 0, 500_000 - 100, 0, -5, 5_400_000 + 100)
    path = write_tiff(tmp_path / "hill.tif", hill, transform=transform)
    terrain = rasters.read_terrain([path], MapContext(frame, box(-50, -380, 450, 50)))
    draped = drape_network(road_map.network, terrain, (200.0, -150.0), where=TOWN01)
    roads = read(draped.text, tmp_path)
    assert draped.zero_height_m == pytest.approx(320, abs=0.1)
    for shape in all_lanes(roads).values():
        ground = (
            300 + 20 * np.exp(-(((shape[:, 0] - 200) ** 2 + (shape[:, 1] + 150) ** 2) / 120**2)) - draped.zero_height_m
        )
        assert np.abs(shape[:, 2] - ground).max() < 0.03
    points = ground_points(terrain, box(-50, -380, 450, 50), 5.0)
    ply.write(tmp_path / "terrain.ply", points - np.array([0, 0, draped.zero_height_m]))
    assert len(ply.read(tmp_path / "terrain.ply", "t")) == 101 * 87
