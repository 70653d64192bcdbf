"""Point clouds as the static world: what is read, counted and said, and what sites see of the result."""

from __future__ import annotations

import gzip
import importlib.util
import random
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import box

import egvs
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Roi
from egvs.creation.alignment import make_alignment
from egvs.creation.map_parts import Alignment, MapContext, MappedMesh
from egvs.extensions.maps.point_clouds import reader as point_cloud
from egvs.extensions.maps.point_clouds.as_built_view import AsBuiltMap, unseen_shares
from egvs.extensions.maps.point_clouds.moving_points import StationScan
from egvs.formats.georeference import WorldFrame
from egvs.formats.point_clouds import write_points
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.static_world import build_world
from tests.extensions.maps import as_built_clouds
from tests.extensions.maps.test_moving_points import CAR, ROI, WALL, scan, world
from tests.fuzz import bases, mutating

needs_pye57 = pytest.mark.skipif(importlib.util.find_spec("pye57") is None, reason="pye57 is not installed (egvs[las])")
needs_laspy = pytest.mark.skipif(importlib.util.find_spec("laspy") is None, reason="laspy is not installed (egvs[las])")

MUTANTS = 40
SAME_FRAME = Alignment(np.array([[0.0, 0.0], [100.0, 0.0]]), np.array([[0.0, 0.0], [100.0, 0.0]]))
CONTEXT = MapContext(None, box(-30, -30, 30, 30), SAME_FRAME)
STATIONS = [(-12.0, -8.0, 2.0), (12.0, -2.0, 2.0), (-12.0, 12.0, 2.0), (10.0, 12.0, 2.0)]
HOUSE = ((4.0, 3.0, 6.0), (0.0, 3.0, 3.0))


def write_pcd(path: Path, view: StationScan) -> Path:
    """A binary PCD in the scanner's frame, whose VIEWPOINT is the station."""
    write_points(path, view.points_m - view.station_m)
    x, y, z = view.station_m
    head, mark, body = path.read_bytes().partition(b"VIEWPOINT 0 0 0 ")
    path.write_bytes(head + f"VIEWPOINT {x} {y} {z} ".encode() + body)
    assert mark
    return path


