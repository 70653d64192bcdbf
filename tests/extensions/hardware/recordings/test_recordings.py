"""Sweeps of recordings of ROS and of captures of Velodyne packets.

Evidence: recordings that rosbags writes, packets made by hand from the maker's manual, and points at ranges and angles
that a person can check.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from egvs.core import plugins
from egvs.core.errors import EgvsError, InputError
from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.fit import fit_sensor
from egvs.extensions.hardware.recordings import ros_bags, velodyne_pcap
from egvs.formats.recording_options import RecordingOptions
from egvs.formats.recordings import chosen_sweeps, ring_numbers, sweep_blocks
from egvs.formats.sweep_files import read_sweeps
from tests.extensions.hardware.fit.small_sensor import TRUTH, coarse_sensor, sweep_of
from tests.extensions.hardware.recordings.ros_recordings import TOPIC, write_recording
from tests.extensions.hardware.recordings.velodyne_packets import ELEVATIONS_DEG, packets, write_pcap

pytest.importorskip("rosbags")
pytest.importorskip("velodyne_decoder")

TIME_S = np.repeat(np.arange(300), 10) * 0.1 / 300
"""Ten channels and 300 azimuths in a tenth of a second."""


def clouds(count: int) -> list[tuple[float, FloatArray, FloatArray | None]]:
    return [(1000.0 + 0.1 * i, sweep_of(TRUTH, coarse_sensor(), seed=i), TIME_S) for i in range(count)]


# ---- recordings of ROS


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_messages_are_sweeps(tmp_path: Path, suffix: str) -> None:
    path = write_recording(tmp_path / f"run{suffix}", clouds(3))
    sweeps = read_sweeps([path])
    assert [sweep.name for sweep in sweeps] == [f"run{suffix}: {TOPIC} at {0.1 * i:.3f} s" for i in range(3)]
    for (_, expected, _), sweep in zip(clouds(3), sweeps, strict=True):
        np.testing.assert_array_equal(sweep.points_m, expected)
        assert sweep.time_s is not None
        np.testing.assert_allclose(sweep.time_s, TIME_S, atol=1e-9)
    recording = sweeps[0].recording
    assert recording is not None
    assert (recording.sweeps, recording.source) == (3, f"topic {TOPIC}, frame lidar")
    np.testing.assert_allclose(recording.stamps_s, [1000.0, 1000.1, 1000.2], atol=1e-6)


@pytest.mark.slow
@pytest.mark.system
def test_folder_of_ros2(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", clouds(2))
    path.rename(tmp_path / "run" / "run.mcap")  # as rosbags wrote it
    assert len(read_sweeps([tmp_path / "run"])) == 2


@pytest.mark.slow
@pytest.mark.system
def test_fit_of_recording_is_that_of_its_sweeps(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", clouds(2))
    fit = fit_sensor(read_sweeps([path]))
    np.testing.assert_allclose(np.sort(fit.angles.elevation_deg), np.sort(coarse_sensor().elevations_deg), atol=0.01)
    assert fit.rotation is not None and fit.rotation.rate_hz == pytest.approx(10.0, abs=0.001)


@pytest.mark.slow
@pytest.mark.system
def test_sweeps_are_spread_over_recording(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", clouds(7))
    sweeps = read_sweeps([path], RecordingOptions(max_sweeps=3))
    assert [sweep.name.split()[-2] for sweep in sweeps] == ["0.000", "0.300", "0.600"]
    assert sweeps[0].recording is not None and sweeps[0].recording.sweeps == 7
    assert chosen_sweeps(7, 3).tolist() == [0, 3, 6]
    assert chosen_sweeps(2, 3).tolist() == [0, 1]
    assert chosen_sweeps(5, 1).tolist() == [0]


@pytest.mark.slow
@pytest.mark.system
def test_topic_is_chosen(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", clouds(1), topics=("/rear", "/front"))
    with pytest.raises(InputError, match=r"run.mcap: expected one topic with point clouds, got 2: /front, /rear"):
        read_sweeps([path])
    with pytest.raises(InputError, match=r"--topic: expected one of /front, /rear, got '/points'"):
        read_sweeps([path], RecordingOptions(topic="/points"))
    (sweep,) = read_sweeps([path], RecordingOptions(topic="/rear"))
    assert sweep.name == "run.mcap: /rear at 0.000 s"


def message(dtype: np.dtype, rows: int, padding: int, **values: FloatArray) -> SimpleNamespace:
    """A PointCloud2 of two or more rows, each followed by padding."""
    numbers = {"f4": 7, "f8": 8, "u4": 6, "u2": 4}
    assert dtype.fields is not None
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=numbers[kind.str[1:]])
        for name, (kind, offset) in dtype.fields.items()
    ]
    points = np.zeros((rows, len(values["x"]) // rows), dtype)
    for name, column in values.items():
        points[name] = column.reshape(points.shape)
    width = points.shape[1]
    data = b"".join(row.tobytes() + b"\xff" * padding for row in points)
    return SimpleNamespace(
        is_bigendian=dtype["x"].byteorder == ">",
        fields=fields,
        height=rows,
        width=width,
        point_step=dtype.itemsize,
        row_step=width * dtype.itemsize + padding,
        data=np.frombuffer(data, np.uint8),
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_decodes_any_layout_of_points(order: str) -> None:
    """Fields out of order with gaps, padded rows, either byte order; integers of time are nanoseconds."""
    dtype = np.dtype(
        {"names": ["z", "t", "x", "y", "ring"],
         "formats": [f"{order}{kind}" for kind in ("f8", "u4", "f8", "f8", "u2")],
         "offsets": [4, 12, 20, 28, 36], "itemsize": 40}
    )  # fmt: skip
    x, y = np.array([1.0, 2.0, np.nan, 4.0]), np.array([5.0, 6.0, np.nan, 8.0])
    t = np.array([4_000_000_000, 4_000_500_000, 4_001_000_000, 4_001_500_000])
    values = {"x": x, "y": y, "z": -x, "t": t, "ring": np.array([0, 63, 1, 2])}
    points_m, time_s, ring = ros_bags.decode_points(message(dtype, 2, 7, **values))
    np.testing.assert_array_equal(points_m, np.column_stack([x, y, -x]))
    np.testing.assert_allclose(time_s, [0.0, 0.0005, 0.001, 0.0015], atol=1e-12)
    np.testing.assert_array_equal(ring, [0, 63, 1, 2])


def test_blocks_carry_times_and_rings() -> None:
    """Either without the other; invalid times are not taken for times."""
    points, values = np.ones((4, 3)), np.array([0.0, 0.02, 0.05, 0.1])
    for time_s, ring in ((values, values * 10), (values, None), (None, np.arange(4.0)), (None, None)):
        blocks = list(sweep_blocks("one", points, time_s, ring))
        assert len(blocks) == (1 if time_s is None and ring is None else 2)
        if len(blocks) == 2:
            columns = blocks[1].points_m
            expected = np.full(4, np.nan) if time_s is None else time_s
            np.testing.assert_array_equal(columns[:, 0], expected)
            np.testing.assert_array_equal(columns[:, 1], np.full(4, np.nan) if ring is None else ring)
    assert ring_numbers(values * 10) is None
    assert ring_numbers(np.full(4, np.nan)) is None
    np.testing.assert_array_equal(ring_numbers(np.arange(4.0)), np.arange(4))


def test_rejects_contradictory_message() -> None:
    dtype = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    sound = message(dtype, 2, 0, x=np.ones(4), y=np.ones(4), z=np.ones(4))
    assert ros_bags.decode_points(sound)[1:] == (None, None)
    for key, value, problem in (
        ("width", 3, "has 48"),
        ("point_step", 0, "points of 0 bytes"),
        ("fields", sound.fields[:2], "no field z"),
        ("fields", [*sound.fields[:2], SimpleNamespace(name="z", offset=10, datatype=7)], "does not fit"),
        ("fields", [*sound.fields[:2], SimpleNamespace(name="z", offset=8, datatype=99)], "unknown type 99"),
        ("fields", [*sound.fields[:2], SimpleNamespace(name="z", offset=8, datatype=6)], "floating point"),
    ):
        with pytest.raises(ValueError, match=problem):
            ros_bags.decode_points(SimpleNamespace(**(vars(sound) | {key: value})))


# ---- captures of Velodyne packets


def cylinder(azimuth_deg: FloatArray, elevation_deg: FloatArray) -> FloatArray:
    """10 m away; 20 m to the maker's right (azimuth 90); nothing from 180 to 190 degrees."""
    ranges = np.where(np.abs(azimuth_deg - 90.0) < 20.0, 20.0, 10.0)
    return np.where((azimuth_deg > 180.0) & (azimuth_deg < 190.0), 0.0, ranges)


