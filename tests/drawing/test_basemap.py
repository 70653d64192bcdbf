"""Background of the maps: outlines of solids, lanes, and where street names are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.drawing import basemap
from egvs.drawing.basemap import Roads, network_file, roads_within, world_outlines
from egvs.world.mesh import World
from tests.report.small_runs import make_world


def test_outlines_have_no_inner_edges():
    outlines = {group.css_class: group for group in world_outlines(make_world(), (0.0, 0.0, 12.0, 8.0))}
    assert {css_class: group.kinds for css_class, group in outlines.items()} == {
        "large": ("building",), "small": ("pole",), "green": ("tree crown",),
    }  # fmt: skip
    assert [len(ring) for ring in outlines["large"].rings] == [5], "a rectangle: its triangles are united"


def test_outlines_are_cut_at_the_edge_of_the_map():
    (buildings,) = world_outlines(make_world(), (9.0, 5.0, 10.0, 8.0))
    assert buildings.rings[0][:, 0].min() >= 8.0 and buildings.rings[0][:, 0].max() <= 11.0
    empty = World(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32), np.empty(0, dtype=np.int32), ())
    assert world_outlines(empty, (0.0, 0.0, 1.0, 1.0)) == ()


def test_squares_cover_small_triangles_and_keep_large_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    small = rng.uniform(1, 9, (200, 1, 2)) + rng.uniform(0, 0.4, (200, 3, 2))
    triangles = np.concatenate([small, [[[20.0, 1.0], [29.0, 1.0], [20.0, 9.0]]]])
    box = (0.0, 0.0, 30.0, 10.0)
    exact = basemap.union_of_triangles(triangles, box)
    assert exact.equals(shapely.union_all(shapely.polygons(triangles)))
    monkeypatch.setattr(basemap, "_MAX_SMALL_TRIANGLES", 199)
    drawn = basemap.union_of_triangles(triangles, box)
    assert drawn.buffer(1e-9).covers(exact)
    assert exact.buffer(2 * 0.25 * 2**0.5 + 0.4).covers(drawn)
    east_part = shapely.box(15, 0, 30, 10)
    assert shapely.intersection(drawn, east_part).equals(shapely.intersection(exact, east_part))


NETWORK = """<net version="1.20">
    <edge id=":b_0" function="internal"><lane id=":b_0_0" index="0" length="8" shape="46,-1.6 54,-1.6"/></edge>
    <edge id=":b_c0" function="crossing"><lane id=":b_c0_0" index="0" allow="pedestrian" width="4" length="7"
        shape="45,-4 45,4"/></edge>
    <edge id=":b_w0" function="walkingarea"><lane id=":b_w0_0" index="0" allow="pedestrian" width="4" length="3"
        shape="44,4 46,4 46,6"/></edge>
    <edge id="east" from="a" to="b" name="High Street">
        <lane id="east_0" index="0" allow="pedestrian" width="2" length="46" shape="0,-5 46,-5"/>
        <lane id="east_1" index="1" allow="bicycle" width="1.5" length="46" shape="0,-3.4 46,-3.4"/>
        <lane id="east_2" index="2" disallow="pedestrian" length="46" shape="0,-1.6 46,-1.6"/>
    </edge>
    <edge id="west" from="b" to="a" name="High Street">
        <lane id="west_0" index="0" disallow="pedestrian" length="46" shape="46,1.6 20,1.6 0,1.6"/>
    </edge>
    <edge id="tram" from="b" to="c"><lane id="tram_0" index="0" allow="tram" length="46" shape="54,0 100,0"/></edge>
    <junction id="b" type="priority" x="50" y="0" incLanes="" intLanes="" shape="46,-6 54,-6 54,6 46,6"/>
    <junction id=":b_0" type="internal" x="50" y="0" incLanes="" intLanes=""/>
    <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,-6 0,6"/>
    <connection from="east" to="tram" fromLane="2" toLane="0" dir="s" state="M"/>
</net>
"""


def roads(folder: Path, box: tuple[float, float, float, float]) -> Roads:
    path = folder / "sumo" / "network.net.xml"
    path.parent.mkdir()
    path.write_text(NETWORK)
    assert network_file(folder) == path
    return roads_within(path, box)


def test_lanes_are_cut_at_the_map_and_sorted_by_users(tmp_path: Path) -> None:
    visible = roads(tmp_path, (10.0, -20.0, 60.0, 20.0))
    lanes = [(lane.css_class, lane.width_m, lane.line.tolist()) for lane in visible.lanes]
    assert lanes == [
        ("walk", 4.0, [[45.0, -4.0], [45.0, 4.0]]),
        ("walk", 2.0, [[10.0, -5.0], [46.0, -5.0]]),
        ("cycle", 1.5, [[10.0, -3.4], [46.0, -3.4]]),
        ("drive", 3.2, [[10.0, -1.6], [46.0, -1.6]]),
        ("drive", 3.2, [[46.0, 1.6], [20.0, 1.6], [10.0, 1.6]]),
        ("rail", 3.2, [[54.0, 0.0], [60.0, 0.0]]),
    ]
    assert [outline.tolist() for outline in visible.junctions] == [[[46, -6], [54, -6], [54, 6], [46, 6]]]


def test_street_name_is_once_on_the_longest_straight_line_from_west_to_east(tmp_path: Path) -> None:
    (name,) = roads(tmp_path, (-10.0, -20.0, 60.0, 20.0)).names
    assert (name.text, name.start_m, name.end_m, name.length_m) == ("High Street", (0.0, -1.6), (46.0, -1.6), 46.0)


def test_roads_outside_the_map_are_not_shown(tmp_path: Path) -> None:
    assert roads(tmp_path, (200.0, 200.0, 300.0, 300.0)) == Roads()


def test_no_roads_without_a_network(tmp_path: Path) -> None:
    assert network_file(tmp_path) is None
    assert roads_within(None, (0.0, 0.0, 1.0, 1.0)) == Roads()
