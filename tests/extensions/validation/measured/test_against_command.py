"""``egvs validate --against``: what it prints and writes, and one message for each wrong input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.extensions.validation.measured.sensor_site import move_boxes
from egvs.formats import pcd
from egvs.sensors.sensor import CATALOGUE, rotation_world_sensor
from egvs.sensors.sensor_table import format_sensor_table, sensor_keys
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def in_frame(folder: Path, made: twin.Twin, rotation: np.ndarray) -> Path:
    """Write sweeps and labels of a twin turned into another frame."""
    folder.mkdir()
    points_m = [points @ rotation.T for points in made.points_m]
    boxes = [move_boxes(boxes, rotation, np.zeros(3)) for boxes in made.boxes]
    turned = twin.Twin(points_m, boxes)
    twin.write_pcd(folder, turned)
    twin.write_openlabel(folder, turned)
    return folder


@pytest.fixture(scope="module")
def made() -> twin.Twin:
    return twin.make_twin(LOSSES, seed=6, sweeps=1, cars=8)


TURN = np.diag([1.0, -1.0, -1.0])


def write_mast(mini: Path, roll_deg: float) -> None:
    """A mast of the twin's height far from the building."""
    row = f"mast,-80,40,{twin.POSE.z_m},90,{twin.POSE.pitch_deg},{roll_deg}"
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg\n{row}\n", encoding="utf-8")


def counts(path: Path) -> np.ndarray:
    """Simulated and measured points of each box, (n, 2)."""
    boxes = json.loads((path / "against.json").read_text(encoding="utf-8"))["boxes"]
    return np.array([[box["simulated"], box["measured"]] for box in boxes])


@pytest.mark.slow
def test_frames_of_sweeps_give_the_same_points(made: twin.Twin, mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    """A sensor upside down whose beams are those of an upright one in the world, with and without a site."""
    common = ("--sensor", SENSOR, "--detector", "points", "--out")
    plain = in_frame(tmp_path / "plain", made, np.eye(3))
    code, _, error = run_egvs("validate", "--against", plain, "--labels", plain, *common, tmp_path / "a")
    assert code == 0, error
    expected = counts(tmp_path / "a")

    hung = in_frame(tmp_path / "hung", made, TURN)
    write_mast(mini, twin.POSE.roll_deg)
    upright = CATALOGUE[SENSOR]
    keys = sensor_keys(upright) | {"mount": "inverted", "elevations_deg": [-value for value in upright.elevations_deg]}
    keys["azimuth_offsets_deg"] = [-value for value in upright.azimuth_offsets_deg]
    with (mini / "scenario.toml").open("a", encoding="utf-8") as file:
        file.write(format_sensor_table("hung", keys))
    common = ("--sensor", "hung", "--detector", "points", "--out")
    for number, site in enumerate(((), ("--site", "mast"))):
        arguments = (mini, *site, "--set", "sites.replace_sensor=hung", "--against", hung, "--labels", hung)
        code, _, error = run_egvs("validate", *arguments, *common, tmp_path / f"b{number}")
        assert code == 0, error
        found = counts(tmp_path / f"b{number}")
        assert found[:, 1].tolist() == expected[:, 1].tolist()
        assert np.abs(found[:, 0] - expected[:, 0]).max() <= 0.1 * expected[:, 0].max()
        assert "mount = 'inverted'" in (tmp_path / f"b{number}" / "sensor.toml").read_text(encoding="utf-8")

    level = in_frame(tmp_path / "level", made, rotation_world_sensor(0.0, -20.0, 0.0))
    write_mast(mini, twin.POSE.roll_deg)
    arguments = (mini, "--site", "mast", "--against", level, "--labels", level)
    code, _, error = run_egvs("validate", *arguments, *common, tmp_path / "c")
    assert code == 2 and "the ground of the sweeps is not that below site mast" in error


@pytest.mark.slow
def test_levelled_sweeps_are_reported(made: twin.Twin, mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    """The pose of the site is tilted and upside down; the sweeps are those of a program that levels them."""
    pose = twin.POSE
    level = in_frame(tmp_path / "level", made, rotation_world_sensor(0.0, pose.pitch_deg, pose.roll_deg))
    plain = in_frame(tmp_path / "plain", made, np.eye(3))
    common = ("--labels", level, "--sensor", SENSOR, "--detector", "points", "--out")
    row = f"mast,-80,40,{pose.z_m},90,-6,0"
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg\n{row}\n", encoding="utf-8")
    for key in ("sites.mount=upright", "sites.mount=inverted"):
        arguments = (mini, "--site", "mast", "--set", key, "--against", level)
        code, printed, error = run_egvs("validate", *arguments, *common, tmp_path / key[-8:])
        assert code == 0, error
        assert "The sweeps are levelled" in printed.replace("\n", " ")
        assert counts(tmp_path / key[-8:])[:, 1].sum() > 0
    assert counts(tmp_path / "=upright")[:, 0].sum() > 0  # upside down, this sensor looks at the sky
    write_mast(mini, pose.roll_deg)
    arguments = (mini, "--site", "mast", "--set", "sites.mount=inverted", "--against", plain, "--labels", plain)
    code, _, error = run_egvs("validate", *arguments, "--sensor", SENSOR, "--out", tmp_path / "no")
    assert code == 2 and "the sweeps are upside down for site mast" in error and "sites.mount=upright" in error


@pytest.mark.slow
def test_other_rings_are_reported_and_nothing_is_fitted(folder: Path, tmp_path: Path, run_egvs: Any) -> None:
    common = ("--against", folder, "--labels", folder, "--detector", "points", "--out", tmp_path / "out")
    code, printed, error = run_egvs("validate", *common, "--sensor", "OS1-64 2048")
    assert code == 0, error
    assert "The rings do not match" in printed and f"The nearest sensor of the catalogue is {SENSOR}." in printed
    assert "No losses are fitted." in printed and "[sensors." not in printed
    code, printed, error = run_egvs("validate", *common, "--sensor", SENSOR)
    assert code == 0, error
    assert "do not match" not in printed
    code, printed, error = run_egvs("validate", *common, "--sensor", "OS1-64 BH")
    assert code == 0, error
    assert "The azimuths do not match: in the sweeps, the returns of a ring are 0.17" in printed
    assert "degrees apart, those of OS1-64 BH 0.352." in printed
    assert f"The nearest sensor of the catalogue is {SENSOR}. No losses are fitted." in printed


@pytest.mark.slow
def test_sensor_may_be_a_file(folder: Path, tmp_path: Path, run_egvs: Any) -> None:
    """The file of a fit, named as it is written; one message for a wrong one."""
    file = tmp_path / "sensor.toml"
    file.write_text(format_sensor_table("unit", sensor_keys(CATALOGUE[SENSOR])), encoding="utf-8")
    common = ("validate", "--against", folder, "--labels", folder, "--detector", "points", "--sensor", file)
    code, printed, error = run_egvs(*common, "--out", tmp_path / "out")
    assert code == 0, error
    assert "unit: 16 labelled boxes" in printed
    for text, message in (
        ("[sensors.a]\nrange_m = 0\n", "sensor.toml: sensors.a"),
        ("x = 1\n", "sensor.toml: expected one table [sensors.NAME], got 0"),
        ("[[", "sensor.toml"),
    ):
        file.write_text(text, encoding="utf-8")
        code, _, error = run_egvs(*common, "--out", tmp_path / "no")
        assert code == 2 and message in error and "Traceback" not in error
