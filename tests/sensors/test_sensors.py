"""Does every beam point where the maker's table, the mount and the definitions say - and exactly so where it can be
exact?"""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.scenario.sensor_config import SensorConfig
from egvs.sensors.sensor import CATALOGUE, Sensor, resolve_sensor, rotation_world_sensor
from egvs.world import clearances
from egvs.world.static_world import GROUND_MARGIN_M

BEAMS = {
    "VLP-16": 28_800, "VLP-32C": 57_600, "Pandar XT-32": 64_000, "OS1-64": 65_536, "OS1-128": 131_072,
    "AT128": 153_600, "Pandar128": 230_400, "RS-Ruby Plus": 230_400, "RS-M1": 75_000, "OS0-128": 131_072,
    "Livox Tele-15": 24_000, "Livox HAP": 45_200,
}  # fmt: skip
ALL_ROUND = [name for name, sensor in CATALOGUE.items() if sensor.azimuth_span_deg is None]
LENGTH = 1e-15


def true_directions(sensor):
    """The definition in 30 digits: (cos el cos az, cos el sin az, sin el), k = a * channels + r."""
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
        exact = 10**6 * 360 % max(sensor.azimuths, 1) == 0 and name != "Pandar128"
        for yaw in (90.0, 45.0, 30.5, 123.456, -77.7):
            turned = sensor.directions() @ rotation_world_sensor(yaw, 0.0, 0.0).T
            assert np.abs(sensor.directions(yaw) - turned).max() < (1e-15 if exact else np.radians(1e-6))


def test_vlp_32c_follows_the_manual():
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
def test_poses_that_a_hand_can_show(pose, x, y, z):
    """Roll first, then pitch (nose up positive), then yaw (counter-clockwise)."""
    assert forward(*pose).tolist() == [list(x), list(y), list(z)]


def test_tilted_beams_are_the_rotated_table():
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
def test_whole_turns_change_nothing(yaw, turns):
    sensor = resolve_sensor(
        "own", {"own": SensorConfig(elevations_deg=(-10.0, 5.0), azimuth_step_deg=5.0, range_m=50.0)}, "x"
    )
    assert np.abs(sensor.directions(yaw) - sensor.directions(yaw + 360.0 * turns)).max() < 3e-15


def test_own_sensors():
    listed = SensorConfig(
        elevations_deg=(-10.0, 0.0, 3.5), azimuth_step_deg=90.0, range_m=10.0, azimuth_offsets_deg=(0.0, 45.0, 90.0)
    )
    uniform = SensorConfig(elevations_deg=(-15.0, 15.0), channels=5, azimuth_step_deg=0.2, range_m=10.0)
    own = {"a": listed, "b": uniform, "VLP-16": listed}
    a, b = resolve_sensor("a", own, "x"), resolve_sensor("b", own, "x")
    assert (a.beams, b.beams) == (12, 9000)
    assert b.elevations_deg == (-15.0, -7.5, 0.0, 7.5, 15.0)
    assert b.azimuth_offsets_deg == (0.0,) * 5
    directions = a.directions().reshape(4, 3, 3)
    half = np.sqrt(0.5)
    assert np.abs(directions[0, 1] - [half, half, 0]).max() < 2e-16
    assert directions[0, 2, 0] == 0.0
    assert directions[3, 2, 0] > 0
    assert directions[3, 2, 1] == 0.0
    assert resolve_sensor("VLP-16", own, "x").channels == 3  # the user's own goes first


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
def test_senseless_sensors_are_refused(values):
    with pytest.raises(ValueError, match=r"elevations_deg|azimuth|pattern|channels"):
        SensorConfig(range_m=10.0, **values)


def test_unknown_sensor_names_the_nearest():
    with pytest.raises(InputError, match="Did you mean VLP-32C"):
        resolve_sensor("VLP32C", {}, "site a")


def test_a_negative_azimuth_is_the_positive_one_to_the_last_bit() -> None:
    """-8.018 degrees and 351.982 degrees are the same direction; as float64, 360 - 8.018 is not 351.982."""
    assert 360.0 - 8.018 != 351.982
    below, above = (Sensor("s", (10.0,), (offset,), 1, 100.0, "") for offset in (-8.018, 351.982))
    assert below.directions().tolist() == above.directions().tolist()
    assert Sensor("s", (0.0,), (-1e-9,), 1, 100.0, "").directions().tolist() == [[1.0, 0.0, 0.0]]


def test_no_sensor_reaches_beyond_what_is_built_and_checked() -> None:
    farthest_m = max(sensor.range_m for sensor in CATALOGUE.values())
    assert farthest_m <= clearances.MAX_STATICS_DISTANCE_M
    assert farthest_m <= GROUND_MARGIN_M