def write_views(folder: Path, views: Sequence[StationScan]) -> list[Path]:
    return [write_pcd(folder / f"{number}.pcd", view) for number, view in enumerate(views)]


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A house and a wall on a plane from four stations, during the first of which a car stood there."""
    static = (WALL, HOUSE)
    views = [
        scan(world(*static, *([(CAR, (-6.0, -6.0, 0.75))] if i == 0 else [])), at, i) for i, at in enumerate(STATIONS)
    ]
    return write_views(tmp_path_factory.mktemp("survey"), views)


# --- which files ---


@pytest.mark.parametrize(
    ("name", "head", "expected"),
    [
        ("a.las", b"LASF", True),
        ("a.LAZ", b"LASF", True),
        ("a.e57", b"ASTM-E57", True),
        ("a.pcd", b"# .PCD", True),
        ("a.pcd.gz", b"# .PCD", True),
        ("a.las.gz", b"LASF", False),
        ("a.ply", b"ply\nelement vertex 3\nproperty float x\nend_header\n", True),
        ("a.ply", b"ply\nelement vertex 3\nelement face 0\nend_header\n", True),
        ("a.ply", b"ply\nelement vertex 3\nelement face 1\nend_header\n", False),
        ("a.csv", b"x_m,y_m,z_m,intensity\n1,2,3,4\n", True),
        ("a.csv", b"site,x_m,y_m,z_m\n", False),
        ("a.csv", b"x,y\n", False),
        ("a.gz", b"", False),
        ("a.obj", b"v 0 0 0", False),
        ("a", b"", False),
    ],
)
def test_files_that_are_point_clouds(name: str, head: bytes, expected: bool) -> None:
    assert point_cloud.can_open(Path(name), head) is expected


# --- what is read and said ---


@pytest.mark.slow
def test_house_on_a_plane(survey: list[Path]) -> None:
    """Two meshes, of which the ground is flat and the objects are as high as the house, 6 m; the car is gone."""
    result = point_cloud.read_solids(survey, CONTEXT)
    ground, objects = result.meshes
    assert (ground.kind, objects.kind) == ("ground", "as_built")
    assert not ground.is_closed and not objects.is_closed
    assert np.abs(ground.vertices_m[:, 2]).max() < 0.3
    assert np.abs(np.median(ground.vertices_m[:, 2])) < 0.01
    assert objects.vertices_m[:, 2].max() == pytest.approx(6.0, abs=0.1)
    with_car = point_cloud.read_solids(survey[:1], CONTEXT).meshes[1]
    assert vertices_in_car(objects) < 0.2 * vertices_in_car(with_car)
    assert result.has_absolute_heights
    assert result.counts.objects == {"ground": 1, "as_built": 1}
    moving = result.counts.dropped["moving"]["point"]
    assert moving > 1000
    assert f"{moving:,} on moving objects" in result.notes[0]
    assert result.notes[2] == "The scans are from 4 places."


def vertices_in_car(mesh: MappedMesh) -> int:
    inside = np.abs(mesh.vertices_m - (-6.0, -6.0, 0.75)) < np.array(CAR) / 2 + 0.05
    return int(np.count_nonzero(inside.all(axis=1) & (mesh.vertices_m[:, 2] > 0.3)))


@pytest.mark.slow
def test_same_files_give_the_same_bytes(survey: list[Path]) -> None:
    first, second = (point_cloud.read_solids(survey, CONTEXT) for _ in range(2))
    for one, other in zip(first.meshes, second.meshes, strict=True):
        assert one.vertices_m.tobytes() == other.vertices_m.tobytes()
        assert one.faces.tobytes() == other.faces.tobytes()
    assert first.notes == second.notes


def test_counts_add_up(tmp_path: Path) -> None:
    """10 points in the window, 3 beyond it, 2 that are NaN."""
    rows = [(x, y, 0.0) for x in range(5) for y in range(2)] + [(99.0, 0.0, 0.0)] * 3 + [(np.nan, 0.0, 0.0)] * 2
    path = tmp_path / "a.csv"
    path.write_text("x_m,y_m,z_m\n" + "".join(f"{x},{y},{z}\n" for x, y, z in rows))
    result = point_cloud.read_solids([path], CONTEXT)
    assert {reason: dict(points) for reason, points in result.counts.dropped.items()} == {
        "out_of_range": {"point": 3},
        "not_finite": {"point": 2},
    }
    assert result.notes[0] == (
        "15 points read from 1 scan: 3 outside the window, 2 not finite, 0 on moving objects, 0 merged with neighbours"
        " within 0.075 m; 10 are used (10 on the ground)."
    )
    assert "Where the scanner stood is unknown: what moved" in result.notes[2]
    assert "If it is from one place, this is a world for that place only." in result.notes[2]
    assert [mesh.kind for mesh in result.meshes] == ["ground"]


@pytest.mark.slow
def test_gzipped_file_equals_plain_one(tmp_path: Path, survey: list[Path]) -> None:
    packed = tmp_path / "0.pcd.gz"
    packed.write_bytes(gzip.compress(survey[0].read_bytes(), mtime=0))
    one, other = (point_cloud.read_solids([path], CONTEXT) for path in (survey[0], packed))
    assert one.meshes[1].vertices_m.tobytes() == other.meshes[1].vertices_m.tobytes()
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"0\.pcd\.gz: damaged gzip file"):
        point_cloud.read_solids([packed], CONTEXT)


def test_large_scans_are_thinned_while_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is held never exceeds twice what is kept; the surface is nearly the same."""
    points = np.random.default_rng(1).uniform((-5, -5, 0), (5, 5, 0.001), (60_000, 3))
    write_points(tmp_path / "a.pcd", points)
    whole = point_cloud.read_solids([tmp_path / "a.pcd"], CONTEXT)
    monkeypatch.setattr(point_cloud, "LARGE_SCAN", 5000)
    chunks = [points[start : start + 3000] for start in range(0, len(points), 3000)]
    scan_ = point_cloud._Scan(None)
    held = []
    for chunk in chunks:
        scan_.add(chunk)
        held.append(sum(map(len, scan_._parts)))
    cells = len(np.unique(np.floor(points[:, :2] / point_cloud.THIN_CELL_M), axis=0))
    assert max(held) < 2 * cells + 3000
    thinned = point_cloud.read_solids([tmp_path / "a.pcd"], CONTEXT)
    assert thinned.counts.dropped["thinned"]["point"] > 30_000
    np.testing.assert_allclose(thinned.meshes[0].vertices_m, whole.meshes[0].vertices_m, atol=0.08)


