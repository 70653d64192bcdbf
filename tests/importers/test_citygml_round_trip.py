"""A scenario's world, written as CityGML in degrees and read back, hides and shows the same voxels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.core.grid import Grid
from egvs.formats.georeference import WorldFrame
from egvs.importers import citygml
from egvs.importers.map_parts import MapContext
from egvs.scenario import loading
from egvs.sensors.sites import candidate_sites
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.static_world import build_world
from tests.formats.small_city_models import city_object, multi_surface, nest, polygon, write_model

SCENARIO = Path(__file__).parents[2] / "scenarios" / "nishishinjuku"
FRAME = WorldFrame("EPSG:32654", (-380_000.0, -3_950_000.0))
SITES = 10
VOXEL_M = 0.5


def write_world(path: Path, world: World) -> None:
    """Write each solid but the ground as a building of triangles, in latitude, longitude and height."""
    lon_lat = FRAME.to_degrees(world.vertices_m[:, :2])
    vertices = np.column_stack([lon_lat[:, 1], lon_lat[:, 0], world.vertices_m[:, 2]])
    members = []
    for number, (_, kind) in enumerate(world.solids):
        if kind == "ground":
            continue
        faces = world.faces[world.solid_of_face == number]
        triangles = [polygon([tuple(vertices[corner].tolist()) for corner in face]) for face in faces]
        members.append(city_object("Building", f"s{number}", nest(multi_surface(triangles), "lod2MultiSurface")))
    write_model(path, *members, srs_name="http://www.opengis.net/def/crs/EPSG/0/6697")


def read_world(path: Path, world: World) -> World:
    """Read the buildings back, and add the ground of the original."""
    result = citygml.read_solids([path], MapContext(FRAME, shapely.box(-5000, -5000, 5000, 5000)))
    ground = [number for number, (_, kind) in enumerate(world.solids) if kind == "ground"]
    is_ground = np.isin(world.solid_of_face, ground)
    vertices, faces = [world.vertices_m], [world.faces[is_ground].astype(np.int64)]
    count = len(world.vertices_m)
    for mesh in result.meshes:
        vertices.append(mesh.vertices_m)
        faces.append(mesh.faces + count)
        count += len(mesh.vertices_m)
    all_faces = np.concatenate(faces).astype(np.int32)
    numbers = np.zeros(len(all_faces), dtype=np.int32)
    return World(np.concatenate(vertices), all_faces, numbers, (("world", "building"),))


@pytest.mark.slow
def test_visibility_of_every_voxel_is_the_same(tmp_path: Path) -> None:
    """Only voxels whose line of sight passes within 0.1 mm of an edge may differ."""
    scenario = loading.load(SCENARIO)
    world, _ = build_world(scenario)
    write_world(tmp_path / "world.gml", world)
    copy = read_world(tmp_path / "world.gml", world)
    assert len(copy.faces) == len(world.faces)

    roi = scenario.roi.box
    grid = Grid.over(roi, VOXEL_M)
    index = np.stack(np.meshgrid(*(np.arange(count) for count in grid.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = (index + 0.5) * VOXEL_M
    original, read_back = Caster(world, roi), Caster(copy, roi)
    visible = different = 0
    for site in candidate_sites(scenario)[:SITES]:
        position = np.subtract(site.pose.position_m, roi.origin_m)
        rays = centres - position
        distance_m = np.linalg.norm(rays, axis=1)
        directions = rays / distance_m[:, None]
        before = original.first_hits(position, directions)[0] >= distance_m
        after = read_back.first_hits(position, directions)[0] >= distance_m
        visible += int(before.sum())
        different += int((before != after).sum())
    total = SITES * len(centres)
    assert total == 10 * 200 * 100 * 10
    assert 0.1 * total < visible < total, "statics hide some voxels, and not all"
    print(visible, different, total)
    assert different <= 1e-5 * total
