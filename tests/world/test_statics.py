"""Is every footprint and mesh built as it is meant, or mended with a count, or refused with the reason - and never
dropped?"""

import contextlib
import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pyproj
import pytest
import trimesh

from egvs.core.errors import DiagnosticsError, InputError
from egvs.formats.georeference import WorldFrame
from egvs.scenario import loading
from egvs.scenario.loading import scenario_from_dict
from egvs.sensors.scanner import Scanner
from egvs.stages import inputs
from egvs.world import static_world
from egvs.world.mesh import World, read_ply, write_ply
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


def built(folder, *features):
    """The world and the counts of a GeoJSON file."""
    (folder / "s.geojson").write_text(collection(*features))
    return static_world.build_world(load(folder, footprints=["s.geojson"]))


def volumes(world):
    """Signed volume of each solid."""
    t = world.triangles_m
    each = (t[:, 0] * np.cross(t[:, 1], t[:, 2])).sum(axis=1) / 6
    return np.bincount(world.solid_of_face, weights=each, minlength=len(world.solids))


def mesh_of(folder, mesh, **settings):
    """The world and the counts of a mesh file."""
    mesh.export(folder / "m.ply")
    return static_world.build_world(load(folder, meshes=[{"file": "m.ply", **settings}]))


@pytest.mark.parametrize(
    ("rings", "area"),
    [
        ([SQUARE], 16),
        ([SQUARE[::-1]], 16),
        ([COURT, HOLE], 300),
        ([COURT[::-1], HOLE[::-1]], 300),
        ([COURT, HOLE, [[11, 11], [12, 11], [11.5, 12], [11, 11]]], 299.5),
        ([COURT, [[10, 10], [15, 20], [20, 15], [10, 10]]], 400 - 37.5),  # the hole touches the ring in a point
        ([[[0, 0], [10, 0], [10, 10], [5, 1], [0, 10], [0, 0]]], 100 - 45),
        ([[[0, 0], [1000, 0], [1000, 1e-6], [0, 0]]], 5e-4),
    ],
)
def test_a_prism_is_closed_faces_outwards_and_has_its_volume(tmp_path, rings, area):
    world, counts = built(tmp_path, polygon(*rings, base_m=2.5, height_m=7.0))
    assert world.closed.all()
    assert volumes(world) == pytest.approx([area * 4.5], rel=1e-9)
    assert world.triangles_m[..., 2].min() == 2.5
    assert world.triangles_m[..., 2].max() == 7.0
    assert not counts.repaired
    assert not counts.ignored


def test_points_are_discs_and_lines_are_strips(tmp_path):
    world, counts = built(
        tmp_path,
        feature({"type": "Point", "coordinates": [5, 5]}, height_m=3, radius_m=0.5, kind="pole"),
        feature(
            {"type": "LineString", "coordinates": [[0, 0], [10, 0], [10, 10]]}, height_m=1, radius_m=0.25, kind="wall"
        ),
        feature({"type": "MultiPoint", "coordinates": [[20, 5], [22, 5]]}, height_m=3, radius_m=0.5, kind="pole"),
    )
    assert world.closed.all()
    disc = 16 / 2 * 0.25 * math.sin(2 * math.pi / 16) * 3
    assert volumes(world)[[0, 2, 3]] == pytest.approx([disc] * 3, rel=1e-12)
    assert volumes(world)[1] == pytest.approx(10.0, rel=0.02)  # the bend is mitred, the ends are flat
    assert counts.built == {"pole": 3, "wall": 1}


