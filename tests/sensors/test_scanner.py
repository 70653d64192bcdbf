"""Empty scans from any pose, and measured scans."""

from __future__ import annotations

import importlib.util
import math
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import egvs
from egvs.artefacts import parquet
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.formats import point_clouds
from egvs.formats.georeference import WorldFrame
from egvs.kernels import embree
from egvs.sensors.scanner import Scan, Scanner, _bounding_roi, _count_distinct
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Pose
from egvs.stages.inputs import build_scene
from egvs.world import ray_casting
from egvs.world.mesh import read_ply
from egvs.world.ray_casting import Caster
from tests.conftest import feature
from tests.effects.scan_helpers import CROWNS, ROI, _world, prism, run_scan, write_scene

EFFECTS = ["effects.mount_sway.tilt_deg=0.5", "effects.divergence.sub_beams=7"]


@pytest.fixture
def scene(mini: Path) -> Scene:
    return egvs.build_scene(egvs.load(mini))


def same(one, other) -> bool:
    """Whether two scans have the same rows, bit for bit."""
    arrays = ("beam", "ends_m", "returned", "weight")
    return all(
        np.array_equal(getattr(one.rows, name), getattr(other.rows, name))
        if getattr(one.rows, name) is not None
        else getattr(other.rows, name) is None
        for name in arrays
    )


def test_pose_of_a_site_gives_its_scan(scene):
    scanner = Scanner(scene)
    for site in scene.sites:
        scan = scanner.scan(site.pose, scene.sensor(site.sensor))
        assert same(scan, scanner.scan_site(site)) and scan.beams == scan.sensor.beams and scan.returns > 0


@pytest.mark.parametrize("settings", [[], EFFECTS], ids=["plain", "weighted"])
def test_any_pose_gives_the_scan_of_a_site_there(mini, settings):
    """The triangles are culled for the sites; another pose must not miss any."""
    pose = Pose(25.0, 30.0, 4.0, yaw_deg=200.0, pitch_deg=-8.0)
    scene = egvs.build_scene(egvs.load(mini, settings))
    moved = replace(scene, sites=(replace(scene.sites[0], pose=pose),))
    sensor = scene.sensor("small")
    free, named = Scanner(scene).scan(pose, sensor), Scanner(moved).scan(pose, sensor)
    assert same(free, named) and (free.rows.weight is not None) == bool(settings)


def test_scan_shares_no_data_with_the_scanner(scene):
    scanner, sensor = Scanner(scene), scene.sensor("small")
    first = scanner.scan(scene.sites[0].pose, sensor)
    remaining = first.rows.ends_m.copy()
    scanner.scan(scene.sites[1].pose, sensor).rows.ends_m[:] = 0.0
    assert np.array_equal(first.rows.ends_m, remaining)
    first.rows.ends_m[:] = np.nan
    assert np.array_equal(scanner.scan(scene.sites[0].pose, sensor).rows.ends_m, remaining)


def test_record_of_a_scan_names_the_site_where_it_has_no_pole(scene):
    scan = Scanner(scene).scan(scene.sites[0].pose, scene.sensor("small"))
    assert [scan.as_site("s").pole, scan.as_site("s", "p").pole] == ["s", "p"]


def test_options_of_a_scanner_are_named(scene):
    with pytest.raises(TypeError, match="positional"):
        Scanner(scene, True)


def test_threads_may_share_a_scanner(scene):
    scanner, sensor = Scanner(scene), scene.sensor("small")
    poses = [Pose(5.0 + i, 14.0, 3.0, yaw_deg=3.0 * i) for i in range(24)]
    alone = [Scanner(scene).scan(pose, sensor) for pose in poses]
    with ThreadPoolExecutor(8) as pool:
        shared = list(pool.map(lambda pose: scanner.scan(pose, sensor), poses))
    assert all(same(one, other) for one, other in zip(alone, shared, strict=True))


def test_number_of_cached_mounts_is_limited(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(mini))
    one, many = Scanner(scene, mounts=1), Scanner(scene)
    for yaw_deg in (0.0, 10.0, 20.0, 10.0):
        pose = Pose(10.0, 12.0, 3.0, yaw_deg)
        first, second = (scanner.scan(pose, scene.sensor("small")) for scanner in (one, many))
        assert np.array_equal(first.rows.ends_m, second.rows.ends_m)
        assert len(one._directions) == 1
    assert len(many._directions) == 3
    assert pickle.loads(pickle.dumps(one))._mounts == 1


