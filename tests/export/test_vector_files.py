"""Each format has every layer, with the values of the artefacts at their positions to a centimetre.

The files are read by libraries that did not write them: SQLite, GDAL, fastparquet, pandas.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pyarrow.parquet as pq
import pytest

from egvs import load
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_scores
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.export.export import FORMATS, export_run
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.runs import run
from egvs.world.footprints import read_footprints
from tests.conftest import BUILDING, feature, write_mini
from tests.export.conftest import EPSG, HOUSE, LAMP, OFFSET_M
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


def assert_at_sites(actual: dict[str, tuple[float, float]]) -> None:
    """World-frame positions of all sites, equal to a centimetre."""
    assert actual.keys() == SITES.keys()
    for name, place in SITES.items():
        assert actual[name] == pytest.approx(place, abs=NEAR_M)


def test_geopackage_has_sites_scores_and_reference_system(located: Path, tmp_path: Path) -> None:
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


def test_geopackage_style_colours_each_site_once(located: Path, tmp_path: Path) -> None:
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


def test_every_rule_of_a_style_has_a_symbol(located: Path, tmp_path: Path) -> None:
    export_run(located, "gpkg", out=tmp_path / "run.gpkg")
    with sqlite3.connect(tmp_path / "run.gpkg") as file:
        styles = [ET.fromstring(text) for (text,) in file.execute("SELECT styleQML FROM layer_styles")]
    for style in styles:
        labels = style.get("labelsEnabled")
        assert (labels == "1") == (style.find("labeling") is not None)
        symbols = {symbol.get("name"): symbol for symbol in style.iter("symbol")}
        assert [rule.get("symbol") for rule in style.iter("rule")] == list(symbols)
        assert all(symbol.find("layer/Option/Option") is not None for symbol in symbols.values())


def test_geopackage_has_the_same_bytes_twice(located: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        export_run(located, "gpkg", out=tmp_path / name / "run.gpkg")
    assert (tmp_path / "a/run.gpkg").read_bytes() == (tmp_path / "b/run.gpkg").read_bytes()


def test_geojson_degrees_agree_with_the_formulas_of_the_projection(located: Path, tmp_path: Path) -> None:
    export_run(located, "geojson", out=tmp_path)
    document = json.loads((tmp_path / "sites.geojson").read_text())
    assert "crs" not in document  # as RFC 7946 requires
    actual = {
        one["properties"]["site"]: in_world(*utm32(*one["geometry"]["coordinates"])) for one in document["features"]
    }
    assert_at_sites(actual)


def test_exported_footprints_can_be_imported(located: Path, tmp_path: Path) -> None:
    """A building of 4 m x 3 m x 6 m at its place, and a lamp, in each system."""
    frame = WorldFrame(f"EPSG:{EPSG}", OFFSET_M)
    world = Georeference(frame, Roi.around((20, 0, 2.5), (40, 20, 5)), "scenario.toml")
    for crs in ("scenario", "wgs84"):
        export_run(located, "geojson", crs=crs, out=tmp_path / crs)
        path = tmp_path / crs / "footprints.geojson"
        if crs == "wgs84":  # RFC 7946 forbids the member "crs", so it has to be declared
            with pytest.raises(InputError, match='"crs"'):
                read_footprints(path, world)
            declared = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
            path.write_text(json.dumps(json.loads(path.read_text()) | {"crs": declared}))
        file = read_footprints(path, world)
        house = next(one for one in file.footprints if one.name == "house")
        assert (house.kind, house.base_m, house.height_m) == ("building", 0.0, 6.0)
        assert house.polygon.area == pytest.approx(12.0, abs=0.01)
        assert house.polygon.bounds == pytest.approx((14, 5, 18, 8), abs=NEAR_M)
        assert len(file.footprints) == 2


def test_geoparquet_has_positions_and_reference_system(located: Path, tmp_path: Path) -> None:
    export_run(located, "geoparquet", out=tmp_path)
    table = pq.read_table(tmp_path / "sites.parquet")
    metadata = json.loads(table.schema.metadata[b"geo"])
    assert metadata["columns"]["geometry"]["crs"]["id"] == {"authority": "EPSG", "code": EPSG}
    assert metadata["columns"]["geometry"]["encoding"] == "WKB"
    assert_at_sites({row["site"]: in_world(*points_of_wkb(row["geometry"])[0]) for row in table.to_pylist()})


def test_csv_can_be_opened_in_a_spreadsheet(located: Path, tmp_path: Path) -> None:
    export_run(located, "csv", out=tmp_path)
    assert (tmp_path / "sites.csv").read_bytes().startswith(b"\xef\xbb\xbf")
    with (tmp_path / "sites.csv").open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    assert_at_sites({row["site"]: in_world(float(row["easting_m"]), float(row["northing_m"])) for row in rows})
    scores = read_scores(located / "scores.parquet").to_pylist()
    assert [float(row["egvs"]) for row in rows] == [one["egvs"] for one in scores]
    assert [row["note"] for row in rows] == ["'=1+1", "it's, 'quoted'"]  # not a formula
    with (tmp_path / "footprints.csv").open(encoding="utf-8-sig", newline="") as file:
        assert next(csv.DictReader(file))["wkt"].startswith("MULTIPOLYGON (((5500")


def test_kml_has_every_site_in_degrees_and_colour(located: Path, tmp_path: Path) -> None:
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
    visible = [one.findtext(f"{KML}visibility") for one in folders["blindspots"].iter(f"{KML}Placemark")]
    assert {"0", "1"} == set(visible)


@pytest.mark.parametrize("to", ["gpkg", "geojson", "geoparquet", "csv"])
def test_without_a_reference_system_positions_are_local_metres(
    local: Path, tmp_path: Path, run_egvs: Call, to: str
) -> None:
    out = tmp_path / ("run.gpkg" if to == "gpkg" else "out")
    code, output, err = run_egvs("export", local, "--to", to, "--out", out)
    assert (code, err) == (0, "")
    assert "positions in local metres of the world frame, because the scenario has no reference system" in output
    match to:
        case "gpkg":
            with sqlite3.connect(out) as file:
                rows = file.execute("SELECT site, geom FROM sites").fetchall()
                system = file.execute(
                    "SELECT organization FROM gpkg_spatial_ref_sys JOIN gpkg_geometry_columns USING (srs_id)"
                ).fetchone()
            assert system[0].upper() != "EPSG"
            actual = {site: points_of_gpkg(shape)[0] for site, shape in rows}
        case "geojson":
            document = json.loads((out / "sites.geojson").read_text())
            assert document["crs"] is None
            actual = {one["properties"]["site"]: tuple(one["geometry"]["coordinates"]) for one in document["features"]}
        case "geoparquet":
            table = pq.read_table(out / "sites.parquet").to_pylist()
            actual = {row["site"]: points_of_wkb(row["geometry"])[0] for row in table}
        case _:
            with (out / "sites.csv").open(encoding="utf-8-sig", newline="") as file:
                actual = {
                    row["site"]: (float(row["easting_m"]), float(row["northing_m"])) for row in csv.DictReader(file)
                }
    assert actual == {"pole_a": (10.0, 12.0), "pole_b": (30.5, -12.0)}


def test_local_footprints_can_be_imported_by_the_same_scenario(local: Path, tmp_path: Path) -> None:
    export_run(local, "geojson", out=tmp_path)
    world = Georeference(None, Roi.around((20, 0, 2.5), (40, 20, 5)), "scenario.toml")
    house = next(
        one for one in read_footprints(tmp_path / "footprints.geojson", world).footprints if one.name == "house"
    )
    assert set(house.polygon.exterior.coords) == {tuple(map(float, corner)) for corner in BUILDING[0]}


LAYERS = ("sites", "plan", "blindspots", "blindspot_lanes", "footprints", "region")


Points = list[tuple[float, float]]


@dataclass(frozen=True)
class Thing:
    """A row of a layer: its numbers and words, and the corners of its geometry."""

    row: dict[str, Any]
    points: Points


Layers = dict[str, list[Thing]]


def rows_of(run: Path, artefact: str) -> list[dict[str, Any]]:
    table = parquet.read_artefact(run / f"{artefact}.parquet", artefact)[0]
    return [{name: _plain(value) for name, value in row.items()} for row in table.to_pylist()]


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def lanes_of(run: Path) -> dict[str, Points]:
    """The middle line of each lane, from the network's own file."""
    lanes = ET.parse(run / "sumo" / "network.net.xml").getroot().iter("lane")
    return {
        lane.attrib["id"]: [tuple(map(float, pair.split(",")[:2])) for pair in lane.attrib["shape"].split()]
        for lane in lanes
    }


