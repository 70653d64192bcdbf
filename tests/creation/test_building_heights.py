"""Heights that a map does not give: from neighbours, from a surface model; objects in the way of vehicles."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from egvs.creation.building_heights import (
    heights_from_neighbours,
    heights_from_surface,
    objects_on_carriageway,
    sample_points,
)
from egvs.creation.map_parts import ImportCounts, MappedMesh, MappedSolid
from egvs.world.extrusion import extrude_polygon


def building(name: str, x_m: float, height_m: float, source: str = "height", **options: float) -> MappedSolid:
    return MappedSolid(name, "building", shapely.box(x_m, 0, x_m + 10, 10), height_m, source, **options)


def counted(solids: list[MappedSolid]) -> ImportCounts:
    counts = ImportCounts()
    for solid in solids:
        counts.keep(solid)
    return counts


def test_median_of_three_neighbours() -> None:
    solids = [
        building("a", 0, 5),
        building("b", 20, 30, "levels"),
        building("c", 40, 8),
        building("x", 60, 10, "default"),
    ]
    counts = counted(solids)
    assert [solid.height_m for solid in heights_from_neighbours(solids, counts)] == [5, 30, 8, 8]
    assert counts.heights == {"building": {"height": 2, "levels": 1, "neighbours": 1}}


def test_distance_is_100_m_between_centres() -> None:
    near = [building("a", 100, 5), building("b", 100, 6), building("c", 100, 7), building("x", 0, 10, "default")]
    assert heights_from_neighbours(near, counted(near))[-1].height_m == 6
    far = [building("a", 100.5, 5), building("b", 100, 6), building("c", 100, 7), building("x", 0, 10, "default")]
    assert heights_from_neighbours(far, counted(far)) == far


def test_assumed_heights_are_no_evidence() -> None:
    solids = [building(name, 20.0 * n, 10, "default") for n, name in enumerate("abcd")]
    assert heights_from_neighbours(solids, counted(solids)) == solids
    solids[0] = MappedSolid("pole", "pole", shapely.Point(0, 0), 3, "height", radius_m=0.1)
    assert heights_from_neighbours(solids, counted(solids)) == solids


def test_meshes_are_neighbours() -> None:
    vertices, faces = extrude_polygon(shapely.box(0, 0, 10, 10), 12.0)
    meshes = [
        MappedMesh(name, "building", np.add(vertices, (20.0 * n, 0, 35.0)), faces, True) for n, name in enumerate("abc")
    ]
    solids = [building("x", 60, 10, "default")]
    assert heights_from_neighbours(solids, counted(solids), meshes)[0].height_m == pytest.approx(12.0)


def test_base_above_the_new_height_keeps_the_old_one() -> None:
    solids = [
        building("a", 0, 5),
        building("b", 20, 5),
        building("c", 40, 5),
        building("x", 60, 10, "default", base_m=6),
    ]
    assert heights_from_neighbours(solids, counted(solids))[-1].height_m == 10


class Plane:
    """Ground at a height that grows to the east; unknown beyond x = 100."""

    notes = ()

    def __init__(self, height_m: float) -> None:
        self._height_m = height_m

    def height_m(self, xy_m: np.ndarray) -> np.ndarray:
        return np.where(xy_m[:, 0] < 100, self._height_m + 0.1 * xy_m[:, 0], np.nan)


def test_height_from_surface_model_minus_ground() -> None:
    solids = [building("x", 0, 10, "default"), building("known", 0, 4), building("outside", 120, 10, "default")]
    counts = counted(solids)
    heights = [solid.height_m for solid in heights_from_surface(solids, counts, Plane(50.0), Plane(42.5))]
    assert heights == pytest.approx([7.5, 4, 10])
    assert counts.heights == {"building": {"height": 1, "surface model": 1, "default": 1}}
    flat = heights_from_surface(solids, counted(solids), Plane(43.0), Plane(42.5))
    assert flat == solids, "half a metre is no building"


def test_samples_are_inside_one_for_each_square_metre() -> None:
    ring = shapely.Point(0, 0).buffer(20).difference(shapely.Point(0, 0).buffer(10))
    points = sample_points(ring)
    assert shapely.contains_xy(ring, points[:, 0], points[:, 1]).all()
    assert len(points) == pytest.approx(ring.area, rel=0.02)
    assert len(sample_points(shapely.box(0, 0, 5000, 5000))) <= 10_201


def test_objects_in_the_space_of_vehicles_are_named() -> None:
    """A lane from the west to the east, 3 m wide, on ground at 20 m."""
    lane = shapely.LineString([(0, 0), (100, 0)]).buffer(1.5)

    def mesh(name: str, y_m: float, low_m: float, high_m: float) -> MappedMesh:
        vertices, faces = extrude_polygon(shapely.box(40, y_m - 1, 42, y_m + 1), high_m - low_m)
        return MappedMesh(name, "furniture", np.add(vertices, (0, 0, 20 + low_m)), faces, True)

    meshes = [
        mesh("on the lane", 0, 0, 3), mesh("beside", 5, 0, 3), mesh("gantry", 0, 5, 6), mesh("cellar", 0, -3, -1),
        mesh("kerb", 0, 0, 0.2), mesh("edge", 2, 0, 3),
    ]  # fmt: skip
    names = objects_on_carriageway(meshes, [lane], lambda xy: np.full(len(xy), 20.0))
    assert names == ["on the lane", "edge"]


def test_reports_thin_wall_on_a_lane() -> None:
    wall = np.array([[10.0, -1, 0], [10, 1, 0], [10, 0, 3]])
    mesh = MappedMesh("wall", "furniture", wall, np.array([[0, 1, 2]]), False)
    lane = shapely.box(0, -2, 100, 2)
    assert objects_on_carriageway([mesh], [lane], lambda xy: np.zeros(len(xy))) == ["wall"]
