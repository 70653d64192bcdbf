"""Sensors that are aimed, places with several heights and pitches: angles that a hand can check, names, refusals."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.core.errors import InputError
from egvs.scenario.loading import scenario_from_dict
from egvs.sensors import sensor, sites
from egvs.sensors.sensor import CATALOGUE, Sensor, rotation_world_sensor
from egvs.studies import measurement
from tests.conftest import collection, feature


def of(mini: Path, rows: str = "", **sites_keys: str) -> tuple[sites.Site, ...]:
    """The candidates of the small scenario with these rows of ``sites.csv`` and these keys of ``[sites]``."""
    if rows:
        (mini / "sites.csv").write_text(rows)
    return sites.candidate_sites(egvs.load(mini, [f"sites.{key}={value}" for key, value in sites_keys.items()]))


def angles(found: tuple[sites.Site, ...]) -> list[tuple[str, float, float, float]]:
    return [(site.name, site.pose.z_m, site.pose.yaw_deg, site.pose.pitch_deg) for site in found]


ROW = "site,x_m,y_m,z_m\np,0,0,6\n"


# --- where an aimed sensor points -------------------------------------------------------------------------------------


def test_a_vlp_32c_is_tilted_by_the_targets_elevation_less_that_of_its_middle(mini: Path) -> None:
    """Its rings go from -25 to 15 degrees: the middle is -5. From 6 m up, a point on the ground 10 m ahead lies
    atan(6 / 10) = 30.963757 degrees below level, so the nose goes down by 25.963757."""
    assert CATALOGUE["VLP-32C"].middle_deg == (-5.0, 0.0)
    (site,) = of(mini, ROW, sensor="VLP-32C", aim_m="[10, 0, 0]")
    assert angles((site,)) == [("p", 6, 0, -25.963757)]


@pytest.mark.parametrize(
    ("target", "yaw_deg", "pitch_deg"),
    [
        ([0, 6, 0], 90, -45 + 5),
        ([-6, 0, 0], 180, -45 + 5),
        ([0, -6, 12], -90, 45 + 5),
        ([3, 3, 6], 45, 0 + 5),
        ([6 * math.sqrt(3), 0, 0], 0, -30 + 5),
    ],
)
def test_targets_that_a_hand_can_check(target: list[float], yaw_deg: float, pitch_deg: float) -> None:
    """The sensor of the small scenario has rings from -15 to 5 degrees, so the VLP-32C's middle, -5."""
    sensor = Sensor("s", (-15.0, 5.0), (0.0, 0.0), 4, 100.0, "")
    x, y, z = target
    assert sites.aiming_angles("here", (0, 0, 6), (x, y, z), 0.0, sensor) == (yaw_deg, pitch_deg)


@given(
    st.tuples(*[st.floats(-60, 60)] * 3),
    st.floats(-30, 30),
    st.one_of(st.floats(-40, 40), st.floats(140, 220)),
    st.floats(-30, 30),
)  # to, elevation, azimuth, roll
def test_the_middle_ray_meets_the_point(
    to_m: tuple[float, float, float], elevation: float, azimuth: float, roll_deg: float
) -> None:
    """Held against the matrix that turns beams: whatever the middle ray and the roll, it meets the point."""
    at_m = 3.0, -2.0, 5.0
    ray = np.array([
        math.cos(math.radians(elevation)) * math.cos(math.radians(azimuth)),
        math.cos(math.radians(elevation)) * math.sin(math.radians(azimuth)),
        math.sin(math.radians(elevation)),
    ])  # fmt: skip

    class Looking(Sensor):
        @property
        def middle_deg(self) -> tuple[float, float]:
            return elevation, azimuth

    sensor = Looking("s", (elevation,), (0.0,), 1, 100.0, "")
    way = np.subtract(to_m, at_m)
    try:
        yaw_deg, pitch_deg = sites.aiming_angles("here", at_m, to_m, roll_deg, sensor)
    except InputError:
        flat = math.hypot(way[0], way[1]) / max(float(np.linalg.norm(way)), 1e-9)
        assert flat < 0.9  # steep ones alone are out of reach of a pitch between -90 and 90
        return
    pointed = rotation_world_sensor(yaw_deg, pitch_deg, roll_deg) @ ray
    assert np.cross(pointed, way / np.linalg.norm(way)) == pytest.approx(np.zeros(3), abs=1e-7)
    assert pointed @ way > 0


