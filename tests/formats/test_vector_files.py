"""Sites and footprints from GeoPackage, Shapefile, GeoParquet and KML."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

import egvs
from egvs.core import plugins
from egvs.core.errors import InputError, MissingExtraError
from egvs.core.grid import Roi
from egvs.formats import vector_files
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.sensors import sites
from egvs.stages.scene_dependencies import site_digests
from egvs.world.footprints import read_footprints
from tests.sensors.helpers import site_positions

pytestmark = pytest.mark.system

geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed (egvs[gis])")
pyogrio = pytest.importorskip("pyogrio", reason="pyogrio is not installed (egvs[gis])")

OFFSET_M = (-550000.0, -5630000.0)
CRS = f"\n[crs]\nepsg = 25832\noffset_m = [{OFFSET_M[0]}, {OFFSET_M[1]}]\n"
FORMATS = ("gpkg", "shp", "parquet", "geoparquet")

ROWS = {
    "site": ["pole_a", "pole_b"],
    "z_m": [3.0, 4.5],
    "pitch_deg": [-10.0, None],
    "owner": ["City", None],
    "number": [7, 8],
}
POINTS_M = [(10.0, 12.0), (30.5, -12.0)]


@pytest.fixture
def located(mini: Path) -> Path:
    """The small scenario at a known position on the Earth."""
    file = mini / "scenario.toml"
    file.write_text(file.read_text() + CRS)
    return mini


def frame_of(
    columns: dict[str, Any], points_m: Sequence[tuple[float, float]] = POINTS_M, epsg: int | None = 4326
) -> Any:
    """A table of points, given in the world frame, in some reference system."""
    points = [shapely.Point(x - OFFSET_M[0], y - OFFSET_M[1]) for x, y in points_m]
    frame = geopandas.GeoDataFrame(columns, geometry=points, crs=25832)
    return frame.set_crs(None, allow_override=True) if epsg is None else frame.to_crs(epsg)


def write(path: Path, frame: Any, **options: Any) -> Path:
    if path.suffix in (".parquet", ".geoparquet"):
        frame.to_parquet(path, **options)
    elif path.suffix == ".kml":
        frame.to_file(path, driver="LIBKML", **options)  # else it makes a folder
    else:
        frame.to_file(path, **options)
    return path


def candidates(folder: Path, name: str) -> tuple[sites.Site, ...]:
    return sites.candidate_sites(egvs.load(folder, [f'sites.file="{name}"']))


# --- sites ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("epsg", [4326, 25832, 3857])
@pytest.mark.parametrize("suffix", FORMATS)
def test_sites_are_in_the_world_frame_with_their_columns(located: Path, suffix: str, epsg: int) -> None:
    write(located / f"poles.{suffix}", frame_of(ROWS, epsg=epsg))
    first, second = candidates(located, f"poles.{suffix}")
    assert site_positions((first, second)) == [
        ("pole_a", pytest.approx(10, abs=1e-3), pytest.approx(12, abs=1e-3), 3.0),
        ("pole_b", pytest.approx(30.5, abs=1e-3), pytest.approx(-12, abs=1e-3), 4.5),
    ]
    assert (first.pose.pitch_deg, second.pose.pitch_deg) == (-10.0, 0.0)
    assert first.user_columns == {"owner": "City", "number": 7}
    assert second.user_columns == {"owner": None, "number": 8}


@pytest.mark.slow
def test_point_heights_and_multipoints_of_one_point_are_sites(located: Path) -> None:
    frame = frame_of({"name": ["a", "b"]}, epsg=25832)
    frame.geometry = [shapely.MultiPoint([shapely.force_3d(point, 6.0)]) for point in frame.geometry]
    write(located / "poles.gpkg", frame)
    assert site_positions(candidates(located, "poles.gpkg")) == [("a", 10, 12, 6), ("b", 30.5, -12, 6)]


KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder><name>Poles</name>
<Placemark><name>k1</name><ExtendedData><Data name="z_m"><value>4.5</value></Data>
<Data name="owner"><value>City</value></Data></ExtendedData>
<Point><coordinates>{a},0</coordinates></Point></Placemark>
<Placemark><name>k2</name><Point><altitudeMode>{mode}</altitudeMode><coordinates>{b},3</coordinates></Point></Placemark>
</Folder></Document></kml>"""


