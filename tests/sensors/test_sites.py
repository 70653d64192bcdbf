"""Candidate sites: rules, mounts, aiming."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

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
from tests.sensors.helpers import angles_of, site_positions, sites_from

ROW = "site,x_m,y_m,z_m\np,0,0,6\n"


# --- where an aimed sensor points -------------------------------------------------------------------------------------
def test_vlp_32c_is_tilted_by_the_elevation_of_the_target(mini: Path) -> None:
    """Its rings go from -25 to 15 degrees: the middle is -5. From 6 m up, a point on the ground 10 m ahead lies
    atan(6 / 10) = 30.963757 degrees below level, so the nose goes down by 25.963757."""
    assert CATALOGUE["VLP-32C"].middle_deg == (-5.0, 0.0)
    (site,) = sites_from(mini, ROW, sensor="VLP-32C", aim_m="[10, 0, 0]")
    assert angles_of((site,)) == [("p", 6, 0, -25.963757)]


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
def test_aiming_angles_equal_hand_computed_ones(target: list[float], yaw_deg: float, pitch_deg: float) -> None:
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
def test_middle_ray_meets_the_target(
    to_m: tuple[float, float, float], elevation: float, azimuth: float, roll_deg: float
) -> None:
    """Compared with the rotation matrix, for any middle ray and roll."""
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


def test_sensor_facing_backwards_is_turned_around() -> None:
    """Its middle ray has azimuth 180: the point to the east is met with the nose to the west. It lies 45 degrees below
    level, so the back goes down, and the nose up."""
    back = Sensor("back", (-10.0, 10.0), (0.0, 0.0), 61, 100.0, "", azimuth_deg=(150.0, 210.0))
    assert sites.aiming_angles("here", (0, 0, 6), (6, 0, 0), 0.0, back) == (180.0, 45.0)
    temp_path = Sensor("aside", (0.0,), (0.0,), 61, 100.0, "", azimuth_deg=(90.0, 150.0))
    assert sites.aiming_angles("here", (0, 0, 6), (6, 0, 6), 0.0, temp_path) == (-120.0, 0.0)


def test_aim_roi_is_the_centre_of_the_region(mini: Path) -> None:
    """The region's middle is (20, 0, 2.5); a height that an aim does not name is the same."""
    by_name, by_point, by_columns, by_column = (
        sites_from(mini, "site,x_m,y_m,z_m\np,0,0,6\n", aim="roi"),
        sites_from(mini, "site,x_m,y_m,z_m\np,0,0,6\n", aim_m="[20, 0]"),
        sites_from(mini, "site,x_m,y_m,z_m,aim_x_m,aim_y_m\np,0,0,6,20,0\n"),
        sites_from(mini, "site,x_m,y_m,z_m,aim\np,0,0,6,roi\n"),
    )
    pitch_deg = round(math.degrees(math.atan2(-3.5, 20)) + 5, 6)
    assert by_name == by_point == by_columns == by_column
    assert angles_of(by_name) == [("p", 6, 0, pitch_deg)]


# --- every combination is a candidate ---------------------------------------------------------------------------------
def test_all_heights_and_pitches_of_a_file_are_candidates(mini: Path) -> None:
    result = sites_from(
        mini, "site,x_m,y_m\nc01,0,0\nc02,0,9\n", heights_m="[3, 4.5]", pitch_deg='[0, -10, "aim"]', aim="roi"
    )
    assert [site.name for site in result[:6]] == [
        "c01@3m+0deg", "c01@3m-10deg", "c01@3m+aim", "c01@4.5m+0deg", "c01@4.5m-10deg", "c01@4.5m+aim",
    ]  # fmt: skip
    assert [site.pole for site in result] == ["c01"] * 6 + ["c02"] * 6
    assert {site.pose.yaw_deg for site in result[:6]} == {0}  # the aim turns those that it does not tilt as well
    assert [site.pose.pitch_deg for site in result[:2]] == [0, -10]
    assert result[5].pose.pitch_deg == round(math.degrees(math.atan2(-2, 20)) + 5, 6)


def test_name_has_only_the_values_that_vary(mini: Path) -> None:
    rows = "site,x_m,y_m,z_m\nc01,0,0,5\n"
    assert [s.name for s in sites_from(mini, rows, pitch_deg="[0, -10, 2.5]")] == [
        "c01@0deg",
        "c01@-10deg",
        "c01@2.5deg",
    ]
    assert [s.name for s in sites_from(mini, rows, pitch_deg='["aim", -10]', aim="roi")] == ["c01@aim", "c01@-10deg"]
    assert [s.name for s in sites_from(mini, rows, pitch_deg="-10")] == ["c01"]