@needs_laspy
def test_las_file_in_another_reference_system(tmp_path: Path) -> None:
    """A plane in UTM 54 north, heights in the file's own system; the world frame is the same projection, shifted."""
    import laspy
    from pyproj import CRS

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [380_000, 3_950_000, 0]
    header.add_crs(CRS.from_epsg(32654))
    cloud = laspy.LasData(header)
    xs, ys = np.meshgrid(np.arange(0, 20, 0.5), np.arange(0, 20, 0.5))
    cloud.x, cloud.y, cloud.z = xs.ravel() + 380_010, ys.ravel() + 3_950_020, np.full(xs.size, 37.5)
    cloud.write(tmp_path / "a.las")
    frame = WorldFrame("EPSG:32654", (-380_000.0, -3_950_000.0))
    result = point_cloud.read_solids([tmp_path / "a.las"], MapContext(frame, box(0, 0, 100, 100)))
    vertices = result.meshes[0].vertices_m
    np.testing.assert_allclose(vertices.min(axis=0), [10, 20, 37.5], atol=0.26)
    np.testing.assert_allclose(vertices[:, 2], 37.5, atol=1e-9)


@needs_laspy
def test_two_reference_systems_that_disagree_are_named(tmp_path: Path) -> None:
    from pyproj import CRS

    from tests.formats.test_las_header import UTM_15, write_las

    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 20, 0.5), np.arange(0, 20, 0.5)))
    points = np.column_stack([x + 500_000, y + 4_600_000, np.full(x.size, 3.0)])
    context = MapContext(WorldFrame("EPSG:32615", (-500_000.0, -4_600_000.0)), box(-50, -50, 50, 50))
    for code, said in (("EPSG:32615+6360", "heights in the unit US survey foot instead of metre."),
                       ("EPSG:32616", r"positions (49[89]|50[01]) km away."), ("EPSG:32615", "")):  # fmt: skip
        path = write_las(tmp_path / "a.las", UTM_15, CRS(code).to_wkt("WKT1_GDAL"), points=points)
        found = [note for note in point_cloud.read_solids([path], context).notes if "disagree" in note]
        assert len(found) == bool(said)
        assert all(note.startswith(f"{path} declares two") and re.search(f"{said}$", note) for note in found)


@needs_laspy
def test_heights_in_feet_and_points_marked_as_noise(tmp_path: Path) -> None:
    """A plane 300 m high in US survey feet, and a cloud of noise above it, in UTM 15 north by GeoTIFF keys."""
    from tests.formats.test_las_header import SURVEY_FOOT_M, UTM_15, write_las

    xs, ys = (axis.ravel() for axis in np.meshgrid(np.arange(0, 20, 0.5), np.arange(0, 20, 0.5)))
    x, y = np.tile(xs, 2) + 500_000, np.tile(ys, 2) + 4_600_000
    z = np.repeat([300.0, 304.0], len(xs)) / SURVEY_FOOT_M
    path = write_las(
        tmp_path / "a.las",
        UTM_15 | {4096: 6360, 4099: 9003},
        points=np.column_stack([x, y, z]),
        classification=np.repeat([2, 18], len(xs)),
    )
    frame = WorldFrame("EPSG:32615", (-500_000.0, -4_600_000.0))
    result = point_cloud.read_solids([path], MapContext(frame, box(-50, -50, 50, 50)))
    assert [mesh.kind for mesh in result.meshes] == ["ground"]
    np.testing.assert_allclose(result.meshes[0].vertices_m[:, 2], 300.0, atol=0.001)
    assert result.counts.dropped == {"marked": {"point": 1600}}
    assert " 1,600 marked as noise (class 18), 0 on moving objects" in result.notes[0]
    assert result.notes[3] == (
        "Heights in the file are in US survey feet and converted to metres (NAVD88 height (ftUS))."
    )


@pytest.mark.slow
@needs_laspy
@pytest.mark.parametrize("text", ["Local", '""', "NOT A SYSTEM[]"])
def test_alignment_places_a_file_whose_reference_system_is_no_text_of_one(tmp_path: Path, text: str) -> None:
    from tests.formats.test_las_header import write_las

    path = write_las(tmp_path / "a.las", wkt=text, points=np.random.default_rng(0).uniform(0, 9, (500, 3)))
    result = point_cloud.read_solids([path], CONTEXT)
    assert result.notes[3] == "Heights in the file are in metres (from the distance of the points of --align)."
    with pytest.raises(InputError, match=r"a\.las: .*coordinate reference system.* Give two of its points .*--align"):
        point_cloud.read_solids([path], MapContext(None, box(-30, -30, 30, 30)))


