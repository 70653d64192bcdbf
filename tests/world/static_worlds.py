"""Small static worlds for tests."""

import numpy as np
import trimesh

from egvs.formats.georeference import WorldFrame
from egvs.scenario.loading import scenario_from_dict
from egvs.world import static_world
from tests.conftest import collection, feature

SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]


COURT = [[10, 10], [30, 10], [30, 30], [10, 30], [10, 10]]


HOLE = [[15, 15], [15, 25], [25, 25], [25, 15], [15, 15]]


def polygon(*rings, **properties):
    return feature({"type": "Polygon", "coordinates": list(rings)}, **{"height_m": 5, "name": "it", **properties})


def load(folder, **settings):
    values = {
        "roi": {"center_m": [20, 20, 2.5], "size_m": [80, 80, 5], "voxel_m": 0.5},
        "traffic": {"fcd": "none.csv"},
        "sites": {"file": "sites.csv", "sensor": "VLP-16"},
        "statics": {"ground": False, **settings},
    }
    return scenario_from_dict(values, folder, "scenario.toml")


def build(folder, *features):
    """The world and the counts of a GeoJSON file."""
    (folder / "s.geojson").write_text(collection(*features))
    return static_world.build_world(load(folder, footprints=["s.geojson"]))


def volumes(world):
    """Signed volume of each solid."""
    t = world.triangles_m
    each = (t[:, 0] * np.cross(t[:, 1], t[:, 2])).sum(axis=1) / 6
    return np.bincount(world.solid_of_face, weights=each, minlength=len(world.solids))


def build_mesh(folder, mesh, **settings):
    """The world and the counts of a mesh file."""
    mesh.export(folder / "m.ply")
    return static_world.build_world(load(folder, meshes=[{"file": "m.ply", **settings}]))


BOX = trimesh.creation.box((4, 6, 8))


CRS = {"epsg": 32632, "offset_m": [-550_700, -5_635_200]}


FRAME = WorldFrame("EPSG:32632", (-550_700.0, -5_635_200.0))


def build_located(folder, **settings):
    values = {
        "roi": {"center_m": [20, 20, 2.5], "size_m": [80, 80, 5], "voxel_m": 0.5},
        "traffic": {"fcd": "none.csv"},
        "crs": CRS,
        "sites": {"file": "sites.csv", "sensor": "VLP-16"},
        "statics": {"ground": False, **settings},
    }
    return static_world.build_world(scenario_from_dict(values, folder, "scenario.toml"))