def expected(run: Path) -> Layers:
    """Layers in the world frame."""
    lanes = lanes_of(run)
    missed = [
        {name: value for name, value in row.items() if name not in ("ix", "iy")}
        for row in rows_of(run, "blindspots")
        if row["by"] != "cell"
    ]
    on_lanes = [row for row in missed if row["by"] == "lane"]
    at = [Thing(row, [(row["x_m"], row["y_m"])]) for row in missed]
    region = {"name": "junction", "low_m": 0.0, "high_m": 5.0, "voxel_m": 1.0, "gamma": "1000"}
    region["rank_by"] = "expected_detections"
    return {
        "sites": [Thing(row, [(row["x_m"], row["y_m"])]) for row in rows_of(run, "scores")],
        "plan": [Thing(row, [(row["x_m"], row["y_m"])]) for row in rows_of(run, "placement")],
        "blindspots": at,
        "blindspot_lanes": [Thing(row, lanes[row["place"]]) for row in on_lanes],
        "footprints": [
            Thing({"name": "house", "kind": "building", "base_m": 0.0, "height_m": 6.5}, [tuple(c) for c in HOUSE]),
            Thing({"name": "lamp", "kind": "pole", "base_m": 0.0, "height_m": 5.0}, []),
        ],
        "region": [Thing(region, [(145, 205), (245, 205), (245, 255), (145, 255)])],
    }


