"""The same scene in metres, in degrees and in map projections ends in the same scores; each output says where it is."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.formats.georeference import WorldFrame
from egvs.results.ranking import Ranking
from egvs.stages import traffic
from tests.conftest import write_mini
from tests.stage_runner import inputs_of
from tests.stages.conftest import net_xml

CRS = "\n[crs]\nepsg = 32632\noffset_m = [-550700, -5635200]\n"
FRAME = WorldFrame("EPSG:32632", (-550_700.0, -5_635_200.0))
PLAIN = ["score.standard_error=false"]
Move = Callable[[float, float], list[float]]


def to_degrees(x: float, y: float) -> list[float]:
    lon, lat = FRAME.to_degrees(np.array([[x, y]]))[0].tolist()
    return [lon, lat]


def to_utm(x: float, y: float) -> list[float]:
    return [x + 550_700.0, y + 5_635_200.0]


def to_gauss_kruger(x: float, y: float) -> list[float]:
    """DHDN, another datum: metres of Gauss-Krueger zone 3."""
    point = WorldFrame("EPSG:31467").from_lon_lat(np.array([to_degrees(x, y)]))[0].tolist()
    return [point[0], point[1]]


def named(crs: str) -> dict[str, Any]:
    return {"type": "name", "properties": {"name": crs}}


def write_geojson(path: Path, features: list[dict[str, Any]], move: Move, crs: str | None) -> None:
    """Write the members of geopandas: ``type, name, crs, features``; without ``crs``, those of RFC 7946."""

    def moved(value: Any) -> Any:
        if isinstance(value[0], list):
            return [moved(item) for item in value]
        return [*move(*value[:2]), *value[2:]]

    for number, feature in enumerate(features):
        feature["id"] = str(number)
        feature["geometry"]["coordinates"] = moved(feature["geometry"]["coordinates"])
    head: dict[str, Any] = {"type": "FeatureCollection", "name": path.stem} | (
        {} if crs is None else {"crs": named(crs)}
    )
    path.write_text(json.dumps({**head, "features": features}), encoding="utf-8")


def moved_mini(folder: Path, move: Move, crs: str | None) -> Path:
    """The small scenario with its statics and sites as GeoJSON in another system."""
    write_mini(folder)
    statics = json.loads((folder / "statics.geojson").read_text())["features"]
    write_geojson(folder / "statics.geojson", statics, move, crs)
    with (folder / "sites.csv").open() as file:
        sites = [
            {"type": "Feature", "properties": {"site": row["site"], "z_m": float(row["z_m"])},
             "geometry": {"type": "Point", "coordinates": [float(row["x_m"]), float(row["y_m"])]}}
            for row in csv.DictReader(file)
        ]  # fmt: skip
    write_geojson(folder / "sites.geojson", sites, move, crs)
    scenario = folder / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("sites.csv", "sites.geojson") + CRS)
    return folder


def scores(folder: Path, out: Path) -> pa.Table:
    egvs.run(egvs.load(folder, PLAIN), out)
    return egvs.read_scores(out / "scores.parquet")


@pytest.fixture(scope="module")
def in_metres(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """The scores of the scene by hand, in metres, its frame known."""
    folder = write_mini(tmp_path_factory.mktemp("metres") / "mini")
    (folder / "scenario.toml").write_text((folder / "scenario.toml").read_text() + CRS)
    return scores(folder, folder / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("move", "crs"),
    [
        pytest.param(to_degrees, "urn:ogc:def:crs:OGC:1.3:CRS84", id="geopandas-4326"),
        pytest.param(to_utm, "urn:ogc:def:crs:EPSG::32632", id="geopandas-projected"),
        pytest.param(to_gauss_kruger, "urn:ogc:def:crs:EPSG::31467", id="geopandas-another-datum"),
    ],
)
def test_geojson_in_any_crs_gives_same_scores(tmp_path: Path, in_metres: pa.Table, move: Move, crs: str | None) -> None:
    found = scores(moved_mini(tmp_path / "mini", move, crs), tmp_path / "run")
    assert len(set(in_metres["egvs"].to_pylist())) == 2
    if move is to_gauss_kruger:
        for name, off in (("x_m", 1e-3), ("longitude_deg", 1e-7), ("egvs", 20.0)):
            assert found[name].to_pylist() == pytest.approx(in_metres[name].to_pylist(), abs=off)
        assert found["rank"].equals(in_metres["rank"])
    else:
        assert found.equals(in_metres)


def test_rejects_geojson_without_crs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'geojson.*: the file does not declare its coordinate system.*Set "crs"'):
        scores(moved_mini(tmp_path / "mini", to_degrees, None), tmp_path / "run")


@pytest.mark.parametrize("columns", ["lon,lat", "Longitude,Latitude", "longitude_deg,latitude_deg", "x_m,y_m,lon,lat"])
def test_csv_with_longitude_and_latitude_gives_same_scores(tmp_path: Path, in_metres: pa.Table, columns: str) -> None:
    folder = write_mini(tmp_path / "mini")
    rows = [f"site,z_m,{columns}"]
    for name, x, y, z in (("pole_a", 10.0, 12.0, 3), ("pole_b", 30.5, -12.0, 3)):
        own = [x, y] if columns.startswith("x_m") else []
        rows.append(",".join(map(str, [name, z, *own, *to_degrees(x, y)])))
    (folder / "sites.csv").write_text("\n".join(rows) + "\n")
    (folder / "scenario.toml").write_text((folder / "scenario.toml").read_text() + CRS)
    assert scores(folder, tmp_path / "run").equals(in_metres)


def write_fcd_in_degrees(folder: Path) -> None:
    head, *rows = (folder / "fcd.csv").read_text().splitlines()
    moved = []
    for row in rows:
        time, name, x, y, *rest = row.split(";")
        lon, lat = to_degrees(float(x), float(y))
        moved.append(";".join([time, name, f"{lon:.13f}", f"{lat:.13f}", *rest]))
    (folder / "fcd.csv").write_text("\n".join([head, *moved]) + "\n")


def test_period_fcd_uses_georeference_of_network(tmp_path: Path, in_metres: pa.Table) -> None:
    """Another place for the world is other traffic: the stage runs again."""
    folder = write_mini(tmp_path / "mini")
    write_fcd_in_degrees(folder)
    location = 'netOffset="-550700,-5635200" projParameter="+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"'
    lanes = net_xml().replace('netOffset="0.00,0.00" projParameter="!"', location)
    (folder / "net.net.xml").write_text(lanes)
    scenario = folder / "scenario.toml"
    period = '[[traffic.periods]]\nname = "day"\nfcd = "fcd.csv"\n\n[[traffic.kinds]]'
    text = (
        scenario.read_text()
        .replace('fcd = "fcd.csv"', 'network = "net.net.xml"\nfcd_geo = true')
        .replace("[[traffic.kinds]]", period)
    )
    scenario.write_text(text)
    assert scores(folder, tmp_path / "run")["egvs"].to_pylist() == in_metres["egvs"].to_pylist()
    before = inputs_of(traffic, egvs.load(folder), tmp_path / "run").to_json()
    (folder / "net.net.xml").write_text(lanes.replace("-550700", "-550701"))
    assert inputs_of(traffic, egvs.load(folder), tmp_path / "run").to_json() != before


def test_fcd_in_degrees_gives_same_scores(tmp_path: Path, in_metres: pa.Table) -> None:
    """As ``--fcd-output.geo`` writes it; it must be declared, and the position of the world frame known."""
    folder = write_mini(tmp_path / "mini")
    write_fcd_in_degrees(folder)
    with pytest.raises(
        InputError, match=r"fcd.csv: x and y look like longitude and latitude, but the position of the world frame"
    ):
        scores(folder, tmp_path / "no_frame")
    scenario = folder / "scenario.toml"
    scenario.write_text(scenario.read_text() + CRS)
    with pytest.raises(InputError, match=r"fcd.csv: .*got longitude and latitude.*Set traffic.fcd_geo = true"):
        scores(folder, tmp_path / "not_declared")
    scenario.write_text(scenario.read_text().replace('fcd = "fcd.csv"', 'fcd = "fcd.csv"\nfcd_geo = true'))
    assert scores(folder, tmp_path / "run").equals(in_metres)


def test_scores_have_longitude_and_latitude(tmp_path: Path, in_metres: pa.Table) -> None:
    places = zip(in_metres["longitude_deg"].to_pylist(), in_metres["latitude_deg"].to_pylist(), strict=True)
    for place, metres in zip(places, [(10.0, 12.0), (30.5, -12.0)], strict=True):
        assert place == pytest.approx(to_degrees(*metres), abs=1e-9)
        assert FRAME.from_lon_lat(np.array([place]))[0] == pytest.approx(metres, abs=1e-3)
    unknown = scores(write_mini(tmp_path / "mini"), tmp_path / "run")
    assert unknown.equals(in_metres.drop_columns(["longitude_deg", "latitude_deg"]))
    assert Ranking.read(tmp_path / "run" / "scores.parquet").sites[0].longitude_deg is None
    assert "Latitude" not in (tmp_path / "run" / "report.html").read_text()


def test_report_shows_coordinates(tmp_path: Path) -> None:
    folder = write_mini(tmp_path / "mini")
    (folder / "scenario.toml").write_text((folder / "scenario.toml").read_text() + CRS)
    scores(folder, tmp_path / "run")
    page = (tmp_path / "run" / "report.html").read_text()
    lon, lat = to_degrees(10.0, 12.0)
    assert f"{lat:.6f}" in page
    assert f"{lon:.6f}" in page


@pytest.mark.slow
def test_changed_crs_moves_sites(tmp_path: Path) -> None:
    """Stages that read degrees run again when the frame is another; those that do not know it are left."""
    folder = moved_mini(tmp_path / "mini", to_degrees, "urn:ogc:def:crs:OGC:1.3:CRS84")
    scores(folder, tmp_path / "run")
    text = (folder / "scenario.toml").read_text().replace("-550700", "-550690")
    (folder / "scenario.toml").write_text(text)
    assert scores(folder, tmp_path / "run")["x_m"].to_pylist() == [20.0, 40.5]