def test_alignment_of_a_file_in_feet(tmp_path: Path) -> None:
    """Two points 100 feet apart in the file are 30.48 m apart on the ground; heights are feet, too."""
    corners = np.array([(x, y, 10.0) for x in range(0, 101, 2) for y in range(0, 101, 2)], dtype=np.float64)
    write_points(tmp_path / "a.ply", corners)
    alignment = make_alignment([((0.0, 0.0), (0.0, 0.0)), ((100.0, 0.0), (30.48, 0.0))], None)
    result = point_cloud.read_solids([tmp_path / "a.ply"], MapContext(None, box(-50, -50, 50, 50), alignment))
    vertices = result.meshes[0].vertices_m
    np.testing.assert_allclose(vertices.max(axis=0), [30.48, 30.48, 3.048], atol=0.31)
    np.testing.assert_allclose(vertices[:, 2], 3.048, atol=1e-9)
    xy_m = np.array([[3.0, -4.0]])
    np.testing.assert_allclose(alignment.to_world(alignment.from_world(xy_m)), xy_m, atol=1e-12)
    with pytest.raises(InputError, match=r"the points are 100\.00 apart in the file and 50\.00 m on the ground"):
        make_alignment([((0.0, 0.0), (0.0, 0.0)), ((100.0, 0.0), (50.0, 0.0))], None)


def test_messages(tmp_path: Path, survey: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"0\.pcd: the file declares no coordinate reference system\. Give two"):
        point_cloud.read_solids(survey[:1], MapContext(None, box(-30, -30, 30, 30)))
    with pytest.raises(
        InputError, match=r"0\.pcd: none of its [\d,]+ points is in the window around the roads \(\d+ m from it\)"
    ):
        point_cloud.read_solids(survey[:1], MapContext(None, box(500, 500, 600, 600), SAME_FRAME))
    write_points(tmp_path / "far.pcd", np.array([[1e300, 0, 0]]))
    with pytest.raises(InputError, match=r"far\.pcd: expected coordinates of at most 1e\+08, got 1e\+300"):
        point_cloud.read_solids([tmp_path / "far.pcd"], CONTEXT)
    monkeypatch.setenv("EGVS_MAX_TRIANGLES", "1000")
    with pytest.raises(InputError, match=r"0\.pcd: its surface .* triangles\. The limit is 1,000 triangles"):
        point_cloud.read_solids(survey[:1], CONTEXT)
    monkeypatch.setenv("EGVS_MAX_POINTS", "1000")
    with pytest.raises(InputError, match=r"0\.pcd: has [\d,]+ points"):
        point_cloud.read_solids(survey[:1], CONTEXT)


REAL = Path(__file__).parents[4] / "shared" / "real" / "chengdu" / "sweep.pcd.gz"


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_file(), reason="chengdu/sweep.pcd.gz is not beside the checkout (shared/real)")
def test_real_sweep_next_to_a_freeway() -> None:
    """144,000 rows, 48,974 with nan (``zgrep -c nan``); a carriageway 3.7 m below the sensor, other ground 6 to 8 m."""
    result = point_cloud.read_solids([REAL], MapContext(None, box(-60, -60, 60, 60), SAME_FRAME))
    assert result.notes[0].startswith("144,000 points read from 1 scan: ")
    assert result.counts.dropped["not_finite"]["point"] == 48_974
    ground, objects = result.meshes
    heights = ground.vertices_m[:, 2]
    assert np.mean((heights > -8.5) & (heights < -3.0)) > 0.95
    assert 20_000 < len(objects.faces) < 200_000


