"""Sensors that do not see all round: windows, tables of beams, patterns; the catalogue; what a run makes of them."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.scenario.sensor_config import BeamPatternConfig, SensorConfig
from egvs.sensors import sensor, sites
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import (
    CATALOGUE,
    BeamTable,
    Sensor,
    catalogue_entries,
    resolve_sensor,
    rotation_world_sensor,
    scenario_sensor,
)
from egvs.stages.scene_inputs import site_digests

TABLE = "elevation_deg,azimuth_deg,channel\n0,0,a\n-30,0,a\n0,90,b\n-45,350,b\n"


def model(**keys: object) -> SensorConfig:
    return SensorConfig.from_dict({"range_m": 50, **keys})


def windowed(first: float, last: float, step: float, *elevations: float) -> Sensor:
    keys = {"elevations_deg": list(elevations), "azimuth_deg": [first, last], "azimuth_step_deg": step}
    return resolve_sensor("s", {"s": model(**keys)}, "here")


@pytest.mark.parametrize(
    ("azimuths", "span"),
    [
        (range(0, 360, 10), None), ([0, 120, 240], None), (range(-60, 61, 10), (-60, 60)), ([150, 210], (150, 210)),
        ([30], (30, 30)), ([0, 90, 350], (-10, 90)),
    ],
)  # fmt: skip
def test_a_coarse_table_of_a_whole_turn_looks_to_no_side(
    azimuths: list[float], span: tuple[float, float] | None
) -> None:
    table = BeamTable(np.zeros(len(azimuths)), np.array(azimuths, dtype=np.float64))
    assert table.azimuth_span_deg == span


def test_beams_that_repeat_an_earlier_one_are_found() -> None:
    """0, 360 and -360 degrees are one azimuth; straight up, every azimuth is the same."""
    beams = [(0, 0), (0, 90), (0, 360), (90, 10), (5, 0), (0, -360), (90, 200), (0, 1e-7), (0, -270)]
    table = BeamTable(*np.array(beams, dtype=np.float64).T)
    assert sensor.repeated_beams(table) == [(2, 0), (5, 0), (6, 3), (7, 0), (8, 1)]
    assert sensor.repeated_beams(BeamTable(np.zeros(2), np.array([0.0, 1.0]))) == []


# --- fields of view ---------------------------------------------------------------------------------------------------


def test_a_window_has_both_its_ends() -> None:
    """Three azimuths, two rings: beam k = a * 2 + r."""
    sensor = windowed(-60, 60, 60, 0, -30)
    assert (sensor.beams, sensor.azimuths, sensor.azimuth_step_deg) == (6, 3, 60.0)
    half, root = 0.5, math.sqrt(0.75)
    expected = [
        (half, -root, 0), (root * half, -root * root, -half), (1, 0, 0), (root, 0, -half), (half, root, 0),
        (root * half, root * root, -half),
    ]  # fmt: skip
    assert sensor.directions() == pytest.approx(np.array(expected), abs=1e-15)
    assert sensor.directions()[2].tolist() == [1.0, 0.0, 0.0]


def test_a_window_is_a_part_of_the_turn() -> None:
    """The same beams, to the last bit, as those of the whole turn that lie in it; turned by yaw as well."""
    whole = resolve_sensor("w", {"w": model(elevations_deg=[-10, 5], azimuth_step_deg=0.1)}, "here")
    part = windowed(-30, 45, 0.1, -10, 5)
    for yaw in (0.0, 90.0, 12.3):
        every = {tuple(ray) for ray in whole.directions(yaw).tolist()}
        assert {tuple(ray) for ray in part.directions(yaw).tolist()} <= every
    assert part.beams == 751 * 2


@pytest.mark.parametrize(
    ("first", "last", "middle"), [(-60, 60, 0), (0, 90, 45), (150, 210, 180), (-90, -30, -60), (300, 360, 330)]
)
def test_the_middle_of_a_window_is_halfway(first: float, last: float, middle: float) -> None:
    assert windowed(first, last, 10, -25, 15).middle_deg == (-5.0, middle)


def test_a_window_that_looks_aside_is_turned_back_by_its_aim(mini: Path) -> None:
    """Its field of view is 0 to 90 degrees, so it looks along 45: to meet a point due east the x axis goes to -45."""
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,aim_x_m,aim_y_m,aim_z_m\np,0,0,6,10,0,6\n")
    keys = ["sensors.small.azimuth_deg=[0, 90]", "sensors.small.elevations_deg=[0]", "sensors.small.channels=1"]
    (site,) = sites.candidate_sites(egvs.load(mini, keys))
    assert (site.pose.yaw_deg, site.pose.pitch_deg) == (-45.0, 0.0)


# --- tables -----------------------------------------------------------------------------------------------------------


def with_table(mini: Path, text: str = TABLE) -> Path:
    """The small scenario with a sensor from a table; its two sites are equipped with it."""
    (mini / "beams.csv").write_text(text)
    path = mini / "scenario.toml"
    rings = "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n"
    assert rings in path.read_text()
    path.write_text(path.read_text().replace(rings, 'beams = "beams.csv"\n'))
    return mini


def test_row_k_of_a_table_is_beam_k(mini: Path) -> None:
    sensor = scenario_sensor("small", egvs.load(with_table(mini)), "here")
    root = math.sqrt(0.5)
    expected = [(1, 0, 0), (math.sqrt(0.75), 0, -0.5), (0, 1, 0),
                (root * math.cos(math.radians(10)), -root * math.sin(math.radians(10)), -root)]  # fmt: skip
    assert sensor.beams == 4
    assert sensor.directions() == pytest.approx(np.array(expected), abs=1e-15)
    assert sensor.directions(90.0)[0].tolist() == [0.0, 1.0, 0.0]
    tilted = sensor.directions(10.0, -20.0, 5.0)
    assert tilted == pytest.approx(np.array(expected) @ rotation_world_sensor(10.0, -20.0, 5.0).T, abs=1e-15)


def test_the_middle_of_a_table_is_that_of_the_arc_that_holds_it() -> None:
    """From 350 to 90 degrees through 0: 50; elevations from -45 to 0."""
    elevations, azimuths = np.array([0.0, -30, 0, -45]), np.array([0.0, 0, 90, 350])
    sensor = Sensor("t", (), (), 0, 9.0, "", table=BeamTable(elevations, azimuths))
    assert sensor.azimuth_span_deg == (-10.0, 90.0)
    assert sensor.middle_deg == (-22.5, 40.0)
    turn = BeamTable(np.zeros(90), np.arange(90) * 4.0)
    assert turn.azimuth_span_deg is None
    assert Sensor("t", (), (), 0, 9.0, "", table=turn).middle_deg == (0.0, 0.0)
    assert BeamTable(np.zeros(2), np.array([170.0, 200.0])).azimuth_span_deg == (170.0, 200.0)
    assert BeamTable(np.zeros(1), np.array([270.0])).azimuth_span_deg == (-90.0, -90.0)


def test_a_ring_sensor_written_as_a_table_scores_the_same(mini: Path, tmp_path: Path) -> None:
    """The table of the small sensor, beam by beam: the same scans to the last bit, so the same scores."""
    by_rings = egvs.run(egvs.load(mini), tmp_path / "rings")
    small = scenario_sensor("small", egvs.load(mini), "here")
    rows = [f"{el},{a * 1.0}" for a in range(small.azimuths) for el in small.elevations_deg]
    with_table(mini, "\n".join(["elevation_deg,azimuth_deg", *rows, ""]))
    by_table = egvs.run(egvs.load(mini), tmp_path / "table")
    scans = [egvs.read_scans(tmp_path / way / "scans.parquet") for way in ("rings", "table")]
    scores = [egvs.read_scores(tmp_path / way / "scores.parquet") for way in ("rings", "table")]
    assert scans[0].equals(scans[1])
    assert scores[0].equals(scores[1])
    assert by_rings.stages["scan"].inputs != by_table.stages["scan"].inputs


def test_another_table_under_the_same_name_is_another_input(mini: Path) -> None:
    scenario = egvs.load(with_table(mini))
    before = site_digests(scenario, sites.candidate_sites(scenario))
    (mini / "beams.csv").write_text(TABLE + "1,1,c\n")
    after = site_digests(scenario, sites.candidate_sites(scenario))
    assert set(before) == set(after) == {"sites.csv", "beams.csv"}
    assert before["beams.csv"] != after["beams.csv"]
    assert before["sites.csv"] == after["sites.csv"]


def test_the_catalogue_counts_only_where_it_is_used(mini: Path) -> None:
    scenario = egvs.load(mini, ["sites.sensor=AT128"])
    assert set(site_digests(scenario, sites.candidate_sites(scenario))) == {"sites.csv", "catalogue: AT128"}
    assert len({sensor.catalogue_digest(name) for name in CATALOGUE}) == len(CATALOGUE)


EFFECTS = {
    "divergence": "{sub_beams = 7}",
    "mount_sway": "{tilt_deg = 0.5}",
    "range_limit": "{rated_range_m = 30, rated_reflectivity = 0.1}",
    "dropout": "{share = 0.1}",
    "rain": "{rate_mm_h = 20}",
}


WINDOW = "{range_m = 100, elevations_deg = [-25, 5], channels = 16, azimuth_deg = [-60, 60], azimuth_step_deg = 1}"


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["window", "Livox Tele-15", "small"])
def test_effects_act_on_every_kind_of_sensor(mini: Path, tmp_path: Path, sensor: str) -> None:
    """A score with an effect is another, and not 0: the sensors look at the region from 6 m up."""
    rows = "\n".join(f"{el},{az}" for el in range(-40, 0, 2) for az in range(-60, 60, 2))
    with_table(mini, f"elevation_deg,azimuth_deg\n{rows}\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,aim\np,-12,0,6,roi\n")
    scenario = [f'sites.sensor="{sensor}"', "score.standard_error=false", "roi.voxel_m=1.0", "score.gamma=inf"]
    scenario += [f"sensors.window={WINDOW}"]
    plain = score(mini, scenario, tmp_path / "plain")
    assert plain > 0
    for name, value in EFFECTS.items():
        changed = score(mini, [*scenario, f"effects.{name}={value}"], tmp_path / name)
        assert changed > 0
        assert changed != plain, name


def score(mini: Path, overrides: list[str], out: Path) -> float:
    egvs.run(egvs.load(mini, overrides), out)
    return float(egvs.read_scores(out / "scores.parquet").column("egvs")[0].as_py())


def test_scenes_and_sensors_can_be_sent_to_another_process(mini: Path) -> None:
    scenario = egvs.load(with_table(mini))
    scene = Scene(scenario, None, sites.candidate_sites(scenario))  # type: ignore[arg-type]
    sensor = scene.sensor("small")
    assert scene.sensor("small") is sensor
    (mini / "beams.csv").unlink()
    again = pickle.loads(pickle.dumps(scene)).sensor("small")
    assert again == sensor
    assert hash(again) == hash(sensor)
    assert again.directions().tobytes() == sensor.directions().tobytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"beams\.csv: .*has no column elevation_deg.*columns elevation_deg, azimuth_deg"),
        ("elevation_deg,azimuth\n1,2\n", "has no column azimuth_deg"),
        ("elevation_deg,azimuth_deg\n", "at least one beam"),
        ("elevation_deg,azimuth_deg\n1,2\n91,3\n", r"beam 1: elevation_deg: .*between -90 and 90, got '91'"),
        ("elevation_deg,azimuth_deg\n1,400\n", r"beam 0: azimuth_deg: .*between -360 and 360, got '400'"),
        ("elevation_deg,azimuth_deg\n1,\n", r"beam 0: azimuth_deg: .*a number .*got ''"),
        ("elevation_deg,azimuth_deg\n1\n", r"beam 0: azimuth_deg: .*a number .*got None"),
        ("elevation_deg,azimuth_deg\nnan,0\n", r"beam 0: elevation_deg: .*'nan'"),
        ("elevation_deg,azimuth_deg\nup,0\n", r"beam 0: elevation_deg: .*'up'"),
        (
            "elevation_deg,azimuth_deg\n-5,5,3,5\n",
            "beam 0: expected 2 values, .*got 4.*decimal points",
        ),
        ("elevation_deg,azimuth_deg,elevation_deg\n1,2,3\n", "has 2 columns elevation_deg"),
        ("elevation_deg;azimuth_deg\n1;2\n", "has no column elevation_deg.*separated by commas"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(mini: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        scenario_sensor("small", egvs.load(with_table(mini, text)), "here")


def test_a_table_that_is_not_there_or_no_text_is_told(mini: Path) -> None:
    scenario = egvs.load(with_table(mini))
    (mini / "beams.csv").write_bytes(b"elevation_deg,azimuth_deg\n\xff,1\n")
    with pytest.raises(InputError, match="cannot be read as CSV"):
        scenario_sensor("small", scenario, "here")
    (mini / "beams.csv").unlink()
    with pytest.raises(InputError, match=r"sensors\.small\.beams = 'beams\.csv': no such file"):
        scenario_sensor("small", scenario, "here")


def test_too_many_beams_are_refused(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_BEAMS", "3")
    with pytest.raises(InputError, match=r"has more than 3 beams\. The limit is 3 beams; set EGVS_MAX_BEAMS to raise"):
        scenario_sensor("small", egvs.load(with_table(mini)), "here")


# --- patterns ---------------------------------------------------------------------------------------------------------


def test_a_rosette_is_the_sum_of_two_turning_vectors() -> None:
    """Against the formula in complex numbers: each prism is a phasor."""
    pattern = BeamPatternConfig(
        kind="rosette", samples=50, azimuth_deg=(-4, 8), elevation_deg=(-3, 1), turns=(12.156667, -7.773333)
    )
    table = sensor.beams_from_pattern(pattern)
    for k in range(50):
        t = (k + 0.5) / 50
        both = sum(np.exp(2j * np.pi * turns * t) for turns in (12.156667, -7.773333)) / 2
        assert table.azimuth_deg[k] == pytest.approx(2 + 6 * both.real, abs=1e-6)
        assert table.elevation_deg[k] == pytest.approx(-1 + 2 * both.imag, abs=1e-6)


def test_an_even_pattern_is_even() -> None:
    """Each of 4 x 4 equal parts of the field of view gets its share of the beams, to within two."""
    table = sensor.beams_from_pattern(
        BeamPatternConfig(kind="even", samples=1600, azimuth_deg=(-60, 60), elevation_deg=(-12.5, 12.5))
    )
    counts, *_ = np.histogram2d(table.azimuth_deg, table.elevation_deg, bins=4, range=[[-60, 60], [-12.5, 12.5]])
    assert np.abs(counts - 100).max() <= 2


@pytest.mark.parametrize("name", ["Livox Tele-15", "Livox HAP"])
def test_patterns_fill_their_field_of_view(name: str) -> None:
    sensor, wanted = CATALOGUE[name], catalogue_entries()[name].pattern
    assert wanted is not None
    assert "model" in sensor.assumed
    assert sensor.elevation_span_deg == pytest.approx(wanted.elevation_deg, abs=0.1)
    assert sensor.azimuth_span_deg == pytest.approx(wanted.azimuth_deg, abs=0.1)


# --- the catalogue ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_sensor_says_where_it_is_from(name: str) -> None:
    sensor, entry = CATALOGUE[name], catalogue_entries()[name]
    assert sensor.source == entry.source
    assert sensor.rated_range_m is not None
    assert ("divergence" in sensor.assumed) == ("divergence_mrad" not in entry.model_fields_set or name[:3] == "VLP")


def test_beams_a_frame_are_the_makers_points_a_second() -> None:
    """At 10 frames a second: AT128 1,536,000, M1 750,000, Tele-15 240,000, HAP 452,000, Ruby Plus 2,304,000."""
    per_second = {"AT128": 1536e3, "RS-M1": 750e3, "Livox Tele-15": 240e3, "Livox HAP": 452e3, "RS-Ruby Plus": 2304e3}
    assert {name: 10 * CATALOGUE[name].beams for name in per_second} == per_second


def test_pandar128_follows_the_makers_table() -> None:
    """Channels 1, 26 and 128 of correction.csv; the maker's azimuths run clockwise."""
    sensor = CATALOGUE["Pandar128"]
    assert [sensor.elevations_deg[i] for i in (0, 25, 127)] == [14.436, 2.013, -25.01577]
    assert [sensor.azimuth_offsets_deg[i] for i in (0, 25, 127)] == [-3.257, 1.113115, 3.448749]
    assert min(np.abs(np.diff(sensor.elevations_deg))) == pytest.approx(0.122, abs=1e-3)


def test_the_list_of_sensors_is_printed_with_what_is_assumed(run_egvs) -> None:  # type: ignore[no-untyped-def]
    code, out, _ = run_egvs("sensors")
    assert code == 0
    for name in CATALOGUE:
        assert name in out
    assert "-59.95 to 59.95" in out
    assert "Assumed:" in out