def in_gpkg(path: Path) -> Layers:
    with sqlite3.connect(path) as file:
        file.row_factory = sqlite3.Row
        actual = {}
        for name in LAYERS:
            rows = [dict(row) for row in file.execute(f"SELECT * FROM {name} ORDER BY fid")]
            actual[name] = [Thing(row, points_of_gpkg(row.pop("geom"))) for row in rows]
    return actual


def in_geojson(folder: Path) -> Layers:
    return {name: by_gdal(folder / f"{name}.geojson", name) for name in LAYERS}


def by_gdal(path: Path, layer: str) -> list[Thing]:
    import pyogrio.raw

    metadata, _, shapes, columns = pyogrio.raw.read(path, layer=layer, force_2d=True)
    rows = zip(*columns, strict=True) if len(columns) else [()] * len(shapes)
    return [
        Thing({n: _plain(v) for n, v in zip(metadata["fields"], row, strict=True)}, points_of_wkb(shape))
        for row, shape in zip(rows, shapes, strict=True)
    ]


def in_geoparquet(folder: Path) -> Layers:
    fastparquet = pytest.importorskip("fastparquet", reason="reads what pyarrow wrote")
    actual = {}
    for name in LAYERS:
        content = (folder / f"{name}.parquet").read_bytes()  # a file it would leave open
        rows = fastparquet.ParquetFile(io.BytesIO(content)).to_pandas().to_dict("records")
        actual[name] = [
            Thing({n: _plain(v) for n, v in row.items() if n != "geometry"}, points_of_wkb(row["geometry"]))
            for row in rows
        ]
    return actual