def test_rules_accept_pitches_and_aims(mini: Path) -> None:
    path = mini / "scenario.toml"
    rule = 'aim = "roi"\npitch_deg = ["aim", 0]\n[sites.grid]\nlow_m = [0, 0]\nhigh_m = [0, 0]\nspacing_m = 1\n'
    path.write_text(path.read_text().replace('file = "sites.csv"\n', "").replace(
        'sensor = "small"\n', f'sensor = "small"\n{rule}heights_m = [4, 6]\n'))  # fmt: skip
    result = sites.candidate_sites(egvs.load(mini))
    assert [site.name for site in result] == ["g01@4m+aim", "g01@4m+0deg", "g01@6m+aim", "g01@6m+0deg"]


def test_recorded_scenario_gives_the_same_candidates(mini: Path) -> None:
    """As `verify` reads it: with all keys, including defaults."""
    (mini / "sites.csv").write_text("site,x_m,y_m\nc01,10,12\nc02,30.5,-12\n")
    scenario = egvs.load(mini, ["sites.heights_m=[3, 4.5]", 'sites.pitch_deg=["aim", 0]', "sites.aim_m=[1, 2]"])
    recorded = json.loads(json.dumps(scenario.model_dump(mode="json")))
    assert sites.candidate_sites(scenario_from_dict(recorded, mini, "run.json")) == sites.candidate_sites(scenario)


def test_rows_at_one_position_share_a_pole(mini: Path) -> None:
    result = sites_from(mini, "site,x_m,y_m,z_m\nlow,0,0,3\nhigh,0,0,5\nelse,0.5,0,3\n")
    assert [site.pole for site in result] == ["low", "low", "else"]