def test_scanner_is_pickled_as_its_scene(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(mini, EFFECTS))
    scanner = Scanner(scene)
    pose, sensor = scene.sites[0].pose, scene.sensor("small")
    again = pickle.loads(pickle.dumps(scanner))
    assert len(pickle.dumps(scanner)) < 100_000  # the scene alone, no tree
    assert same(scanner.scan(pose, sensor), again.scan(pose, sensor))


ON_MAST = "on_top,10,7,5\nbeside,10.4,7,3\nelsewhere,30.5,-12,3\n"
MAST = feature({"type": "Point", "coordinates": [10, 7]}, name="m1", kind="mast", height_m=5, radius_m=0.2)
HOUSE = prism(14, 5, 18, 8, 0, 6, "building")


@pytest.mark.parametrize("settings", [[], EFFECTS], ids=["plain", "weighted"])
def test_scan_leaves_out_the_mast_of_its_own_sensor_only(mini: Path, settings: list[str]) -> None:
    with_mast = egvs.build_scene(egvs.load(write_scene(mini, MAST, HOUSE, sites=ON_MAST), settings))
    without = egvs.build_scene(egvs.load(write_scene(mini, HOUSE), settings))
    scanner, reference = Scanner(with_mast), Scanner(without)
    for name in ("on_top", "beside"):
        assert same(scanner.scan_site(with_mast.site(name)), reference.scan_site(without.site(name)))
    elsewhere = with_mast.site("elsewhere")
    assert not same(scanner.scan_site(elsewhere), reference.scan_site(elsewhere))


def test_sweep_leaves_out_the_mast_and_names_the_faces_of_the_complete_world(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(write_scene(mini, MAST, HOUSE, sites=ON_MAST)))
    rows = Scanner(scene, full_sweep=True).scan_site(scene.site("on_top")).rows
    assert rows.face is not None
    solids = scene.world.solid_of_face[rows.face[rows.returned]]
    assert {scene.world.solids[solid][1] for solid in solids} == {"building", "ground"}


def test_sweeps_meet_what_no_beam_towards_the_region_meets(mini: Path) -> None:
    """Walls behind the only site, 13 m from it and further: a scan can leave them out, a sweep cannot."""
    walls = [prism(-20 - 4 * i, -9, -18 - 4 * i, 9, 0, 5, "building", f"b{i}") for i in range(8)]
    scene = egvs.build_scene(egvs.load(write_scene(mini, *walls, sites="before,-5,0,3\n")))
    pose = scene.sites[0].pose
    backwards = np.array([[-1.0, 0.0, 0.0]])
    assert Scanner(scene).sweep_from(pose, backwards, 100.0).ends_m == pytest.approx(13.0 * backwards)
    rows = Scanner(scene, full_sweep=True).scan_site(scene.sites[0]).rows
    behind_m = rows.ends_m[rows.returned & (rows.ends_m[:, 0] < 0) & (rows.ends_m[:, 2] > -2.0)]
    assert len(behind_m) > 50
    assert behind_m[:, 0] == pytest.approx(-13.0, abs=1e-6)


def test_sweep_ends_in_leaves_behind_the_region(mini: Path) -> None:
    """One crown stands before the region, so that foliage acts; the other, 10 m behind the only site."""
    crowns = prism(0, -4, 4, 4, 0, 5, "tree_crown", "a"), prism(-25, -4, -15, 4, 0, 5, "tree_crown", "b")
    folder = write_scene(mini, *crowns, sites="before,-5,0,3\n")
    scene = egvs.build_scene(egvs.load(folder, ["effects.foliage.leaf_area_density=1"]))
    rows = Scanner(scene, full_sweep=True).scan_site(scene.sites[0]).rows
    x_m = rows.ends_m[rows.returned & (np.abs(rows.ends_m[:, 1]) < 0.1) & (rows.ends_m[:, 2] > -2.0), 0]
    assert np.count_nonzero((x_m > -20.0) & (x_m < -10.0)) > 10


def test_box_around_a_full_sweep_holds_the_world_and_the_region(scene: Scene) -> None:
    box = _bounding_roi(scene)
    low_m, region_m = np.array(box.origin_m), np.array(scene.roi.origin_m)
    held = np.concatenate([scene.world.vertices_m, [region_m, region_m + scene.roi.size_m]])
    assert (low_m < held).all() and (held < low_m + box.size_m).all()