@pytest.mark.slow
@pytest.mark.system
def test_packets_are_turns(tmp_path: Path) -> None:
    write_pcap(tmp_path / "run.pcap", packets(cylinder, turns=3.3))
    sweeps = read_sweeps([tmp_path / "run.pcap"])
    assert [sweep.name for sweep in sweeps] == ["run.pcap: turn 1", "run.pcap: turn 2", "run.pcap: turn 3"]
    points, times = sweeps[1].points_m, sweeps[1].time_s
    assert times is not None and len(points) % 16 == 0
    missing = np.isnan(points[:, 0])
    assert missing.mean() == pytest.approx(10.0 / 360.0, abs=0.002)
    rings = points.reshape(-1, 16, 3)
    elevation_deg = np.degrees(np.arctan2(rings[..., 2], np.hypot(rings[..., 0], rings[..., 1])))
    np.testing.assert_allclose(np.nanmedian(elevation_deg, axis=0), np.sort(ELEVATIONS_DEG), atol=0.1)
    distance = np.linalg.norm(points, axis=1)
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))  # 0 is the maker's y axis, ahead
    right = np.abs(azimuth_deg + 90.0) < 19.0
    np.testing.assert_allclose(distance[right], 20.0, atol=0.02)
    np.testing.assert_allclose(distance[~right & ~missing & (np.abs(azimuth_deg + 90.0) > 21.0)], 10.0, atol=0.02)
    assert np.nanmax(times) == pytest.approx(0.1, abs=0.002)