def test_a_window_that_looks_backwards_is_turned_round() -> None:
    """Its middle ray has azimuth 180: the point to the east is met with the nose to the west. It lies 45 degrees below
    level, so the back goes down, and the nose up."""
    back = Sensor("back", (-10.0, 10.0), (0.0, 0.0), 61, 100.0, "", azimuth_deg=(150.0, 210.0))
    assert sites.aiming_angles("here", (0, 0, 6), (6, 0, 0), 0.0, back) == (180.0, 45.0)
    aside = Sensor("aside", (0.0,), (0.0,), 61, 100.0, "", azimuth_deg=(90.0, 150.0))
    assert sites.aiming_angles("here", (0, 0, 6), (6, 0, 6), 0.0, aside) == (-120.0, 0.0)


def test_aim_roi_is_the_middle_of_the_region(mini: Path) -> None:
    """The region's middle is (20, 0, 2.5); a height that an aim does not name is the same."""
    by_name, by_point, by_columns, by_column = (
        of(mini, "site,x_m,y_m,z_m\np,0,0,6\n", aim="roi"),
        of(mini, "site,x_m,y_m,z_m\np,0,0,6\n", aim_m="[20, 0]"),
        of(mini, "site,x_m,y_m,z_m,aim_x_m,aim_y_m\np,0,0,6,20,0\n"),
        of(mini, "site,x_m,y_m,z_m,aim\np,0,0,6,roi\n"),
    )
    pitch_deg = round(math.degrees(math.atan2(-3.5, 20)) + 5, 6)
    assert by_name == by_point == by_columns == by_column
    assert angles(by_name) == [("p", 6, 0, pitch_deg)]


def test_geojson_aims_too_and_rows_go_their_own_way(mini: Path) -> None:
    """A row's own yaw or aim goes before that of [sites], as everything of its own does."""
    (mini / "sites.geojson").write_text(
        collection(
            feature({"type": "Point", "coordinates": [0, 0, 6]}, name="aimed", aim_x_m=0, aim_y_m=6, aim_z_m=0),
            feature({"type": "Point", "coordinates": [0, 0, 6]}, name="turned", yaw_deg=30),
            feature({"type": "Point", "coordinates": [0, 0, 6]}, name="tilted", pitch_deg=-7),
        )
    )
    found = of(mini, file='"sites.geojson"', aim_m="[10, 0, 0]")
    assert angles(found) == [
        ("aimed", 6, 90, -40),
        ("turned", 6, 30, 0),
        ("tilted", 6, 0, -7),
    ]


# --- every combination is a candidate ---------------------------------------------------------------------------------


def test_heights_and_pitches_of_a_file_are_all_tried(mini: Path) -> None:
    found = of(mini, "site,x_m,y_m\nc01,0,0\nc02,0,9\n", heights_m="[3, 4.5]", pitch_deg='[0, -10, "aim"]', aim="roi")
    assert [site.name for site in found[:6]] == [
        "c01@3m+0deg", "c01@3m-10deg", "c01@3m+aim", "c01@4.5m+0deg", "c01@4.5m-10deg", "c01@4.5m+aim",
    ]  # fmt: skip
    assert [site.pole for site in found] == ["c01"] * 6 + ["c02"] * 6
    assert {site.pose.yaw_deg for site in found[:6]} == {0}  # the aim turns those that it does not tilt as well
    assert [site.pose.pitch_deg for site in found[:2]] == [0, -10]
    assert found[5].pose.pitch_deg == round(math.degrees(math.atan2(-2, 20)) + 5, 6)


def test_a_name_says_only_what_differs(mini: Path) -> None:
    rows = "site,x_m,y_m,z_m\nc01,0,0,5\n"
    assert [s.name for s in of(mini, rows, pitch_deg="[0, -10, 2.5]")] == ["c01@0deg", "c01@-10deg", "c01@2.5deg"]
    assert [s.name for s in of(mini, rows, pitch_deg='["aim", -10]', aim="roi")] == ["c01@aim", "c01@-10deg"]
    assert [s.name for s in of(mini, rows, pitch_deg="-10")] == ["c01"]


def test_rules_take_pitches_and_aims(mini: Path) -> None:
    path = mini / "scenario.toml"
    rule = 'aim = "roi"\npitch_deg = ["aim", 0]\n[sites.grid]\nlow_m = [0, 0]\nhigh_m = [0, 0]\nspacing_m = 1\n'
    path.write_text(path.read_text().replace('file = "sites.csv"\n', "").replace(
        'sensor = "small"\n', f'sensor = "small"\n{rule}heights_m = [4, 6]\n'))  # fmt: skip
    found = sites.candidate_sites(egvs.load(mini))
    assert [site.name for site in found] == ["g01@4m+aim", "g01@4m+0deg", "g01@6m+aim", "g01@6m+0deg"]