def in_csv(folder: Path) -> Layers:
    import pandas

    actual = {}
    for name in LAYERS:
        table = pandas.read_csv(folder / f"{name}.csv", encoding="utf-8-sig", dtype=str)
        table = table.astype(object).where(table.notna(), None)
        actual[name] = []
        for row in table.to_dict("records"):
            pair = [row.get(key) for key in (METRES if METRES[0] in row else DEGREES)]
            wkt = row.get("wkt") or f"{pair[0]} {pair[1]}"
            numbers = [tuple(map(float, its)) for its in re.findall(r"(-?[0-9.]+) (-?[0-9.]+)", wkt)]
            actual[name].append(Thing(row, numbers))
    return actual


METRES, DEGREES = ("easting_m", "northing_m"), ("longitude_deg", "latitude_deg")


def in_kml(path: Path) -> Layers:
    """By GDAL, whose layers are the document's folders, those of sites among them."""
    import pyogrio

    actual: Layers = {name: [] for name in LAYERS}
    into = LAYERS[0]
    for name, _ in pyogrio.list_layers(path).tolist():
        into = name if name in LAYERS else into
        if name not in ("blindspots", "blindspot_lanes"):  # those hold folders alone
            actual[into] += [
                Thing({"name": its.row["Name"], **its.row}, its.points)  # GDAL does not tell the two apart
                for its in by_gdal(path, name)
            ]
    return actual


READERS: dict[str, Callable[[Path], Layers]] = {
    "gpkg": in_gpkg, "geojson": in_geojson, "geoparquet": in_geoparquet, "csv": in_csv, "kml": in_kml,
}  # fmt: skip


def to_world(points: Sequence[tuple[float, float]], *, is_degrees: bool) -> np.ndarray:
    eastings = [utm32(*point) for point in points] if is_degrees else points
    return np.asarray(eastings, dtype=float) + OFFSET_M


def same(value: Any, expected_layers: Any) -> bool:
    """Whether a value is the one that an artefact has; formats that hold texts alone write numbers in full."""
    if expected_layers in (None, ""):
        return value in (None, "")
    if isinstance(value, str) and not isinstance(expected_layers, str):
        return value == str(expected_layers) if isinstance(expected_layers, bool) else float(value) == expected_layers
    return bool(value == expected_layers)


@pytest.mark.slow
@pytest.mark.system  # SUMO drives in this run
@pytest.mark.parametrize(
    ("to", "crs"),
    [(to, crs) for to in READERS for crs in ("scenario", "wgs84") if (to, crs) != ("kml", "scenario")],
)
def test_every_layer_has_every_value_at_the_position(on_roads: Path, tmp_path: Path, to: str, crs: str) -> None:
    out = tmp_path / (f"run{FORMATS[to].suffix}" if FORMATS[to].is_one_file else "out")
    export_run(on_roads, to, crs=crs, out=out)
    actual, expected_layers = READERS[to](out), expected(on_roads)
    assert {name: len(its) for name, its in actual.items()} == {name: len(its) for name, its in expected_layers.items()}
    for name, things in expected_layers.items():
        for its, thing in zip(actual[name], things, strict=True):
            differ = {key: (its.row.get(key), value) for key, value in thing.row.items()
                      if not same(its.row.get(key), value)}  # fmt: skip
            assert not differ, name
            corners = to_world(its.points, is_degrees=crs == "wgs84")
            if name == "footprints" and thing.row["name"] == "lamp":
                assert np.hypot(*(corners - LAMP).T) == pytest.approx(0.1, abs=NEAR_M)
            elif name in ("footprints", "region"):  # a ring may begin anywhere
                assert {tuple(np.round(corner, 1)) for corner in corners} == {tuple(c) for c in thing.points}
                for corner in corners:
                    assert np.hypot(*(np.asarray(thing.points) - corner).T).min() < NEAR_M
            else:
                assert corners == pytest.approx(np.asarray(thing.points, dtype=float), abs=NEAR_M)


