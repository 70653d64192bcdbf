"""``egvs sensor fit``: what it prints and writes, and one message for each wrong input.

Evidence: a sweep of a simulated sensor; options that are wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.formats import ply
from tests.sensor_fit.small_sensor import TRUTH, sweep_of


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    path = tmp_path / "sweep.ply"
    ply.write(path, sweep_of(TRUTH))
    return path


def test_prints_sensor_pose_and_files(sweep: Path, tmp_path: Path, run_egvs: Any) -> None:
    out = tmp_path / "made"
    code, printed, _ = run_egvs("sensor", "fit", str(sweep), "--name", "mast", "--out", str(out))
    assert code == 0
    assert "elevations: 10 channels from -25.000 to 3.000 degrees" in printed
    assert "optics 30.0 mm from the axis" in printed
    assert "azimuths: 900 every 0.4000 degrees, counter-clockwise from above" in printed
    assert "in steps of 4 mm" in printed
    assert "1 (chosen)" in printed
    assert "ground.png that the chosen plane is the road" in printed
    assert sorted(path.name for path in out.iterdir()) == [
        "angles.png", "fit.json", "ground.png", "ranges.png", "sensor.toml"
    ]  # fmt: skip
    assert "# Sensor mast, fitted by egvs sensor fit to:" in (out / "sensor.toml").read_text(encoding="utf-8")


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


def test_rejects_cloud_without_rings(tmp_path: Path, run_egvs: Any) -> None:
    path = tmp_path / "cloud.ply"
    ply.write(path, np.random.default_rng(0).normal(size=(4000, 3)) * (20.0, 20.0, 5.0))
    code, _, error = run_egvs("sensor", "fit", str(path), "--name", "a", "--out", str(tmp_path / "made"))
    assert code == 2
    assert "cloud.ply: expected" in error
    assert not (tmp_path / "made").exists()