@pytest.mark.slow
def test_run_ranks_candidates_and_groups_them_by_pole(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    (mini / "sites.csv").write_text("site,x_m,y_m\nc01,10,12\nc02,30.5,-12\n")
    expected = ["sites.heights_m=[3, 4.5]", 'sites.pitch_deg=[0, "aim"]', "sites.aim=roi", "score.standard_error=false"]
    words = [mini, "--out", tmp_path / "run", *(part for w in expected for part in ("--set", w))]
    code, out, _ = run_egvs("run", *words, "--verbose")
    assert code == 0
    scores = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pylist()
    assert [row["pole"] for row in scores] == ["c01"] * 4 + ["c02"] * 4
    assert "best candidate on each pole" in run_egvs("score", *words)[1]
    _, all_printed, _ = run_egvs("run", *words, "--all")
    assert "best candidate on each pole" not in all_printed  # the answer lists all poles
    assert sum(line.split()[1:2] == ["c02"] for line in all_printed.splitlines()) == 1
    best = {pole: max((r for r in scores if r["pole"] == pole), key=lambda r: r["egvs"]) for pole in ("c01", "c02")}
    rows = [line.split() for line in out.splitlines()]
    html = (tmp_path / "run" / "report.html").read_text()
    section = html[html.index("The best site on each pole") :]
    for pole, row in best.items():
        assert [pole, row["site"]] in [words[1:3] for words in rows]
        assert f'<th scope="row">{pole}</th><td>{row["site"]}</td>' in section


@pytest.mark.slow
def test_no_table_of_poles_with_one_candidate_each(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    _, out, _ = run_egvs("run", mini, "--out", tmp_path / "run", "--all")
    assert "best candidate on each pole" not in out
    assert "The best site on each pole" not in (tmp_path / "run" / "report.html").read_text()


def test_study_uses_the_first_candidate(mini: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m\nc01,10,12\nc02,30.5,-12\n")
    scenario = egvs.load(mini, ["sites.heights_m=[3, 4.5]", 'sites.pitch_deg=["aim", 0]', "sites.aim=roi"])
    first, (alone,) = sites.candidate_sites(scenario)[0], sites.candidate_sites(measurement.with_one_site(scenario))
    assert alone.pose == first.pose


# --- errors
PLACE = "site,x_m,y_m\np,0,0\n"


@pytest.mark.parametrize(
    ("rows", "keys", "message"),
    [
        (PLACE, {}, r"line 2 \(p\): z_m is missing.*site, x_m, y_m, z_m"),
        (ROW, {"heights_m": "[3, 4]"}, r"sites\.heights_m: .*no effect on any site.*z_m from the rows of sites"),
        (
            "site,x_m,y_m,z_m,yaw_deg\np,0,0,6,0\n",
            {"aim": "roi"},
            r"sites\.aim: .*no effect on any site.*yaw_deg or aim from",
        ),
        ("site,x_m,y_m,z_m,pitch_deg\np,0,0,6,0\n", {"pitch_deg": "-10"}, r"sites\.pitch_deg: .*no effect on any site"),
        (
            "site,x_m,y_m,z_m,yaw_deg\np,0,0,6,0\n",
            {"yaw_deg": "0"},
            r"sites\.yaw_deg: .*no effect on any site: each row of sites\.csv has its own yaw_deg or aim",
        ),
        ("site,x_m,y_m,z_m,roll_deg\np,0,0,6,0\n", {"roll_deg": "0"}, r"sites\.roll_deg: .*no effect on any site"),
        ("site,x_m,y_m,z_m,mount\np,0,0,6,upright\n", {"mount": '"inverted"'}, r"sites\.mount: .*no effect on any"),
        ("site,x_m,y_m,z_m,mount\np,0,0,6,hanging\n", {}, r"\(p\): mount: expected upright or inverted, got 'hanging'"),
        (
            "site,x_m,y_m,z_m,sensor\np,0,0,6,VLP-16\n",
            {"sensor": "OS1-128"},
            r"sites\.sensor: .*no effect on any site: each row of sites\.csv has its own sensor\. "
            r"Use sites\.replace_sensor=OS1-128 to replace them",
        ),
        ("site,x_m,y_m,z_m,sensor\np,0,0,6,VLP-16\n", {"sensor": "OS1-129"}, r"sites\.sensor: .*no effect on any site"),
        (
            ROW,
            {"pitch_deg": '"aim"'},
            r"line 2 \(p\): pitch_deg: .*'aim', but there is no aim.*aim = \"roi\", or aim_m",
        ),
        (
            "site,x_m,y_m,z_m,yaw_deg\np,0,0,6,30\n",
            {"aim": "roi", "pitch_deg": '"aim"'},
            r"line 2 \(p\): pitch_deg: .*'aim', but .*yaw_deg, 30",
        ),
        (ROW, {"aim_m": "[0, 0, 1]"}, r"line 2 \(p\): aim: \(0, 0, 1\) is directly above or below the sensor"),
        (
            ROW,
            {"aim": "roi", "sensor": "VLP-33"},
            r"^--set: sites.sensor: unknown sensor 'VLP-33'. Did you mean VLP-32C",
        ),
        ("site,x_m,y_m,z_m,aim_x_m\np,0,0,6,5\n", {}, r"line 2 \(p\): aim: one of aim_x_m and aim_y_m is missing"),
        ("site,x_m,y_m,z_m,aim\np,0,0,6,ROI\n", {}, r"line 2 \(p\): aim: .*'roi', got 'ROI'.*aim_x_m and aim_y_m"),
        ("site,x_m,y_m,z_m,aim,aim_x_m\np,0,0,6,roi,3\n", {}, r"line 2 \(p\): aim: .*'roi' and at a point"),
        ("site,x_m,y_m,z_m,aim_x_m,aim_y_m\np,0,0,6,5,north\n", {}, r"line 2 \(p\): aim_y_m: .*finite number.*'north'"),
        (
            "site,x_m,y_m,z_m,yaw_deg,aim_x_m,aim_y_m\np,0,0,6,9,5,5\n",
            {},
            r"line 2 \(p\): yaw_deg: .* = 9 and an aim",
        ),
        (
            "site,x_m,y_m,z_m,points\np,0,0,6,a.ply\n",
            {"pitch_deg": "[0, -10]"},
            r"line 2 \(p\): points: .*one measured scan is given for 2 mounts",
        ),
        (
            "site,x_m,y_m,z_m,pitch_deg\np,0,0,6,\np@0deg,1,1,5,3\n",
            {"pitch_deg": "[0, -9]"},
            r"two sites 'p@0deg'",
        ),
    ],
)
def test_rejects_invalid_aim(mini: Path, rows: str, keys: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        sites_from(mini, rows, **keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"aim": "junction"}, r"sites\.aim: expected 'roi', got 'junction'"),
        ({"aim_m": "[1]"}, r"sites\.aim_m"),
        ({"pitch_deg": "[]"}, r"pitch_deg = \[\] leaves no candidate"),
        ({"pitch_deg": "[0, 0]"}, "contains a value twice"),
        ({"pitch_deg": "[-91]"}, r"sites\.pitch_deg"),
        ({"heights_m": "[3, 3]"}, "contains a value twice"),
        ({"heights_m": "[-3]"}, r"sites\.heights_m"),
    ],
)
def test_rejects_invalid_mount_keys(mini: Path, keys: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        sites_from(mini, **keys)


MIXED_SENSORS = "site,x_m,y_m,z_m,sensor\na,0,0,6,VLP-16\nb,9,0,6,\n"


def test_accepts_sensor_that_the_rows_name_too(mini: Path) -> None:
    rows = "site,x_m,y_m,z_m,sensor\na,0,0,6,VLP-16\n"
    assert [site.sensor for site in sites_from(mini, rows, sensor="VLP-16")] == ["VLP-16"]


def test_each_sensor_of_a_list_is_a_candidate_of_rows_without_their_own(mini: Path) -> None:
    result = sites_from(mini, MIXED_SENSORS, sensor='["VLP-32C", "AT128"]', pitch_deg="[0, -5]")
    assert [(site.name, site.sensor, site.pole) for site in result] == [
        ("a@0deg", "VLP-16", "a"), ("a@-5deg", "VLP-16", "a"),
        ("b@0deg+VLP-32C", "VLP-32C", "b"), ("b@-5deg+VLP-32C", "VLP-32C", "b"),
        ("b@0deg+AT128", "AT128", "b"), ("b@-5deg+AT128", "AT128", "b"),
    ]  # fmt: skip
    result = sites_from(mini, MIXED_SENSORS, sensor='["VLP-32C", "AT128"]')
    assert [site.name for site in result] == ["a", "b@VLP-32C", "b@AT128"]
    aimed = sites_from(mini, sensor='["VLP-32C", "small"]', aim="roi")
    one_by_one = [sites_from(mini, sensor=name, aim="roi") for name in ("VLP-32C", "small")]
    assert [site.pose for site in aimed if site.pole == "b"] == [each[1].pose for each in one_by_one]
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"', 'sensor = ["VLP-32C", "AT128"]'))
    replaced = sites_from(mini, replace_sensor="small")
    assert [(site.name, site.sensor) for site in replaced] == [("a", "small"), ("b", "small")]


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ('["VLP-16", "VLP-16"]', "contains a value twice"),
        ("[]", "sites.sensor"),
        ('["VLP-16", "VLP-99"]', r"sites\.sensor: unknown sensor 'VLP-99'"),
    ],
)
def test_rejects_lists_of_sensors(mini: Path, sensor: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        sites_from(mini, sensor=sensor, aim="roi")


def test_rows_of_one_pole_with_several_sensors_lead_to_the_list(mini: Path) -> None:
    rows = "site,x_m,y_m,z_m,sensor\na,0,0,6,VLP-16\na,0,0,6,AT128\n"
    with pytest.raises(InputError, match=r'use one row, and sites\.sensor = \["VLP-16", "AT128"\]'):
        sites_from(mini, rows)


def test_measured_scan_is_of_one_sensor(mini: Path) -> None:
    rows = "site,x_m,y_m,z_m,points\na,0,0,6,scan.csv\n"
    with pytest.raises(InputError, match="one measured scan is given for 2 mounts"):
        sites_from(mini, rows, sensor='["VLP-16", "AT128"]')


def test_replace_sensor_applies_to_rows_that_name_another_sensor(mini: Path) -> None:
    assert [site.sensor for site in sites_from(mini, MIXED_SENSORS)] == ["VLP-16", "small"]
    assert [site.sensor for site in sites_from(mini, MIXED_SENSORS, sensor="AT128")] == ["VLP-16", "AT128"]
    assert [site.sensor for site in sites_from(mini, MIXED_SENSORS, replace_sensor="AT128")] == ["AT128", "AT128"]


def test_rejects_replace_sensor_beside_sensor_in_one_file(mini: Path) -> None:
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"', 'sensor = "small"\nreplace_sensor = "AT128"'))
    with pytest.raises(InputError, match=r"sites\.sensor: the key has no effect .*: replace_sensor sets"):
        sites_from(mini)
    assert {site.sensor for site in sites_from(mini, sensor="VLP-16")} == {"VLP-16"}  # the override replaces both


def test_scenario_without_replace_sensor_is_recorded_without_it(mini: Path) -> None:
    """So that cache keys and the metadata of artefacts stay what they were."""
    assert "replace_sensor" not in egvs.load(mini).model_dump(mode="json")["sites"]
    replaced = egvs.load(mini, ["sites.replace_sensor=AT128"]).model_dump(mode="json")
    assert replaced["sites"]["replace_sensor"] == "AT128"


def test_recorded_scenario_may_have_sensor_and_roll_that_rows_override(mini: Path) -> None:
    """``run.json`` has all keys, including defaults without effect."""
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,roll_deg,sensor\na,0,0,6,1,VLP-16\n")
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"\n', ""))
    scenario = egvs.load(mini)
    recorded = json.loads(json.dumps(scenario.model_dump(mode="json")))
    assert sites.candidate_sites(scenario_from_dict(recorded, mini, "run.json")) == sites.candidate_sites(scenario)


def test_sensor_that_is_upside_down(mini: Path) -> None:
    """By the row, else by [sites], else by the sensor; the front and the aim stay, and the sides change places."""
    (mini / "sites.csv").write_text(
        "site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,mount\na,0,0,6,30,-9,2,inverted\nb,0,0,6,30,-9,,upright\nc,0,0,6,,-9,,\n"
    )

    def rolls(*settings: str) -> list[float]:
        return [site.pose.roll_deg for site in sites.candidate_sites(egvs.load(mini, list(settings)))]

    assert rolls() == [-178, 0, 0]
    assert rolls("sites.mount='inverted'") == [-178, 0, 180]
    assert rolls("sensors.small.mount='inverted'") == [-178, 0, 180]
    assert rolls("sensors.small.mount='inverted'", "sites.mount='upright'") == [-178, 0, 0]
    hung, stood, _ = sites.candidate_sites(egvs.load(mini))
    assert (hung.pose.is_inverted, stood.pose.is_inverted) == (True, False)
    front = [rotation_world_sensor(*site.pose.angles_deg)[:, 0] for site in (hung, stood)]
    assert front[0] == pytest.approx(front[1])
    assert rotation_world_sensor(*hung.pose.angles_deg)[2, 2] < -0.9
    aimed = {name: sites_from(mini, mount=f'"{name}"', aim='"roi"')[2].pose for name in ("upright", "inverted")}
    assert aimed["inverted"].yaw_deg == aimed["upright"].yaw_deg and aimed["inverted"].roll_deg == 180


@pytest.mark.parametrize(("other", "result"), [("aim_m = [1, 2]", "aim and aim_m"), ("yaw_deg = 0", "aim and yaw_deg")])
def test_rejects_two_directions_at_once(mini: Path, other: str, result: str) -> None:
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"\n', f'sensor = "small"\naim = "roi"\n{other}\n'))
    with pytest.raises(InputError, match=f"expected at most one of aim, aim_m and yaw_deg, got {result}"):
        egvs.load(mini)


def test_new_direction_replaces_the_old_one(mini: Path) -> None:
    """As a new source does: in --set, and in a scenario that extends another."""
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('sensor = "small"\n', 'sensor = "small"\naim = "roi"\nheights_m = [3]\n'))
    (mini / "sites.csv").write_text("site,x_m,y_m\np,0,0\n")
    assert sites_from(mini, aim_m="[0, 9]")[0].pose.yaw_deg == 90
    assert angles_of(sites_from(mini, yaw_deg="30")) == [("p", 3, 30, 0)]
    heir = mini.parent / "heir"
    heir.mkdir()
    rule = "[sites.grid]\nlow_m = [0, 0]\nhigh_m = [0, 0]\nspacing_m = 1\nheights_m = [5]\n"
    (heir / "scenario.toml").write_text(f'extends = "../mini"\n[sites]\nyaw_deg = -45\n{rule}')
    assert angles_of(sites.candidate_sites(egvs.load(heir))) == [("g01", 5, -45, 0)]