def write_kml(path: Path, mode: str = "relativeToGround") -> Path:
    points = [f"{point.x!r},{point.y!r}" for point in frame_of({"n": [1, 2]}).geometry]
    path.write_text(KML.format(a=points[0], b=points[1], mode=mode), encoding="utf-8")
    return path


@pytest.mark.slow
def test_kml_altitudes_count_only_above_the_ground(located: Path) -> None:
    write_kml(located / "poles.kml")
    result = candidates(located, "poles.kml")
    assert [(site.name, site.pose.z_m) for site in result] == [("k1", 4.5), ("k2", 3.0)]
    assert result[0].pose.x_m == pytest.approx(10, abs=1e-3) and result[0].pose.y_m == pytest.approx(12, abs=1e-3)
    assert result[0].user_columns == {"owner": "City"} and not result[1].user_columns

    write_kml(located / "poles.kml", mode="absolute")
    with pytest.raises(InputError, match=r"poles\.kml: k2: expected an altitude above the ground, got one above sea"):
        candidates(located, "poles.kml")

    write_kml(located / "poles.kml", mode="clampToGround")
    with pytest.raises(InputError, match="z_m is missing"):
        candidates(located, "poles.kml")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["gpkg", "parquet"])
def test_columns_of_other_programs_are_rejected_with_the_hint(located: Path, suffix: str) -> None:
    write(located / f"poles.{suffix}", frame_of({"site": ["a", "b"], "z_m": [3.0, 3.0], "heading": [0.0, 90.0]}))
    with pytest.raises(InputError, match=r"the column 'heading' has no effect\. Use yaw_deg, counter-clockwise"):
        candidates(located, f"poles.{suffix}")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".shp", ".shx", ".dbf"])
def test_truncated_part_of_shapefile_is_rejected(located: Path, suffix: str) -> None:
    """GDAL alone would read a Shapefile without its last records."""
    path = write(located / "poles.shp", frame_of({"site": ["a", "b"], "z_m": [3.0, 3.0]}))
    assert len(candidates(located, "poles.shp")) == 2
    part = path.with_suffix(suffix)
    data = part.read_bytes()
    declared = len(data) - (suffix == ".dbf")  # without the mark at its end
    for size, problem in ((len(data) - 20, f"the header declares {declared} bytes"), (30, "the file")):
        part.write_bytes(data[:size])
        with pytest.raises(InputError, match=rf"poles\{suffix}: {problem}"):
            candidates(located, "poles.shp")


@pytest.mark.slow
def test_shapefile_without_attributes_is_rejected(located: Path) -> None:
    path = write(located / "poles.shp", frame_of({"site": ["a", "b"], "z_m": [3.0, 3.0]}))
    path.with_suffix(".dbf").rename(path.with_suffix(".DBF"))
    assert len(candidates(located, "poles.shp")) == 2
    path.with_suffix(".DBF").unlink()
    with pytest.raises(InputError, match=r"poles\.shp: its file of attributes, .* is missing. Add poles\.dbf"):
        candidates(located, "poles.shp")


@pytest.mark.parametrize("name", ["poles.gpkg", "poles.shp"])
@pytest.mark.parametrize("part", ["poles.gpkg-wal", "poles.prj", "poles.aux.xml"])
def test_pipes_named_like_parts_of_a_file_are_rejected(located: Path, name: str, part: str) -> None:
    """GDAL opens them and waits."""
    write(located / name, frame_of({"site": ["a", "b"], "z_m": [3.0, 3.0]}))
    (located / part).unlink(missing_ok=True)
    os.mkfifo(located / part)
    with pytest.raises(InputError, match=rf"{part}: expected a file, got a pipe or a device"):
        candidates(located, name)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["gpkg", "parquet"])
