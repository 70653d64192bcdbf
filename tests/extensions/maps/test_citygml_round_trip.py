"""A scenario's world, written as CityGML in degrees and read back, hides and shows the same voxels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.core.grid import Grid
from egvs.creation.map_parts import MapContext
from egvs.extensions.maps.buildings import citygml
from egvs.formats.georeference import WorldFrame
from egvs.scenario import loading
from egvs.scenario.model import Scenario
from egvs.sensors.sites import candidate_sites
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.static_world import build_world
from tests.extensions.maps.formats.small_city_models import city_object, multi_surface, nest, polygon, write_model

SCENARIO = Path(__file__).parents[3] / "scenarios" / "nishishinjuku"
FRAME = WorldFrame("EPSG:32654", (-380_000.0, -3_950_000.0))
SITES = 10


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


def lines_of_sight(world: World, scenario: Scenario, voxel_m: float) -> np.ndarray:
    """Return whether each voxel's centre is visible from each of the first sites, (sites, voxels)."""
    roi = scenario.roi.box
    grid = Grid.over(roi, voxel_m)
    index = np.stack(np.meshgrid(*(np.arange(count) for count in grid.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = (index + 0.5) * voxel_m
    caster = Caster(world, roi)
    visible = []
    for site in candidate_sites(scenario)[:SITES]:
        position = np.subtract(site.pose.position_m, roi.origin_m)
        rays = centres - position
        distance_m = np.linalg.norm(rays, axis=1)
        visible.append(caster.first_hits(position, rays / distance_m[:, None])[0] >= distance_m)
    return np.array(visible)


@pytest.mark.parametrize("voxel_m", [1.25, pytest.param(0.25, marks=pytest.mark.slow)])
def test_visibility_of_every_voxel_is_the_same(tmp_path: Path, voxel_m: float) -> None:
    """But for one line of sight in 100,000, which may pass so close to an edge that rounding of degrees matters.

    Centres of voxels of 1 m would lie exactly on walls of this scenario, where rounding decides.
    """
    scenario = loading.load(SCENARIO)
    world, _ = build_world(scenario)
    write_world(tmp_path / "world.gml", world)
    copy = read_world(tmp_path / "world.gml", world)
    assert len(copy.faces) == len(world.faces)
    before, after = (lines_of_sight(mesh, scenario, voxel_m) for mesh in (world, copy))
    assert before.shape == (10, 100 * 50 * 5 / voxel_m**3)
    assert 0.1 < before.mean() < 1, "statics hide some voxels, and not all"
    assert np.count_nonzero(before != after) <= 1e-5 * before.size


@pytest.mark.slow
def test_visibility_tells_a_shift_of_ten_centimetres(tmp_path: Path) -> None:
    """What the other test could not tell otherwise."""
    scenario = loading.load(SCENARIO)
    world, _ = build_world(scenario)
    moved = World(np.add(world.vertices_m, (0.1, 0.1, 0.0)), world.faces, world.solid_of_face, world.solids)
    before, after = (lines_of_sight(mesh, scenario, 1.0) for mesh in (world, moved))
    assert np.count_nonzero(before != after) > 1e-4 * before.size
