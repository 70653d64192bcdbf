"""``egvs sensor fit``: what it prints and writes, and one message for each wrong input.

Evidence: a sweep of a simulated sensor; options that are wrong.
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.extensions.hardware import sensor_commands as sensor
from egvs.formats import ply
from egvs.formats.recording_options import RecordingOptions
from tests.extensions.hardware.fit.small_sensor import TRUTH, coarse_sensor, sweep_of
from tests.extensions.hardware.recordings.ros_recordings import write_recording


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    path = tmp_path / "sweep.ply"
    ply.write(path, sweep_of(TRUTH))
    return path


@pytest.mark.slow
def test_prints_sensor_pose_and_files(sweep: Path, tmp_path: Path, run_egvs: Any) -> None:
    out = tmp_path / "made"
    code, printed, _ = run_egvs("sensor", "fit", str(sweep), "--name", "mast", "--out", str(out))
    assert code == 0
    assert "elevations: 10 channels from -25.000 to 3.000 degrees" in printed
    assert "optics 30.0 mm from the axis" in printed
    assert "azimuths: 900 every 0.4000 degrees, counter-clockwise from above" in printed
    assert "in steps of 4 mm" in printed
    assert "rotation: rate unknown (the sweeps have no times)" in printed
    assert "1 (chosen)" in printed
    assert "ground.png that the chosen plane is the road" in printed
    assert sorted(path.name for path in out.iterdir()) == [
        "angles.png", "fit.json", "ground.png", "ranges.png", "sensor.toml"
    ]  # fmt: skip
    assert "# Sensor mast, fitted by egvs sensor fit to:" in (out / "sensor.toml").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.system
def test_prints_recording_and_rotation(tmp_path: Path, run_egvs: Any) -> None:
    pytest.importorskip("rosbags")
    times = np.repeat(np.arange(300), 10) * 0.1 / 300
    clouds = [(50.0 + 0.1 * i, sweep_of(TRUTH, coarse_sensor(), seed=i), times) for i in range(3)]
    path = write_recording(tmp_path / "run.mcap", clouds)
    out = tmp_path / "made"
    code, printed, error = run_egvs("sensor", "fit", path, "--name", "mast", "--out", out, "--max-sweeps", "2")
    assert code == 0, error
    assert "run.mcap: 2 of 3 sweeps read; topic /lidar/points, frame lidar" in printed
    assert "rotation: 10.0000 +- " in printed
    assert "turns per second, from times of points of 2 sweeps; a firing every 333.333 us" in printed
    rotation = json.loads((out / "fit.json").read_text(encoding="utf-8"))["rotation"]
    assert rotation["turns_per_second"]["value"] == pytest.approx(10.0, abs=1e-3)
    assert rotation["azimuth_step_deg"] == pytest.approx(1.2, abs=1e-3)


@pytest.mark.slow
@pytest.mark.system
def test_rejects_unknown_topic(tmp_path: Path, run_egvs: Any) -> None:
    pytest.importorskip("rosbags")
    path = write_recording(tmp_path / "run.bag", [(50.0, sweep_of(TRUTH, coarse_sensor()), None)])
    arguments = ("sensor", "fit", path, "--name", "mast", "--out", tmp_path / "made", "--topic", "/rear")
    code, _, error = run_egvs(*arguments)
    assert code == 2
    assert "--topic: expected one of /lidar/points, got '/rear'" in error
    assert "Traceback" not in error
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--name: no name is given"),
        (("--name", "a/b"), "--name: expected a name of letters"),
        (("--name", "a", "--road", "20"), "--road: expected two azimuths"),
        (("--name", "a", "--road=30,-30"), "--road: expected two azimuths"),
        (("--name", "a", "--ground", "3"), "--ground: expected a plane from 1 to 1, got 3"),
        (("--name", "a", "--without-empty-sector"), "--without-empty-sector: this sensor has no sector"),
        (("--name", "a", "--out", "sweep.ply"), "sweep.ply"),
    ],
)
def test_rejects_option(
    sweep: Path,
    tmp_path: Path,
    run_egvs: Any,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, printed, error = run_egvs("sensor", "fit", sweep.name, *options)
    assert code == 2
    assert printed == ""
    assert message in error
    assert "Traceback" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.ply"]


@pytest.mark.slow
def test_rejects_cloud_without_rings(tmp_path: Path, run_egvs: Any) -> None:
    path = tmp_path / "cloud.ply"
    ply.write(path, np.random.default_rng(0).normal(size=(4000, 3)) * (20.0, 20.0, 5.0))
    code, _, error = run_egvs("sensor", "fit", str(path), "--name", "a", "--out", str(tmp_path / "made"))
    assert code == 2
    assert "cloud.ply: expected" in error
    assert not (tmp_path / "made").exists()


def test_defaults_of_recordings_have_one_definition() -> None:
    """The command's defaults are those of the reader: 20 sweeps and 500 m."""
    options = {name: parameter.default for name, parameter in inspect.signature(sensor.fit).parameters.items()}
    assert RecordingOptions() == RecordingOptions(None, options["max_sweeps"], options["max_range"])
    assert (options["max_sweeps"], options["max_range"]) == (20, 500.0)


@pytest.mark.slow
@pytest.mark.parametrize(("unit_s", "kind"), [(1e-9, "U"), (1.0, "F")])
def test_times_of_points_of_a_file_give_the_rotation(tmp_path: Path, run_egvs: Any, unit_s: float, kind: str) -> None:
    """An Ouster's field t counts nanoseconds; others have seconds."""
    points_m = sweep_of(TRUTH, coarse_sensor())
    times = np.repeat(np.arange(300), 10) * 0.1 / 300 / unit_s
    returned = np.isfinite(points_m[:, 0])
    rows = np.column_stack([points_m, times])[returned]
    header = (
        f"VERSION 0.7\nFIELDS x y z t\nSIZE 8 8 8 {4 if kind == 'U' else 8}\nTYPE F F F {kind}\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA ascii\n"
    )
    lines = [f"{x!r} {y!r} {z!r} {round(t) if kind == 'U' else t!r}" for x, y, z, t in rows.tolist()]
    (tmp_path / "sweep.pcd").write_text(header + "\n".join(lines) + "\n")
    code, printed, error = run_egvs(
        "sensor", "fit", tmp_path / "sweep.pcd", "--name", "mast", "--out", tmp_path / "made"
    )
    assert code == 0, error
    assert "rotation: 10.0" in printed and "from times of points" in printed.replace("\n", " ")