@pytest.mark.slow
@pytest.mark.system
def test_fits_packets(tmp_path: Path) -> None:
    """A room of 40 x 48 m, 2 m below: elevations, the known 41.9 mm of the optics, 10 turns per second."""

    def room(azimuth_deg: FloatArray, elevation_deg: FloatArray) -> FloatArray:
        azimuth, elevation = np.radians(-azimuth_deg), np.radians(elevation_deg)
        with np.errstate(divide="ignore"):
            walls = np.minimum(20.0 / np.abs(np.cos(azimuth)), 24.0 / np.abs(np.sin(azimuth))) / np.cos(elevation)
            ground = np.where(elevation < 0, -2.0 / np.sin(elevation), np.inf)
        return np.minimum(walls, ground) + rng.normal(0.0, 0.01, azimuth.shape)

    rng = np.random.default_rng(0)
    write_pcap(tmp_path / "run.pcap", packets(room, turns=2.2))
    fit = fit_sensor(read_sweeps([tmp_path / "run.pcap"]))
    np.testing.assert_allclose(np.sort(fit.angles.elevation_deg), np.sort(ELEVATIONS_DEG), atol=0.01)
    assert fit.angles.axis_distance_m == pytest.approx(0.0419, abs=0.002)
    assert fit.angles.direction == -1
    assert fit.plane.height_m == pytest.approx(2.0, abs=0.02)
    assert fit.rotation is not None
    assert fit.rotation.rate_hz == pytest.approx(-10.0, abs=0.002)
    assert fit.rotation.firing_interval_s == pytest.approx(55.296e-6, abs=1e-8)
    assert fit.rotation.step_deg == pytest.approx(0.1990656, abs=1e-4)


@pytest.mark.slow
@pytest.mark.system
def test_returns_beyond_200_m_are_kept(tmp_path: Path) -> None:
    """VLP-32C packets: ranges in steps of 4 mm, all of them 230 m; the decoder's default would drop them."""

    def payload(number: int) -> bytes:
        blocks = b""
        for block in range(12):
            azimuth = (20 * (12 * number + block)) % 36000
            blocks += b"\xff\xee" + azimuth.to_bytes(2, "little") + ((57500).to_bytes(2, "little") + b"\x64") * 32
        return blocks + round(number * 12 * 55.296).to_bytes(4, "little") + b"\x37\x28"

    write_pcap(tmp_path / "far.pcap", [payload(number) for number in range(400)])
    sweep = read_sweeps([tmp_path / "far.pcap"])[0]
    np.testing.assert_allclose(np.linalg.norm(sweep.points_m, axis=1), 230.0, atol=0.1)
    with pytest.raises(InputError, match="at least 2,000 returns, got 0"):
        read_sweeps([tmp_path / "far.pcap"], RecordingOptions(range_m=200.0))