def test_rejects_heights_with_a_rule(mini: Path) -> None:
    path = mini / "scenario.toml"
    rule = "heights_m = [3]\n[[sites.along]]\nline_m = [[0, 0], [1, 0]]\nspacing_m = 1\nheights_m = [3]\n"
    path.write_text(path.read_text().replace('file = "sites.csv"\n', "").replace(
        'sensor = "small"\n', f'sensor = "small"\n{rule}'))  # fmt: skip
    with pytest.raises(InputError, match=r"heights_m has no effect with along\. Set along\.heights_m"):
        egvs.load(mini)


def test_rejects_target_out_of_reach_of_the_middle_ray() -> None:
    up = Sensor("up", (30.0,), (0.0,), 1, 100.0, "")
    with pytest.raises(InputError, match=r"up cannot be pitched so that its central ray meets \(0.1, 0, 0\)"):
        sites.aiming_angles("here", (0, 0, 6), (0.1, 0, 0), 0.0, up)
    assert sensor.CATALOGUE["OS1-128"].middle_deg == (0.0, 0.0)


def sites_of_lines(mini: Path, *rules: dict[str, Any]) -> tuple[sites.Site, ...]:
    tables = "".join(
        f"[[sites.along]]\nline_m = {rule['line']}\nspacing_m = {rule['spacing']}\nheights_m = {rule['heights']}\n"
        for rule in rules
    )
    path = mini / "scenario.toml"
    path.write_text(path.read_text().replace('file = "sites.csv"\n', "yaw_deg = 15\n") + tables)
    return sites.candidate_sites(egvs.load(mini))


