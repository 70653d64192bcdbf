"""Every layer of every format holds the numbers of the artefacts, at their places to a centimetre.

Each format is read by a library that did not write it: SQLite, GDAL, fastparquet, pandas.
"""

from __future__ import annotations

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
import pytest

from egvs.artefacts import parquet
from egvs.export.export import FORMATS, export_run
from tests.export.conftest import HOUSE, LAMP, OFFSET_M
from tests.export.readers import points_of_gpkg, points_of_wkb, utm32

pytest.importorskip("pyogrio", reason="the extra egvs[gis] is not installed")
pytest.importorskip("geopandas", reason="the extra egvs[gis] is not installed")

pytestmark = pytest.mark.system  # SUMO drives on the network that the run is of

LAYERS = ("sites", "plan", "blindspots", "blindspot_lanes", "footprints", "region")
NEAR_M = 0.01

Points = list[tuple[float, float]]


@dataclass(frozen=True)
class Thing:
    """A row of a layer: its numbers and words, and the corners of its geometry."""

    row: dict[str, Any]
    points: Points


Layers = dict[str, list[Thing]]


# ---- what the artefacts have


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
    region = {"name": "junction", "low_m": 0.0, "high_m": 5.0, "voxel_m": 1.0, "gamma": "1000", "rank_by": "egvs"}
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


# ---- what the formats have


def in_gpkg(path: Path) -> Layers:
    with sqlite3.connect(path) as file:
        file.row_factory = sqlite3.Row
        found = {}
        for name in LAYERS:
            rows = [dict(row) for row in file.execute(f"SELECT * FROM {name} ORDER BY fid")]
            found[name] = [Thing(row, points_of_gpkg(row.pop("geom"))) for row in rows]
    return found


def in_geojson(folder: Path) -> Layers:
    return {name: by_gdal(folder / f"{name}.geojson", name) for name in LAYERS}


def by_gdal(path: Path, layer: str) -> list[Thing]:
    import pyogrio.raw

    about, _, shapes, columns = pyogrio.raw.read(path, layer=layer, force_2d=True)
    rows = zip(*columns, strict=True) if len(columns) else [()] * len(shapes)
    return [
        Thing({n: _plain(v) for n, v in zip(about["fields"], row, strict=True)}, points_of_wkb(shape))
        for row, shape in zip(rows, shapes, strict=True)
    ]


def in_geoparquet(folder: Path) -> Layers:
    fastparquet = pytest.importorskip("fastparquet", reason="reads what pyarrow wrote")
    found = {}
    for name in LAYERS:
        content = (folder / f"{name}.parquet").read_bytes()  # a file it would leave open
        rows = fastparquet.ParquetFile(io.BytesIO(content)).to_pandas().to_dict("records")
        found[name] = [
            Thing({n: _plain(v) for n, v in row.items() if n != "geometry"}, points_of_wkb(row["geometry"]))
            for row in rows
        ]
    return found


def in_csv(folder: Path) -> Layers:
    import pandas

    found = {}
    for name in LAYERS:
        table = pandas.read_csv(folder / f"{name}.csv", encoding="utf-8-sig", dtype=str)
        table = table.astype(object).where(table.notna(), None)
        found[name] = []
        for row in table.to_dict("records"):
            pair = [row.get(key) for key in (PLACE if PLACE[0] in row else DEGREES)]
            wkt = row.get("wkt") or f"{pair[0]} {pair[1]}"
            numbers = [tuple(map(float, its)) for its in re.findall(r"(-?[0-9.]+) (-?[0-9.]+)", wkt)]
            found[name].append(Thing(row, numbers))
    return found


PLACE, DEGREES = ("easting_m", "northing_m"), ("longitude_deg", "latitude_deg")


def in_kml(path: Path) -> Layers:
    """By GDAL, whose layers are the document's folders, those of sites among them."""
    import pyogrio

    found: Layers = {name: [] for name in LAYERS}
    into = LAYERS[0]
    for name, _ in pyogrio.list_layers(path).tolist():
        into = name if name in LAYERS else into
        if name not in ("blindspots", "blindspot_lanes"):  # those hold folders alone
            found[into] += [
                Thing({"name": its.row["Name"], **its.row}, its.points)  # GDAL does not tell the two apart
                for its in by_gdal(path, name)
            ]
    return found


READERS: dict[str, Callable[[Path], Layers]] = {
    "gpkg": in_gpkg, "geojson": in_geojson, "geoparquet": in_geoparquet, "csv": in_csv, "kml": in_kml,
}  # fmt: skip


def to_world(points: Sequence[tuple[float, float]], *, is_degrees: bool) -> np.ndarray:
    eastings = [utm32(*point) for point in points] if is_degrees else points
    return np.asarray(eastings, dtype=float) + OFFSET_M


def same(value: Any, wanted: Any) -> bool:
    """Whether a value is the one that an artefact has; formats that hold texts alone write numbers in full."""
    if wanted in (None, ""):
        return value in (None, "")
    if isinstance(value, str) and not isinstance(wanted, str):
        return value == str(wanted) if isinstance(wanted, bool) else float(value) == wanted
    return bool(value == wanted)


@pytest.mark.parametrize(
    ("to", "crs"),
    [(to, crs) for to in READERS for crs in ("scenario", "wgs84") if (to, crs) != ("kml", "scenario")],
)
def test_every_layer_has_every_number_at_its_place(on_roads: Path, tmp_path: Path, to: str, crs: str) -> None:
    out = tmp_path / (f"run{FORMATS[to].suffix}" if FORMATS[to].is_one_file else "out")
    export_run(on_roads, to, crs=crs, out=out)
    found, wanted = READERS[to](out), expected(on_roads)
    assert {name: len(its) for name, its in found.items()} == {name: len(its) for name, its in wanted.items()}
    for name, things in wanted.items():
        for its, thing in zip(found[name], things, strict=True):
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


def test_the_run_has_what_is_looked_for(on_roads: Path) -> None:
    wanted = expected(on_roads)
    assert [len(wanted[name]) for name in ("sites", "plan", "footprints", "region")] == [2, 2, 2, 1]
    assert len(wanted["blindspot_lanes"]) > 15
    assert {thing.row["by"] for thing in wanted["blindspots"]} >= {"all", "approach", "lane", "turn"}
    assert all("egvs_se" in thing.row for thing in wanted["sites"])
    assert wanted["plan"][1].row["score"] > wanted["plan"][0].row["score"] > 0


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_the_same_bytes_twice(on_roads: Path, tmp_path: Path, to: str) -> None:
    made = []
    for name in ("a", "b"):
        out = tmp_path / name
        export_run(on_roads, to, out=out / f"run{FORMATS[to].suffix}" if FORMATS[to].is_one_file else out)
        made.append({path.name: path.read_bytes() for path in sorted(out.iterdir())})
    assert made[0] == made[1]
    assert len(made[0]) == {"gpkg": 1, "kml": 1, "geotiff": 12}.get(to, len(LAYERS))


def test_geojson_in_a_system_of_its_own_names_it(on_roads: Path, tmp_path: Path) -> None:
    import pyogrio

    export_run(on_roads, "geojson", crs="scenario", out=tmp_path)
    assert pyogrio.read_info(tmp_path / "plan.geojson")["crs"] == "EPSG:25832"
    assert json.loads((tmp_path / "plan.geojson").read_text())["name"] == "plan"