@pytest.mark.system  # SUMO drives in this run
def test_the_run_has_all_layers(on_roads: Path) -> None:
    expected_layers = expected(on_roads)
    assert [len(expected_layers[name]) for name in ("sites", "plan", "footprints", "region")] == [2, 2, 2, 1]
    assert len(expected_layers["blindspot_lanes"]) > 15
    assert {thing.row["by"] for thing in expected_layers["blindspots"]} >= {"all", "approach", "lane", "turn"}
    assert all("egvs_se" in thing.row for thing in expected_layers["sites"])
    assert expected_layers["plan"][1].row["score"] > expected_layers["plan"][0].row["score"] > 0


@pytest.mark.system  # SUMO drives in this run
@pytest.mark.parametrize("to", sorted(FORMATS))
def test_files_have_the_same_bytes_twice(on_roads: Path, tmp_path: Path, to: str) -> None:
    made = []
    for name in ("a", "b"):
        out = tmp_path / name
        export_run(on_roads, to, out=out / f"run{FORMATS[to].suffix}" if FORMATS[to].is_one_file else out)
        made.append({path.name: path.read_bytes() for path in sorted(out.iterdir())})
    assert made[0] == made[1]
    assert len(made[0]) == {"gpkg": 1, "kml": 1, "geotiff": 24, "dxf": 1, "glb": 2, "usd": 2}.get(to, len(LAYERS))


@pytest.mark.system  # SUMO drives in this run
def test_geojson_names_the_reference_system(on_roads: Path, tmp_path: Path) -> None:
    import pyogrio

    export_run(on_roads, "geojson", crs="scenario", out=tmp_path)
    assert pyogrio.read_info(tmp_path / "plan.geojson")["crs"] == "EPSG:25832"
    assert json.loads((tmp_path / "plan.geojson").read_text())["name"] == "plan"


# --- a small KML ---------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_kml_has_footprints_in_range_and_blindspots_of_the_best_on_each_pole(tmp_path: Path) -> None:
    """A barn 150 m away is beyond the 100 m of a VLP-16; each pole has two heights."""
    scenario = write_mini(tmp_path / "mini")
    statics = json.loads((scenario / "statics.geojson").read_text())
    barn = [[x + 150.0, y] for x, y in BUILDING[0]]
    statics["features"].append(feature({"type": "Polygon", "coordinates": [barn]}, name="barn", height_m=6))
    (scenario / "statics.geojson").write_text(json.dumps(statics))
    with (scenario / "scenario.toml").open("a") as file:
        file.write(f"\n[crs]\nepsg = {EPSG}\noffset_m = [{OFFSET_M[0]}, {OFFSET_M[1]}]\n")
    (scenario / "sites.csv").write_text("site,x_m,y_m\npole_a,10,12\npole_b,30.5,-12\n")
    overrides = ["sites.heights_m=[3,4]", "sites.replace_sensor='VLP-16'"]
    run.run(load(scenario, overrides), tmp_path / "run")

    kml = export_run(tmp_path / "run", "kml", out=tmp_path / "run.kml")
    text = (tmp_path / "run.kml").read_text(encoding="utf-8")
    assert "<name>house</name>" in text and "barn" not in text
    rows = read_scores(tmp_path / "run" / "scores.parquet").to_pylist()
    best = {pole: min((r for r in rows if r["pole"] == pole), key=lambda r: r["rank"]) for pole in ("pole_a", "pole_b")}
    folders = {folder.find(f"{KML}name").text for folder in ET.fromstring(text).iter(f"{KML}Folder")}
    assert {name for name in folders if "@" in name} == {row["site"] for row in best.values()}
    assert "footprints: 2 of 3, those within the range of a sensor; GeoPackage and GeoJSON files have all" in kml.notes
    assert any(note.startswith("blindspots: ") and "best candidate on each of" in note for note in kml.notes)

    everything = export_run(tmp_path / "run", "geojson", out=tmp_path / "all")
    assert "barn" in (tmp_path / "all" / "footprints.geojson").read_text(encoding="utf-8") and not everything.notes