@pytest.mark.parametrize(("x_m", "is_beyond"), [(1e8, False), (1.01e8, True)])
def test_rejects_points_beyond_the_largest_coordinate(mini: Path, x_m: float, is_beyond: bool) -> None:
    (mini / "p.csv").write_text(f"x_m,y_m,z_m\n{x_m},0,1\n")
    with pytest.raises(InputError) as error:
        scan_file(mini, "p.csv", crs="")
    assert ("expected points within 1e+08 m" in str(error.value)) == is_beyond


def test_rejects_sensor_inside_any_other_solid(mini: Path) -> None:
    wide = feature({"type": "Point", "coordinates": [10, 12]}, name="m1", kind="mast", height_m=5, radius_m=0.6)
    kiosk = feature({"type": "Point", "coordinates": [10, 12]}, name="m1", kind="kiosk", height_m=5, radius_m=0.2)
    for solid, is_narrow in ((wide, False), (kiosk, True)):
        scene = egvs.build_scene(egvs.load(write_scene(mini, solid, sites="inside,10,12,3\n")))
        with pytest.raises(InputError, match=r"site inside: \(10, 12, 3\) is inside m1") as error:
            Scanner(scene).scan_site(scene.site("inside"))
        assert ("set its kind to pole or mast or sign" in str(error.value)) == is_narrow


def test_number_of_cached_worlds_is_limited(mini: Path) -> None:
    masts, rows = [], ""
    for i in range(7):
        point = {"type": "Point", "coordinates": [2 + 5 * i, 12]}
        masts.append(feature(point, name=f"m{i}", kind="mast", height_m=5, radius_m=0.2))
        rows += f"s{i},{2 + 5 * i},12,5\n"
    scene = egvs.build_scene(egvs.load(write_scene(mini, *masts, sites=rows)))
    scanner = Scanner(scene)
    first = scanner.scan_site(scene.sites[0])
    for site in scene.sites:
        scanner.scan_site(site)
    assert len(scanner._casters_without) == 4
    assert same(scanner.scan_site(scene.sites[0]), first)


def test_error_of_one_site_does_not_affect_others(mini: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\ngood,10,12,3,\nwall,16,6,3,\ntypo,10,12,3,VLP-99\n")
    scene = egvs.build_scene(egvs.load(mini))
    scanner = Scanner(scene)
    assert scanner.scan_site(scene.site("good")).returns > 0
    with pytest.raises(InputError, match=r"site wall: \(16, 6, 3\) is inside house"):
        scanner.scan_site(scene.site("wall"))
    with pytest.raises(InputError, match=r"site typo: unknown sensor 'VLP-99'"):
        scanner.scan_site(scene.site("typo"))
    with pytest.raises(InputError, match=r"(?s)site wall.*\n.*site typo"):
        scanner.check(scene.sites)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (Pose(16, 6, 3), "is inside house"),
        (Pose(20, 0, -1), "is not above the ground"),
        (Pose(900, 0, 3), "from the region of interest"),
    ],
)
def test_rejects_impossible_position_with_its_coordinates(scene, pose, message):
    with pytest.raises(InputError, match=message) as error:
        Scanner(scene).scan(pose, scene.sensor("small"))
    assert f"pose ({pose.x_m:g}, {pose.y_m:g}, {pose.z_m:g})" in str(error.value)


def test_directions_of_mounts_are_cached_with_a_limit(scene):
    scanner, sensor = Scanner(scene), scene.sensor("small")
    for yaw in range(80):
        scanner.scan(Pose(10, 12, 3, yaw_deg=float(yaw)), sensor)
    assert len(scanner._directions) <= 32


