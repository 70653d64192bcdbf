"""Meshes and the ground in the static world, and sites in its solids."""

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import trimesh

from egvs.core.errors import InputError
from egvs.scenario import loading
from egvs.sensors.scanner import Scanner
from egvs.stages import scene_inputs
from egvs.world import static_world
from tests.conftest import collection
from tests.world.static_worlds import BOX, COURT, FRAME, HOLE, SQUARE, build_located, build_mesh, load, polygon, volumes


def test_builds_solids_of_poly_xml(tmp_path):
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


def test_divides_mesh_into_closed_pieces(tmp_path):
    two = trimesh.util.concatenate([BOX, BOX.copy().apply_translation([10, 0, 0])])
    world, counts = build_mesh(tmp_path, two, offset_m=(100, 200, 300), kind="city")
    assert len(world.solids) == 2
    assert world.closed.all()
    assert world.triangles_m.min(axis=(0, 1)).tolist() == [98, 197, 296]
    assert counts.built == {"city": 2}
    assert not counts.repaired


def test_inverted_solid_is_closed(tmp_path):
    inverted = BOX.copy()
    inverted.invert()
    world, _ = build_mesh(tmp_path, inverted)
    assert world.closed.all()
    assert world.signs.tolist() == [-1]


@pytest.mark.parametrize("spoil", ["hole", "flipped"])
def test_mesh_with_hole_or_flipped_triangle_is_open_surface(tmp_path, spoil):
    faces = np.array(BOX.faces)
    faces = faces[1:] if spoil == "hole" else np.concatenate([faces[:1, ::-1], faces[1:]])
    world, counts = build_mesh(tmp_path, trimesh.Trimesh(BOX.vertices, faces, process=False))
    assert len(world.faces) == len(faces)
    assert not world.closed.any()
    assert counts.built == {"mesh (open surface)": 1}


def test_drops_and_counts_duplicate_and_degenerate_triangles(tmp_path):
    faces = np.concatenate([BOX.faces, BOX.faces[:3], BOX.faces[:2, [0, 0, 1]]])
    world, counts = build_mesh(tmp_path, trimesh.Trimesh(BOX.vertices, faces, process=False))
    assert world.closed.all()
    assert dict(counts.repaired) == {"degenerate or doubled triangles dropped": 5}