@pytest.mark.parametrize(
    ("features", "mended", "area"),
    [
        ([polygon([[0, 0], [4, 0], [4, 0], [4, 4], [4, 4], [4, 4], [0, 4], [0, 0]])], {"doubled points": 3}, [16]),
        # two triangles that share a corner, as one ring
        (
            [polygon([[0, 0], [4, 0], [2, 2], [4, 4], [0, 4], [2, 2], [0, 0]])],
            {"rings that touched themselves": 1},
            [4, 4],
        ),
        # the same, with a line to one side of it: what is mended is a collection, in which several polygons are one
        (
            [polygon([[0, 0], [4, 0], [2, 2], [4, 4], [0, 4], [2, 2], [0, 0], [0, -3], [0, 0]])],
            {"rings that touched themselves": 1},
            [4, 4],
        ),
        # a ring that runs round its own hole and back through a point
        (
            [polygon([[0, 0], [9, 0], [9, 9], [0, 9], [0, 0], [2, 3], [3, 6], [6, 3], [0, 0]])],
            {"rings that touched themselves": 1},
            [81 - 12],
        ),
    ],
)
def test_dirt_with_one_meaning_is_mended_and_counted(tmp_path, features, mended, area):
    world, counts = built(tmp_path, *features)
    assert dict(counts.repaired) == mended
    assert world.closed.all()
    assert sorted(volumes(world)) == pytest.approx(sorted(5 * a for a in area), rel=1e-12)