# --- culling
def test_culling_unreachable_geometry_does_not_change_scans(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    corners = rng.uniform([-200, -200], [240, 200], (150, 2))
    blocks = [prism(x, y, x + 3, y + 2, 0, 2 + i % 7, "building", f"b{i}") for i, (x, y) in enumerate(corners)]
    free = [
        b
        for b, (x, y) in zip(blocks, corners, strict=True)
        if math.hypot(x - 10, y - 12) > 9 and math.hypot(x - 30.5, y - 16) > 9
    ]
    write_scene(mini, *free, sites="pole_a,10,12,3\npole_b,30.5,16,7\n")
    _, culled = run_scan(mini, tmp_path / "a")
    held = []
    monkeypatch.setattr(
        ray_casting,
        "reachable_shapes",
        lambda shapes, *_: held.append(len(shapes)) or np.ones(len(shapes), dtype=np.bool_),
    )
    _, complete = run_scan(mini, tmp_path / "b")
    assert files.hash_file(culled / "scans.parquet") == files.hash_file(complete / "scans.parquet")
    monkeypatch.undo()
    world, _ = read_ply(complete / "statics.ply")
    sites = np.array([[10, 12, 3], [30.5, 16, 7.0]])
    remaining = ray_casting.reachable_shapes(world.triangles_m, egvs.load(mini).roi.box, sites, 100.0)
    assert 0.05 * held[0] < remaining.sum() < 0.5 * held[0]


def test_culling_keeps_all_shapes_that_beams_meet() -> None:
    rng = np.random.default_rng(9)
    roi = Roi((0.0, 0.0, 0.0), (10.0, 6.0, 4.0))
    for _ in range(30):
        sites = rng.uniform([-15, -15, 1], [25, 25, 12], (3, 3))
        start, through = sites[rng.integers(3, size=200)], rng.uniform([0, 0, 0], [10, 6, 4], (200, 3))
        far = rng.uniform(0, 6, 200)[:, None]
        met = start + far * (through - start)
        shapes = met[:, None] + rng.normal(0, 0.5, (200, 3, 3))
        shapes[:, 0] = met
        assert ray_casting.reachable_shapes(shapes, roi, sites, float(np.linalg.norm(met - start, axis=1).max())).all()
        assert ray_casting.shapes_between(shapes[far[:, 0] <= 1], roi, sites).all()


def test_builds_no_tree_without_geometry_in_reach(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embree, "TriangleTree", lambda triangles: pytest.fail("a tree was built"))
    for number, solids in enumerate(((), (prism(5, 60, 9, 70, 0, 9, "building"),))):
        _, out = run_scan(
            write_scene(mini, *solids, sites="pole_a,10,12,3\n"), tmp_path / str(number), "statics.ground=false"
        )
        table, _ = parquet.read_artefact(out / "scans.parquet", "scans")
        assert table.num_rows > 0 and not any(table.column("returned").to_pylist())


def test_caster_without_sites_has_all_triangles() -> None:
    world = _world(*CROWNS)
    assert len(Caster(world, ROI)._triangles) == len(world.faces)


WORLD_FRAME = WorldFrame("EPSG:32632", (-550_700.0, -5_635_200.0))


CRS = "\n[crs]\nepsg = 32632\noffset_m = [-550700, -5635200]\nzero_height_m = 210.0\n"


POINTS = np.array([[12.0, 3.0, 0.5], [20.0, -4.0, 1.25], [35.0, 8.0, 2.0]])


needs_laspy = pytest.mark.skipif(importlib.util.find_spec("laspy") is None, reason="laspy is not installed (egvs[las])")


def write_las(path: Path, points_m: NDArray[np.float64], crs: str | None, point_format: int = 6) -> None:
    import laspy
    import pyproj

    header = laspy.LasHeader(version="1.4" if point_format >= 6 else "1.2", point_format=point_format)
    header.scales, header.offsets = [1e-4] * 3, np.floor(points_m[0])
    if crs is not None:
        header.add_crs(pyproj.CRS(crs))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points_m.T
    cloud.write(path)


def scan_file(mini: Path, name: str, crs: str = CRS) -> Scan:
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,points\npole_a,10,12,3,{name}\n")
    text = (mini / "scenario.toml").read_text().partition("\n[crs]")[0]
    (mini / "scenario.toml").write_text(text + crs)
    scene = build_scene(egvs.load(mini))
    return Scanner(scene).scan_site(scene.sites[0])


@needs_laspy
@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32632+5783", "EPSG:31467"])
@pytest.mark.parametrize("point_format", [3, 6])
def test_las_in_a_projection_gives_the_same_scan_as_metres(mini: Path, crs: str, point_format: int) -> None:
    """Heights above the sea become heights above the world's z = 0."""
    if point_format == 3 and "+" in crs:
        pytest.skip("LAS 1.2 names its system by a single code")
    point_clouds.write_points(mini / "m.ply", POINTS)
    by_metres = scan_file(mini, "m.ply")
    lon_lat_deg = WORLD_FRAME.to_degrees(POINTS[:, :2])
    xy = WorldFrame(crs.partition("+")[0]).from_lon_lat(lon_lat_deg)
    write_las(mini / "m.las", np.column_stack([xy, POINTS[:, 2] + 210.0]), crs, point_format)
    by_las = scan_file(mini, "m.las")
    assert len(by_las.rows.ends_m) == 3
    assert by_las.rows.ends_m == pytest.approx(by_metres.rows.ends_m, abs=2e-3 if "31467" in crs else 2e-4)


@needs_laspy
@pytest.mark.parametrize(("vertical", "unit_m"), [("+6360", 1200 / 3937), ("+5703", 1.0), ("", 1200 / 3937)])
def test_las_in_feet_gives_the_same_scan_as_metres(mini: Path, vertical: str, unit_m: float) -> None:
    """New York's plane counts in US survey feet; its heights too, where no vertical system says otherwise."""
    frame = WorldFrame("EPSG:32618", (-585_000.0, -4_510_000.0))
    known = "\n[crs]\nepsg = 32618\noffset_m = [-585000, -4510000]\nzero_height_m = 5.0\n"
    feet = WorldFrame("EPSG:2263").from_lon_lat(frame.to_degrees(POINTS[:, :2]))
    write_las(mini / "m.las", np.column_stack([feet, (POINTS[:, 2] + 5.0) / unit_m]), f"EPSG:2263{vertical}")
    assert scan_file(mini, "m.las", known).rows.ends_m == pytest.approx(POINTS - [10, 12, 3], abs=2e-3)


@needs_laspy
def test_las_without_crs_is_in_metres(mini: Path) -> None:
    write_las(mini / "m.las", POINTS, None)
    assert scan_file(mini, "m.las").rows.ends_m == pytest.approx(POINTS - [10, 12, 3], abs=1e-4)


@needs_laspy
def test_rejects_scan_far_from_the_region(mini: Path) -> None:
    utm = np.add(POINTS, (550_700, 5_635_200, 210))
    write_las(mini / "m.las", utm, None)
    message = "Read as eastings and northings of EPSG:32632, they would be near it. Save the points"
    with pytest.raises(InputError, match=rf"site pole_a: points: .*m.las: coordinates .*{message}"):
        scan_file(mini, "m.las")
    write_las(mini / "m.las", utm, "EPSG:25833")
    with pytest.raises(InputError, match=r"are [\d,]+ km from the region of interest, read as ETRS89 / UTM zone 33N"):
        scan_file(mini, "m.las")
    write_las(mini / "m.las", utm, "EPSG:25832")
    with pytest.raises(InputError, match=r"from the region of interest, read as ETRS89 / UTM zone 32N, which must"):
        scan_file(mini, "m.las", crs="")


def test_rejects_points_in_degrees(mini: Path) -> None:
    degrees = np.column_stack([WORLD_FRAME.to_degrees(POINTS[:, :2]), POINTS[:, 2]])
    point_clouds.write_points(mini / "m.ply", degrees)
    with pytest.raises(
        InputError,
        match=r"m.ply: expected metres .*, got longitude and latitude: .*, as degrees 0 m from the region",
    ):
        scan_file(mini, "m.ply")


def test_measured_points_count_where_their_beams_can_meet_the_region(mini: Path) -> None:
    """Points in all directions; the region is 6 m beside the sensor, and farther than its range for some beams."""
    pose, range_m = Pose(2.0, 3.0, 4.0), 9.0
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    point_clouds.write_points(mini / "points.ply", pose.position_m + directions * rng.uniform(0.5, 9.0, (400, 1)))
    settings = [
        "roi.center_m=[12, 3, 2]", "roi.size_m=[8, 8, 4]", "sensors.small.range_m=9", 'sites.points="points.ply"',
    ]  # fmt: skip
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,2,3,4\n")
    scene = egvs.build_scene(egvs.load(mini, settings))
    scan = Scanner(scene).scan_site(scene.sites[0])
    low, high = np.array([8.0, -1.0, 0.0]), np.array([16.0, 7.0, 4.0])
    steps = np.linspace(0.0, range_m, 4001)[:, None]
    meets = [((low <= p) & (p <= high)).all(axis=1).any() for p in pose.position_m + directions[:, None] * steps]
    difference = set(scan.rows.beam.tolist()) ^ set(np.flatnonzero(meets).tolist())
    assert 10 < sum(meets) < 200
    assert scan.rows.weight is None, "nothing in the scenario weights beams"
    assert len(difference) <= 1, "beams that graze an edge between two samples"


@pytest.mark.parametrize("numbers", [[], [3], [3, 3], [0, 1, 2], [0, 0, 5, 5, 5, 9]])
def test_distinct_numbers_are_counted(numbers: list[int]) -> None:
    assert _count_distinct(np.array(numbers, dtype=np.uint32)) == len(set(numbers))