# --- along lines ------------------------------------------------------------------------------------------------------
def test_sites_follow_a_line_around_its_corner(mini: Path) -> None:
    """25 m east, then north: the distance of 10 m is counted round the corner."""
    result = sites_of_lines(mini, {"line": [[0, 5], [25, 5], [25, 20]], "spacing": 10, "heights": [4]})
    assert site_positions(result) == [
        ("a01", 0, 5, 4),
        ("a02", 10, 5, 4),
        ("a03", 20, 5, 4),
        ("a04", 25, 10, 4),
        ("a05", 25, 20, 4),
    ]
    assert {(site.pose.yaw_deg, site.pose.pitch_deg, site.sensor, site.points) for site in result} == {
        (15, 0, "small", None)
    }


def test_each_position_has_all_heights_and_names_continue_across_lines(mini: Path) -> None:
    result = sites_of_lines(
        mini,
        {"line": [[0, 0], [0, -3.5]], "spacing": 2, "heights": [3, 5]},
        {"line": [[7, 7], [8, 7]], "spacing": 2, "heights": [6]},
    )
    assert site_positions(result) == [
        ("a01@3m", 0, 0, 3),
        ("a01@5m", 0, 0, 5),
        ("a02@3m", 0, -2, 3),
        ("a02@5m", 0, -2, 5),
        ("a03", 7, 7, 6),
    ]
    assert [site.pole for site in result] == ["a01", "a01", "a02", "a02", "a03"]