def test_coordinates_that_are_not_finite_give_no_warning(tmp_path: Path, suffix: str) -> None:
    """The readers of features report them, with the number of the feature."""
    path = tmp_path / f"houses.{suffix}"
    with np.errstate(invalid="ignore"):
        ring = shapely.Polygon([(0, 0), (4, 0), (4, float("nan")), (0, 4)])
        write(path, geopandas.GeoDataFrame({"height_m": [6.0]}, geometry=[ring], crs="EPSG:25832"))
    (feature,) = vector_files.read_gis_file(path, "Polygon")["features"]
    assert not np.isfinite(feature["geometry"]["coordinates"]).all()


@pytest.mark.slow
def test_kml_with_a_coordinate_that_is_no_number_gives_no_warning(tmp_path: Path) -> None:
    ring = "<LinearRing><coordinates>10,52,0 10.1,52,0 10.1,nan,0 10,52,0</coordinates></LinearRing>"
    polygon = f"<Polygon><outerBoundaryIs>{ring}</outerBoundaryIs></Polygon>"
    head = '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>h</name>'
    (tmp_path / "h.kml").write_text(f"{head}{polygon}</Placemark></Document></kml>", encoding="utf-8")
    (feature,) = vector_files.read_gis_file(tmp_path / "h.kml", "Polygon")["features"]
    assert not np.isfinite(feature["geometry"]["coordinates"]).all()


@pytest.mark.slow
def test_geometries_other_than_points_are_rejected(located: Path) -> None:
    frame = frame_of({"site": ["a", "b"], "z_m": [3.0, 3.0]})
    write(located / "poles.gpkg", frame.set_geometry(frame.to_crs(25832).buffer(2.0).to_crs(4326)))
    with pytest.raises(InputError, match=r"poles\.gpkg: feature 0: expected a Feature that has .* a Point geometry"):
        candidates(located, "poles.gpkg")


@pytest.mark.slow
def test_layer_of_points_is_used_and_several_are_rejected(located: Path) -> None:
    path = write(located / "all.gpkg", frame_of(ROWS), layer="poles")
    lanes = frame_of({"name": ["x", "y"]})
    write(path, lanes.set_geometry(lanes.to_crs(25832).buffer(2.0).to_crs(4326)), layer="zones")
    assert len(candidates(located, "all.gpkg")) == 2
    write(path, frame_of(ROWS), layer="more")
    with pytest.raises(InputError, match=r"all\.gpkg: expected one layer of Point geometries, got poles, more\. Save"):
        candidates(located, "all.gpkg")


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "kml", "parquet"])
def test_damaged_file_is_named(located: Path, suffix: str) -> None:
    (located / f"poles.{suffix}").write_bytes(b"not a GIS file at all")
    with pytest.raises(
        InputError, match=rf"poles\.{suffix}: (the file cannot be read as \w+ \(|is not well-formed XML)"
    ):
        candidates(located, f"poles.{suffix}")


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "text"), [("dbf", b"City"), ("dbf", b"owner"), ("parquet", b"City")])
def test_text_that_is_not_utf_8_is_rejected(located: Path, suffix: str, text: bytes) -> None:
    name = "poles.parquet" if suffix == "parquet" else "poles.shp"
    write(located / name, frame_of(ROWS), **({"compression": None} if suffix == "parquet" else {}))
    path = located / f"poles.{suffix}"
    path.write_bytes(path.read_bytes().replace(text, b"\x80" * len(text)))
    with pytest.raises(InputError, match=rf"{name}: the file cannot be read as \w+ \(.*(?i:utf.?8)"):
        candidates(located, name)


@pytest.mark.slow
def test_parquet_without_geometry_is_rejected(located: Path) -> None:
    pq.write_table(pa.table({"site": ["a"], "x_m": [1.0]}), located / "poles.parquet")
    with pytest.raises(InputError, match=r"poles\.parquet: the file cannot be read as GeoParquet \(KeyError\('geo'\)"):
        candidates(located, "poles.parquet")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["shp", "parquet"])
