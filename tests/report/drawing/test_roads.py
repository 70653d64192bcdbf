"""Roads under the maps: which lanes, how wide, whose, and where a street's name is written."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from egvs.core.grid import Grid
from egvs.report import maps
from egvs.report.basemap import Roads, network_file, roads_within
from egvs.report.maps import Backdrop
from egvs.report.svg_figures import MapSite

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


def test_lanes_are_cut_at_the_map_and_sorted_by_who_uses_them(tmp_path: Path) -> None:
    shown = roads(tmp_path, (10.0, -20.0, 60.0, 20.0))
    lanes = [(lane.look, lane.width_m, lane.line.tolist()) for lane in shown.lanes]
    assert lanes == [
        ("walk", 4.0, [[45.0, -4.0], [45.0, 4.0]]),
        ("walk", 2.0, [[10.0, -5.0], [46.0, -5.0]]),
        ("cycle", 1.5, [[10.0, -3.4], [46.0, -3.4]]),
        ("drive", 3.2, [[10.0, -1.6], [46.0, -1.6]]),
        ("drive", 3.2, [[46.0, 1.6], [20.0, 1.6], [10.0, 1.6]]),
        ("rail", 3.2, [[54.0, 0.0], [60.0, 0.0]]),
    ]
    assert [outline.tolist() for outline in shown.junctions] == [[[46, -6], [54, -6], [54, 6], [46, 6]]]


def test_a_name_is_written_once_from_west_to_east_along_the_longest_straight_piece(tmp_path: Path) -> None:
    (name,) = roads(tmp_path, (-10.0, -20.0, 60.0, 20.0)).names
    assert (name.text, name.start_m, name.end_m, name.length_m) == ("High Street", (0.0, -1.6), (46.0, -1.6), 46.0)


def test_what_lies_elsewhere_is_not_shown(tmp_path: Path) -> None:
    assert roads(tmp_path, (200.0, 200.0, 300.0, 300.0)) == Roads()


def test_without_a_network_there_are_no_roads(tmp_path: Path) -> None:
    assert network_file(tmp_path) is None
    assert roads_within(None, (0.0, 0.0, 1.0, 1.0)) == Roads()


def drawn(folder: Path, sites: list[MapSite]) -> str:
    grid = Grid((0.0, -10.0, 0.0), 0.5, (100, 40, 4))
    backdrop = Backdrop((), roads(folder, (-10.0, -20.0, 60.0, 20.0)))
    return maps.site_map(grid, np.zeros((100, 40)), backdrop, sites, "")


def test_lanes_are_drawn_as_wide_as_they_are(tmp_path: Path) -> None:
    figure = drawn(tmp_path, [MapSite("a", 5.0, 8.0, 3.0, 1.0, 1)])
    widths = dict(re.findall(r'class="lane (\w+)" style="stroke-width:([\d.]+)px"', figure))
    scale = float(re.search(r'class="edge" style="stroke-width:([\d.]+)px"', figure).group(1)) / 4.0  # the crossing's
    assert float(widths["drive"]) == round(3.2 * scale - 1.0, 2)
    assert not re.search(r"M[Mz\"]", figure), "an empty path ends the drawing of all that follow"


def test_a_street_name_makes_way_for_sites(tmp_path: Path) -> None:
    def places(folder: Path, x_m: float) -> list[str]:
        folder.mkdir()
        return re.findall(r'class="street" transform="translate\(([\d.]+) ', drawn(folder, [site_at(x_m)]))

    def site_at(x_m: float) -> MapSite:
        return MapSite("a", x_m, -1.6, 3.0, 1.0, 1)

    (free,), (moved,) = places(tmp_path / "beside", 49.0), places(tmp_path / "on", 23.0)
    assert free != moved
