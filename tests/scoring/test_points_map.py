"""Maps of points on target: a case by hand, rays against one box by trimesh, surfaces, overlap, and file formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from egvs.core.grid import Grid
from egvs.scoring import points_map
from egvs.scoring.points_map import CAR, PEDESTRIAN, PointsMap, TargetPositions, overlap_map
from egvs.scoring.visibility import Beams
from egvs.sensors.sensor import resolve_sensor
from egvs.sensors.sites import Pose
from egvs.traffic import network
from egvs.traffic.network import Network
from tests.scoring.target_scenes import SHRINK_M

GRID = Grid((0.0, -10.0, 0.0), 0.5, (80, 40, 10))
"""40 m to the east from 0, 20 m to the north from -10."""

NET = """<net version="1.20">
    <edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" length="4" shape="20,-2 22,0 22,3"/></edge>
    <edge id=":j_c0" function="crossing"><lane id=":j_c0_0" index="0" allow="pedestrian" width="4" length="8"
        shape="30,-6 30,6"/></edge>
    <edge id="out" from="a" to="j"><lane id="out_0" index="0" allow="pedestrian" width="2" length="40"
        shape="0,-5 40,-5"/><lane id="out_1" index="1" disallow="pedestrian" length="40" shape="0,-2 40,-2"/></edge>
    <edge id="rail" from="a" to="r"><lane id="rail_0" index="0" allow="rail" length="15" shape="0,6 15,6"/></edge>
    <edge id="up" from="j" to="n"><lane id="up_0" index="0" length="30" shape="22,3,0 22,10,0.7"/></edge>
    <junction id="j" type="priority" x="20" y="0" incLanes="" intLanes="" shape="18,-4 22,-4 22,4 18,4"/>
</net>
"""


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Network:
    path = tmp_path_factory.mktemp("streets") / "made.net.xml"
    path.write_text(NET)
    return network.read_net_xml(path)


def sweep(pose: Pose, length_m: float = 60.0) -> Beams:
    """Beams every 2 degrees in 12 rings that end on the ground, or after a length."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.5, 360.0, 2.0)), np.radians(np.linspace(-40.0, 4.0, 12)))
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    down = directions[:, 2] < 0
    ranges = np.where(down, np.minimum(length_m, -pose.z_m / np.where(down, directions[:, 2], -1.0)), length_m)
    return Beams(pose, resolve_sensor("VLP-16", {}, ""), directions * ranges[:, None])


def test_cells_with_aimed_beams_by_hand(streets: Network) -> None:
    """Three beams end inside the car that stands on the square (10, 8), whose middle is (10.5, -1.5, 0.75).

    The car on the next square to the east is hit as well, as it is 4.5 m long; one 5 squares away is not.
    """
    pose = Pose(10.5, 9.0, 3.0)
    targets_m = np.array([[10.5, -1.5, 0.75], [10.0, -1.5, 0.75], [11.0, -1.5, 0.75]])
    beams = Beams(pose, resolve_sensor("VLP-16", {}, ""), targets_m - np.array(pose.position_m))
    points = TargetPositions.of(CAR, streets, GRID).points_map(beams)
    assert points.values[10, 8] == 3
    assert points.values[11, 8] == 3
    assert points.values[15, 8] == 0
    assert np.isnan(points.values[10, 15])  # no lane
    assert np.nansum(points.values > 0) < 30


@pytest.mark.parametrize("target", [CAR, PEDESTRIAN])
def test_points_equal_rays_against_one_box(streets: Network, target: points_map.StandardTarget) -> None:
    positions = TargetPositions.of(target, streets, GRID)
    beams = sweep(Pose(12.0, 6.5, 4.0))
    values = positions.points_map(beams).values
    length_m = np.linalg.norm(beams.ends_m, axis=1)
    origins = np.tile(beams.pose.position_m, (len(length_m), 1))
    rng = np.random.default_rng(3)
    hit = 0
    for cell in positions.cells[rng.choice(len(positions.cells), 25, replace=False)]:
        counts = []
        for box in positions.boxes[(positions.cells == cell).all(axis=1)]:
            turn = trimesh.transformations.rotation_matrix(box[6], (0, 0, 1))
            turn[:3, 3] = box[:3]
            mesh = trimesh.creation.box(box[3:6] - 2 * SHRINK_M, turn)
            places, rays, _ = mesh.ray.intersects_location(origins, beams.ends_m / length_m[:, None])
            reached = np.linalg.norm(places - origins[rays], axis=1) < length_m[rays]
            counts.append(len(np.unique(rays[reached])))
        assert values[tuple(cell)] == min(counts)
        hit += values[tuple(cell)] > 0
    assert hit > 10


def test_static_occlusion_shortens_beams(streets: Network) -> None:
    positions = TargetPositions.of(CAR, streets, GRID)
    far, near = (positions.points_map(sweep(Pose(12.0, 6.5, 4.0), length_m)).values for length_m in (60.0, 8.0))
    known = ~np.isnan(far)
    assert (near[known] <= far[known]).all()
    assert near[known].sum() < far[known].sum()


def test_cars_stand_on_lanes_and_people_on_every_surface(streets: Network) -> None:
    """The lane along y = -2 is 3.2 m wide: squares with middles at -3.5, -2.5, -1.5 and -0.5."""
    cars, people = (TargetPositions.of(target, streets, GRID) for target in (CAR, PEDESTRIAN))
    car_cells, people_cells = set(map(tuple, cars.cells.tolist())), set(map(tuple, people.cells.tolist()))
    assert {(5, iy) for iy in range(20) if (5, iy) in car_cells} == {(5, 6), (5, 7), (5, 8), (5, 9)}
    assert {(5, iy) for iy in range(20) if (5, iy) in people_cells} == {(5, iy) for iy in (4, 5, 6, 7, 8, 9)}
    assert (5, 16) not in people_cells  # tracks
    assert (30, 14) in people_cells  # the crossing
    assert (30, 14) not in car_cells
    assert car_cells < people_cells


