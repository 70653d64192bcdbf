"""Vector exports hold every site at its place, in any format and system; they are read by what did not write them."""

from __future__ import annotations

import csv
import errno
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import pyarrow.parquet as pq
import pytest

from egvs.artefacts.readers import read_scores
from egvs.core import files, plugins
from egvs.core.files import add_checksum
from egvs.core.grid import Roi
from egvs.export.export import FORMATS, export_run
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.world import geolocation
from egvs.world.footprints import read_geojson
from tests.conftest import BUILDING
from tests.export.conftest import EPSG, OFFSET_M
from tests.export.readers import points_of_gpkg, points_of_wkb, utm32

pytest.importorskip("pyogrio", reason="the extra egvs[gis] is not installed")
pytest.importorskip("geopandas", reason="the extra egvs[gis] is not installed")

Call = Callable[..., tuple[int, str, str]]
NEAR_M = 0.01
KML = "{http://www.opengis.net/kml/2.2}"
SITES = {"pole_a": (10.0, 12.0), "pole & <b>": (30.5, -12.0)}
"""Positions in the world frame."""


def in_world(easting_m: float, northing_m: float) -> tuple[float, float]:
    return easting_m + OFFSET_M[0], northing_m + OFFSET_M[1]


def assert_at_sites(found: dict[str, tuple[float, float]]) -> None:
    """World-frame positions of all sites, equal to a centimetre."""
    assert found.keys() == SITES.keys()
    for name, place in SITES.items():
        assert found[name] == pytest.approx(place, abs=NEAR_M)


# ---- GeoPackage


def test_a_geopackage_holds_sites_scores_and_system(located: Path, tmp_path: Path) -> None:
    done = export_run(located, "gpkg", out=tmp_path / "run.gpkg")
    assert done.reference == "ETRS89 / UTM zone 32N"
    with sqlite3.connect(tmp_path / "run.gpkg") as file:
        assert file.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
        assert file.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
        rows = file.execute("SELECT site, geom, rank, egvs, egvs_se, given_fid, given_Geometry FROM sites").fetchall()
        system = file.execute(
            "SELECT organization, organization_coordsys_id FROM gpkg_spatial_ref_sys JOIN gpkg_geometry_columns"
            " USING (srs_id) WHERE table_name = 'sites'"
        ).fetchone()
        layers = [name for (name,) in file.execute("SELECT table_name FROM gpkg_contents WHERE data_type='features'")]
    assert system == ("EPSG", EPSG)
    assert layers == ["sites", "blindspots", "footprints", "region"]
    assert_at_sites({site: in_world(*points_of_gpkg(shape)[0]) for site, shape, *_ in rows})
    scores = read_scores(located / "scores.parquet").to_pylist()
    assert [row[2:] for row in rows] == [
        (one["rank"], one["egvs"], one["egvs_se"], one["fid"], one["Geometry"]) for one in scores
    ]


