"""Candidate sites from GeoJSON and along lines: where they stand, what they are called, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.core.errors import InputError
from egvs.sensors import sites
from tests.conftest import collection, feature


def point(*coordinates: object, **properties: object) -> dict[str, Any]:
    return feature({"type": "Point", "coordinates": coordinates}, **properties)


def named(crs: str) -> dict[str, Any]:
    """What GeoJSON of 2008 could hold as ``crs``."""
    return {"type": "name", "properties": {"name": crs}}


def of_geojson(mini: Path, text: str, name: str = "sites.geojson") -> tuple[sites.Site, ...]:
    (mini / name).write_text(text, encoding="utf-8")
    return sites.candidate_sites(egvs.load(mini, [f'sites.file="{name}"']))


def of_lines(mini: Path, *rules: dict[str, Any]) -> tuple[sites.Site, ...]:
    tables = "".join(
        f"[[sites.along]]\nline_m = {rule['line']}\nspacing_m = {rule['spacing']}\nheights_m = {rule['heights']}\n"
        for rule in rules
    )
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('file = "sites.csv"\n', "yaw_deg = 15\n") + tables)
    return sites.candidate_sites(egvs.load(mini))


def places(found: tuple[sites.Site, ...]) -> list[tuple[str, float, float, float]]:
    return [(site.name, *site.pose.position_m) for site in found]


# --- GeoJSON ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sites.geojson", "sites.json", "SITES.GeoJSON"])
def test_geojson_says_the_same_as_csv(mini: Path, name: str) -> None:
    by_csv = sites.candidate_sites(egvs.load(mini))
    text = collection(point(10, 12, 3, name="pole_a"), point(30.5, -12, 3, name="pole_b"))
    assert of_geojson(mini, text, name) == by_csv
    assert places(by_csv) == [("pole_a", 10, 12, 3), ("pole_b", 30.5, -12, 3)]


def test_properties_of_a_feature_are_its_pose_sensor_and_scan(mini: Path) -> None:
    own = {"yaw_deg": 90, "pitch_deg": -7.5, "roll_deg": 1, "sensor": "VLP-16", "points": "measured.ply"}
    first, second = of_geojson(
        mini, collection(point(0, 1, 2, name="a", **own), point(3, 4, 5, name="b", yaw_deg=None))
    )
    assert first == sites.Site("a", sites.Pose(0, 1, 2, 90, -7.5, 1), "VLP-16", "measured.ply", "a")
    assert second == sites.Site("b", sites.Pose(3, 4, 5), "small", pole="b")


def test_a_height_may_be_a_property_and_a_name_a_number_as_in_csv(mini: Path) -> None:
    found = of_geojson(mini, collection(point(0, 1, z_m=2, name=5), point(0, 1, 3, z_m=3.0, site="b"),
                                        point(0, 1, 4, z_m=None, name="c")))  # fmt: skip
    assert places(found) == [("5", 0, 1, 2), ("b", 0, 1, 3), ("c", 0, 1, 4)]


@pytest.mark.parametrize("crs", [None, named("urn:ogc:def:crs:EPSG::25832"), named('LOCAL_CS["site",UNIT["metre",1]]')])
def test_a_crs_in_metres_is_taken(mini: Path, crs: object) -> None:
    text = json.dumps({"crs": crs, "features": [point(0, 1, 2, name="a")]})
    assert places(of_geojson(mini, text)) == [("a", 0, 1, 2)]


@pytest.mark.slow
def test_a_run_from_geojson_scores_what_a_run_from_csv_does(mini: Path, tmp_path: Path) -> None:
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
        (json.dumps({"features": [point(0, 0, 3, name="a")]}), r'sites\.geojson: .*no member "crs"'),
        *((collection(point(0, 0, 3, name="a"), wrong), "feature 1: expected a Feature with properties")
          for wrong in (None, 5, [], {"type": "Feature", "geometry": None}, feature({"type": "Point"}, name="b"),
                        feature({"type": "Point", "coordinates": None}, name="b"), point(0, name="b"),
                        feature({"type": "Point", "coordinates": "195"}, name="b"), point(0, 0, 3, 4, name="b"),
                        {**point(0, 0, 3), "properties": None})),
        (collection(point(0, "195", 3, name="a")), "feature 0: y_m: expected a number.*text '195'"),
        (collection(point(0, True, 3, name="a")), "feature 0: y_m: .*finite number.*True"),
        (collection(point(0, None, 3, name="a")), "feature 0: y_m is missing"),
        (collection(point(0, 0, 10**400, name="a")), "is not valid JSON: a number has too many digits"),
        (collection(point(0, 0, 3, name="a", z_m=4)), "feature 0: z_m: there are two values, 4 and 3"),
        (collection(point(0, 0, 3, name="a", site="b")), "feature 0: site: there are two values, 'b' and 'a'"),
        *((collection(point(0, 0, 3, **{"name": "a", key: value})), f"feature 0: {found}: expected a text")
          for key, found in (("name", "site"), ("sensor", "sensor"), ("points", "points"))
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
        *((collection(point(0, 0, 3, **{"name": "a", key: 90})), f"unknown column '{key}'. Did you mean yaw_deg[?]")
          for key in ("yaw", "Yaw_deg", "yaw_dge", "yaw_rad", "yawdeg")),
        (collection(point(0, 0, 3, name="a", pitch_deg=91)), "feature 0: pitch_deg.*91"),
        (collection(point(0, 0, 3, name="a", yaw_deg="north")), "feature 0: yaw_deg.*'north'"),
        (collection(point(0, 0, math.nan, name="a")), "feature 0: z_m.*nan"),
        (
            json.dumps({"crs": None, "features": [feature({"type": "Point", "coordinates": ["x", 0, 3]}, name="a")]}),
            "feature 0: x_m.*'x'",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_geojson_is_said(mini: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        of_geojson(mini, text)


def test_geojson_that_is_no_utf8_is_refused(mini: Path) -> None:
    (mini / "sites.geojson").write_bytes(b'{"features": "\xff"}')
    with pytest.raises(InputError, match="is not valid JSON"):
        sites.candidate_sites(egvs.load(mini, ['sites.file="sites.geojson"']))


# --- along lines ------------------------------------------------------------------------------------------------------


def test_sites_stand_along_a_line_and_round_its_corner(mini: Path) -> None:
    """25 m east, then north: the distance of 10 m is counted round the corner."""
    found = of_lines(mini, {"line": [[0, 5], [25, 5], [25, 20]], "spacing": 10, "heights": [4]})
    assert places(found) == [
        ("a01", 0, 5, 4),
        ("a02", 10, 5, 4),
        ("a03", 20, 5, 4),
        ("a04", 25, 10, 4),
        ("a05", 25, 20, 4),
    ]
    assert {(site.pose.yaw_deg, site.pose.pitch_deg, site.sensor, site.points) for site in found} == {
        (15, 0, "small", None)
    }


def test_each_place_has_all_heights_and_names_go_on_from_line_to_line(mini: Path) -> None:
    found = of_lines(
        mini,
        {"line": [[0, 0], [0, -3.5]], "spacing": 2, "heights": [3, 5]},
        {"line": [[7, 7], [8, 7]], "spacing": 2, "heights": [6]},
    )
    assert places(found) == [
        ("a01@3m", 0, 0, 3),
        ("a01@5m", 0, 0, 5),
        ("a02@3m", 0, -2, 3),
        ("a02@5m", 0, -2, 5),
        ("a03", 7, 7, 6),
    ]
    assert [site.pole for site in found] == ["a01", "a01", "a02", "a02", "a03"]


def test_the_end_of_a_line_has_a_site_though_tenths_do_not_add_up(mini: Path) -> None:
    found = of_lines(mini, {"line": [[0, 0], [0.3, 0], [0.7, 0]], "spacing": 0.1, "heights": [3]})
    assert len(found) == 8
    assert found[-1].pose.x_m == pytest.approx(0.7, abs=1e-12)


def test_many_sites_have_names_of_one_length(mini: Path) -> None:
    found = of_lines(mini, {"line": [[0, 0], [120, 0]], "spacing": 1, "heights": [3]})
    assert [found[i].name for i in (0, 9, 120)] == ["a001", "a010", "a121"]


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"line": [[0, 0]], "spacing": 1, "heights": [3]}, r"line_m"),
        ({"line": [[0, 0], [1, 0]], "spacing": 0, "heights": [3]}, "spacing_m"),
        ({"line": [[0, 0], [1, 0]], "spacing": 1, "heights": []}, "heights_m"),
        ({"line": [[0, 0], [1, 0, 2]], "spacing": 1, "heights": [3]}, "line_m"),
    ],
)
def test_senseless_lines_are_refused(mini: Path, rule: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        of_lines(mini, rule)


def test_a_line_beside_a_file_is_refused(mini: Path) -> None:
    path = mini / "scenario.toml"
    path.write_text(path.read_text() + "[[sites.along]]\nline_m = [[0, 0], [1, 0]]\nspacing_m = 1\nheights_m = [3]\n")
    with pytest.raises(InputError, match="expected exactly one of file, grid and along, got file and along"):
        egvs.load(mini)


# --- too many ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "grid={low_m=[0,0],high_m=[100,100],spacing_m=1e-6,heights_m=[3]}",
            r"sites\.grid: there are more than .*spacing_m = 1e-06",
        ),
        (
            "grid={low_m=[0,0],high_m=[1,1],spacing_m=1e-308,heights_m=[3]}",
            r"sites\.grid: there are more than .*spacing_m = 1e-308",
        ),
        (
            "grid={low_m=[0,0],high_m=[400,400],spacing_m=1,heights_m=[3]}",
            r"sites\.grid: there are more than 100,000 candidates",
        ),
        (
            "along=[{line_m=[[0,0],[100,0]],spacing_m=1e-7,heights_m=[3]}]",
            r"sites\.along: there are more than .*a wider spacing",
        ),
    ],
)
def test_a_rule_of_too_many_places_is_refused_at_once(mini: Path, setting: str, message: str) -> None:
    key, _, rule = setting.partition("=")
    with pytest.raises(InputError, match=message):
        sites.candidate_sites(egvs.load(mini, [f"sites.{key}={rule}"]))


def test_too_many_combinations_are_refused(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_SITES", "5")
    rule = "sites.grid={low_m=[0,0],high_m=[1,0],spacing_m=1,heights_m=[3,4,5]}"
    with pytest.raises(
        InputError, match=r"more than 5 candidates \(each combination of location, height and pitch is one\)"
    ):
        sites.candidate_sites(egvs.load(mini, [rule]))
