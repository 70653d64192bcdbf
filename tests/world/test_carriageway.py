"""A road, a bridge across it and a footway by hand; outlines of a network that touch or cross themselves."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from egvs.traffic import network
from egvs.traffic.network import Shape
from egvs.world.carriageway import Carriageway, _outlines
from egvs.world.clearances import LANE_INSET_M

LANES = [
    ("road", "", 'width="4" shape="0,0,0 60,0,3 100,0,4"'),
    ("bridge", "", 'width="4" shape="50,-40,9 50,40,9"'),
    ("foot", "", 'allow="pedestrian" shape="0,8 100,8"'),
    (":b_c0", ' function="crossing"', 'width="4" shape="98,-4 98,4"'),
    (":b_w0", ' function="walkingarea"', 'shape="100,6 110,6 110,10 100,10"'),
]
JUNCTION = '<junction id="b" type="priority" x="105" y="0" shape="100,-10 110,-10 110,10 100,10"/>'
ROAD, BRIDGE = 0, 1


@pytest.fixture(scope="module")
def roads(tmp_path_factory: pytest.TempPathFactory) -> Carriageway:
    path = tmp_path_factory.mktemp("roads") / "made.net.xml"
    edges = [
        f'<edge id="{name}" from="a" to="b"{kind}><lane id="{name}_0" index="0" length="1" {rest}/></edge>'
        for name, kind, rest in LANES
    ]
    path.write_text(f'<net version="1.20">{"".join(edges)}{JUNCTION}</net>')
    return Carriageway.of(network.read_net_xml(path))


def test_lanes_of_vehicles_only(roads: Carriageway) -> None:
    assert roads.names == ("road_0", "bridge_0")
    assert roads.bounds_m.tolist() == [[0, -40], [100, 40]]


def test_sensor_stands_in_the_highest_lane_below_it(roads: Carriageway) -> None:
    """At x = 50 the road is at z = 2.5, the bridge at 9."""
    edge_m = 2 - LANE_INSET_M
    at_m = np.array([
        [20, 1, 5], [20, edge_m - 0.01, 5], [20, edge_m + 0.01, 5], [50, 0, 6], [50, 0, 12], [50, 0, 2], [50, 20, 6],
    ])  # fmt: skip
    assert roads.lanes_at(at_m) == [ROAD, ROAD, None, ROAD, BRIDGE, None, None]


def test_height_is_that_of_the_nearest_point_of_the_centre_line(roads: Carriageway) -> None:
    at_m = np.array([[30, 1.5], [60, -1], [80, 0], [-9, 0], [140, 3]])
    assert [roads.height_m(ROAD, at) for at in at_m] == pytest.approx([1.5, 3, 3.5, 0, 4])
    assert sorted(roads.heights_in((45, -2), (55, 2))) == pytest.approx([2.5, 9])
    assert roads.heights_in((10, -2), (20, 2)) == pytest.approx([0.75])


def test_rectangles(roads: Carriageway) -> None:
    width_m = 4 - 2 * LANE_INSET_M
    assert roads.within((10, -5), (20, 0)).area == pytest.approx(5 * width_m)
    assert roads.within((10, 5), (20, 12)).area == 0
    assert roads.distance_m((10, 5), (20, 12)) == pytest.approx(5 - width_m / 2)
    assert roads.distance_m((45, 5), (55, 12)) == 0
    assert roads.nearest(np.array([30, 12])) == ROAD
    assert roads.nearest(np.array([40, 12])) == BRIDGE


def test_junction_interiors_exclude_kerbs_and_walking_areas(roads: Carriageway) -> None:
    at_m = np.array([[105, 0], [105, 8], [100 + 0.9 * LANE_INSET_M, 0], [100 + 1.1 * LANE_INSET_M, 0], [111, 0]])
    assert roads.in_junctions(at_m).tolist() == [True, False, False, True, False]


def test_nearest_kerb_is_the_edge_of_the_lane(roads: Carriageway) -> None:
    np.testing.assert_allclose(roads.nearest_kerb_m(np.array([[20, 1.0], [30, -5.0]])), [[20, 2], [30, -2]], atol=1e-9)


def test_outline_of_a_thin_walking_area_that_crosses_itself_is_valid() -> None:
    """One pass of GEOS makes an invalid polygon of this one, as netconvert wrote it; a union with others then fails."""
    thin = Shape("712.53,628.85 711,627.57 717.44,632.96 723.88,638.35 722.35,637.07 712.53,628.85", "thin")
    (outline,) = _outlines([thin])
    assert shapely.is_valid(outline)
    assert 0.0 < outline.area < 0.01
