"""Sites from CSV and GeoJSON files, and their user columns."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import egvs
from egvs.artefacts.extra_columns import extra_columns
from egvs.core.errors import InputError, find_misspelling
from egvs.sensors import sites
from tests.conftest import collection, feature
from tests.sensors.helpers import angles_of, site_positions, sites_from

CSV = """fid,site,x_m,y_m,z_m,owner,note,plan,cost,rank
1,pole_a,10,12,3,"City, east",,007,1200,b
2,pole_b,30.5,-12,3,Grid Ltd.,"by the ""old"" bridge",012,1300.5,
"""


USER_COLUMNS = {"fid": [1, 2], "owner": ["City, east", "Grid Ltd."], "note": [None, 'by the "old" bridge'],
       "plan": ["007", "012"], "cost": [1200.0, 1300.5], "given_rank": ["b", None]}  # fmt: skip


KNOWN = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor", "points")


@pytest.mark.slow
def test_user_columns_of_csv_are_in_the_scores_with_their_types(mini: Path, tmp_path: Path, run_egvs) -> None:
    plain = tmp_path / "plain"
    assert run_egvs("run", mini, "--out", plain)[0] == 0
    (mini / "sites.csv").write_text(CSV)
    code, _, output = run_egvs("run", mini, "--out", tmp_path / "own")
    assert code == 0, output
    scores = egvs.read_scores(tmp_path / "own" / "scores.parquet")
    assert {name: scores.column(name).to_pylist() for name in USER_COLUMNS} == USER_COLUMNS
    assert scores.schema.field("fid").type == pa.int64()
    assert scores.schema.field("cost").type == pa.float64()
    assert scores.drop_columns(list(USER_COLUMNS)).equals(egvs.read_scores(plain / "scores.parquet"))
    assert list(scores.to_pandas().owner) == USER_COLUMNS["owner"]
    assert run_egvs("verify", tmp_path / "own")[0] == 0


@pytest.mark.slow
def test_changed_user_column_is_in_the_next_scores(mini: Path, tmp_path: Path, run_egvs) -> None:
    for note in ("first", "second"):
        rows = f"site,x_m,y_m,z_m,note\npole_a,10,12,3,{note}\npole_b,30.5,-12,3,{note}\n"
        (mini / "sites.csv").write_text(rows)
        assert run_egvs("run", mini, "--out", tmp_path / "out")[0] == 0
        assert egvs.read_scores(tmp_path / "out" / "scores.parquet").column("note").to_pylist() == [note] * 2


def test_geojson_properties_keep_their_types(mini: Path) -> None:
    user_file = {
        "fid": 7,
        "lit": True,
        "tags": {"ref": ["A", 1]},
        "text": "12",
        "huge": 10**30,
        "none": None,
    }
    point = feature({"type": "Point", "coordinates": [0, 1, 2]}, name="a", **user_file)
    (mini / "sites.geojson").write_text(collection(point))
    (site,) = sites.candidate_sites(egvs.load(mini, ['sites.file="sites.geojson"']))
    expected = {"tags": '{"ref": ["A", 1]}', "huge": str(10**30)}
    assert site.user_columns == user_file | expected


def test_column_type_fits_all_values() -> None:
    rows = [{"a": 1, "b": 1, "c": 1, "d": True, "e": None}, {"a": None, "b": 0.5, "c": "x", "d": False}, {"f": "y"}]
    columns = extra_columns(rows, ("a", "given_a", "f"))
    assert {name: (column.to_pylist(), str(column.type)) for name, column in columns.items()} == {
        "given_given_a": ([1, None, None], "int64"),
        "b": ([1.0, 0.5, None], "double"),
        "c": (["1", "x", None], "string"),
        "d": ([True, False, None], "bool"),
        "e": ([None] * 3, "string"),
        "given_f": ([None, None, "y"], "string"),
    }


@pytest.mark.parametrize(
    ("name", "meant"),
    [("yaw", "yaw_deg"), ("YAW_DEG", "yaw_deg"), ("pitch_dg", "pitch_deg"), ("role_deg", "roll_deg"),
     ("sensors", "sensor"), ("point", "points"), ("x", "x_m"), ("Z_M", "z_m")],
)  # fmt: skip
def test_finds_misspelling_of_a_missing_known_name(name: str, meant: str) -> None:
    assert find_misspelling([name, *(set(KNOWN) - {meant})], KNOWN) == (name, meant)
    assert find_misspelling([name, *KNOWN], KNOWN) is None


def test_user_column_names_are_no_misspellings() -> None:
    assert (
        find_misspelling(
            ["fid", "owner", "note", "name", "side", "height", "street", "id", "tilt", "lamp", "type"], KNOWN
        )
        is None
    )


def test_reports_misspelt_column_once_for_all_rows(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,yaw\na,10,12,3,90\nb,30.5,-12,3,90\nc,20,12,3,0\n")
    code, _, output = run_egvs("run", mini, "--out", tmp_path)
    assert code == 2
    assert output.count("unknown column 'yaw'. Did you mean yaw_deg?") == 1
    assert "line 2 (a), line 3 (b), line 4 (c): " in output


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        *((name, "Use z_m, the sensor's z in the world frame in metres") for name in
          ("height", "height_m", "Height (m)", "heights_m", "height_ft", "mounting-height", "altitude_m",
           "alt", "Elevation (m)", "elev", "h", "height above ground")),
        *((name, "Use yaw_deg, counter-clockwise from east: 90 minus the degrees clockwise from north") for name in
          ("heading", "heading_deg", "azimuth", "bearing", "Bearing [deg]", "orientation_deg",
           "direction")),
        *((name, "Use pitch_deg, positive for nose up: minus the degrees by which the sensor is tilted") for name in
          ("tilt", "tilt_deg", "downtilt_deg")),
        *((name, "Use sensor, with a name from `egvs sensors`") for name in ("lidar", "sensor_model")),
    ],
)  # fmt: skip
def test_rejects_column_that_other_programs_use_for_a_known_one(mini: Path, name: str, hint: str) -> None:
    (mini / "sites.csv").write_text(f"site,x_m,y_m,{name}\na,10,12,4\nb,30.5,-12,4\n")
    with pytest.raises(InputError, match=re.escape(hint)) as error:
        sites_from(mini, file='"sites.csv"', heights_m="[3, 4.5, 6]")
    assert f"sites.csv: line 2 (a), line 3 (b): the column {name!r} has no effect" in str(error.value)
    assert str(error.value).count(hint) == 1


def test_rejects_property_that_other_programs_use_for_yaw(mini: Path) -> None:
    (mini / "sites.geojson").write_text(collection(point(0, 0, 6, name="a", heading_deg=10)))
    with pytest.raises(InputError, match=r"feature 0: the column 'heading_deg' has no effect. Use yaw_deg"):
        sites_from(mini, file='"sites.geojson"')


@pytest.mark.parametrize("name", ["height", "lamp_height_m", "street_heading"])
def test_accepts_custom_columns_of_similar_names_and_empty_ones(mini: Path, name: str) -> None:
    value = "" if name == "height" else "4"
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,{name}\na,10,12,3,{value}\n")
    (site,) = sites_from(mini, file='"sites.csv"')
    assert site.user_columns == {name: int(value) if value else None}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "meant"), [("heigth_m", "height_m"), ("height", "height_m"), ("bse_m", "base_m")])
def test_rejects_misspelt_height_of_a_footprint(mini: Path, tmp_path: Path, run_egvs, name: str, meant: str) -> None:
    heights = {"height_m": 6, "base_m": 3, "building:levels": 2, "owner": "x"}
    house = {"type": "Polygon", "coordinates": [[[14, 5], [18, 5], [18, 8], [14, 5]]]}
    for spelt in (False, True):
        user_file = {name if spelt and key == meant else key: value for key, value in heights.items()}
        (mini / "statics.geojson").write_text(collection(feature(house, **user_file)))
        code, _, output = run_egvs("run", mini, "--out", tmp_path)
        assert code == (2 if spelt else 0), output
    assert f"unknown property '{name}'. Did you mean {meant}?" in output


def test_geojson_rows_may_have_their_own_aim(mini: Path) -> None:
    """Yaw or aim of a row override those of [sites]."""
    (mini / "sites.geojson").write_text(
        collection(
            feature({"type": "Point", "coordinates": [0, 0, 6]}, name="aimed", aim_x_m=0, aim_y_m=6, aim_z_m=0),
            feature({"type": "Point", "coordinates": [0, 0, 6]}, name="turned", yaw_deg=30),
            feature({"type": "Point", "coordinates": [0, 0, 6]}, name="tilted", pitch_deg=-7),
        )
    )
    result = sites_from(mini, file='"sites.geojson"', aim_m="[10, 0, 0]")
    assert angles_of(result) == [
        ("aimed", 6, 90, -40),
        ("turned", 6, 30, 0),
        ("tilted", 6, 0, -7),
    ]


def point(*coordinates: object, **properties: object) -> dict[str, Any]:
    return feature({"type": "Point", "coordinates": coordinates}, **properties)


def named(crs: str) -> dict[str, Any]:
    """What GeoJSON of 2008 could hold as ``crs``."""
    return {"type": "name", "properties": {"name": crs}}


def sites_of_geojson(mini: Path, text: str, name: str = "sites.geojson") -> tuple[sites.Site, ...]:
    (mini / name).write_text(text, encoding="utf-8")
    return sites.candidate_sites(egvs.load(mini, [f'sites.file="{name}"']))


# --- GeoJSON ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["sites.geojson", "sites.json", "SITES.GeoJSON"])
def test_geojson_gives_the_same_sites_as_csv(mini: Path, name: str) -> None:
    by_csv = sites.candidate_sites(egvs.load(mini))
    text = collection(point(10, 12, 3, name="pole_a"), point(30.5, -12, 3, name="pole_b"))
    assert sites_of_geojson(mini, text, name) == by_csv
    assert site_positions(by_csv) == [("pole_a", 10, 12, 3), ("pole_b", 30.5, -12, 3)]


def test_properties_set_pose_sensor_and_scan(mini: Path) -> None:
    user_file = {"yaw_deg": 90, "pitch_deg": -7.5, "roll_deg": 1, "sensor": "VLP-16", "points": "measured.ply"}
    first, second = sites_of_geojson(
        mini, collection(point(0, 1, 2, name="a", **user_file), point(3, 4, 5, name="b", yaw_deg=None))
    )
    assert first == sites.Site("a", sites.Pose(0, 1, 2, 90, -7.5, 1), "VLP-16", "measured.ply", "a")
    assert second == sites.Site("b", sites.Pose(3, 4, 5), "small", pole="b")


def test_height_may_be_a_property_and_name_a_number(mini: Path) -> None:
    result = sites_of_geojson(mini, collection(point(0, 1, z_m=2, name=5), point(0, 1, 3, z_m=3.0, site="b"),
                                        point(0, 1, 4, z_m=None, name="c")))  # fmt: skip
    assert site_positions(result) == [("5", 0, 1, 2), ("b", 0, 1, 3), ("c", 0, 1, 4)]


@pytest.mark.parametrize("crs", [None, named("urn:ogc:def:crs:EPSG::25832"), named('LOCAL_CS["site",UNIT["metre",1]]')])
def test_accepts_crs_in_metres(mini: Path, crs: object) -> None:
    text = json.dumps({"crs": crs, "features": [point(0, 1, 2, name="a")]})
    assert site_positions(sites_of_geojson(mini, text)) == [("a", 0, 1, 2)]


@pytest.mark.slow
def test_run_from_geojson_has_the_scores_of_csv(mini: Path, tmp_path: Path) -> None:
    settings = ["score.standard_error=false"]
    egvs.run(egvs.load(mini, settings), tmp_path / "csv")
    text = collection(point(10, 12, 3, name="pole_a"), point(30.5, -12, 3, name="pole_b"))
    (mini / "sites.geojson").write_text(text)
    egvs.run(egvs.load(mini, [*settings, 'sites.file="sites.geojson"']), tmp_path / "geojson")
    by_csv, by_geojson = (egvs.read_scores(tmp_path / way / "scores.parquet") for way in ("csv", "geojson"))
    assert by_csv.num_rows == 2
    assert by_geojson.equals(by_csv)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not valid JSON"),
        *((text, r"sites\.geojson: expected a FeatureCollection of Points, got ")
          for text in ("[1, 2]", '{"type": "Point"}', "[]", "null", "5", '{"features": null}', '{"features": {}}')),
        pytest.param("[" * 100_000, "is not valid JSON", id="deep"),
        (collection(), "expected at least one site"),
        *((collection(point(0, 0, 3, name="a"), wrong), "feature 1: expected a Feature that has properties")
          for wrong in (None, 5, [], {"type": "Feature", "geometry": None}, feature({"type": "Point"}, name="b"),
                        feature({"type": "Point", "coordinates": None}, name="b"), point(0, name="b"),
                        feature({"type": "Point", "coordinates": "195"}, name="b"), point(0, 0, 3, 4, name="b"),
                        {**point(0, 0, 3), "properties": None})),
        (collection(point(0, "195", 3, name="a")), "feature 0: y_m: expected a numeric coordinate.*text '195'"),
        (collection(point(0, True, 3, name="a")), "feature 0: y_m: .*finite number.*True"),
        (collection(point(0, None, 3, name="a")), "feature 0: y_m is missing"),
        (collection(point(0, 0, 10**400, name="a")), "is not valid JSON: a number has too many digits"),
        (collection(point(0, 0, 3, name="a", z_m=4)), "feature 0: z_m: there are two values, 4 and 3"),
        (collection(point(0, 0, 3, name="a", site="b")), "feature 0: site: there are two values, 'b' and 'a'"),
        *((collection(point(0, 0, 3, **{"name": "a", key: value})), f"feature 0: {result}: expected text")
          for key, result in (("name", "site"), ("sensor", "sensor"), ("points", "points"))
          for value in ([], ["b"], {}, True)),
        (collection(point(0, 0, 3, name="\ud800")), r"is not valid JSON: it is not valid text"),
        *((json.dumps({"crs": crs, "features": [point(0, 0, 3, name="a")]}),
           r"sites\.geojson: crs: expected a named system or null, got ")
          for crs in (5, "EPSG:25832", {}, {"properties": {"name": 5}})),
        (json.dumps({"crs": named("local"), "features": [point(0, 0, 3, name="a")]}),
           r"sites\.geojson: crs: unknown coordinate reference system 'local'"),
        *((json.dumps({"crs": named(crs), "features": [point(9, 51, 3, name="a")]}),
           rf"sites\.geojson: the file is in {name}.*, but the position of the world frame on the Earth is unknown.*"
           r"under \[crs\] in .*scenario\.toml, or use a network with a <location>")
          for crs, name in (("EPSG:4326", "WGS 84"), ("urn:ogc:def:crs:OGC:1.3:CRS84", "WGS"), ("EPSG:2263", "NAD83"))),
        (
            collection(feature({"type": "LineString", "coordinates": [[0, 0, 3], [1, 1, 3]]}, name="a")),
            "feature 0: expected .*a Point.*'LineString'",
        ),
        (collection(point(0, 0, 3, name="a"), point(0, 0, name="b")), "feature 1.*z_m is missing"),
        (collection(point(0, 0, 3)), "feature 0.*site is missing"),
        (collection(point(0, 0, 3, name="")), "feature 0.*site is missing"),
        (collection(point(0, 0, 3, name="a/b")), "feature 0: site.*'a/b'"),
        (collection(point(0, 0, 3, name="a"), point(1, 0, 3, name="a")), "feature 1.*two sites 'a'"),
        *((collection(point(0, 0, 3, **{"name": "a", key: 90})), f"column '{re.escape(key)}'. Did you mean yaw_deg[?]")
          for key in ("yaw", "Yaw_deg", "yaw_dge", "yaw_rad", "yawdeg", "yaw [°]", "Yaw (deg)")),
        (collection(point(0, 0, 3, name="a", pitch_deg=91)), "feature 0: pitch_deg.*91"),
        (collection(point(0, 0, 3, name="a", yaw_deg="north")), "feature 0: yaw_deg.*'north'"),
        (collection(point(0, 0, math.nan, name="a")), "feature 0: z_m.*nan"),
        (
            json.dumps({"crs": None, "features": [feature({"type": "Point", "coordinates": ["x", 0, 3]}, name="a")]}),
            "feature 0: x_m.*'x'",
        ),
    ],
)  # fmt: skip
def test_rejects_invalid_geojson(mini: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        sites_of_geojson(mini, text)


def test_rejects_geojson_that_is_not_utf8(mini: Path) -> None:
    (mini / "sites.geojson").write_bytes(b'{"features": "\xff"}')
    with pytest.raises(InputError, match="is not valid JSON"):
        sites.candidate_sites(egvs.load(mini, ['sites.file="sites.geojson"']))


def test_stops_reading_a_table_with_too_many_rows(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The malformed row after the limit is not read."""
    monkeypatch.setenv("EGVS_MAX_SITES", "3")
    rows = "".join(f"s{i},{i},12,3\n" for i in range(1, 5))
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m\n{rows}s5,5,12\n")
    with pytest.raises(InputError, match=r"sites\.csv: there are more than 3 candidates .*EGVS_MAX_SITES"):
        sites.candidate_sites(egvs.load(mini))


def test_rejects_too_many_features_before_their_coordinates_are_read(
    mini: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGVS_MAX_SITES", "3")
    (mini / "sites.geojson").write_text(collection(*(point("east", i, 3, name=f"s{i}") for i in range(5))))
    with pytest.raises(InputError, match=r"sites\.geojson: there are more than 3 candidates"):
        sites_from(mini, file='"sites.geojson"')
