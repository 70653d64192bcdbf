"""``egvs validate --against``: what it prints and writes, and one message for each wrong input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.formats import pcd
from tests.extensions.validation.measured import twin
from tests.extensions.validation.measured.test_comparison import LOSSES
from tests.extensions.validation.measured.twin import SENSOR


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sweeps of eight cars each, with labels."""
    path = tmp_path_factory.mktemp("sweeps")
    made = twin.make_twin(LOSSES, seed=5, sweeps=2, cars=8)
    twin.write_pcd(path, made)
    twin.write_openlabel(path, made)
    return path


def test_prints_tables_and_writes_files(folder: Path, tmp_path: Path, run_egvs: Any) -> None:
    out = tmp_path / "out"
    arguments = ("--against", folder, "--labels", folder, "--sensor", SENSOR, "--detector", "points", "--out", out)
    code, printed, error = run_egvs("validate", *arguments)
    assert code == 0, error
    assert "Points on vehicles (± 2 se)" in printed and "car         all" not in error
    assert "16 different cars in 2 sweeps are an anchor, not a validation" in printed
    assert "[sensors." in printed and "people (noticed)" in printed
    assert sorted(path.name for path in out.iterdir()) == ["against.html", "against.json", "sensor.toml"]
    values = json.loads((out / "against.json").read_text(encoding="utf-8"))
    assert len(values["boxes"]) == 16 and values["points"][0]["boxes"] == 16
    low_m, high_m = values["fitted_losses"]["limit_interval_m"]
    assert low_m < LOSSES.limit_m(0.03) < high_m
    page = (out / "against.html").read_text(encoding="utf-8")
    assert "16 labelled boxes in 2 sweeps" in page and "http" not in page.split("<body>")[1]


def test_without_labels_prints_repetition(folder: Path, run_egvs: Any) -> None:
    code, printed, error = run_egvs("validate", "--against", folder, "--sensor", SENSOR)
    assert code == 0, error
    assert "Returns that come again in the next of 2 sweeps" in printed
    assert "What vehicles reflect does not follow from it" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--against", "{}", "--labels", "{}"), "--sensor: expected the sensor of the sweeps, got none"),
        (("--against", "{}", "--labels", "{}", "--sensor", "OS1"), "--sensor: unknown sensor 'OS1'"),
        (("--against", "{}", "--labels", "{}", "--sensor", SENSOR, "--site", "a"), "--site: expected a scenario"),
        (("--against", "{}", "--labels", "{}", "--sensor", SENSOR, "--yaw", "z"), "--yaw: expected x-ccw, x-cw"),
        (("--against", "{}/none.pcd", "--labels", "{}", "--sensor", SENSOR), "none.pcd"),
        (("--against", "{}", "--sensor", SENSOR), "--out: only available with labels"),
        (("--against", "{}/sweep0.json", "--labels", "{}", "--sensor", SENSOR), "sweep0.json"),
        (("--labels", "{}"), "--labels: expected two lists without sweeps, got one. Add the labels of another sensor"),
        (("--against", "{}", "--labels", "{}", "--sensor", "a", "--sensor", "b"), "--sensor: expected one name, got 2"),
        (("--against", "{}", "--labels", "{}", "--detections", "{}"), "--detections: not available with measured"),
        (("--labels", "{}", "--labels", "{}", "--plan"), "--plan: not available with measured sweeps"),
        (("--sensor", SENSOR), "--sensor: only available with measured sweeps"),
        ((), "SCENARIO: expected a scenario or a run, got none"),
        (("--against", "{}", "--labels", "{}/sweep0.pcd", "--sensor", SENSOR), "sweep0.pcd: expected labels ("),
        (
            ("--against", "{}", "--labels", "{}", "--sensor", SENSOR, "--columns", "x"),
            "--columns: expected VALUE=COLUMN",
        ),
    ],
)
def test_wrong_input_gives_one_message(
    folder: Path, tmp_path: Path, run_egvs: Any, arguments: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "out"
    code, _, error = run_egvs("validate", *(text.format(folder) for text in arguments), "--out", out)
    assert code == 2
    assert message in error and "Traceback" not in error
    assert not out.exists()


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        ("sweep,type,x_m,y_m,z_m,length_m,width_m,yaw_deg", "s,car,1,2,0,4,2,0", "expected the columns height_m"),
        (
            "type,x_m,y_m,z_m,length_m,width_m,height_m,yaw_deg",
            "car,1,2,0,4,2,1,0",
            "one of the columns sweep or time_s",
        ),
        ("sweep,type,x_m,y_m,z_m,length_m,width_m,height_m,yaw_deg", "s,car,1,2,0,4,2,x,0", "expected a finite number"),
        ("sweep,type,x_m,y_m,z_m,length_m,width_m,height_m,yaw_deg", "s,car,1,2,0,4,2,-1,0", "expected a box near"),
    ],
)
def test_damaged_tables_are_refused(
    folder: Path, tmp_path: Path, run_egvs: Any, header: str, row: str, message: str
) -> None:
    table = tmp_path / "labels.csv"
    table.write_text(f"{header}\n{row}\n", encoding="utf-8")
    code, _, error = run_egvs("validate", "--against", folder, "--labels", table, "--sensor", SENSOR)
    assert code == 2 and message in error and "labels.csv" in error


def test_points_of_kitti_are_sweeps(folder: Path, tmp_path: Path, run_egvs: Any) -> None:
    """The same sweep as float32 with an intensity gives the same table."""
    points_m = pcd.read(folder / "sweep0.pcd", "sweep0.pcd")
    np.column_stack([points_m, np.zeros(len(points_m))]).astype("<f4").tofile(tmp_path / "sweep0.bin")
    label = folder / "sweep0.json"
    common = ("--labels", label, "--sensor", SENSOR, "--detector", "points")
    printed = []
    for sweep in (folder / "sweep0.pcd", tmp_path / "sweep0.bin"):
        code, text, error = run_egvs("validate", "--against", sweep, *common)
        assert code == 0, error
        printed.append(text.split("\n")[2].split()[:5])
    assert printed[0] == printed[1]
    (tmp_path / "cut.bin").write_bytes(b"\0" * 30)
    code, _, error = run_egvs("validate", "--against", tmp_path / "cut.bin", *common)
    assert code == 2 and "expected records of 16 bytes" in error


def test_world_and_pose_of_a_scenario(folder: Path, mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    """Over level ground far from the building, a site of a scenario sees what the fitted ground plane does."""
    pose = twin.POSE
    row = f"mast,-80,40,{pose.z_m},90,{pose.pitch_deg},{pose.roll_deg}"
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg\n{row}\n", encoding="utf-8")
    common = ("--against", folder, "--labels", folder, "--sensor", SENSOR, "--detector", "points", "--out")
    simulated = []
    for name, scenario in (("plane", ()), ("site", (mini, "--site", "mast"))):
        code, printed, error = run_egvs("validate", *scenario, *common, tmp_path / name)
        assert code == 0, error
        values = json.loads((tmp_path / name / "against.json").read_text(encoding="utf-8"))
        simulated.append([box["simulated"] for box in values["boxes"]])
    assert "The world is that of" in printed and "the pose that of its site mast" in printed
    assert np.abs(np.subtract(*simulated)).max() <= 0.05 * np.max(simulated)
    code, _, error = run_egvs("validate", mini, "--site", "pole", *common, tmp_path / "none")
    assert code == 2 and "--site: expected one of 1 sites, got 'pole'" in error