def test_boxes_follow_their_lanes_and_stand_on_them(streets: Network) -> None:
    cars = TargetPositions.of(CAR, streets, GRID)
    assert cars.boxes[(cars.cells == (5, 8)).all(axis=1), :2].tolist() == [[5.5, -1.5]]
    north = (cars.cells == (21, 18)).all(axis=1)
    assert cars.boxes[north, 6] == pytest.approx([np.pi / 2])
    assert cars.boxes[north, 2] == pytest.approx([0.55 + 0.75])  # the lane climbs by 0.1 m a metre from y = 3
    yaws = cars.boxes[(cars.cells == (20, 8)).all(axis=1), 6]
    assert sorted(yaws) == pytest.approx([0.0, np.pi / 4])  # straight on, and the turn


def test_overlap_counts_sensors_with_enough_points() -> None:
    first = PointsMap(CAR, np.array([[20.0, 19.0], [np.nan, 40.0]]), (0.0, 0.0))
    second = PointsMap(CAR, np.array([[25.0, 30.0], [np.nan, 0.0]]), (0.0, 0.0))
    overlap = overlap_map([first, second])
    assert overlap.values.tolist()[0] == [2.0, 1.0]
    assert np.isnan(overlap.values[1, 0])
    assert overlap.values[1, 1] == 1.0
    assert overlap.share_with(2) == pytest.approx(1 / 3)


def test_classes_begin_at_their_limits() -> None:
    points = PointsMap(CAR, np.array([[0.0, 1.0, 4.0, 5.0], [19.0, 20.0, 500.0, np.nan]]), (0.0, 0.0))
    assert points.classes[0].tolist() == [0, 1, 1, 2]
    assert points.classes[1, :3].tolist() == [2, 3, 5]
    assert np.isnan(points.classes[1, 3])


def test_region_without_lanes_has_no_surface(streets: Network) -> None:
    away = Grid((500.0, 500.0, 0.0), 1.0, (10, 10, 5))
    positions = TargetPositions.of(CAR, streets, away)
    assert len(positions.boxes) == 0
    assert np.isnan(positions.points_map(sweep(Pose(505.0, 505.0, 3.0))).values).all()


@pytest.mark.slow
def test_maps_of_a_run_are_drawn_and_exported(mini: Path, tmp_path: Path) -> None:
    """The GeoTIFF has the numbers of the map at their places; the page has both maps and the overlap."""
    pytest.importorskip("rasterio", reason="the extra egvs[gis] is not installed")
    import rasterio

    import egvs
    from egvs.export.export import export_run
    from egvs.placement import plan
    from egvs.runs.run_context import open_folder
    from egvs.stages.site_scans import empty_scans

    (mini / "roads.net.xml").write_text(NET)
    keys = ["traffic.roads='roads.net.xml'", "crs.epsg=25832", "crs.offset_m=[-550000, -5630000]", "placement.count=2"]
    scenario = egvs.load(mini, keys)
    egvs.run(scenario, tmp_path / "run", jobs=1)
    plan.place(scenario, tmp_path / "run", jobs=1)
    result = export_run(tmp_path / "run", "geotiff", out=tmp_path / "maps", sites=["pole_a"])
    assert result.notes == ()

    context = open_folder(scenario, tmp_path / "run", jobs=1)
    scans = {scan.site.name: scan.beams for scan in empty_scans(context)}
    grid = scenario.roi.grid
    positions = TargetPositions.of(CAR, network.read_net_xml(mini / "roads.net.xml"), grid)
    expected = positions.points_map(scans["pole_a"]).values
    with rasterio.open(tmp_path / "maps" / "points_car_pole_a.tif") as file:
        assert file.crs.to_epsg() == 25832
        band = file.read(1)
        for ix, iy in ((5, 6), (20, 8), (39, 7), (0, 0)):
            row, column = file.index(550000 + ix + 0.5, 5630000 - 10 + iy + 0.5)
            assert band[row, column] == (file.nodata if np.isnan(expected[ix, iy]) else expected[ix, iy])
    assert (expected[~np.isnan(expected)] > 0).any()

    both = overlap_map([positions.points_map(beams) for beams in scans.values()]).values
    with rasterio.open(tmp_path / "maps" / "overlap_car.tif") as file:
        band = np.flipud(file.read(1)).T
        assert (np.where(band == file.nodata, np.nan, band) == both)[~np.isnan(both)].all()
        assert (tmp_path / "maps" / "overlap_pedestrian.tif").exists()

    page = (tmp_path / "run" / "report.html").read_text()
    assert '<section id="points">' in page
    assert "pole_b: pedestrian" in page
    assert "The plan: car" in page


@pytest.mark.slow
def test_run_without_network_says_why_there_is_no_map(mini: Path, tmp_path: Path) -> None:
    pytest.importorskip("rasterio", reason="the extra egvs[gis] is not installed")
    import egvs
    from egvs.export.export import export_run

    egvs.run(egvs.load(mini), tmp_path / "run", jobs=1)
    result = export_run(tmp_path / "run", "geotiff", out=tmp_path / "maps")
    assert any("points on target are left out" in note for note in result.notes)
    assert '<section id="points">' not in (tmp_path / "run" / "report.html").read_text()