def test_end_of_a_line_has_a_site_despite_rounding(mini: Path) -> None:
    result = sites_of_lines(mini, {"line": [[0, 0], [0.3, 0], [0.7, 0]], "spacing": 0.1, "heights": [3]})
    assert len(result) == 8
    assert result[-1].pose.x_m == pytest.approx(0.7, abs=1e-12)


def test_names_of_many_sites_have_equal_length(mini: Path) -> None:
    result = sites_of_lines(mini, {"line": [[0, 0], [120, 0]], "spacing": 1, "heights": [3]})
    assert [result[i].name for i in (0, 9, 120)] == ["a001", "a010", "a121"]


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"line": [[0, 0]], "spacing": 1, "heights": [3]}, r"line_m"),
        ({"line": [[0, 0], [1, 0]], "spacing": 0, "heights": [3]}, "spacing_m"),
        ({"line": [[0, 0], [1, 0]], "spacing": 1, "heights": []}, "heights_m"),
        ({"line": [[0, 0], [1, 0, 2]], "spacing": 1, "heights": [3]}, "line_m"),
    ],
)
def test_rejects_invalid_lines(mini: Path, rule: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        sites_of_lines(mini, rule)


def test_rejects_line_with_a_file(mini: Path) -> None:
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
def test_rejects_rule_with_too_many_positions(mini: Path, setting: str, message: str) -> None:
    key, _, rule = setting.partition("=")
    with pytest.raises(InputError, match=message):
        sites.candidate_sites(egvs.load(mini, [f"sites.{key}={rule}"]))


def test_rejects_too_many_combinations(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_SITES", "5")
    rule = "sites.grid={low_m=[0,0],high_m=[1,0],spacing_m=1,heights_m=[3,4,5]}"
    with pytest.raises(
        InputError, match=r"more than 5 candidates \(each combination of location, sensor, height and pitch is one\)"
    ):
        sites.candidate_sites(egvs.load(mini, [rule]))
