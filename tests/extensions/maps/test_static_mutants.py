"""Damaged files of static objects end in an InputError that names the file, or in a result; never in another error.

The mutants are those of the fuzzer (``tests/fuzz/mutating.py``).
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import shapely
import trimesh

from egvs.core.errors import InputError
from egvs.creation.map_parts import Alignment, MapContext, SolidMap
from egvs.extensions.maps.buildings import citygml, cityjson, footprint_maps, mesh_maps
from egvs.extensions.maps.formats.citygml import read_relief
from tests.extensions.maps.formats.small_city_models import city_model, city_object, multi_surface, nest, polygon
from tests.extensions.maps.test_citygml import CONTEXT, FRAME, REFERENCE, TEMPLATE, at, city_json, house, implicit
from tests.fuzz.mutating import mutant

ALIGNED = MapContext(FRAME, CONTEXT.window, Alignment(np.array([[0.0, 0], [1, 0]]), np.array([[0.0, 0], [1, 0]])))


def _citygml() -> bytes:
    ring = [at(30, 0, 2.0), at(35, 0, 2.0), at(35, 5, 2.0)]
    foot = nest(multi_surface([polygon(ring)]), "lod0FootPrint")
    storeys = "<x:storeysAboveGround>3</x:storeysAboveGround>"
    members = [house("h", 0, 0), city_object("Building", "f", storeys, foot)]
    members += [implicit("i", at(20, 30, 3), TEMPLATE), implicit("j", at(60, 30, 3), REFERENCE)]
    return city_model(*members).encode()


def _geojson() -> bytes:
    ring = FRAME.to_degrees(np.array([[0.0, 0], [9, 0], [9, 9], [0, 0]])).tolist()
    geometry = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": {"height": 9, "name": "a"}, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [feature, feature]}).encode()


def _mesh(suffix: str) -> Callable[[], bytes]:
    def make() -> bytes:
        data = trimesh.creation.box((4, 2, 6)).export(file_type=suffix)
        return data.encode() if isinstance(data, str) else bytes(data)

    return make


FORMATS: dict[str, tuple[ModuleType, Callable[[], bytes]]] = {
    "gml": (citygml, _citygml),
    "city.json": (cityjson, lambda: json.dumps(city_json()).encode()),
    "geojson": (footprint_maps, _geojson),
    "obj": (mesh_maps, _mesh("obj")),
    "ply": (mesh_maps, _mesh("ply")),
    "stl": (mesh_maps, _mesh("stl")),
    "glb": (mesh_maps, _mesh("glb")),
}


def check(result: SolidMap) -> None:
    """Whatever a reader accepts is finite and refers to its own vertices."""
    for mesh in result.meshes:
        assert np.isfinite(mesh.vertices_m).all() and len(mesh.faces)
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices_m)
    for solid in result.solids:
        assert solid.geometry.is_valid and 0 < solid.height_m - solid.base_m <= 1000
        assert np.isfinite(shapely.get_coordinates(solid.geometry)).all()


def read_mutants(folder: Path, suffix: str, count: int) -> tuple[int, int]:
    """Return how many mutants were read, and how many rejected."""
    reader, make = FORMATS[suffix]
    sound = make()
    path = folder / f"map.{suffix}"
    path.write_bytes(sound)
    original = reader.read_solids([path], ALIGNED)
    check(original)
    assert original.meshes or original.solids
    read = rejected = 0
    for seed in range(count):
        path.write_bytes(mutant(random.Random(seed), sound))
        try:
            check(reader.read_solids([path], ALIGNED))
            read += 1
        except InputError as error:
            assert str(path) in str(error), seed
            assert len(str(error)) < 4000, seed
            rejected += 1
    return read, rejected


@pytest.mark.parametrize("count", [25, pytest.param(200, marks=pytest.mark.slow)])
def test_mutants_of_relief(tmp_path: Path, count: int) -> None:
    corners = [[(0.0, 0.0, 1.0), (1.0, 0.0, 2.0), (0.0, 1.0, 3.0)], [(1.0, 0.0, 2.0), (1.0, 1.0, 4.0), (0.0, 1.0, 3.0)]]
    triangles = "".join(polygon(ring, tag="Triangle") for ring in corners)
    tin = nest(triangles, "reliefComponent", "TINRelief", "tin", "TriangulatedSurface", "trianglePatches")
    sound = city_model(city_object("ReliefFeature", "r", tin)).encode()
    path = tmp_path / "dem.gml"
    path.write_bytes(sound)
    assert len(read_relief(path).faces) == 2
    rejected = 0
    for seed in range(count):
        path.write_bytes(mutant(random.Random(seed), sound))
        try:
            vertices, faces, _ = read_relief(path)
            assert np.isfinite(vertices).all() and (not len(faces) or faces.max() < len(vertices))
        except InputError as error:
            assert str(path) in str(error), seed
            rejected += 1
    assert rejected > count // 4


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_some_mutants(tmp_path: Path, suffix: str) -> None:
    read, rejected = read_mutants(tmp_path, suffix, 25)
    assert read + rejected == 25 and rejected > 0


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_200_mutants(tmp_path: Path, suffix: str) -> None:
    read, rejected = read_mutants(tmp_path, suffix, 200)
    assert read + rejected == 200 and rejected > 20
