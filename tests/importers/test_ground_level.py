"""The height of the ground by which city models are shifted."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from egvs.importers.ground_level import ground_level
from egvs.importers.map_parts import MappedMesh
from egvs.world.extrusion import extrude_polygon

MIDDLE = np.array([0.0, 0.0])


def building(x_m: float, base_m: float, kind: str = "building") -> MappedMesh:
    vertices, faces = extrude_polygon(shapely.box(x_m, -5, x_m + 10, 5), 8.0)
    return MappedMesh(f"at {x_m}", kind, np.add(vertices, (0, 0, base_m)), faces, True)


class Flat:
    """Ground at one height; unknown where it is nan."""

    notes = ()

    def __init__(self, height_m: float) -> None:
        self._height_m = height_m

    def height_m(self, xy_m: np.ndarray) -> np.ndarray:
        return np.full(len(xy_m), self._height_m)


BUILDINGS = [building(20.0 * n, base_m) for n, base_m in enumerate((3.0, 3.4, 3.1, 2.5, 3.6, 90.0, 95.0))]


def test_median_of_the_five_nearest_buildings() -> None:
    level = ground_level([*BUILDINGS[::-1], building(1, -50, "furniture")], MIDDLE)
    assert level is not None
    assert (level.height_m, level.deviation_m) == (pytest.approx(3.1), pytest.approx(0.6))
    assert level.note() == (
        "Heights are shifted by -3.10 m, so that the ground is at z = 0: the median of the lowest points of the 5"
        " nearest buildings. The nearest buildings then float or sink by up to 0.60 m."
    )


def test_terrain_comes_first() -> None:
    level = ground_level(BUILDINGS, MIDDLE, Flat(2.0))
    assert level is not None and (level.height_m, level.deviation_m) == (2.0, pytest.approx(1.6))
    unknown = ground_level(BUILDINGS, MIDDLE, Flat(float("nan")))
    assert unknown is not None and unknown.height_m == pytest.approx(3.1)
    alone = ground_level([], MIDDLE, Flat(2.0))
    assert alone is not None and alone.note().endswith("the terrain at the middle of the region.")


def test_nothing_tells() -> None:
    assert ground_level([], MIDDLE) is None
    single = ground_level(BUILDINGS[:1], MIDDLE)
    assert single is not None and "of the only building" in single.note()
