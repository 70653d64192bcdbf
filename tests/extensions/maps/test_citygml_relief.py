"""Terrain from the relief of CityGML: heights between corners, tiles in reach, and what is rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.creation.map_parts import MapContext
from egvs.extensions.maps.terrain import citygml_relief
from tests.extensions.maps.formats.small_city_models import city_object, nest, polygon, write_model
from tests.extensions.maps.test_citygml import FRAME, at

CONTEXT = MapContext(FRAME, shapely.box(-20, -20, 20, 20))


def plane_m(east_m: float, north_m: float) -> float:
    """A ground that climbs by 10 % to the east and 5 % to the north."""
    return 30.0 + 0.1 * east_m + 0.05 * north_m


def relief(cells: int = 20, cell_m: float = 5.0, east_m: float = -50.0) -> str:
    """A ground of squares of two triangles each, every second one clockwise."""
    triangles = []
    for row in range(cells):
        for column in range(cells):
            x, y = east_m + column * cell_m, -50.0 + row * cell_m
            corners = [(x, y), (x + cell_m, y), (x + cell_m, y + cell_m), (x, y + cell_m)]
            points = [at(*corner, plane_m(*corner)) for corner in corners]
            triangles += [
                polygon(points[:3], tag="Triangle"),
                polygon([points[3], points[2], points[0]], tag="Triangle"),
            ]
    surface = nest("".join(triangles), "TriangulatedSurface", "trianglePatches")
    return city_object("ReliefFeature", "r", nest(surface, "reliefComponent", "TINRelief", "tin"))


def test_heights_are_those_of_the_plane(tmp_path: Path) -> None:
    path = write_model(tmp_path / "ground.gml", relief())
    terrain = citygml_relief.read_terrain([path], CONTEXT)
    points = np.random.default_rng(1).uniform(-20, 20, (200, 2))
    np.testing.assert_allclose(terrain.height_m(points), [plane_m(*point) for point in points], atol=1e-6)
    assert np.isnan(terrain.height_m(np.array([[45.0, 45.0]]))).all(), "outside the window"
    assert "ground.gml: terrain of " in terrain.notes[0]


def test_tiles_out_of_reach_are_not_opened(tmp_path: Path) -> None:
    write_model(tmp_path / "53392640_dem_6697_op.gml", relief())
    (tmp_path / "53394525_dem_6697_op.gml").write_text("damaged, 20 km away")
    terrain = citygml_relief.read_terrain(sorted(tmp_path.iterdir()), CONTEXT)
    assert terrain.height_m(np.zeros((1, 2))) == pytest.approx([30.0])


def test_ground_elsewhere_is_rejected(tmp_path: Path) -> None:
    far = write_model(tmp_path / "far.gml", relief(2, east_m=5000.0))
    with pytest.raises(InputError, match=r"far.gml: the terrain has no triangle in the region"):
        citygml_relief.read_terrain([far], CONTEXT)
    near = write_model(tmp_path / "near.gml", relief())
    assert citygml_relief.read_terrain([far, near], CONTEXT).height_m(np.zeros((1, 2))) == pytest.approx([30.0])
