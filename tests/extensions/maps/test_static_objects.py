"""Heights of static objects of maps, counted from z = 0."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.creation.map_parts import OBJECT_KIND, MappedMesh, SolidMap
from egvs.creation.static_objects import ReadMap, _lower_to_ground

WALL = np.array([[0.0, 0.0, 40.0], [4.0, 0.0, 40.0], [4.0, 0.0, 43.0]])


def cloud() -> ReadMap:
    mesh = MappedMesh("wall", OBJECT_KIND, WALL, np.array([[0, 1, 2]]), is_closed=False)
    return ReadMap((Path("wall.las"),), "point_cloud", SolidMap(meshes=(mesh,), has_absolute_heights=True))


def test_point_cloud_counts_heights_from_the_ground_of_the_region() -> None:
    lowered, subtracted_m = _lower_to_ground(cloud(), (0.0, 0.0), 38.0)
    assert subtracted_m == 38.0
    np.testing.assert_array_equal(lowered.meshes[0].vertices_m[:, 2], [2.0, 2.0, 5.0])


def test_point_cloud_without_ground_is_rejected_where_no_other_map_has_the_ground() -> None:
    with pytest.raises(InputError, match=r"wall\.las: the points show no ground, .* Add a map of the terrain"):
        _lower_to_ground(cloud(), (0.0, 0.0), None)
