"""Zones from files: formats, names, degrees, and each wrong file with its message."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely

import egvs
from egvs.artefacts.readers import read_scores
from egvs.core.errors import InputError
from egvs.formats import georeference
from egvs.placement import plan
from egvs.scenario import loading
from egvs.scoring import zones

WEST_M = [[0.0, -10.0], [16.0, -10.0], [16.0, 10.0], [0.0, 10.0]]
EAST_M = [[20.0, -8.0], [30.0, -8.0], [30.0, 8.0]]
EPSG = ("crs.epsg=25832", "crs.offset_m=[-500000, -5600000]")


def write_zones(path: Path, crs: str | None, **polygons: list[list[float]]) -> None:
    features = []
    for name, corners in polygons.items():
        ring = [*corners, corners[0]]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {"name": name}, "geometry": geometry})
    named = None if crs is None else {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": named, "features": features}), encoding="utf-8")


def weight(name: str, file: str) -> str:
    return f"score.weights.zones.{name}={{weight=4, file='{file}'}}"


def test_zone_takes_the_area_of_its_name(mini: Path) -> None:
    write_zones(mini / "zones.geojson", None, west=WEST_M, east=EAST_M)
    scenario = loading.load(mini, [weight("east", "zones.geojson"), weight("west", "zones.geojson")])
    areas = zones.weight_zones(scenario)
    assert areas["east"].equals(shapely.Polygon(EAST_M))
    assert areas["west"].equals(shapely.Polygon(WEST_M))


def test_zone_takes_the_only_area_of_a_file_whatever_its_name(mini: Path) -> None:
    write_zones(mini / "zones.geojson", None, drawn=WEST_M)
    scenario = loading.load(mini, [weight("crossing", "zones.geojson")])
    assert zones.weight_zones(scenario)["crossing"].equals(shapely.Polygon(WEST_M))


def test_parts_of_one_name_are_one_area(mini: Path) -> None:
    (mini / "zones.csv").write_text("zone,x_m,y_m\n" + "".join(f"west,{x},{y}\n" for x, y in WEST_M))
    write_zones(mini / "west.geojson", None, west=WEST_M)
    document = json.loads((mini / "west.geojson").read_text())
    second = json.loads(json.dumps(document["features"][0]))
    second["geometry"]["coordinates"] = [[[40, 0], [42, 0], [42, 2], [40, 0]]]
    document["features"].append(second)
    (mini / "west.geojson").write_text(json.dumps(document))
    scenario = loading.load(mini, [weight("west", "west.geojson")])
    assert zones.weight_zones(scenario)["west"].area == pytest.approx(16 * 20 + 2)


def test_corners_of_a_csv_in_metres_and_in_degrees_give_the_same_area(mini: Path) -> None:
    frame = georeference.WorldFrame.from_projection("EPSG:25832", (-500000.0, -5600000.0), "test")
    degrees = frame.to_degrees(np.array(WEST_M))
    (mini / "metres.csv").write_text("zone,x_m,y_m\n" + "".join(f"west,{x},{y}\n" for x, y in WEST_M))
    rows = "".join(f"west,{lon:.9f},{lat:.9f}\n" for lon, lat in degrees.tolist())
    (mini / "degrees.csv").write_text("zone,longitude,latitude\n" + rows)
    for file in ("metres.csv", "degrees.csv"):
        scenario = loading.load(mini, [*EPSG, weight("west", file)])
        area = zones.weight_zones(scenario)["west"]
        assert shapely.get_coordinates(area)[:-1] == pytest.approx(np.array(WEST_M), abs=1e-3)


def test_geojson_in_degrees_gives_the_area_in_metres(mini: Path) -> None:
    frame = georeference.WorldFrame.from_projection("EPSG:25832", (-500000.0, -5600000.0), "test")
    write_zones(mini / "zones.geojson", georeference.WGS84, west=frame.to_degrees(np.array(WEST_M)).tolist())
    scenario = loading.load(mini, [*EPSG, weight("west", "zones.geojson")])
    area = zones.weight_zones(scenario)["west"]
    assert area.symmetric_difference(shapely.Polygon(WEST_M)).area < 0.01


@pytest.mark.slow
def test_zone_of_a_file_scores_and_plans_as_the_same_corners(mini: Path, tmp_path: Path) -> None:
    write_zones(mini / "zones.geojson", None, west=WEST_M, east=EAST_M)
    corners = f"score.weights.zones.west={{weight=4, polygon_m={WEST_M}}}"
    others = 'score.others=["seen_well"]'
    scores = []
    for number, key in enumerate((weight("west", "zones.geojson"), corners)):
        egvs.run(loading.load(mini, [key, others]), tmp_path / str(number), jobs=1)
        scores.append(read_scores(tmp_path / str(number) / "scores.parquet")["seen_well"].to_pylist())
    assert scores[0] == scores[1]

    plans = []
    for source in ("file='zones.geojson'", f"polygon_m={EAST_M}"):
        demand = f"placement.zones.east={{{source}, share=0.01}}"
        plans.append(plan.place(loading.load(mini, [demand, "placement.count=1"]), tmp_path / "0", jobs=1))
    assert plans[0].zones == plans[1].zones
    assert 0.0 < plans[0].zones[0].seen <= 1.0


@pytest.mark.slow
def test_moving_a_zone_in_its_file_scores_again(mini: Path, tmp_path: Path) -> None:
    write_zones(mini / "zones.geojson", None, west=WEST_M)
    scenario = loading.load(mini, [weight("west", "zones.geojson"), 'score.others=["seen_well"]'])
    first = egvs.run(scenario, tmp_path / "run", jobs=1)
    write_zones(mini / "zones.geojson", None, west=EAST_M)
    second = egvs.run(scenario, tmp_path / "run", jobs=1)
    assert first.stages["score"].inputs != second.stages["score"].inputs
    assert first.stages["tpog"].inputs == second.stages["tpog"].inputs


CORNERS = "zone,x_m,y_m\n"


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("none.geojson", None, "score.weights.zones.z.file"),
        ("z.csv", CORNERS + "z,0,0\nz,1,1\n", "zone z: expected at least 3 corners, got 2"),
        ("z.csv", CORNERS + "z,0,0\nz,1,1\nz,1,0\nz,0,1\n", "zone z: the corners do not enclose an area"),
        ("z.csv", CORNERS + "z,0,0\nz,1,\nz,1,0\n", "y_m: expected metres, got ''"),
        ("z.csv", "x_m,y_m\n0,0\n1,1\n1,0\n", "zone is missing. Use the columns zone, x_m, y_m, one row per corner."),
        ("z.csv", CORNERS + "a,0,0\na,1,1\na,1,0\nb,0,0\nb,1,1\nb,1,0\n", "expected an area named 'z', got a, b"),
        ("z.geojson", '{"type": "Point"}', "expected a GeoJSON FeatureCollection"),
    ],
)  # fmt: skip
def test_wrong_file_is_one_message(mini: Path, file: str, text: str | None, message: str) -> None:
    if text is not None:
        (mini / file).write_text(text)
    scenario = loading.load(mini, [weight("z", file)])
    with pytest.raises(InputError) as error:
        zones.weight_zones(scenario)
    assert message in str(error.value)


@pytest.mark.parametrize("source", ["", ", polygon_m=[[0,0],[1,1],[1,0]], file='z.csv'"])
def test_zone_needs_corners_or_a_file(mini: Path, source: str) -> None:
    with pytest.raises(InputError, match="expected either polygon_m or file"):
        loading.load(mini, [f"score.weights.zones.z={{weight=1{source}}}"])
