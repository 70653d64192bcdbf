"""Sensors: beam directions, beam tables, the catalogue."""

from __future__ import annotations

import math
import pickle
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import egvs
from egvs.core.errors import InputError
from egvs.effects.range_limit import RangeLimit
from egvs.scenario.effects_config import RangeLimitParameters
from egvs.scenario.sensor_config import BeamPatternConfig, SensorConfig
from egvs.sensors import sensor, sites
from egvs.sensors.beam_files import BeamTable
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import (
    CATALOGUE,
    Sensor,
    catalogue_entries,
    resolve_sensor,
    rotation_world_sensor,
    scenario_sensor,
)
from egvs.stages.scene_dependencies import site_digests
from egvs.world import clearances
from egvs.world.static_world import GROUND_MARGIN_M

BEAMS = {
    "VLP-16": 28_800, "VLP-32C": 57_600, "Pandar XT-32": 64_000, "OS1-64": 65_536, "OS1-128": 131_072,
    "AT128": 153_600, "Pandar128": 230_400, "RS-Ruby Plus": 230_400, "RS-M1": 75_000, "OS0-128": 131_072,
    "Livox Tele-15": 24_000, "Livox HAP": 45_200, "Pandar64": 115_200, "RS-Ruby 80": 144_000, "OS1-64 BH": 65_536,
    "OS1-128 BH": 131_072, "OS1-64 BH 2048": 131_072, "OS1-64 2048": 131_072, "OS1-128 2048": 262_144,
}  # fmt: skip
ALL_ROUND = [name for name, sensor in CATALOGUE.items() if sensor.azimuth_span_deg is None]
LENGTH = 1e-15


def true_directions(sensor):
    """Number and direction of some beams, computed with 30 digits: (cos el cos az, cos el sin az, sin el)."""
    with mpmath.workdps(30):
        for k, elevation, azimuth in true_angles(sensor):
            az = mpmath.radians(mpmath.mpf(round(azimuth * 10**6)) / 10**6)
            el = mpmath.radians(mpmath.mpf(repr(elevation)))
            yield (
                k,
                [float(v) for v in (mpmath.cos(el) * mpmath.cos(az), mpmath.cos(el) * mpmath.sin(az), mpmath.sin(el))],
            )