def test_its_style_colours_each_site_once(located: Path, tmp_path: Path) -> None:
    export_run(located, "gpkg", out=tmp_path / "run.gpkg")
    with sqlite3.connect(tmp_path / "run.gpkg") as file:
        styles = dict(file.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault = 1"))
        registered = file.execute("SELECT data_type FROM gpkg_contents WHERE table_name = 'layer_styles'").fetchone()
        assert styles.keys() == {"sites", "blindspots", "footprints", "region"}
        assert registered == ("attributes",)
        rules = [rule.get("filter") for rule in ET.fromstring(styles["sites"]).iter("rule")]
        # QGIS's expressions of this kind are SQLite's too
        taken = [file.execute(f"SELECT count(*) FROM sites WHERE {rule}").fetchone()[0] for rule in rules]
        rules = [rule.get("filter") for rule in ET.fromstring(styles["blindspots"]).iter("rule")]
        best = [row for rule in rules for row in file.execute(f"SELECT DISTINCT site FROM blindspots WHERE {rule}")]
    assert sum(taken) == 2
    assert len(taken) == 9
    assert set(best) <= {
        (one["site"],) for one in read_scores(located / "scores.parquet").to_pylist() if one["rank"] == 1
    }


def test_symbols_of_rules_are_there(located: Path, tmp_path: Path) -> None:
    export_run(located, "gpkg", out=tmp_path / "run.gpkg")
    with sqlite3.connect(tmp_path / "run.gpkg") as file:
        styles = [ET.fromstring(text) for (text,) in file.execute("SELECT styleQML FROM layer_styles")]
    for style in styles:
        labels = style.get("labelsEnabled")
        assert (labels == "1") == (style.find("labeling") is not None)
        symbols = {symbol.get("name"): symbol for symbol in style.iter("symbol")}
        assert [rule.get("symbol") for rule in style.iter("rule")] == list(symbols)
        assert all(symbol.find("layer/Option/Option") is not None for symbol in symbols.values())


def test_a_geopackage_is_the_same_twice(located: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        export_run(located, "gpkg", out=tmp_path / name / "run.gpkg")
    assert (tmp_path / "a/run.gpkg").read_bytes() == (tmp_path / "b/run.gpkg").read_bytes()


# ---- GeoJSON, GeoParquet, CSV


def test_geojson_is_in_degrees_that_the_projection_s_formulas_bring_back(located: Path, tmp_path: Path) -> None:
    export_run(located, "geojson", out=tmp_path)
    document = json.loads((tmp_path / "sites.geojson").read_text())
    assert "crs" not in document  # RFC 7946
    found = {
        one["properties"]["site"]: in_world(*utm32(*one["geometry"]["coordinates"])) for one in document["features"]
    }
    assert_at_sites(found)


def test_exported_footprints_are_footprints_again(located: Path, tmp_path: Path) -> None:
    """A building of 4 m x 3 m x 6 m at its place, and a lamp, in each system."""
    frame = WorldFrame(f"EPSG:{EPSG}", OFFSET_M)
    world = Georeference(frame, Roi.around((20, 0, 2.5), (40, 20, 5)), "scenario.toml")
    for crs in ("scenario", "wgs84"):
        export_run(located, "geojson", crs=crs, out=tmp_path / crs)
        file = read_geojson(tmp_path / crs / "footprints.geojson", world)
        house = next(one for one in file.footprints if one.name == "house")
        assert (house.kind, house.base_m, house.height_m) == ("building", 0.0, 6.0)
        assert house.polygon.area == pytest.approx(12.0, abs=0.01)
        assert house.polygon.bounds == pytest.approx((14, 5, 18, 8), abs=NEAR_M)
        assert len(file.footprints) == 2


def test_geoparquet_says_its_system_and_holds_positions(located: Path, tmp_path: Path) -> None:
    export_run(located, "geoparquet", out=tmp_path)
    table = pq.read_table(tmp_path / "sites.parquet")
    about = json.loads(table.schema.metadata[b"geo"])
    assert about["columns"]["geometry"]["crs"]["id"] == {"authority": "EPSG", "code": EPSG}
    assert about["columns"]["geometry"]["encoding"] == "WKB"
    assert_at_sites({row["site"]: in_world(*points_of_wkb(row["geometry"])[0]) for row in table.to_pylist()})


def test_csv_is_for_a_spreadsheet(located: Path, tmp_path: Path) -> None:
    export_run(located, "csv", out=tmp_path)
    assert (tmp_path / "sites.csv").read_bytes().startswith(b"\xef\xbb\xbf")
    with (tmp_path / "sites.csv").open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    assert_at_sites({row["site"]: in_world(float(row["easting_m"]), float(row["northing_m"])) for row in rows})
    scores = read_scores(located / "scores.parquet").to_pylist()
    assert [float(row["egvs"]) for row in rows] == [one["egvs"] for one in scores]
    assert [row["note"] for row in rows] == ["'=1+1", "it's, 'quoted'"]  # no formula
    with (tmp_path / "footprints.csv").open(encoding="utf-8-sig", newline="") as file:
        assert next(csv.DictReader(file))["wkt"].startswith("MULTIPOLYGON (((5500")


# ---- KML


def test_kml_has_every_site_in_degrees_and_in_its_colour(located: Path, tmp_path: Path) -> None:
    export_run(located, "kml", out=tmp_path / "run.kml")
    root = ET.parse(tmp_path / "run.kml").getroot()
    folders = {one.findtext(f"{KML}name"): one for one in root.iter(f"{KML}Folder")}
    styles = {f"#{one.get('id')}": one.findtext(f"{KML}IconStyle/{KML}color") for one in root.iter(f"{KML}Style")}
    places, colours = {}, {}
    for mark in folders["sites"].iter(f"{KML}Placemark"):
        name = mark.findtext(f"{KML}name")
        lon, lat, height = map(float, mark.findtext(f"{KML}Point/{KML}coordinates").split(","))
        places[name], colours[name] = in_world(*utm32(lon, lat)), styles[mark.findtext(f"{KML}styleUrl")]
        assert height == {"pole_a": 3.0, "pole & <b>": 3.25}[name]
    assert_at_sites(places)
    ranked = sorted(read_scores(located / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    # viridis: the best is dark violet, the last yellow; written alpha, blue, green, red
    assert [colours[row["site"]] for row in ranked] == ["ff540144", "ff25e7fd"]
    assert all(one.text in styles for one in root.iter(f"{KML}styleUrl"))
    shown = [one.findtext(f"{KML}visibility") for one in folders["blindspots"].iter(f"{KML}Placemark")]
    assert {"0", "1"} == set(shown)


# ---- nobody knows where it lies


@pytest.mark.parametrize("to", ["gpkg", "geojson", "geoparquet", "csv"])
def test_without_a_reference_system_metres_are_local_and_that_is_said(
    local: Path, tmp_path: Path, run_egvs: Call, to: str
) -> None:
    out = tmp_path / ("run.gpkg" if to == "gpkg" else "out")
    code, told, err = run_egvs("export", local, "--to", to, "--out", out)
    assert (code, err) == (0, "")
    assert "positions in local metres of the world frame, as the scenario does not say where on the Earth" in told
    match to:
        case "gpkg":
            with sqlite3.connect(out) as file:
                rows = file.execute("SELECT site, geom FROM sites").fetchall()
                system = file.execute(
                    "SELECT organization FROM gpkg_spatial_ref_sys JOIN gpkg_geometry_columns USING (srs_id)"
                ).fetchone()
            assert system[0].upper() != "EPSG"
            found = {site: points_of_gpkg(shape)[0] for site, shape in rows}
        case "geojson":
            document = json.loads((out / "sites.geojson").read_text())
            assert document["crs"] is None
            found = {one["properties"]["site"]: tuple(one["geometry"]["coordinates"]) for one in document["features"]}
        case "geoparquet":
            table = pq.read_table(out / "sites.parquet").to_pylist()
            found = {row["site"]: points_of_wkb(row["geometry"])[0] for row in table}
        case _:
            with (out / "sites.csv").open(encoding="utf-8-sig", newline="") as file:
                found = {
                    row["site"]: (float(row["easting_m"]), float(row["northing_m"])) for row in csv.DictReader(file)
                }
    assert found == {"pole_a": (10.0, 12.0), "pole_b": (30.5, -12.0)}


def test_local_footprints_are_footprints_of_the_same_scenario(local: Path, tmp_path: Path) -> None:
    export_run(local, "geojson", out=tmp_path)
    world = Georeference(None, Roi.around((20, 0, 2.5), (40, 20, 5)), "scenario.toml")
    house = next(one for one in read_geojson(tmp_path / "footprints.geojson", world).footprints if one.name == "house")
    assert set(house.polygon.exterior.coords) == {tuple(map(float, corner)) for corner in BUILDING[0]}


# ---- what cannot be done


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--to", "shp"), "--to: 'shp'; one of gpkg, geojson, geoparquet, kml, csv, geotiff"),
        (("--to", "gpkg", "--crs", "EPSG:4326"), "--crs: 'EPSG:4326'; scenario (its reference system) or wgs84"),
        (("--to", "kml", "--crs", "scenario"), "--crs: scenario with --to kml; wgs84: KML knows degrees only"),
        (("--to", "csv", "--crs", "wgs84"), "has no degrees: nothing says where the scenario's world frame lies"),
        (("--to", "kml"), "has no degrees: nothing says where the scenario's world frame lies on the Earth; [crs]"),
        (("--to", "csv", "--site", "pole_a"), "--site: with --to csv; --to geotiff"),
        (("--to", "geotiff", "--site", "pole_z"), "--site: 'pole_z' is no site of this run; one of pole_a, pole_b"),
        (("--to", "gpkg", "--out", "sites.csv"), "--out: 'sites.csv'; a file that ends in .gpkg"),
    ],
)
def test_what_cannot_be_done_is_one_message(local: Path, run_egvs: Call, options: tuple[str, ...], said: str) -> None:
    before = sorted(local.rglob("*"))
    code, out, err = run_egvs("export", local, *options)
    assert (code, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1
    assert sorted(local.rglob("*")) == before


@pytest.mark.parametrize(("to", "library"), [("gpkg", "pyogrio"), ("geoparquet", "geopandas"), ("geotiff", "rasterio")])
def test_without_the_extra_it_is_named(
    local: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch, to: str, library: str
) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda name: None)
    code, _, err = run_egvs("export", local, "--to", to)
    told = f"egvs: export to {to} needs {library}, which is not installed: pip install 'egvs[gis]'\n"
    assert (code, err) == (2, told)


def test_a_run_that_is_not_there_or_not_done(tmp_path: Path, run_egvs: Call) -> None:
    code, _, err = run_egvs("export", tmp_path / "none", "--to", "csv")
    assert (code, err) == (2, f"egvs: {tmp_path / 'none'}: no such folder; the folder of a run, which egvs run makes\n")
    code, _, err = run_egvs("export", tmp_path, "--to", "csv")
    assert (code, err) == (
        2,
        f"egvs: {tmp_path / 'run.json'}: no such file. Name a folder that egvs run has written.\n",
    )


def test_a_run_that_is_not_finished_or_of_another_version(local: Path, tmp_path: Path, run_egvs: Call) -> None:
    """Without its seal a record is of another version."""
    shutil.copytree(local.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "run" / "run.json"
    record = json.loads(path.read_text())
    for kept, first in ((("check", "statics", "scan", "traffic", "tpog"), "score"), (None, "statics")):
        stages = {name: its for name, its in record["stages"].items() if kept is None or name in kept}
        value = {name: its for name, its in record.items() if name != "own_sha256"} | {"stages": stages}
        path.write_text(files.to_json_text(value if kept is None else add_checksum(value)))
        code, _, err = run_egvs("export", path.parent, "--to", "csv", "--out", tmp_path / "out")
        found = f"the stage {first} is not done, or another version of this program did it"
        assert (code, err) == (2, f"egvs: {path}: {found}; a finished run; egvs run finishes it\n")
        assert not (tmp_path / "out").exists()


def test_a_run_from_before_the_scenario_had_a_place(
    local: Path, tmp_path: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    placed = Georeference(WorldFrame(f"EPSG:{EPSG}", OFFSET_M), Roi.around((0, 0, 0), (1, 1, 1)), "")
    monkeypatch.setattr(geolocation, "scenario_georeference", lambda scenario: placed)
    code, _, err = run_egvs("export", local, "--to", "csv", "--out", tmp_path / "out")
    found = "its sites have no longitude and latitude, and the scenario, or its network, has a place by now"
    assert (code, err) == (2, f"egvs: {local / 'scores.parquet'}: {found}; egvs run makes it anew\n")


def test_a_scenario_that_lies_elsewhere_by_now_is_refused(
    located: Path, tmp_path: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = Georeference(WorldFrame(f"EPSG:{EPSG}", (-550000.0, -5630001.0)), Roi.around((0, 0, 0), (1, 1, 1)), "")
    for now in (moved, Georeference(None, moved.roi, "")):
        monkeypatch.setattr(geolocation, "scenario_georeference", lambda scenario, now=now: now)
        code, _, err = run_egvs("export", located, "--to", "csv", "--out", tmp_path / "out")
        assert code == 2
        assert "scores.parquet: its sites lie elsewhere on the Earth than the scenario, or its network, says by" in err


@pytest.mark.parametrize("artefact", ["scores.parquet", "blindspots.parquet", "statics.ply"])
def test_a_damaged_artefact_is_refused_and_nothing_written(
    local: Path, tmp_path: Path, run_egvs: Call, artefact: str
) -> None:
    path, out = local / artefact, tmp_path / "out"
    kept = path.read_bytes()
    path.write_bytes(kept[: len(kept) // 2])
    try:
        code, _, err = run_egvs("export", local, "--to", "csv", "--out", out)
    finally:
        path.write_bytes(kept)
    assert code == 2
    assert f"{path}: was altered or replaced" in err
    assert not out.exists()


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_a_target_that_cannot_be_written(located: Path, tmp_path: Path, run_egvs: Call, to: str) -> None:
    (tmp_path / "file").write_text("mine")
    code, _, err = run_egvs("export", located, "--to", to, "--out", tmp_path / "file" / f"run.{to}")
    assert code == 2
    assert "cannot be written (" in err
    assert err.count("\n") == 1
    assert (tmp_path / "file").read_text() == "mine"


def test_a_user_s_file_is_no_folder(located: Path, tmp_path: Path, run_egvs: Call) -> None:
    (tmp_path / "file").write_text("mine")
    code, _, err = run_egvs("export", located, "--to", "csv", "--out", tmp_path / "file")
    assert (code, (tmp_path / "file").read_text()) == (2, "mine")
    assert "is a file; a folder: --to csv writes several files" in err


def test_no_file_in_a_user_s_folder_is_replaced(local: Path, run_egvs: Call) -> None:
    """Of a scenario its sites, of a run its blind spots."""
    for to, folder, name in (("csv", local.parent / "mini", "sites.csv"), ("geoparquet", local, "blindspots.parquet")):
        kept, before = (folder / name).read_bytes(), sorted(folder.rglob("*"))
        code, _, err = run_egvs("export", local, "--to", to, "--out", folder)
        assert (code, err) == (
            2,
            f"egvs: --out: {folder / name} is there already; a new folder, or one without such files\n",
        )
        assert ((folder / name).read_bytes(), sorted(folder.rglob("*"))) == (kept, before)


@pytest.mark.parametrize("to", ["gpkg", "kml"])
def test_a_user_s_file_is_not_replaced(located: Path, tmp_path: Path, run_egvs: Call, to: str) -> None:
    (path := tmp_path / f"mine.{to}").write_text("mine")
    code, _, err = run_egvs("export", located, "--to", to, "--out", path)
    assert (code, err) == (2, f"egvs: --out: {path} is there already; another name\n")
    assert path.read_text() == "mine"


def test_all_files_appear_or_none(located: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy, copied = shutil.copyfile, []

    def full(source: Path, target: Path) -> None:
        if len(copied) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        copied.append(copy(source, target))

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left") as caught:
        export_run(located, "csv", out=tmp_path / "out")
    assert caught.value.filename == str(tmp_path / "out" / "footprints.csv")
    assert copied
    assert not list((tmp_path / "out").iterdir())


def test_a_layer_that_is_no_more_does_not_stay_in_the_run(local: Path, tmp_path: Path) -> None:
    shutil.copytree(local.parent, tmp_path / "copy")
    folder = tmp_path / "copy" / "run" / "export" / "csv"
    folder.mkdir(parents=True)
    for name in ("plan.csv", "mine.csv"):
        (folder / name).write_text("of before")
    export_run(tmp_path / "copy" / "run", "csv")
    assert {path.name for path in folder.iterdir()} == {
        "sites.csv", "blindspots.csv", "footprints.csv", "region.csv", "mine.csv"
    }  # fmt: skip


def test_by_default_it_goes_into_the_run_and_again(local: Path, run_egvs: Call) -> None:
    told = [run_egvs("export", local, "--to", "csv") for _ in range(2)]
    assert told[0] == told[1]
    paths = [Path(line) for line in told[0][1].splitlines()[1:]]
    assert [path.name for path in paths] == ["sites.csv", "blindspots.csv", "footprints.csv", "region.csv"]
    assert {path.parent for path in paths} == {local / "export" / "csv"}
    shutil.rmtree(local / "export")
