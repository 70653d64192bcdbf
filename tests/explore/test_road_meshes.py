"""Lane markings and crossings have the positions and widths of the lanes that they follow from."""

from __future__ import annotations

import numpy as np

from egvs.explore import road_meshes
from egvs.traffic.network import Edge, Junction, Lane, Network, Permission
from egvs.world.carriageway import Carriageway

ALL = Permission(None, frozenset())
FEET = Permission(frozenset({"pedestrian"}), frozenset())


def lane(y_m: float, permission: Permission = ALL, width_m: float = 3.0, text: str = "") -> Lane:
    """A lane of 21 m towards the east."""
    return Lane(text or f"0,{y_m} 21,{y_m}", "lane", width_m, 21.0, permission)


def edge(function: str, *lanes: Lane) -> Edge:
    """An edge with some lanes."""
    return Edge("e", function, "a", "b", "", lanes)


def quads(mesh: road_meshes.Mesh) -> np.ndarray:
    """Corners of each rectangle, (n, 4, 3)."""
    return mesh.points.reshape(-1, 4, 3)


def test_two_lanes_have_lines_outside_and_dashes_between() -> None:
    network = Network((edge("", lane(-1.5), lane(1.5)),), ())
    drawn = quads(road_meshes.marking_mesh(network, (0.0, 0.0, 0.0)))
    lengths = np.ptp(drawn[:, :, 0], axis=1).round(3)
    middles = drawn[:, :, 1].mean(axis=1).round(3)
    assert sorted(zip(middles.tolist(), lengths.tolist(), strict=True)) == [
        (-3.0, 21.0), (0.0, 3.0), (0.0, 3.0), (0.0, 3.0), (3.0, 21.0),
    ]  # fmt: skip
    assert np.allclose(np.ptp(drawn[:, :, 1], axis=1), 0.15, atol=1e-4)


def test_sidewalks_and_lanes_inside_junctions_have_no_markings() -> None:
    network = Network((edge("", lane(0.0, FEET)), edge("internal", lane(5.0))), ())
    assert len(road_meshes.marking_mesh(network, (0.0, 0.0, 0.0)).faces) == 0


def test_crossing_has_stripes_of_its_width() -> None:
    network = Network((edge("crossing", lane(0.0, FEET, 4.0, "10,0 10,6")),), ())
    drawn = quads(road_meshes.marking_mesh(network, (0.0, 0.0, 0.0)))
    assert np.allclose(np.ptp(drawn[:, :, 0], axis=1), 4.0)
    assert np.allclose(drawn[:, :, 1].min(axis=1), [0.25, 1.25, 2.25, 3.25, 4.25, 5.25])
    assert np.allclose(np.ptp(drawn[:, :, 1], axis=1), 0.5)


def test_junction_is_filled() -> None:
    shape = Junction("0,0,2 10,0,2 10,10,2 5,5,2 0,10,2", "j", "j", "priority", (5.0, 5.0), ())
    mesh = road_meshes.junction_mesh(Carriageway((), (), (shape,)), (0.0, 0.0, 0.0))
    a, b, c = (mesh.points[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    assert np.isclose(np.abs(np.cross(b - a, c - a)[:, 2]).sum() / 2.0, 75.0)
    assert np.allclose(mesh.points[:, 2], 2.01)