def test_file_without_reference_system_is_rejected(located: Path, suffix: str) -> None:
    path = write(located / f"poles.{suffix}", frame_of(ROWS, epsg=4326 if suffix == "shp" else None))
    path.with_suffix(".prj").unlink(missing_ok=True)
    with pytest.raises(InputError, match=r"the file does not declare its coordinate reference system\. (Add|Set) "):
        candidates(located, f"poles.{suffix}")


@pytest.mark.parametrize(("suffix", "kind"), [("gpkg", "GeoPackage"), ("shp", "Shapefile"), ("kml", "KML")])
def test_missing_extra_is_one_message_with_the_command(
    located: Path, monkeypatch: pytest.MonkeyPatch, run_egvs, suffix: str, kind: str
) -> None:
    (located / f"poles.{suffix}").write_bytes(b"")
    monkeypatch.setattr(plugins, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=rf"poles\.{suffix}: reading {kind} needs pyogrio, which is not inst"):
        candidates(located, f"poles.{suffix}")
    code, _, error = run_egvs("check", located, "--set", f'sites.file="poles.{suffix}"')
    assert code == 2 and " ".join(error.split()).count("pip install 'egvs[gis]'") == 1


def test_every_file_of_a_shapefile_is_an_input(located: Path) -> None:
    write(located / "poles.shp", frame_of(ROWS))
    scenario = egvs.load(located, ['sites.file="poles.shp"'])
    before = site_digests(scenario, ())
    write(located / "poles.shp", frame_of(ROWS | {"z_m": [3.0, 5.0]}))
    after = site_digests(scenario, ())
    assert before["poles.shp"] == after["poles.shp"]
    assert before["sites.file: poles.dbf"] != after["sites.file: poles.dbf"]
    assert set(before) == {"poles.shp", *(f"sites.file: poles.{part}" for part in ("dbf", "prj", "cpg", "shx"))}


# --- footprints ----------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("suffix", [*FORMATS, "kml"])
def test_footprints_are_in_the_world_frame(tmp_path: Path, suffix: str) -> None:
    frame = frame_of({"name": ["house", "shed"], "height_m": [6.0, 2.5], "base_m": [0.0, 0.5]}, epsg=25832)
    frame.geometry = frame.buffer(4.0, cap_style="square")
    path = write(tmp_path / f"buildings.{suffix}", frame.to_crs(4326))
    frame_m = WorldFrame("EPSG:25832", OFFSET_M)
    world = Georeference(frame_m, Roi.around((20.0, 0.0, 2.5), (40.0, 40.0, 5.0)), "scenario.toml")
    house, shed = read_footprints(path, world).footprints
    assert (house.name, house.base_m, house.height_m) == ("house", 0.0, 6.0)
    assert (shed.name, shed.base_m, shed.height_m) == ("shed", 0.5, 2.5)
    assert house.polygon.symmetric_difference(shapely.box(6, 8, 14, 16)).area < 0.02


@pytest.mark.slow
def test_geometry_columns_of_geoparquet_are_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "poles.parquet", frame_of(ROWS), write_covering_bbox=True, schema_version="1.1.0")
    assert "bbox" in pq.read_schema(path).names
    document = vector_files.read_gis_file(path, "Point")
    assert set(document["features"][0]["properties"]) == set(ROWS)
    assert json.loads(document["crs"]["properties"]["name"])["id"]["code"] == 4326


@pytest.mark.slow
def test_geometries_of_geoparquet_are_bytes(tmp_path: Path) -> None:
    path = write(tmp_path / "poles.parquet", frame_of(ROWS))
    table = pq.read_table(path)
    lists = pa.array([[value] for value in table["geometry"].to_pylist()], pa.list_(pa.binary()))
    column = table.schema.get_field_index("geometry")
    pq.write_table(table.set_column(column, "geometry", lists).replace_schema_metadata(table.schema.metadata), path)
    with pytest.raises(InputError, match=r"encoded as WKB, got values of type list<.*Export it again"):
        vector_files.read_gis_file(path, "Point")