def test_what_a_run_records_gives_the_same_candidates(mini: Path) -> None:
    """As `verify` reads it: every key is there, those that nobody gave as well."""
    (mini / "sites.csv").write_text("site,x_m,y_m\nc01,10,12\nc02,30.5,-12\n")
    scenario = egvs.load(mini, ["sites.heights_m=[3, 4.5]", 'sites.pitch_deg=["aim", 0]', "sites.aim_m=[1, 2]"])
    recorded = json.loads(json.dumps(scenario.model_dump(mode="json")))
    assert sites.candidate_sites(scenario_from_dict(recorded, mini, "run.json")) == sites.candidate_sites(scenario)


def test_rows_at_one_place_share_a_pole(mini: Path) -> None:
    found = of(mini, "site,x_m,y_m,z_m\nlow,0,0,3\nhigh,0,0,5\nelse,0.5,0,3\n")
    assert [site.pole for site in found] == ["low", "low", "else"]


def test_a_run_ranks_them_and_groups_them_by_pole(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    (mini / "sites.csv").write_text("site,x_m,y_m\nc01,10,12\nc02,30.5,-12\n")
    wanted = ["sites.heights_m=[3, 4.5]", 'sites.pitch_deg=[0, "aim"]', "sites.aim=roi", "score.standard_error=false"]
    code, out, _ = run_egvs("run", mini, "--out", tmp_path / "run", *(part for w in wanted for part in ("--set", w)))
    assert code == 0
    scores = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pylist()
    assert [row["pole"] for row in scores] == ["c01"] * 4 + ["c02"] * 4
    best = {pole: max((r for r in scores if r["pole"] == pole), key=lambda r: r["egvs"]) for pole in ("c01", "c02")}
    table = out[out.index("best candidate of each pole") :]
    html = (tmp_path / "run" / "report.html").read_text()
    section = html[html.index("The best at each pole") :]
    for pole, row in best.items():
        assert f"{pole}  " in table
        assert row["site"] in table.split("\n\n")[0]
        assert f'<th scope="row">{pole}</th><td>{row["site"]}</td>' in section


def test_single_candidates_need_no_table_of_poles(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    _, out, _ = run_egvs("run", mini, "--out", tmp_path / "run")
    assert "best candidate of each pole" not in out
    assert "The best at each pole" not in (tmp_path / "run" / "report.html").read_text()


def test_a_study_tries_the_first_candidate_alone(mini: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m\nc01,10,12\nc02,30.5,-12\n")
    scenario = egvs.load(mini, ["sites.heights_m=[3, 4.5]", 'sites.pitch_deg=["aim", 0]', "sites.aim=roi"])
    first, (alone,) = sites.candidate_sites(scenario)[0], sites.candidate_sites(measurement.with_one_site(scenario))
    assert alone.pose == first.pose


# --- what is refused --------------------------------------------------------------------------------------------------

PLACE = "site,x_m,y_m\np,0,0\n"


@pytest.mark.parametrize(
    ("rows", "keys", "message"),
    [
        (PLACE, {}, r"row p: z_m is missing.*site, x_m, y_m, z_m"),
        (ROW, {"heights_m": "[3, 4]"}, r"sites\.heights_m: .*no effect on any site.*z_m from the rows of sites"),
        (
            "site,x_m,y_m,z_m,yaw_deg\np,0,0,6,0\n",
            {"aim": "roi"},
            r"sites\.aim: .*no effect on any site.*yaw_deg or aim from",
        ),
        ("site,x_m,y_m,z_m,pitch_deg\np,0,0,6,0\n", {"pitch_deg": "-10"}, r"sites\.pitch_deg: .*no effect on any site"),
        (ROW, {"pitch_deg": '"aim"'}, r"row p: pitch_deg: .*'aim', but there is no aim.*aim = \"roi\", or aim_m"),
        (
            "site,x_m,y_m,z_m,yaw_deg\np,0,0,6,30\n",
            {"aim": "roi", "pitch_deg": '"aim"'},
            r"row p: pitch_deg: .*'aim', but .*yaw_deg, 30",
        ),
        (ROW, {"aim_m": "[0, 0, 1]"}, r"row p: aim: \(0, 0, 1\) is straight above or below the sensor"),
        (ROW, {"aim": "roi", "sensor": "VLP-33"}, r"row p: sensor: unknown sensor 'VLP-33'. Did you mean VLP-32C"),
        ("site,x_m,y_m,z_m,aim_x_m\np,0,0,6,5\n", {}, r"row p: aim: one of aim_x_m and aim_y_m is missing"),
        ("site,x_m,y_m,z_m,aim\np,0,0,6,ROI\n", {}, r"row p: aim: .*'roi', got 'ROI'.*aim_x_m and aim_y_m"),
        ("site,x_m,y_m,z_m,aim,aim_x_m\np,0,0,6,roi,3\n", {}, r"row p: aim: .*'roi' and at a point"),
        ("site,x_m,y_m,z_m,aim_x_m,aim_y_m\np,0,0,6,5,north\n", {}, r"row p: aim_y_m: .*finite number.*'north'"),
        ("site,x_m,y_m,z_m,yaw_deg,aim_x_m,aim_y_m\np,0,0,6,9,5,5\n", {}, r"row p: yaw_deg: .*yaw_deg = 9 and an aim"),
        (
            "site,x_m,y_m,z_m,points\np,0,0,6,a.ply\n",
            {"pitch_deg": "[0, -10]"},
            r"row p: points: .*one measured scan for 2 mounts",
        ),
        (
            "site,x_m,y_m,z_m,pitch_deg\np,0,0,6,\np@0deg,1,1,5,3\n",
            {"pitch_deg": "[0, -9]"},
            r"two sites 'p@0deg'",
        ),
    ],
)
def test_what_is_wrong_with_an_aim_is_said(mini: Path, rows: str, keys: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        of(mini, rows, **keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"aim": "junction"}, r"sites\.aim: 'junction'.*'roi'"),
        ({"aim_m": "[1]"}, r"sites\.aim_m"),
        ({"pitch_deg": "[]"}, r"pitch_deg = \[\] leaves no candidate"),
        ({"pitch_deg": "[0, 0]"}, "names a value twice"),
        ({"pitch_deg": "[-91]"}, r"sites\.pitch_deg"),
        ({"heights_m": "[3, 3]"}, "names a value twice"),
        ({"heights_m": "[-3]"}, r"sites\.heights_m"),
    ],
)
def test_senseless_keys_are_refused(mini: Path, keys: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        of(mini, **keys)


@pytest.mark.parametrize(("other", "found"), [("aim_m = [1, 2]", "aim and aim_m"), ("yaw_deg = 0", "aim and yaw_deg")])
def test_two_directions_at_once_are_refused(mini: Path, other: str, found: str) -> None:
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"\n', f'sensor = "small"\naim = "roi"\n{other}\n'))
    with pytest.raises(InputError, match=f"at most one of aim, aim_m and yaw_deg can hold, found {found}"):
        egvs.load(mini)


def test_a_new_direction_takes_the_place_of_the_old_one(mini: Path) -> None:
    """As a new source does: in --set, and in a scenario that extends another."""
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"\n', 'sensor = "small"\naim = "roi"\nheights_m = [3]\n'))
    (mini / "sites.csv").write_text("site,x_m,y_m\np,0,0\n")
    assert of(mini, aim_m="[0, 9]")[0].pose.yaw_deg == 90
    assert angles(of(mini, yaw_deg="30")) == [("p", 3, 30, 0)]
    heir = mini.parent / "heir"
    heir.mkdir()
    rule = "[sites.grid]\nlow_m = [0, 0]\nhigh_m = [0, 0]\nspacing_m = 1\nheights_m = [5]\n"
    (heir / "scenario.toml").write_text(f'extends = "../mini"\n[sites]\nyaw_deg = -45\n{rule}')
    assert angles(sites.candidate_sites(egvs.load(heir))) == [("g01", 5, -45, 0)]


def test_heights_beside_a_rule_are_refused(mini: Path) -> None:
    path = mini / "scenario.toml"
    rule = "heights_m = [3]\n[[sites.along]]\nline_m = [[0, 0], [1, 0]]\nspacing_m = 1\nheights_m = [3]\n"
    path.write_text(path.read_text().replace('file = "sites.csv"\n', "").replace(
        'sensor = "small"\n', f'sensor = "small"\n{rule}'))  # fmt: skip
    with pytest.raises(InputError, match="heights_m is for places in a file: along has heights_m of its own"):
        egvs.load(mini)


def test_a_ray_that_cannot_be_turned_so_far_is_refused() -> None:
    up = Sensor("up", (30.0,), (0.0,), 1, 100.0, "")
    with pytest.raises(InputError, match=r"up cannot be tilted so that its middle ray meets \(0.1, 0, 0\)"):
        sites.aiming_angles("here", (0, 0, 6), (0.1, 0, 0), 0.0, up)
    assert sensor.CATALOGUE["OS1-128"].middle_deg == (0.0, 0.0)