def decoded(firings: int, missing: tuple[int, ...] = ()) -> FloatArray:
    """Rows of the decoder for two lasers, 10 us apart, that fire every 55 us; x is the number of the row."""
    rows = [
        (firing, laser, 55e-6 * firing + 10e-6 * laser)
        for firing in range(firings)
        for laser in (0, 1)
        if firing not in missing
    ]
    points = np.zeros((len(rows), 8))
    points[:, 0] = np.arange(1, len(rows) + 1)
    points[:, 4] = [time_s - 0.1 for _, _, time_s in rows]
    points[:, 5] = np.repeat(np.arange(len(rows) // 2), 2)  # empty packets are not numbered
    points[:, 6] = [laser for _, laser, _ in rows]
    return points


def test_firings_without_return_are_counted() -> None:
    points_m, time_s = velodyne_pcap.organise(decoded(20, missing=(5, 6, 7)))
    expected = [*range(1, 11), *[np.nan] * 6, *range(11, 35)]
    np.testing.assert_array_equal(points_m[:, 0], expected)
    assert time_s[16] == pytest.approx(8 * 55e-6 - 0.1)


def test_first_laser_without_return_moves_no_firing() -> None:
    points_m, _ = velodyne_pcap.organise(np.delete(decoded(20), [4, 10], axis=0))
    assert np.flatnonzero(np.isnan(points_m[:, 0])).tolist() == [4, 10]


def test_list_of_returns_where_slots_are_shared() -> None:
    """Two returns of a laser in one firing, as in dual return mode; and firings at irregular times."""
    points = decoded(20)
    points_m, _ = velodyne_pcap.organise(np.insert(points, 3, points[3], axis=0))
    assert np.isfinite(points_m).all() and len(points_m) == 41
    points[:, 4] = np.sort(np.random.default_rng(0).uniform(0.0, 0.1, len(points)))
    assert velodyne_pcap.organise(points[:-1])[0].shape == (39, 3)


# ---- messages


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "data", "problem"),
    [
        ("run.bag", b"no bag", "cannot be read as a recording of ROS"),
        ("run.mcap", b"\x89MCAP0\r\n and no more", "cannot be read as a recording of ROS"),
        ("run.db3", b"SQLite format 3\0", "cannot be read as a recording of ROS"),
        ("run.pcap", b"no capture", "cannot be read as a capture of a Velodyne sensor"),
        ("run.pcap", b"\x0a\x0d\x0d\x0a" + 100 * b"\0", "cannot be read as a capture of a Velodyne sensor"),
        ("run.pcap", b"", "cannot be read as a capture of a Velodyne sensor"),
    ],
)
def test_rejects_damaged_file(tmp_path: Path, name: str, data: bytes, problem: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=problem) as caught:
        read_sweeps([tmp_path / name])
    assert str(caught.value).startswith(name)


@pytest.mark.parametrize("name", ["run.bag", "run.mcap", "run.pcap"])
def test_rejects_missing_file(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_sweeps([tmp_path / name])


@pytest.mark.slow
@pytest.mark.system
def test_rejects_capture_without_turn(tmp_path: Path) -> None:
    write_pcap(tmp_path / "other.pcap", [b"no packet of a sensor"] * 5)
    with pytest.raises(InputError, match="expected a complete turn, got no packets of a Velodyne sensor"):
        read_sweeps([tmp_path / "other.pcap"])
    write_pcap(tmp_path / "short.pcap", packets(cylinder, turns=0.8))
    with pytest.raises(InputError, match="expected a complete turn, got less than one"):
        read_sweeps([tmp_path / "short.pcap"])


@pytest.mark.parametrize(("name", "package"), [("run.mcap", "rosbags"), ("run.pcap", "velodyne-decoder")])
def test_missing_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr(plugins, "find_spec", lambda _: None)
    monkeypatch.delitem(sys.modules, package, raising=False)
    with pytest.raises(EgvsError, match=rf"needs {package}, which is not installed. Run pip install 'egvs\[sweeps\]'"):
        read_sweeps([tmp_path / name])