@pytest.mark.parametrize(
    ("geometry", "reason"),
    [
        ({"type": "Polygon", "coordinates": [[[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]]]}, "Self-intersection"),
        ({"type": "Polygon", "coordinates": [SQUARE, [[9, 9], [9, 10], [10, 9], [9, 9]]]}, "Hole lies outside"),
        ({"type": "Polygon", "coordinates": [SQUARE, [[2, 2], [9, 2], [2, 9], [2, 2]]]}, "not a valid polygon"),
        (
            {"type": "Polygon", "coordinates": [COURT, HOLE, [[16, 16], [17, 16], [16, 17], [16, 16]]]},
            "Holes are nested",
        ),
        (
            {"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [2, 0], [0, 0]]]},
            "not a valid polygon|encloses no area",
        ),
        (
            {"type": "Polygon", "coordinates": [[[1, 1], [1, 1], [1, 1], [1, 1]]]},
            "not a valid polygon|encloses no area",
        ),
        ({"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [0, 0]]]}, "not a valid polygon"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [math.nan, 0], [4, 4], [0, 0]]]}, "expected finite coordinates"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [math.inf, 0], [4, 4], [0, 0]]]}, "expected finite coordinates"),
        ({"type": "Polygon", "coordinates": []}, "is empty"),
        ({"type": "MultiPolygon", "coordinates": [[SQUARE], [SQUARE]]}, "not a valid polygon"),
        ({"type": "GeometryCollection", "geometries": []}, "is empty"),
        ({"type": "Polygon", "coordinates": [[[0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 0, 1]]]}, "z coordinates"),
        ({"type": "Point", "coordinates": [1, 1]}, "radius_m is missing"),
        ({"type": "Curve", "coordinates": [1, 1]}, "expected a GeoJSON geometry"),
        (None, "expected a GeoJSON geometry"),
    ],
)
def test_dirt_with_two_meanings_is_refused(tmp_path, geometry, reason):
    with pytest.raises(InputError, match=rf"s\.geojson: feature 1 \(bad\).*({reason})"):
        built(tmp_path, polygon(SQUARE), feature(geometry, height_m=3, name="bad"))


def test_a_ring_that_is_not_closed_means_the_closed_one(tmp_path):
    assert volumes(built(tmp_path, polygon(SQUARE[:-1]))[0]) == pytest.approx([80], rel=1e-12)


@pytest.mark.parametrize(
    "values", [{"height_m": 0}, {"height_m": 2, "base_m": 3}, {"height_m": "5"}, {"height_m": None}, {"height_m": True}]
)
def test_senseless_heights_are_refused(tmp_path, values):
    with pytest.raises(InputError, match="height_m"):
        built(tmp_path, polygon(SQUARE, **values))


def test_poly_xml(tmp_path):
    shapes = {"a": "0,0 4,0 4,4 0,4", "b": "0,0 4,4 4,0 0,4", "c": "0,0 5,5", "d": "0,0 nan,0 4,4 0,4"}
    (tmp_path / "s.poly.xml").write_text(
        '<additional><poly id="a" type="building" fill="1" shape="{a}"><param key="height" value="3"/></poly>'
        '<poly id="c" type="building" fill="0" shape="{c}"/><poi id="p" x="0" y="0"/></additional>'.format(**shapes)
    )
    world, counts = static_world.build_world(load(tmp_path, polygons=["s.poly.xml"]))
    assert volumes(world) == pytest.approx([48], rel=1e-12)
    assert sum(counts.ignored.values()) == 2
    crossed, broken = (f'<poly id="x" type="building" fill="1" shape="{shapes[name]}"/>' for name in "bd")
    (tmp_path / "s.poly.xml").write_text(f"<additional>{crossed}</additional>")
    world, counts = static_world.build_world(load(tmp_path, polygons=["s.poly.xml"]))
    assert volumes(world) == pytest.approx([4 * 9, 4 * 9], rel=1e-12)
    (tmp_path / "s.poly.xml").write_text(f"<additional>{broken}</additional>")
    with pytest.raises(InputError, match="poly x"):
        static_world.build_world(load(tmp_path, polygons=["s.poly.xml"]))


BOX = trimesh.creation.box((4, 6, 8))


def test_a_mesh_is_taken_apart_into_closed_pieces(tmp_path):
    two = trimesh.util.concatenate([BOX, BOX.copy().apply_translation([10, 0, 0])])
    world, counts = mesh_of(tmp_path, two, offset_m=(100, 200, 300), kind="city")
    assert len(world.solids) == 2
    assert world.closed.all()
    assert world.triangles_m.min(axis=(0, 1)).tolist() == [98, 197, 296]
    assert counts.built == {"city": 2}
    assert not counts.repaired


def test_an_inverted_solid_is_still_a_solid(tmp_path):
    inverted = BOX.copy()
    inverted.invert()
    world, _ = mesh_of(tmp_path, inverted)
    assert world.closed.all()
    assert world.signs.tolist() == [-1]


@pytest.mark.parametrize("spoil", ["hole", "flipped"])
def test_a_mesh_with_a_hole_or_a_turned_triangle_stays_a_surface(tmp_path, spoil):
    faces = np.array(BOX.faces)
    faces = faces[1:] if spoil == "hole" else np.concatenate([faces[:1, ::-1], faces[1:]])
    world, counts = mesh_of(tmp_path, trimesh.Trimesh(BOX.vertices, faces, process=False))
    assert len(world.faces) == len(faces)
    assert not world.closed.any()
    assert counts.built == {"mesh (open surface)": 1}


def test_doubled_and_degenerate_triangles_are_dropped_and_counted(tmp_path):
    faces = np.concatenate([BOX.faces, BOX.faces[:3], BOX.faces[:2, [0, 0, 1]]])
    world, counts = mesh_of(tmp_path, trimesh.Trimesh(BOX.vertices, faces, process=False))
    assert world.closed.all()
    assert dict(counts.repaired) == {"degenerate or doubled triangles dropped": 5}


def test_a_soup_of_separate_triangles_is_sewn(tmp_path):
    soup = trimesh.Trimesh(BOX.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    world, _ = mesh_of(tmp_path, soup)
    assert world.closed.all()
    assert abs(volumes(world)[0]) == pytest.approx(192)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_vertex_that_is_no_number_is_refused(tmp_path, value):
    (tmp_path / "m.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 {value} 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"m\.obj: vertex 2"):
        static_world.build_world(load(tmp_path, meshes=[{"file": "m.obj"}]))


def test_a_mesh_without_triangles_is_refused(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(InputError, match=r"m\.obj"):
        static_world.build_world(load(tmp_path, meshes=[{"file": "m.obj"}]))


def test_a_mesh_of_nothing_but_degenerate_triangles_is_refused(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 1 2\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"m\.obj"):
        static_world.build_world(load(tmp_path, meshes=[{"file": "m.obj"}]))


def test_ground_reaches_beyond_everything(tmp_path):
    (tmp_path / "s.geojson").write_text(collection(polygon([[p[0] + 300, p[1]] for p in SQUARE])))
    loaded = load(tmp_path, footprints=["s.geojson"], ground=True)
    world, _ = static_world.build_world(loaded)
    ground = world.triangles_m[world.solid_of_face == 1]
    assert (ground[..., 2] == 0).all()
    assert ground[..., 0].max() == 304 + static_world.GROUND_MARGIN_M
    assert world.closed.tolist() == [True, False]
    assert (np.cross(ground[:, 1] - ground[:, 0], ground[:, 2] - ground[:, 0])[:, 2] > 0).all()


def test_ply_comes_back_bit_for_bit(tmp_path):
    world, _ = built(tmp_path, polygon(COURT, HOLE), polygon(SQUARE, name='quote " and é'))
    write_ply(tmp_path / "w.ply", world, {"any": 1})
    again, about = read_ply(tmp_path / "w.ply")
    assert (again.vertices_m == world.vertices_m).all()
    assert (again.faces == world.faces).all()
    assert (again.solid_of_face == world.solid_of_face).all()
    assert again.solids == world.solids
    assert about == {"any": 1}
    assert len(trimesh.load(tmp_path / "w.ply", process=False).faces) == len(world.faces)
    whole = (tmp_path / "w.ply").read_bytes()
    for broken in (
        whole[:-1],
        whole[: len(whole) // 2],
        b"",
        whole.replace(b"element face", b"element fact", 1),
        b"ply\nend_header\n",
    ):
        (tmp_path / "w.ply").write_bytes(broken)
        with pytest.raises(InputError, match=r"complete statics\.ply"):
            read_ply(tmp_path / "w.ply")


INDICES = {
    "a vertex beyond the last": ("faces", 8, "expected a vertex from 0 to 7, got 8"),
    "a vertex before the first": ("faces", -1, "expected a vertex from 0 to 7, got -1"),
    "a solid beyond the last": ("solid_of_face", 1, "expected a solid from 0 to 0, got 1"),
    "a solid before the first": ("solid_of_face", -2, "expected a solid from 0 to 0, got -2"),
    "a vertex that is no number": ("vertices_m", np.nan, "expected finite coordinates"),
}


@pytest.mark.parametrize(("column", "value", "message"), INDICES.values(), ids=INDICES.keys())
def test_ply_whose_indices_lead_nowhere_is_refused(tmp_path, column, value, message):
    world, _ = built(tmp_path, polygon(SQUARE))
    values = getattr(world, column).copy()
    values.flat[5] = value
    write_ply(tmp_path / "w.ply", dataclasses.replace(world, **{column: values}), {})
    with pytest.raises(InputError, match=re.escape(f"w.ply: {message}")):
        read_ply(tmp_path / "w.ply")


def test_ply_with_a_flipped_bit_is_read_or_refused(tmp_path):
    world, _ = built(tmp_path, polygon(SQUARE))
    write_ply(tmp_path / "w.ply", world, {"any": 1})
    whole = (tmp_path / "w.ply").read_bytes()
    for bit in range(0, 8 * len(whole), 17):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        (tmp_path / "w.ply").write_bytes(data)
        with contextlib.suppress(InputError):
            again, _ = read_ply(tmp_path / "w.ply")
            assert np.isfinite(again.triangles_m).all()
            assert len(again.closed) == len(again.solids)


def checked_at(folder, *sites, features, ground=True):
    (folder / "s.geojson").write_text(collection(*features))
    (folder / "sites.csv").write_text(
        "site,x_m,y_m,z_m\n" + "".join(f"s{i},{x!r},{y!r},{z!r}\n" for i, (x, y, z) in enumerate(sites))
    )
    loaded = load(folder, footprints=["s.geojson"], ground=ground)
    return checked(loaded, static_world.build_world(loaded)[0])


def checked(loaded, world):
    """The scene, once all of its sites are checked."""
    scene = inputs.resolve_scene(loaded, world)
    Scanner(scene).check(scene.sites)
    return scene


HOUSES = (
    polygon(COURT, HOLE, name="court", kind="building", height_m=12),
    polygon(
        [[-20, -20], [-10, -20], [-10, -10], [-20, -10], [-20, -20]],
        name="crown",
        kind="tree_crown",
        base_m=4,
        height_m=9,
    ),
)


@pytest.mark.parametrize(
    "site",
    [
        (20.0, 20.0, 3.0),  # in the courtyard
        (12.0, 12.0, 12.5),  # above the roof
        (12.0, 12.0, 12.0),  # on the roof
        (-15.0, -15.0, 3.0),  # under the crown
        (-15.0, -15.0, 4.0),  # at its underside
        (-15.0, -15.0, 9.5),  # above it
        (10.0, 20.0, 3.0),  # on a wall
        (10.0, 10.0, 3.0),  # on a corner
        (9.999, 20.0, 3.0),
        (0.0, 0.0, 0.001),
    ],
)
def test_free_places(tmp_path, site):
    assert len(checked_at(tmp_path, site, features=HOUSES).sites) == 1


@pytest.mark.parametrize(
    ("site", "message"),
    [
        ((12.0, 12.0, 3.0), r"site s0: .* is inside court \(building\)"),
        ((10.001, 20.0, 3.0), "inside court"),
        ((12.5, 20.0, 11.999), "inside court"),
        ((12.5, 12.5, 6.0), "inside court"),  # above a diagonal of the triangulation
        ((-15.0, -15.0, 5.0), r"inside crown \(tree_crown\)"),
        ((-15.0, -15.0, 4.00001), "inside crown"),
        ((0.0, 0.0, 0.0), "not above the ground"),
        ((0.0, 0.0, -1.0), "not above the ground"),
        ((200.0, 20.0, 3.0), r"the site is 140\.0 m from the region of interest"),
    ],
)
def test_impossible_places(tmp_path, site, message):
    with pytest.raises(InputError, match=message):
        checked_at(tmp_path, site, features=HOUSES)


@pytest.mark.parametrize("degrees", range(3, 90, 7))
def test_a_site_on_an_oblique_wall_is_no_matter_of_rounding(tmp_path, degrees):
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])[:2, :2]
    house = (np.array(SQUARE) - 2) @ turn.T + 20
    walls = [
        (*(float(v) for v in turn @ [2.0 + d, y] + 20), 3.0)
        for y in (-1.1, 0.0, 0.3)
        for d in (-5e-7, -1e-12, 0.0, 1e-12)
    ]
    assert len(checked_at(tmp_path, *walls, features=[polygon(house.tolist())]).sites) == len(walls)
    deep = (*(float(v) for v in turn @ [1.999, 0.3] + 20), 3.0)
    with pytest.raises(InputError, match="inside it"):
        checked_at(tmp_path, deep, features=[polygon(house.tolist())])


def test_a_site_inside_an_inverted_solid_is_found_and_an_open_one_is_not(tmp_path):
    (tmp_path / "sites.csv").write_text("site,x_m,y_m,z_m\na,20,20,3\n")
    inverted = BOX.copy()
    inverted.invert()
    for mesh, refused in ((inverted, True), (trimesh.Trimesh(BOX.vertices, BOX.faces[1:], process=False), False)):
        world, _ = mesh_of(tmp_path, mesh, offset_m=(20, 20, 3))
        loaded = load(tmp_path, meshes=[{"file": "m.ply", "offset_m": (20, 20, 3)}])
        if refused:
            with pytest.raises(InputError, match="inside m_0"):
                checked(loaded, world)
        else:
            assert len(checked(loaded, world).sites) == 1


def test_closed_means_each_side_met_by_its_opposite():
    faces = np.array(BOX.faces, dtype=np.int32)
    twice = np.concatenate([faces, faces + 8])
    owner = np.repeat([0, 1], 12).astype(np.int32)
    points = np.concatenate([BOX.vertices, BOX.vertices + 20])
    names = (("a", "x"), ("b", "x"))
    assert World(points, twice, owner, names).closed.tolist() == [True, True]
    assert World(points, twice[:-1], owner[:-1], names).closed.tolist() == [True, False]
    assert World(points, faces, owner[:12], names).closed.tolist() == [True, False]
    doubled = World(points[:8], np.concatenate([faces, faces[:1]]), np.zeros(13, dtype=np.int32), names[:1])
    assert doubled.closed.tolist() == [False]
    far = World(points + np.array([393216.0, 3932160.0, 64.0]), twice[:, ::-1].copy(), owner, names)
    assert far.signs.tolist() == [-1, -1]


def test_shipped_statics_are_closed_and_clean():
    for name in ("nishishinjuku", "ingolstadt", "roundabout"):
        world, counts = static_world.build_world(loading.load(f"scenarios/{name}"))
        kinds = [kind for _, kind in world.solids]
        assert [k for k, closed in zip(kinds, world.closed, strict=True) if not closed] == ["ground"]
        assert (world.signs[world.closed] == 1).all()
        assert not counts.repaired
        assert not counts.ignored
        features = json.loads((Path("scenarios") / name / "statics.geojson").read_text())["features"]
        assert sum(counts.built.values()) >= len(features)


# ---- where files lie on the Earth

CRS = {"epsg": 32632, "offset_m": [-550_700, -5_635_200]}
FRAME = WorldFrame("EPSG:32632", (-550_700.0, -5_635_200.0))


def located(folder, **settings):
    values = {
        "roi": {"center_m": [20, 20, 2.5], "size_m": [80, 80, 5], "voxel_m": 0.5},
        "traffic": {"fcd": "none.csv"},
        "crs": CRS,
        "sites": {"file": "sites.csv", "sensor": "VLP-16"},
        "statics": {"ground": False, **settings},
    }
    return static_world.build_world(scenario_from_dict(values, folder, "scenario.toml"))


def test_features_in_degrees_are_counted_and_stand_where_metres_put_them(tmp_path):
    """Radii and heights stay metres; what is null is as if it were not there, as a GIS writes it."""
    square, lamp = [FRAME.to_degrees(np.array(some, dtype=float)).tolist() for some in (SQUARE, [[9, 9]])]
    more = {"name": None, "kind": None, "base_m": None}
    degrees = (polygon(square, **more), feature({"type": "Point", "coordinates": lamp[0]}, height_m=5, radius_m=0.1))
    metres = (polygon(SQUARE), feature({"type": "Point", "coordinates": [9, 9]}, height_m=5, radius_m=0.1))
    (tmp_path / "s.geojson").write_text(collection(*degrees, crs="OGC:CRS84"))
    world, counts = located(tmp_path, footprints=["s.geojson"])
    assert np.array_equal(world.vertices_m, built(tmp_path, *metres)[0].vertices_m)
    assert counts.repaired == {"features in WGS 84 (CRS84), brought into the world frame": 2}
    assert world.solids[0] == ("s_0", "footprint")


def test_lines_that_rounding_has_left_beside_a_polygon_are_counted(tmp_path):
    """GDAL makes a collection of a polygon whose thin corner fell together."""
    thin = {"type": "LineString", "coordinates": [[4, 4], [6, 4]]}
    both = {"type": "GeometryCollection", "geometries": [{"type": "Polygon", "coordinates": [SQUARE]}, thin]}
    world, counts = built(tmp_path, feature(both, height_m=3))
    assert volumes(world) == pytest.approx([48], rel=1e-12)
    assert counts.repaired == {"lines and points beside polygons, left out": 1}


def test_rings_that_rounded_degrees_make_cross_are_mended_and_others_are_not(tmp_path):
    """A notch of 1 cm is turned over by 6 digits of a degree; a bow-tie crosses whatever the digits."""
    notched = [[0, 0], [4, 0], [4, 4], [2.01, 4], [2.0, -0.02], [1.99, 4], [0, 4], [0, 0]]
    (tmp_path / "s.geojson").write_text(
        collection(polygon(FRAME.to_degrees(np.array(notched)).tolist()), crs="OGC:CRS84")
    )
    world, counts = located(tmp_path, footprints=["s.geojson"])
    assert counts.repaired["rings that rounded degrees made cross"] == 1
    assert volumes(world).sum() == pytest.approx(80, rel=0.01)
    with pytest.raises(InputError, match="is not a valid polygon"):
        built(tmp_path, polygon(notched))
    tie = FRAME.to_degrees(np.array([[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]], dtype=float)).tolist()
    (tmp_path / "s.geojson").write_text(collection(polygon(tie), crs="OGC:CRS84"))
    with pytest.raises(InputError, match="is not a valid polygon"):
        located(tmp_path, footprints=["s.geojson"])


@pytest.mark.parametrize("way", ["epsg", "epsg with offset", "origin"])
def test_a_mesh_may_be_in_a_system_of_its_own(tmp_path, way):
    box = trimesh.creation.box((4, 6, 8))
    eastings = np.array([550_720.0, 5_635_230.0, 4.0])  # (20, 30) in the world
    lon, lat = FRAME.to_degrees(np.array([[20.0, 30.0]]))[0].tolist()
    box.apply_translation(eastings if way == "epsg" else [0, 0, 4])
    settings = {
        "epsg": {"epsg": 25832},
        "epsg with offset": {"epsg": 25832, "offset_m": [*eastings[:2].tolist(), 0]},
        "origin": {"origin_deg": [lon, lat]},
    }[way]
    box.export(tmp_path / "m.ply")
    world, _ = located(tmp_path, meshes=[{"file": "m.ply", **settings}])
    assert world.closed.all()
    near = 0.5 if way == "epsg" else 1e-3  # PLY holds float32: at 5,600 km its last bit is half a metre
    corners = np.array([[x, y] for x in (-2, 2) for y in (-3, 3)], dtype=float)
    expected = np.add(corners, (20.0, 30.0))
    if way == "origin":  # metres to the east and north of a place on the Earth: north is half a degree off the grid's
        bearings_deg = np.degrees(np.arctan2(corners[:, 0], corners[:, 1]))
        ends = pyproj.Geod(ellps="WGS84").fwd([lon] * 4, [lat] * 4, bearings_deg, np.hypot(*corners.T))
        expected = FRAME.from_degrees(np.column_stack(ends[:2]))
        assert np.abs(expected - corners - [20.0, 30.0]).max() > 0.01
    found = np.unique(np.round(world.vertices_m[:, :2], 1 if way == "epsg" else 6), axis=0)
    assert sorted(found.tolist()) == [pytest.approx(spot, abs=near) for spot in sorted(expected.tolist())]
    assert [world.vertices_m[:, 2].min(), world.vertices_m[:, 2].max()] == pytest.approx([0, 8], abs=1e-6)


def test_a_mesh_that_lies_elsewhere_is_refused(tmp_path):
    box = trimesh.creation.box((4, 6, 8))
    box.apply_translation([550_720, 5_635_230, 4])
    box.export(tmp_path / "m.ply")
    with pytest.raises(
        InputError, match=r"m.ply: .*would be near it as eastings and northings of EPSG:32632. Set offset_m"
    ):
        located(tmp_path, meshes=[{"file": "m.ply"}])
    with pytest.raises(InputError, match="expected epsg or origin_deg, got both"):
        located(tmp_path, meshes=[{"file": "m.ply", "epsg": 25832, "origin_deg": [9, 51]}])


def test_all_wrong_features_of_a_file_are_told_at_once(tmp_path: Path) -> None:
    """Twenty by name, then how many more; what ``egvs new`` notes beside a height is no misspelt height."""
    wrong = [polygon(SQUARE, name=f"w{number}", height_m=None, height_from="levels") for number in range(23)]
    with pytest.raises(DiagnosticsError) as caught:
        built(tmp_path, polygon(SQUARE), polygon(SQUARE, height_m="tall", name="t"), *wrong)
    told = [str(finding) for finding in caught.value.findings]
    assert len(told) == 21
    assert "feature 1 (t): height_m: expected metres, at most 1e+08, got 'tall'" in told[0]
    assert "feature 2 (w0): height_m is missing" in told[1]
    assert "4 more features are wrong" in told[-1]
