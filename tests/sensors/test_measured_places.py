"""A measured scan that says where on the Earth it was taken gives what it gives in metres; one that lies elsewhere is
refused."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import egvs
from egvs.core.errors import InputError
from egvs.formats import point_clouds
from egvs.formats.georeference import WorldFrame
from egvs.sensors.scanner import Scan, Scanner
from egvs.stages.inputs import build_scene

FRAME = WorldFrame("EPSG:32632", (-550_700.0, -5_635_200.0))
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


def scanned(mini: Path, name: str, crs: str = CRS) -> Scan:
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,points\npole_a,10,12,3,{name}\n")
    text = (mini / "scenario.toml").read_text().partition("\n[crs]")[0]
    (mini / "scenario.toml").write_text(text + crs)
    scene = build_scene(egvs.load(mini))
    return Scanner(scene).scan_site(scene.sites[0])


@needs_laspy
@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32632+5783", "EPSG:31467"])
@pytest.mark.parametrize("point_format", [3, 6])
def test_las_in_a_projection_gives_what_metres_give(mini: Path, crs: str, point_format: int) -> None:
    """Heights above the sea become heights above the world's z = 0."""
    if point_format == 3 and "+" in crs:
        pytest.skip("LAS 1.2 names its system by a single code")
    point_clouds.write_points(mini / "m.ply", POINTS)
    by_metres = scanned(mini, "m.ply")
    lon_lat_deg = FRAME.to_degrees(POINTS[:, :2])
    xy = WorldFrame(crs.partition("+")[0]).from_degrees(lon_lat_deg)
    write_las(mini / "m.las", np.column_stack([xy, POINTS[:, 2] + 210.0]), crs, point_format)
    by_las = scanned(mini, "m.las")
    assert len(by_las.rows.ends_m) == 3
    assert by_las.rows.ends_m == pytest.approx(by_metres.rows.ends_m, abs=2e-3 if "31467" in crs else 2e-4)


@needs_laspy
@pytest.mark.parametrize(("vertical", "unit_m"), [("+6360", 1200 / 3937), ("+5703", 1.0), ("", 1200 / 3937)])
def test_las_in_feet_gives_what_metres_give(mini: Path, vertical: str, unit_m: float) -> None:
    """New York's plane counts in US survey feet; its heights too, where no vertical system says otherwise."""
    frame = WorldFrame("EPSG:32618", (-585_000.0, -4_510_000.0))
    known = "\n[crs]\nepsg = 32618\noffset_m = [-585000, -4510000]\nzero_height_m = 5.0\n"
    feet = WorldFrame("EPSG:2263").from_degrees(frame.to_degrees(POINTS[:, :2]))
    write_las(mini / "m.las", np.column_stack([feet, (POINTS[:, 2] + 5.0) / unit_m]), f"EPSG:2263{vertical}")
    assert scanned(mini, "m.las", known).rows.ends_m == pytest.approx(POINTS - [10, 12, 3], abs=2e-3)


@needs_laspy
def test_las_without_a_system_is_in_metres(mini: Path) -> None:
    write_las(mini / "m.las", POINTS, None)
    assert scanned(mini, "m.las").rows.ends_m == pytest.approx(POINTS - [10, 12, 3], abs=1e-4)


@needs_laspy
def test_a_scan_that_lies_elsewhere_is_refused(mini: Path) -> None:
    utm = np.add(POINTS, (550_700, 5_635_200, 210))
    write_las(mini / "m.las", utm, None)
    told = "They would be near it as eastings and northings of EPSG:32632. Save the points"
    with pytest.raises(InputError, match=rf"site pole_a: points: .*m.las: coordinates .*{told}"):
        scanned(mini, "m.las")
    write_las(mini / "m.las", utm, "EPSG:25833")
    with pytest.raises(InputError, match=r"are [\d,]+ km from the region of interest as ETRS89 / UTM zone 33N"):
        scanned(mini, "m.las")
    write_las(mini / "m.las", utm, "EPSG:25832")
    with pytest.raises(InputError, match=r"from the region of interest as ETRS89 / UTM zone 32N, which must"):
        scanned(mini, "m.las", crs="")


def test_points_in_degrees_are_refused(mini: Path) -> None:
    degrees = np.column_stack([FRAME.to_degrees(POINTS[:, :2]), POINTS[:, 2]])
    point_clouds.write_points(mini / "m.ply", degrees)
    with pytest.raises(
        InputError,
        match=r"m.ply: expected metres .*, got longitude and latitude: .*, 0 m from the region",
    ):
        scanned(mini, "m.ply")