# --- damaged files ---


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.csv", "a.e57", "a.las", "a.laz", "a.pcd", "a.pcd.gz", "a.ply"])
def test_mutants_are_read_or_rejected_with_one_message(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    """As in the fuzzer, which reads clouds as measured scans."""
    library = {".e57": "pye57", ".las": "laspy", ".laz": "laspy"}.get(Path(name).suffix)
    if library is not None:
        pytest.importorskip(library)
    path = tmp_path / name
    bases.write_cloud(path)
    content = path.read_bytes()
    results = Counter[str]()
    for case in range(MUTANTS):
        path.write_bytes(mutating.mutant(random.Random(f"{name}/{case}"), content))
        try:
            point_cloud.read_solids([path], CONTEXT)
            results["read"] += 1
        except InputError as error:
            assert name in str(error)
            assert len(str(error)) < 4000
            results["rejected"] += 1
    assert results["rejected"] > MUTANTS // 5
    assert capfd.readouterr() == ("", "")


# --- what sites see of it ---


@pytest.mark.slow
def test_one_station_is_a_world_for_that_place_only(survey: list[Path]) -> None:
    """Behind the house nobody has measured: a site there looks into unseen space, a site at the station does not."""
    result = point_cloud.read_solids(survey[1:2], CONTEXT)
    assert result.notes[2].startswith("All scans are from one place.")
    region = Roi((-12.0, -10.0, 0.0), (24.0, 18.0, 4.0))
    at_station, behind_house = result.unseen_shares(np.array([STATIONS[1], (-6.0, 5.0, 2.0)]), region)
    assert at_station == 0.0
    assert behind_house > 0.15


def test_unseen_share_of_a_hand_made_corridor() -> None:
    """A wall halfway along four voxels: the station sees two of them, a site above the wall sees all four."""
    region = Roi((0.0, 0.0, 0.0), (4.0, 1.0, 1.0))
    wall = np.array([[2.0, -9.0, 0.0], [2.0, 9.0, 0.0], [2.0, 9.0, 1.5], [2.0, -9.0, 1.5]])
    hidden = World(wall, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros(2, np.int32), (("wall", "as_built"),))
    station = np.array([[-1.0, 0.5, 0.5]])
    sites = np.array([[2.0, 0.5, 9.0], [-3.0, 0.5, 0.5], [9.0, 0.5, 0.5]])
    assert unseen_shares(hidden, station, sites, region).tolist() == [0.5, 0.0, 1.0]
    assert np.isnan(unseen_shares(hidden, np.empty((0, 3)), sites, region)).all()


def differences(true: World, as_built: AsBuiltMap, roi: Roi, sites_m: FloatArray, points_m: FloatArray) -> FloatArray:
    """Share of points whose visibility differs, for each site."""
    casters = Caster(true, roi), Caster(as_built.world(), roi)
    seen = [[as_built_clouds.visible_points(caster, roi, site, points_m) for caster in casters] for site in sites_m]
    return np.array([np.mean(expected != actual) for expected, actual in seen])


@pytest.mark.slow
def test_visibility_of_a_house_on_a_plane(survey: list[Path]) -> None:
    """2 % of the points differ in the mean, 4 % at the worst site, as for a junction."""
    result = point_cloud.read_solids(survey, CONTEXT)
    points = np.random.default_rng(1).uniform((-12, -12, 0), (12, 12, 5), (3000, 3))
    sites = np.array([(-10.0, -3.0, 4.5), (10.0, -3.0, 4.5), (-8.0, 8.0, 4.5), (8.0, 8.0, 4.5)])
    different = differences(world(WALL, HOUSE), result, ROI, sites, points)
    assert different.mean() < 0.02
    assert different.max() < 0.04


@pytest.mark.nightly  # the house on a plane, above, has the same limits
@pytest.mark.slow
@needs_pye57
def test_visibility_of_a_junction_from_nine_stations(tmp_path: Path) -> None:
    """Nishishinjuku as E57: voxels that ten sites at 4.5 m see, against its own static world."""
    scenario = egvs.load(Path(__file__).parents[3] / "scenarios" / "nishishinjuku")
    true, _ = build_world(scenario)
    roi = scenario.roi.box
    views = as_built_clouds.scan_stations(true, roi, as_built_clouds.stations_around(roi))
    path = as_built_clouds.write_e57(tmp_path / "nine.e57", views)
    result = point_cloud.read_solids([path], MapContext(None, box(120, 180, 270, 280), SAME_FRAME))
    voxels = as_built_clouds.random_voxel_centres(scenario.roi.grid, 15_000)
    different = differences(true, result, roi, as_built_clouds.SITES_M, voxels)
    assert different.mean() < 0.02
    assert different.max() < 0.04