def true_angles(sensor):
    """Number, elevation and azimuth of some beams: of a table's rows, of rings from the first azimuth on."""
    if sensor.table is not None:
        for k in range(0, sensor.beams, 97):
            yield k, float(sensor.table.elevation_deg[k]), Fraction(repr(float(sensor.table.azimuth_deg[k])))
        return
    first, step = Fraction(0), Fraction(360, sensor.azimuths)
    if sensor.azimuth_deg is not None:
        first, last = (Fraction(repr(angle)) for angle in sensor.azimuth_deg)
        step = (last - first) / (sensor.azimuths - 1)
    for a in range(0, sensor.azimuths, sensor.azimuths // 24):
        for r in range(sensor.channels):
            azimuth = first + a * step + Fraction(repr(sensor.azimuth_offsets_deg[r]))
            yield a * sensor.channels + r, sensor.elevations_deg[r], azimuth


@pytest.mark.parametrize("name", sorted(CATALOGUE))
class TestCatalogue:
    def test_number_of_beams(self, name):
        sensor = CATALOGUE[name]
        assert sensor.beams == BEAMS[name]
        assert sensor.table is not None or sensor.beams == sensor.channels * sensor.azimuths
        assert len(sensor.azimuth_offsets_deg) == sensor.channels
        assert sensor.directions().shape == (BEAMS[name], 3)

    @pytest.mark.slow
    def test_order_and_direction(self, name):
        sensor = CATALOGUE[name]
        directions = sensor.directions()
        for k, true in true_directions(sensor):
            # cosdg and sindg are right to an ulp or two; an azimuth such as 33.33 has itself half an ulp.
            assert np.abs(directions[k] - true).max() < 4e-16 * 4

    def test_unit_length(self, name):
        for pose in ((0, 0, 0), (12.5, 0, 0), (33.3, -21.7, 4.4)):
            length = np.sqrt((CATALOGUE[name].directions(*pose) ** 2).sum(axis=1))
            assert np.abs(length - 1).max() < LENGTH

    def test_quarter_turns_are_exact(self, name):
        sensor = CATALOGUE[name]
        if name not in ALL_ROUND:
            pytest.skip("has no beams at quarter turns")
        for yaw in (0.0, 90.0, 180.0, 270.0, -90.0, 720.0):
            directions = sensor.directions(yaw).reshape(sensor.azimuths, sensor.channels, 3)
            for quarter in range(4):
                if sensor.azimuths * quarter % 4:
                    continue
                ahead = (quarter + round(yaw / 90)) % 4
                for r in np.flatnonzero(np.asarray(sensor.azimuth_offsets_deg) == 0):
                    beam = directions[sensor.azimuths * quarter // 4, r]
                    assert beam[1 - ahead % 2] == 0.0
                    assert np.sign(beam[ahead % 2]) == (1 if ahead < 2 else -1)
                    assert not np.signbit(beam[1 - ahead % 2])

    def test_level_rings_stay_level(self, name):
        sensor = CATALOGUE[name]
        if sensor.table is not None:
            pytest.skip("has no rings")
        level = np.flatnonzero(np.asarray(sensor.elevations_deg) == 0)
        z = sensor.directions(37.0).reshape(sensor.azimuths, sensor.channels, 3)[:, level, 2]
        assert (z == 0).all()

    def test_upright_yaw_is_the_rotation(self, name):
        sensor = CATALOGUE[name]
        # Azimuths are rounded to 1e-6 degree; of these tables only Ouster's step, 0.3515625 degrees, and the
        # Pandar128's offsets are no multiples of that.
        exact = 10**6 * 360 % max(sensor.azimuths, 1) == 0 and not name.startswith("Pandar")
        for yaw in (90.0, 45.0, 30.5, 123.456, -77.7):
            turned = sensor.directions() @ rotation_world_sensor(yaw, 0.0, 0.0).T
            assert np.abs(sensor.directions(yaw) - turned).max() < (1e-15 if exact else np.radians(1e-6))


def test_vlp_32c_agrees_with_the_manual():
    sensor = CATALOGUE["VLP-32C"]
    assert (min(sensor.elevations_deg), max(sensor.elevations_deg)) == (-25.0, 15.0)
    assert len(set(sensor.elevations_deg)) == 32
    assert sensor.elevations_deg[:3] == (-25.0, -1.0, -1.667)
    assert sensor.azimuth_offsets_deg[:3] == (1.4, -4.2, 1.4)
    assert {abs(o) for o in sensor.azimuth_offsets_deg} == {1.4, 4.2}
    assert sensor.range_m == 200.0


def forward(yaw, pitch, roll):
    """Where the sensor's x, y and z axes point in the world."""
    return rotation_world_sensor(yaw, pitch, roll).T


@pytest.mark.parametrize(
    ("pose", "x", "y", "z"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((90, 0, 0), (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ((0, -90, 0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),
        ((0, 90, 0), (0, 0, 1), (0, 1, 0), (-1, 0, 0)),
        ((0, 0, 90), (1, 0, 0), (0, 0, 1), (0, -1, 0)),
        ((90, -90, 0), (0, 0, -1), (-1, 0, 0), (0, 1, 0)),
        ((0, 90, 90), (0, 0, 1), (-1, 0, 0), (0, -1, 0)),
        ((90, 0, 90), (0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ],
)
def test_directions_equal_hand_computed_ones(pose, x, y, z):
    """Roll first, then pitch (nose up positive), then yaw (counter-clockwise)."""
    assert forward(*pose).tolist() == [list(x), list(y), list(z)]


def test_tilted_beams_are_rotated():
    sensor = CATALOGUE["VLP-16"]
    for pose in ((10.0, -20.0, 5.0), (0.0, 0.0, 90.0), (200.0, 30.0, 0.0)):
        for table in (sensor, CATALOGUE["VLP-32C"]):
            assert np.abs(table.directions(*pose) - table.directions() @ rotation_world_sensor(*pose).T).max() < 1e-15
    level_ahead = 0 * sensor.channels + sensor.elevations_deg.index(1.0)
    assert sensor.directions(0.0, -10.0, 0.0)[level_ahead][2] == pytest.approx(np.sin(np.radians(-9.0)), abs=1e-15)


@settings(derandomize=True, max_examples=100, deadline=None)
@given(*[st.floats(-360, 360)] * 3)
def test_rotation_is_a_rotation(yaw, pitch, roll):
    matrix = rotation_world_sensor(yaw, pitch, roll)
    assert np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-15
    assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-15)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(yaw=st.integers(-(10**6), 10**6).map(lambda n: n * 1e-3), turns=st.integers(-3, 3))
def test_full_turns_change_nothing(yaw, turns):
    sensor = resolve_sensor(
        "own", {"own": SensorConfig(elevations_deg=(-10.0, 5.0), azimuth_step_deg=5.0, range_m=50.0)}, "x"
    )
    assert np.abs(sensor.directions(yaw) - sensor.directions(yaw + 360.0 * turns)).max() < 3e-15


def test_custom_sensors():
    listed = SensorConfig(
        elevations_deg=(-10.0, 0.0, 3.5), azimuth_step_deg=90.0, range_m=10.0, azimuth_offsets_deg=(0.0, 45.0, 90.0)
    )
    uniform = SensorConfig(elevations_deg=(-15.0, 15.0), channels=5, azimuth_step_deg=0.2, range_m=10.0)
    user_file = {"a": listed, "b": uniform, "VLP-16": listed}
    a, b = resolve_sensor("a", user_file, "x"), resolve_sensor("b", user_file, "x")
    assert (a.beams, b.beams) == (12, 9000)
    assert b.elevations_deg == (-15.0, -7.5, 0.0, 7.5, 15.0)
    assert b.azimuth_offsets_deg == (0.0,) * 5
    directions = a.directions().reshape(4, 3, 3)
    half = np.sqrt(0.5)
    assert np.abs(directions[0, 1] - [half, half, 0]).max() < 2e-16
    assert directions[0, 2, 0] == 0.0
    assert directions[3, 2, 0] > 0
    assert directions[3, 2, 1] == 0.0
    assert resolve_sensor("VLP-16", user_file, "x").channels == 3  # the user's own goes first


@pytest.mark.parametrize(
    "values",
    [
        {"elevations_deg": (), "azimuth_step_deg": 1.0},
        {"elevations_deg": (91.0,), "azimuth_step_deg": 1.0},
        {"elevations_deg": (0.0,), "azimuth_step_deg": 0.7},
        {"elevations_deg": (0.0,), "azimuth_step_deg": 0.0},
        {"elevations_deg": (0.0, 1.0, 2.0), "channels": 5, "azimuth_step_deg": 1.0},
        {"elevations_deg": (0.0, 1.0), "azimuth_offsets_deg": (1.0,), "azimuth_step_deg": 1.0},
        {"elevations_deg": (float("nan"),), "azimuth_step_deg": 1.0},
        {"azimuth_step_deg": 1.0},
        {"elevations_deg": (0.0,)},
        {"elevations_deg": (0.0,), "azimuth_step_deg": 1.0, "azimuth_deg": (60.0, -60.0)},
        {"elevations_deg": (0.0,), "azimuth_step_deg": 1.0, "azimuth_deg": (-180.0, 180.0)},
        {"elevations_deg": (0.0,), "azimuth_step_deg": 0.7, "azimuth_deg": (-60.0, 60.0)},
        {"elevations_deg": (0.0,), "azimuth_step_deg": 1.0, "beams": "table.csv"},
        {"beams": "table.csv", "azimuth_deg": (-60.0, 60.0)},
        {"beams": "table.csv", "channels": 3},
        {"pattern": {"kind": "rosette", "samples": 9, "azimuth_deg": (-1, 1), "elevation_deg": (-1, 1)}},
        {"elevations_deg": (0.0,), "azimuth_offsets_deg": (1e300,), "azimuth_step_deg": 1.0},
        {
            "pattern": {
                "kind": "rosette",
                "turns": (1e300, 2),
                "samples": 9,
                "azimuth_deg": (-1, 1),
                "elevation_deg": (-1, 1),
            }
        },
        {"pattern": {"kind": "even", "samples": 9, "azimuth_deg": (1, -1), "elevation_deg": (-1, 1)}},
    ],
)
def test_rejects_invalid_sensors(values):
    with pytest.raises(ValueError, match=r"elevations_deg|azimuth|pattern|channels"):
        SensorConfig(range_m=10.0, **values)


def test_unknown_sensor_suggests_the_nearest_name():
    with pytest.raises(InputError, match="Did you mean VLP-32C"):
        resolve_sensor("VLP32C", {}, "site a")


def test_negative_azimuth_equals_positive_one_bit_for_bit() -> None:
    """-8.018 degrees and 351.982 degrees are the same direction; as float64, 360 - 8.018 is not 351.982."""
    assert 360.0 - 8.018 != 351.982
    below, above = (Sensor("s", (10.0,), (offset,), 1, 100.0, "") for offset in (-8.018, 351.982))
    assert below.directions().tolist() == above.directions().tolist()
    assert Sensor("s", (0.0,), (-1e-9,), 1, 100.0, "").directions().tolist() == [[1.0, 0.0, 0.0]]


def test_sensor_range_is_within_the_limit() -> None:
    farthest_m = max(sensor.range_m for sensor in CATALOGUE.values())
    assert farthest_m <= clearances.MAX_STATICS_DISTANCE_M
    assert farthest_m <= GROUND_MARGIN_M


TABLE = "elevation_deg,azimuth_deg,channel\n0,0,a\n-30,0,a\n0,90,b\n-45,350,b\n"


def make_config(**keys: object) -> SensorConfig:
    return SensorConfig.from_dict({"range_m": 50, **keys})


def sensor_with_window(first: float, last: float, step: float, *elevations: float) -> Sensor:
    keys = {"elevations_deg": list(elevations), "azimuth_deg": [first, last], "azimuth_step_deg": step}
    return resolve_sensor("s", {"s": make_config(**keys)}, "here")


@pytest.mark.parametrize(
    ("azimuths", "span"),
    [
        (range(0, 360, 10), None), ([0, 120, 240], None), (range(-60, 61, 10), (-60, 60)), ([150, 210], (150, 210)),
        ([30], (30, 30)), ([0, 90, 350], (-10, 90)),
    ],
)  # fmt: skip
def test_coarse_table_of_a_full_turn_has_no_facing(azimuths: list[float], span: tuple[float, float] | None) -> None:
    table = BeamTable(np.zeros(len(azimuths)), np.array(azimuths, dtype=np.float64))
    assert table.azimuth_span_deg == span


def test_finds_repeated_beams() -> None:
    """0, 360 and -360 degrees are one azimuth; straight up, every azimuth is the same."""
    beams = [(0, 0), (0, 90), (0, 360), (90, 10), (5, 0), (0, -360), (90, 200), (0, 1e-7), (0, -270)]
    table = BeamTable(*np.array(beams, dtype=np.float64).T)
    assert sensor.repeated_beams(table) == [(2, 0), (5, 0), (6, 3), (7, 0), (8, 1)]
    assert sensor.repeated_beams(BeamTable(np.zeros(2), np.array([0.0, 1.0]))) == []


# --- fields of view ---------------------------------------------------------------------------------------------------
def test_azimuth_window_includes_both_ends() -> None:
    """Three azimuths, two rings: beam k = a * 2 + r."""
    sensor = sensor_with_window(-60, 60, 60, 0, -30)
    assert (sensor.beams, sensor.azimuths, sensor.azimuth_step_deg) == (6, 3, 60.0)
    half, root = 0.5, math.sqrt(0.75)
    expected = [
        (half, -root, 0), (root * half, -root * root, -half), (1, 0, 0), (root, 0, -half), (half, root, 0),
        (root * half, root * root, -half),
    ]  # fmt: skip
    assert sensor.directions() == pytest.approx(np.array(expected), abs=1e-15)
    assert sensor.directions()[2].tolist() == [1.0, 0.0, 0.0]


def test_azimuth_window_is_part_of_the_turn() -> None:
    """The same beams, bit for bit, as those of the full turn within the window, with any yaw."""
    complete = resolve_sensor("w", {"w": make_config(elevations_deg=[-10, 5], azimuth_step_deg=0.1)}, "here")
    part = sensor_with_window(-30, 45, 0.1, -10, 5)
    for yaw in (0.0, 90.0, 12.3):
        every = {tuple(ray) for ray in complete.directions(yaw).tolist()}
        assert {tuple(ray) for ray in part.directions(yaw).tolist()} <= every
    assert part.beams == 751 * 2


@pytest.mark.parametrize(
    ("first", "last", "middle"), [(-60, 60, 0), (0, 90, 45), (150, 210, 180), (-90, -30, -60), (300, 360, 330)]
)
def test_middle_of_a_window_is_halfway(first: float, last: float, middle: float) -> None:
    assert sensor_with_window(first, last, 10, -25, 15).middle_deg == (-5.0, middle)


def test_aim_compensates_window_off_the_x_axis(mini: Path) -> None:
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


def test_beams_are_in_row_order(mini: Path) -> None:
    sensor = scenario_sensor("small", egvs.load(with_table(mini)), "here")
    root = math.sqrt(0.5)
    expected = [(1, 0, 0), (math.sqrt(0.75), 0, -0.5), (0, 1, 0),
                (root * math.cos(math.radians(10)), -root * math.sin(math.radians(10)), -root)]  # fmt: skip
    assert sensor.beams == 4
    assert sensor.directions() == pytest.approx(np.array(expected), abs=1e-15)
    assert sensor.directions(90.0)[0].tolist() == [0.0, 1.0, 0.0]
    tilted = sensor.directions(10.0, -20.0, 5.0)
    assert tilted == pytest.approx(np.array(expected) @ rotation_world_sensor(10.0, -20.0, 5.0).T, abs=1e-15)


def test_middle_of_a_table_is_that_of_its_smallest_arc() -> None:
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


@pytest.mark.slow
def test_ring_sensor_as_table_has_the_same_scores(mini: Path, tmp_path: Path) -> None:
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


def test_changed_table_is_another_input(mini: Path) -> None:
    scenario = egvs.load(with_table(mini))
    before = site_digests(scenario, sites.candidate_sites(scenario))
    (mini / "beams.csv").write_text(TABLE + "1,1,c\n")
    after = site_digests(scenario, sites.candidate_sites(scenario))
    assert set(before) == set(after) == {"sites.csv", "beams.csv"}
    assert before["beams.csv"] != after["beams.csv"]
    assert before["sites.csv"] == after["sites.csv"]


def test_catalogue_is_an_input_only_if_used(mini: Path) -> None:
    scenario = egvs.load(mini, ["sites.sensor=AT128"])
    assert set(site_digests(scenario, sites.candidate_sites(scenario))) == {"sites.csv", "catalogue: AT128"}
    assert len({sensor.catalogue_digest(name) for name in CATALOGUE}) == len(CATALOGUE)


EFFECT_SETTINGS = {
    "divergence": "{sub_beams = 7}",
    "mount_sway": "{tilt_deg = 0.5}",
    "range_limit": "{rated_range_m = 30, rated_reflectivity = 0.1}",
    "dropout": "{share = 0.1}",
    "rain": "{rate_mm_h = 20}",
}


WINDOW = "{range_m = 100, elevations_deg = [-25, 5], channels = 16, azimuth_deg = [-60, 60], azimuth_step_deg = 1}"


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["window", "Livox Tele-15", "small"])
def test_effects_apply_to_all_kinds_of_sensors(mini: Path, tmp_path: Path, sensor: str) -> None:
    """A score with an effect is another, and not 0: the sensors look at the region from 6 m up."""
    rows = "\n".join(f"{el},{az}" for el in range(-40, 0, 2) for az in range(-60, 60, 2))
    with_table(mini, f"elevation_deg,azimuth_deg\n{rows}\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,aim\np,-12,0,6,roi\n")
    scenario = [f'sites.sensor="{sensor}"', "score.standard_error=false", "roi.voxel_m=1.0", "score.gamma=inf"]
    scenario += [f"sensors.window={WINDOW}"]
    plain = first_score(mini, scenario, tmp_path / "plain")
    assert plain > 0
    for name, value in EFFECT_SETTINGS.items():
        changed = first_score(mini, [*scenario, f"effects.{name}={value}"], tmp_path / name)
        assert changed > 0
        assert changed != plain, name


def first_score(mini: Path, overrides: list[str], out: Path) -> float:
    egvs.run(egvs.load(mini, overrides), out)
    return float(egvs.read_scores(out / "scores.parquet").column("egvs")[0].as_py())


def test_scenes_and_sensors_can_be_pickled(mini: Path) -> None:
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
        ("elevation_deg,azimuth_deg\n1\n", r"beam 0: expected 2 values, one per column, got 1"),
        ("elevation_deg,azimuth_deg\nnan,0\n", r"beam 0: elevation_deg: .*'nan'"),
        ("elevation_deg,azimuth_deg\n1_0,0\n", r"beam 0: elevation_deg: .*'1_0'"),
        ("elevation_deg,azimuth_deg\n\u0661,0\n", r"beam 0: elevation_deg: .*'\u0661'"),
        ("elevation_deg,azimuth_deg\nup,0\n", r"beam 0: elevation_deg: .*'up'"),
        (
            "elevation_deg,azimuth_deg\n-5,5,3,5\n",
            "beam 0: expected 2 values, .*got 4.*decimal points",
        ),
        ("elevation_deg,azimuth_deg,elevation_deg\n1,2,3\n", "has 2 columns elevation_deg"),
    ],
)
def test_rejects_invalid_table(mini: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        scenario_sensor("small", egvs.load(with_table(mini, text)), "here")


def test_rejects_missing_or_binary_table(mini: Path) -> None:
    scenario = egvs.load(with_table(mini))
    (mini / "beams.csv").write_bytes(b"elevation_deg,azimuth_deg\n\xff,1\n")
    with pytest.raises(InputError, match="cannot be read as CSV"):
        scenario_sensor("small", scenario, "here")
    (mini / "beams.csv").unlink()
    with pytest.raises(InputError, match=r"sensors\.small\.beams = 'beams\.csv': no such file"):
        scenario_sensor("small", scenario, "here")


def test_rejects_too_many_beams(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_BEAMS", "3")
    with pytest.raises(InputError, match=r"has more than 3 beams\. The limit is 3 beams; set EGVS_MAX_BEAMS"):
        scenario_sensor("small", egvs.load(with_table(mini)), "here")


# --- patterns ---------------------------------------------------------------------------------------------------------
def test_rosette_is_the_sum_of_two_rotating_vectors() -> None:
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


def test_uniform_pattern_is_uniform() -> None:
    """Each of 4 x 4 equal parts of the field of view gets its share of the beams, to within two."""
    table = sensor.beams_from_pattern(
        BeamPatternConfig(kind="even", samples=1600, azimuth_deg=(-60, 60), elevation_deg=(-12.5, 12.5))
    )
    counts, *_ = np.histogram2d(table.azimuth_deg, table.elevation_deg, bins=4, range=[[-60, 60], [-12.5, 12.5]])
    assert np.abs(counts - 100).max() <= 2


@pytest.mark.parametrize("name", ["Livox Tele-15", "Livox HAP"])
def test_patterns_fill_their_field_of_view(name: str) -> None:
    sensor, expected = CATALOGUE[name], catalogue_entries()[name].pattern
    assert expected is not None
    assert "model" in sensor.assumed
    assert sensor.elevation_span_deg == pytest.approx(expected.elevation_deg, abs=0.1)
    assert sensor.azimuth_span_deg == pytest.approx(expected.azimuth_deg, abs=0.1)


# --- the catalogue ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_sensor_names_its_source(name: str) -> None:
    sensor, entry = CATALOGUE[name], catalogue_entries()[name]
    assert sensor.source == entry.source
    assert sensor.rated_range_m is not None
    assert ("divergence" in sensor.assumed) == ("divergence_mrad" not in entry.model_fields_set or name[:3] == "VLP")


def test_beams_per_frame_match_points_per_second_of_the_maker() -> None:
    """At 10 frames a second: AT128 1,536,000, M1 750,000, Tele-15 240,000, HAP 452,000, Ruby Plus 2,304,000."""
    per_second = {"AT128": 1536e3, "RS-M1": 750e3, "Livox Tele-15": 240e3, "Livox HAP": 452e3, "RS-Ruby Plus": 2304e3}
    assert {name: 10 * CATALOGUE[name].beams for name in per_second} == per_second


def test_pandar128_agrees_with_the_table_of_the_maker() -> None:
    """Channels 1, 26 and 128 of correction.csv; the maker's azimuths run clockwise."""
    sensor = CATALOGUE["Pandar128"]
    assert [sensor.elevations_deg[i] for i in (0, 25, 127)] == [14.436, 2.013, -25.01577]
    assert [sensor.azimuth_offsets_deg[i] for i in (0, 25, 127)] == [-3.257, 1.113115, 3.448749]
    assert min(np.abs(np.diff(sensor.elevations_deg))) == pytest.approx(0.122, abs=1e-3)


def test_list_has_one_line_per_sensor_that_fits_a_narrow_terminal(run_egvs) -> None:  # type: ignore[no-untyped-def]
    code, out, _ = run_egvs("sensors")
    assert code == 0
    lines = out.splitlines()
    table = lines[1 : 1 + len(CATALOGUE)]
    assert [line.split("  ")[0] for line in table] == list(CATALOGUE)
    assert max(len(line.rstrip()) for line in lines[: 1 + len(CATALOGUE)]) <= 80
    assert "120 x -12.7 to 12.7" in next(line for line in table if line.startswith("AT128"))
    assert "costs.sensor" in out


def test_list_converts_rated_ranges_as_the_effect_does_and_marks_unchecked_ones(run_egvs) -> None:  # type: ignore[no-untyped-def]
    effect = RangeLimit(RangeLimitParameters(reflectivity=0.1))
    table = run_egvs("sensors")[1].splitlines()
    for name, entry in CATALOGUE.items():
        line = next(line for line in table if line.startswith(f"{name} "))
        number, mark = line.rstrip("au ").split()[-1], line.split()[-1]
        assert float(number) == pytest.approx(effect.limit_m(entry), abs=0.5)
        words = {"a": "assumed", "u": "unchecked"}
        assert words.get(mark, "") in entry.rated_source
        assert mark in words or not any(word in entry.rated_source for word in words.values())


def test_details_of_a_sensor_have_source_and_assumptions(run_egvs) -> None:  # type: ignore[no-untyped-def]
    code, out, _ = run_egvs("sensors", "AT128", "VLP-16")
    assert code == 0
    for name in ("AT128", "VLP-16"):
        assert f"source: {CATALOGUE[name].source}\n" in out
        assert f"assumed: {CATALOGUE[name].assumed}\n" in out
        assert f"rated range: {CATALOGUE[name].rated_source}" in out
    assert "half are lost at 110 m, 5 % at 48 m, and 5 % at any range (reflectivity 0.03, softness 1:" in out
    assert "-59.95 to 59.95" in out
    code, out, error = run_egvs("sensors", "AT129")
    assert (code, out) == (2, "")
    assert "unknown sensor 'AT129'. Did you mean AT128?" in error