def test_merges_vertices_of_separate_triangles(tmp_path):
    soup = trimesh.Trimesh(BOX.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    world, _ = build_mesh(tmp_path, soup)
    assert world.closed.all()
    assert abs(volumes(world)[0]) == pytest.approx(192)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_rejects_vertex_that_is_not_finite(tmp_path, value):
    (tmp_path / "m.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 {value} 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"m\.obj: vertex 2"):
        static_world.build_world(load(tmp_path, meshes=[{"file": "m.obj"}]))


def test_rejects_mesh_without_triangles(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(InputError, match=r"m\.obj"):
        static_world.build_world(load(tmp_path, meshes=[{"file": "m.obj"}]))


def test_rejects_mesh_of_degenerate_triangles(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 1 2\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"m\.obj"):
        static_world.build_world(load(tmp_path, meshes=[{"file": "m.obj"}]))


def test_ground_extends_beyond_all_solids(tmp_path):
    (tmp_path / "s.geojson").write_text(collection(polygon([[p[0] + 300, p[1]] for p in SQUARE])))
    loaded = load(tmp_path, footprints=["s.geojson"], ground=True)
    world, _ = static_world.build_world(loaded)
    ground = world.triangles_m[world.solid_of_face == 1]
    assert (ground[..., 2] == 0).all()
    assert ground[..., 0].max() == 304 + static_world.GROUND_MARGIN_M
    assert world.closed.tolist() == [True, False]
    assert (np.cross(ground[:, 1] - ground[:, 0], ground[:, 2] - ground[:, 0])[:, 2] > 0).all()


def check_sites_at(folder, *sites, features, ground=True):
    (folder / "s.geojson").write_text(collection(*features))
    (folder / "sites.csv").write_text(
        "site,x_m,y_m,z_m\n" + "".join(f"s{i},{x!r},{y!r},{z!r}\n" for i, (x, y, z) in enumerate(sites))
    )
    loaded = load(folder, footprints=["s.geojson"], ground=ground)
    return check_sites(loaded, static_world.build_world(loaded)[0])


def check_sites(loaded, world):
    """The scene, once all of its sites are checked."""
    scene = scene_inputs.resolve_scene(loaded, world)
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
def test_accepts_sites_outside_solids(tmp_path, site):
    assert len(check_sites_at(tmp_path, site, features=HOUSES).sites) == 1


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
def test_rejects_impossible_sites(tmp_path, site, message):
    with pytest.raises(InputError, match=message):
        check_sites_at(tmp_path, site, features=HOUSES)


@pytest.mark.parametrize("degrees", range(3, 90, 7))
def test_accepts_sites_on_oblique_wall(tmp_path, degrees):
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])[:2, :2]
    house = (np.array(SQUARE) - 2) @ turn.T + 20
    walls = [
        (*(float(v) for v in turn @ [2.0 + d, y] + 20), 3.0)
        for y in (-1.1, 0.0, 0.3)
        for d in (-5e-7, -1e-12, 0.0, 1e-12)
    ]
    assert len(check_sites_at(tmp_path, *walls, features=[polygon(house.tolist())]).sites) == len(walls)
    deep = (*(float(v) for v in turn @ [1.999, 0.3] + 20), 3.0)
    with pytest.raises(InputError, match="inside it"):
        check_sites_at(tmp_path, deep, features=[polygon(house.tolist())])


def test_rejects_site_inside_inverted_but_not_open_solid(tmp_path):
    (tmp_path / "sites.csv").write_text("site,x_m,y_m,z_m\na,20,20,3\n")
    inverted = BOX.copy()
    inverted.invert()
    for mesh, refused in ((inverted, True), (trimesh.Trimesh(BOX.vertices, BOX.faces[1:], process=False), False)):
        world, _ = build_mesh(tmp_path, mesh, offset_m=(20, 20, 3))
        loaded = load(tmp_path, meshes=[{"file": "m.ply", "offset_m": (20, 20, 3)}])
        if refused:
            with pytest.raises(InputError, match="inside m_0"):
                check_sites(loaded, world)
        else:
            assert len(check_sites(loaded, world).sites) == 1


@pytest.mark.slow
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


@pytest.mark.parametrize("way", ["epsg", "epsg with offset", "origin"])
def test_converts_mesh_from_its_crs(tmp_path, way):
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
    world, _ = build_located(tmp_path, meshes=[{"file": "m.ply", **settings}])
    assert world.closed.all()
    near = 0.5 if way == "epsg" else 1e-3  # PLY holds float32: at 5,600 km its last bit is half a metre
    corners = np.array([[x, y] for x in (-2, 2) for y in (-3, 3)], dtype=float)
    expected = np.add(corners, (20.0, 30.0))
    if way == "origin":  # metres to the east and north of a place on the Earth: north is half a degree off the grid's
        bearings_deg = np.degrees(np.arctan2(corners[:, 0], corners[:, 1]))
        ends = pyproj.Geod(ellps="WGS84").fwd([lon] * 4, [lat] * 4, bearings_deg, np.hypot(*corners.T))
        expected = FRAME.from_lon_lat(np.column_stack(ends[:2]))
        assert np.abs(expected - corners - [20.0, 30.0]).max() > 0.01
    corners_found = np.unique(np.round(world.vertices_m[:, :2], 1 if way == "epsg" else 6), axis=0)
    assert sorted(corners_found.tolist()) == [pytest.approx(spot, abs=near) for spot in sorted(expected.tolist())]
    assert [world.vertices_m[:, 2].min(), world.vertices_m[:, 2].max()] == pytest.approx([0, 8], abs=1e-6)


def test_rejects_mesh_of_another_location(tmp_path):
    box = trimesh.creation.box((4, 6, 8))
    box.apply_translation([550_720, 5_635_230, 4])
    box.export(tmp_path / "m.ply")
    with pytest.raises(
        InputError, match=r"m.ply: .*Read as eastings and northings of EPSG:32632, they would be near it. Set offset_m"
    ):
        build_located(tmp_path, meshes=[{"file": "m.ply"}])
    with pytest.raises(InputError, match="expected epsg or origin_deg, got both"):
        build_located(tmp_path, meshes=[{"file": "m.ply", "epsg": 25832, "origin_deg": [9, 51]}])
