"""Files of beams: tables of beams and rings, and the makers' files; one message for each wrong file.

Evidence: angles written by hand in every format; directions that follow from the makers' definitions of azimuth.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import egvs
from egvs.artefacts.tpog import read_tpog
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.core.errors import InputError
from egvs.runs.run_context import open_folder
from egvs.scenario.sensor_config import SensorConfig
from egvs.scoring.scorer import Scorer
from egvs.sensors import sites
from egvs.sensors.beam_files import BeamTable, Rings, read_beam_file, read_directions
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import Sensor, catalogue_entries, describe_odd_angles, resolve_sensor, scenario_sensor
from egvs.sensors.sites import Pose
from egvs.stages import scene_checks
from egvs.stages.inputs import CheckInputs
from egvs.stages.site_scans import empty_scans
from tests.clouds.cloud_scenes import frame_of
from tests.conftest import SCENARIO
from tests.formats.workbooks import write_xlsx

ELEVATIONS_DEG, CLOCKWISE_DEG = [15.0, 1.5, -0.25, -25.0], [3.1, 1.0, -1.1, -3.2]

FLAT = {
    "prod_line": "OS-1-4",
    "lidar_mode": "1024x10",
    "beam_altitude_angles": ELEVATIONS_DEG,
    "beam_azimuth_angles": CLOCKWISE_DEG,
    "lidar_origin_to_beam_origin_mm": 15.806,
}
NESTED = {
    "beam_intrinsics": {key: FLAT[key] for key in FLAT if key.startswith(("beam", "lidar_origin"))},
    "lidar_data_format": {"columns_per_frame": 1024, "column_window": [0, 1023], "pixels_per_column": 4},
    "config_params": {"lidar_mode": "1024x10"},
    "sensor_info": {"prod_line": "OS-1-4"},
}


def write(folder: Path, name: str, content: Any) -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def rings_of(path: Path) -> Rings:
    beams = read_beam_file(path).beams
    assert isinstance(beams, Rings)
    return beams


@pytest.mark.parametrize("layout", ["flat", "flat with data_format", "nested", "nested without columns"])
def test_ouster_metadata(tmp_path: Path, layout: str) -> None:
    document: dict[str, Any] = FLAT if layout.startswith("flat") else NESTED
    if layout == "flat with data_format":
        document = FLAT | {"lidar_mode": "", "data_format": {"columns_per_frame": 1024}}
    elif layout == "nested without columns":
        document = {key: NESTED[key] for key in ("beam_intrinsics", "config_params")}
    path = write(tmp_path, "metadata.json", document)
    assert read_beam_file(path).kind == "Ouster metadata"
    rings = rings_of(path)
    assert rings.elevations_deg == tuple(ELEVATIONS_DEG)
    assert rings.azimuth_offsets_deg == tuple(-angle for angle in CLOCKWISE_DEG)
    assert rings.axis_distance_m == pytest.approx(0.015806)
    assert (rings.azimuths, rings.azimuth_deg) == (1024, None)


@pytest.mark.parametrize(
    ("window", "azimuths", "azimuth_deg"),
    [
        ([0, 255], 256, (-89.6484375, 0.0)),
        ([256, 767], 512, (90.3515625, 270.0)),
        ([960, 63], 128, (-22.1484375 + 360.0 - 337.5, 22.5)),
        ([512, 511], 1024, None),
    ],
)
def test_ouster_azimuth_window(
    tmp_path: Path, window: list[int], azimuths: int, azimuth_deg: tuple[float, float] | None
) -> None:
    """Column k looks at 360 (1 - k / 1024) degrees."""
    document = NESTED | {"lidar_data_format": {"columns_per_frame": 1024, "column_window": window}}
    rings = rings_of(write(tmp_path, "metadata.json", document))
    assert rings.azimuths == azimuths
    if azimuth_deg is None:
        assert rings.azimuth_deg is None
        return
    assert rings.azimuth_deg is not None
    first, last = rings.azimuth_deg
    assert math.cos(math.radians(last + 360.0 * window[0] / 1024)) == pytest.approx(1.0)
    assert math.cos(math.radians(first + 360.0 * window[1] / 1024)) == pytest.approx(1.0)
    assert last - first == pytest.approx(360.0 / 1024 * (azimuths - 1))


def test_ouster_is_a_sensor(tmp_path: Path) -> None:
    """Its first column at azimuth 0: beam 2 looks 1.1 degrees counter-clockwise of x, a quarter degree down."""
    path = write(tmp_path, "metadata.json", NESTED)
    config = SensorConfig.from_dict({"beams": str(path), "range_m": 120})
    sensor = resolve_sensor("unit", {"unit": config}, "here")
    assert (sensor.channels, sensor.azimuths, sensor.beams) == (4, 1024, 4096)
    down, left = math.radians(0.25), math.radians(1.1)
    expected = [math.cos(down) * math.cos(left), math.cos(down) * math.sin(left), -math.sin(down)]
    assert sensor.directions()[2].tolist() == pytest.approx(expected)


HESAI_RINGS = Rings((14.436, -6.5), (-3.257, 1.1))
HESAI = "Laser id,Elevation,Azimuth\n1,14.436,3.257\n2,-6.5,-1.1\n"


@pytest.mark.parametrize(
    ("text", "kind", "rings"),
    [
        (HESAI, "Hesai angles", HESAI_RINGS),
        (HESAI.replace("Laser id", "channel").replace("\n2", "\n\n2"), "Hesai angles", HESAI_RINGS),
        (f"EEFF,1,1\n{HESAI}{'ab12' * 16},,\n", "Hesai angles", HESAI_RINGS),
        (f"{HESAI}{'ab12' * 16}\n", "Hesai angles", HESAI_RINGS),
        ("15.0,-3.5\n-7.25,2.0\n", "RoboSense angles", Rings((15.0, -7.25), (3.5, -2.0))),
        ("elevation_deg,azimuth_offset_deg\n1,2\n-3,0\n", "table of rings", Rings((1.0, -3.0), (2.0, 0.0))),
        (
            "ring,azimuth_offset_deg,vertical_offset_m,elevation_deg\n0,2,0.036,1\n1,0,0.042,-3\n",
            "table of rings",
            Rings((1.0, -3.0), (2.0, 0.0), (0.036, 0.042)),
        ),
    ],
)  # fmt: skip
def test_tables_of_rings(tmp_path: Path, text: str, kind: str, rings: Rings) -> None:
    file = read_beam_file(write(tmp_path, "angles.csv", text))
    assert (file.kind, file.beams) == (kind, rings)


def test_table_of_beams(tmp_path: Path) -> None:
    file = read_beam_file(write(tmp_path, "beams.csv", "elevation_deg,azimuth_deg\n1,2\n-3,350\n"))
    assert file.kind == "table of beams"
    assert isinstance(file.beams, BeamTable)
    assert file.beams.azimuth_deg.tolist() == [2.0, 350.0]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "expected azimuth_step_deg, since angles.csv lists 2 rings, got none"),
        ({"azimuth_step_deg": 1e-5}, "beams"),
    ],
)
def test_rings_need_columns(tmp_path: Path, keys: dict[str, float], message: str) -> None:
    path = write(tmp_path, "angles.csv", HESAI)
    with pytest.raises((InputError, ValueError), match=message):
        resolve_sensor("h", {"h": SensorConfig.from_dict({"beams": str(path), "range_m": 9, **keys})}, "here")


def test_columns_of_rings_are_those_of_the_scenario(tmp_path: Path) -> None:
    path = write(tmp_path, "angles.csv", HESAI)
    keys = {"beams": str(path), "range_m": 9, "azimuth_step_deg": 0.2, "azimuth_deg": (-60.0, 60.0)}
    sensor = resolve_sensor("h", {"h": SensorConfig.from_dict(keys)}, "here")
    expected = Sensor("h", (14.436, -6.5), (-3.257, 1.1), 601, 9.0, "the scenario", azimuth_deg=(-60.0, 60.0))
    assert sensor == expected


@pytest.mark.parametrize(
    ("name", "content"), [("metadata.json", NESTED), ("b.csv", "elevation_deg,azimuth_deg\n1,2\n")]
)
def test_columns_that_have_no_effect(tmp_path: Path, name: str, content: Any) -> None:
    path = write(tmp_path, name, content)
    keys = {"beams": str(path), "range_m": 9, "azimuth_step_deg": 0.2}
    with pytest.raises(InputError, match=rf"sensors\.u\.azimuth_step_deg: no effect with {name}"):
        resolve_sensor("u", {"u": SensorConfig.from_dict(keys)}, "here")


def changed(**values: Any) -> dict[str, Any]:
    return FLAT | values


def windowed(window: Any) -> dict[str, Any]:
    return changed(data_format={"columns_per_frame": 64, "column_window": window})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "expected an object with beam_altitude_angles"),
        ("{", "is not valid JSON"),
        ("[" * 5000, "is not valid JSON"),
        ('{"beam_altitude_angles": [1], "beam_altitude_angles": [2]}', "is not valid JSON"),
        ({}, "beam_altitude_angles: expected a list of angles, got none"),
        ({"beam_intrinsics": 3}, "beam_intrinsics: expected an object"),
        (changed(beam_altitude_angles="15"), "beam_altitude_angles: expected a list of angles, got another value"),
        (changed(beam_altitude_angles=[]), "beam_altitude_angles: expected at least one ring"),
        (changed(beam_altitude_angles=[0.0] * 10_001), "beam_altitude_angles: expected at most 10,000 rings"),
        (changed(beam_altitude_angles=[float("nan")] * 4), r"beam_altitude_angles\[0\]: expected a number between -90"),
        (changed(beam_altitude_angles=[1, 2, 3, 91]), r"beam_altitude_angles\[3\]: .* got '91'"),
        (changed(beam_altitude_angles=[1, 2, 3, True]), r"beam_altitude_angles\[3\]"),
        (changed(beam_azimuth_angles=[1, 2]), "beam_azimuth_angles: expected 4 values"),
        (changed(beam_azimuth_angles=[1, 2, 3, 1e9]), r"beam_azimuth_angles\[3\]: expected a number between -360"),
        (changed(lidar_origin_to_beam_origin_mm=-1), "lidar_origin_to_beam_origin_mm: expected a distance"),
        (changed(lidar_origin_to_beam_origin_mm=float("inf")), "lidar_origin_to_beam_origin_mm: expected a distance"),
        (changed(lidar_origin_to_beam_origin_mm="15"), "lidar_origin_to_beam_origin_mm: expected a distance"),
        (changed(lidar_mode="fast"), "lidar_mode: expected a mode such as 1024x10"),
        (changed(lidar_mode="999999x10"), "lidar_mode: expected a whole number from 1 to 100,000"),
        (changed(data_format={"columns_per_frame": 0}), "columns_per_frame: expected a whole number"),
        (changed(data_format={"columns_per_frame": 512.5}), "columns_per_frame: expected a whole number"),
        (windowed([0, 64]), "column_window: expected two columns"),
        (windowed("x"), "column_window: expected two columns"),
        (changed(data_format={"pixels_per_column": 64}), "beam_altitude_angles: expected 64 values, .* got 4"),
        (
            changed(beam_altitude_angles=[1, 0.0, 0.0, 0], beam_azimuth_angles=[1, 0.0, 0.0, 0]),
            "3 of 4 rings have elevation 0 and azimuth 0",
        ),
        (changed(**dict.fromkeys(("beam_altitude_angles", "beam_azimuth_angles"), [0] * 200), lidar_mode="90000x1"),
         "18,000,000 beams"),
    ],
)  # fmt: skip
def test_rejects_wrong_metadata(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=r"metadata\.json.*" + message):
        read_beam_file(write(tmp_path, "metadata.json", content))


TABLE = "elevation_deg;azimuth_offset_deg\n15,5;-4,226\n-1,25;1,39\n"


@pytest.mark.parametrize(
    "content",
    [
        TABLE.encode(),
        ("sep=;\n" + TABLE).encode("utf-8-sig"),
        TABLE.encode("utf-16"),
        TABLE.replace(";", "\t").encode(),
        TABLE.replace(",", ".").replace(";", "\t").encode(),
        TABLE.replace(",", ".").replace(";", ",").encode(),
        TABLE.replace("_deg\n", "_deg;Name\n").replace("226", "226;hänge").replace("39", "39;").encode("cp1252"),
        b"15.5\t4.226\n-1.25\t-1.39\n",
        b"Laser id\tElevation\tAzimuth\n1\t15.5\t4.226\n2\t-1.25\t-1.39\n",
    ],
)
def test_tables_are_read_as_offices_write_them(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "rings.csv"
    path.write_bytes(content)
    rings = rings_of(path)
    assert rings.elevations_deg == (15.5, -1.25) and rings.azimuth_offsets_deg == (-4.226, 1.39)


@pytest.mark.slow
@pytest.mark.system  # a workbook is read in a process of its own
def test_workbook_of_rings(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    rows = [["elevation_deg", "azimuth_offset_deg"], [15.5, -4.226], [-1.25, 1.39]]
    write_xlsx(tmp_path / "rings.xlsx", {"unit": rows})
    assert rings_of(tmp_path / "rings.xlsx").elevations_deg == (15.5, -1.25)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("rated_reflectivity", 10, "rated_reflectivity: expected a share above 0 and up to 1, got 10: 10 % is 0.1"),
        ("rated_reflectivity", 0, "rated_reflectivity"),
        (
            "azimuth_step_deg",
            0.3516,
            r"0\.3516 does not divide 360. The nearest that does is 0\.3515625 \(360 / 1024\)",
        ),
    ],
)
def test_values_of_data_sheets_are_explained(tmp_path: Path, key: str, value: float, message: str) -> None:
    keys = {"azimuth_step_deg": 0.5, "range_m": 80} | {key: value}
    lines = "".join(f"{name} = {number}\n" for name, number in keys.items())
    (tmp_path / "scenario.toml").write_text(SCENARIO + f"[sensors.mine]\nelevations_deg = [1, 2]\n{lines}")
    with pytest.raises(InputError, match=message):
        egvs.load(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column elevation_deg"),
        ("a,b\n1,2\n", "no column elevation_deg"),
        ("elevation_deg,azimuth_deg,azimuth_offset_deg\n1,2,3\n", "both columns azimuth_deg"),
        ("elevation_deg,azimuth_offset_deg,azimuth_offset_deg\n1,2,3\n", "2 columns azimuth_offset_deg"),
        ("elevation_deg,azimuth_offset_deg\n", "at least one ring"),
        ("elevation_deg,azimuth_offset_deg\n1\n", "ring 0: expected 2 values, one per column, got 1"),
        (
            "elevation_deg,azimuth_offset_deg\n1,2\n95,0\n",
            "ring 1: elevation_deg: expected a number between -90 and 90",
        ),
        ("elevation_deg,azimuth_offset_deg\n1,nan\n", "ring 0: azimuth_offset_deg: expected .* got 'nan'"),
        ("elevation_deg,azimuth_offset_deg\n1,2,5\n", "ring 0: expected 2 values, one per column, got 3"),
        ("elevation_deg,azimuth_offset_deg,vertical_offset_m\n1,2,36\n", "vertical_offset_m: expected .* got '36'"),
        ("elevation_deg,azimuth_offset_deg\n" + "1,2\n" * 10_001, "at most 10,000 rings"),
        ("Laser id,Elevation,Azimuth\n1,2,3\n1,4,5\n", "ring 1: laser '1' is that of ring 0 too"),
        (f"Laser id,Elevation,Azimuth\n{'ab12' * 16},,\n", "at least one ring"),
        ("Laser id,Elevation,Azimuth\n1,2,inf\n", "ring 0: Azimuth: expected"),
        ("1.5,2\n3,x\n", "ring 1: horizontal: expected a number"),
        ("1.5,2\n95,0\n", "ring 1: vertical: expected a number between -90 and 90"),
        ("1,5,2\n", "no column elevation_deg"),
        ("elevation_deg,azimuth_offset_deg\n1,2\n" + "0.0,0\n" * 52, "52 of 53 rings have elevation 0"),
        ("elevation_deg;azimuth_offset_deg\n1;2;3\n", "line 2: expected 2 values, got 3"),
    ],
)
def test_rejects_wrong_tables(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=r"angles\.csv.*" + message):
        read_beam_file(write(tmp_path, "angles.csv", text))


@pytest.mark.parametrize(
    ("text", "settings", "warns"),
    [
        ("elevation_deg,azimuth_deg\n" + "".join(f"{number},0\n" for number in range(64)), (), True),
        ("elevation_deg,azimuth_offset_deg\n-5,0\n-10,0\n-15,1\n", ("sensors.small.azimuth_step_deg=1",), False),
        ("elevation_deg,azimuth_offset_deg\n-5,0\n", ("sensors.small.azimuth_step_deg=1",), True),
    ],
)
def test_warns_about_few_beams(mini: Path, text: str, settings: tuple[str, ...], warns: bool) -> None:
    """64 rows of rings that are named like beams were read as a sensor of 64 beams."""
    write(mini, "beams.csv", text)
    file = mini / "scenario.toml"
    rings = "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n"
    file.write_text(file.read_text(encoding="utf-8").replace(rings, 'beams = "beams.csv"\n'), encoding="utf-8")
    scenario = egvs.load(mini, list(settings))
    inputs = CheckInputs(scenario, sites=sites.candidate_sites(scenario))
    found = list(scene_checks.warn_odd_beams(inputs))
    assert bool(found) == warns
    if warns:
        assert found[0].where == "beams.csv"
        assert "a LiDAR has thousands" in found[0].problem


HESAI_HEADER = "Laser id,Elevation,Azimuth\n"
SWAPPED_HEADER = "Laser id,Azimuth,Elevation\n"


@pytest.mark.parametrize(
    ("name", "header", "scale", "words"),
    [
        ("a.csv", HESAI_HEADER, 1.0, None),
        ("a.csv", SWAPPED_HEADER, 1.0, "they look swapped"),
        ("a.csv", HESAI_HEADER, math.pi / 180, "they look like radians"),
        ("a.csv", "", 1.0, None),
        ("a.csv", "", math.pi / 180, "they look like radians"),
        ("a.json", "", 1.0, None),
        ("a.json", "", math.pi / 180, "they look like radians"),
    ],
)
def test_warns_about_swapped_columns_and_radians(
    mini: Path, name: str, header: str, scale: float, words: str | None
) -> None:
    angles = [(scale * (15 - number * 40 / 31), scale * (number % 4 * 2.8 - 4.2)) for number in range(32)]
    rows = [f"{up},{offset}" for up, offset in angles]
    if header:
        rows = [f"{number},{row}" for number, row in enumerate(rows, start=1)]
    text = header + "".join(f"{row}\n" for row in rows)
    if name.endswith("json"):
        columns = dict(zip(("beam_altitude_angles", "beam_azimuth_angles"), zip(*angles, strict=True), strict=True))
        text = json.dumps({**columns, "lidar_mode": "1024x10"})
    write(mini, name, text)
    file = mini / "scenario.toml"
    rings = "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n"
    step = "" if name.endswith("json") else "azimuth_step_deg = 1.0\n"
    file.write_text(file.read_text(encoding="utf-8").replace(rings, f'beams = "{name}"\n{step}'), encoding="utf-8")
    scenario = egvs.load(mini)
    findings = list(scene_checks.warn_odd_beams(CheckInputs(scenario, sites=sites.candidate_sites(scenario))))
    assert [finding.where for finding in findings] == ([] if words is None else [name])
    assert words is None or words in findings[0].problem


def test_sensors_of_the_catalogue_have_usual_angles() -> None:
    for name in catalogue_entries():
        model = resolve_sensor(name, {}, "sites.sensor")
        offsets_deg = model.azimuth_offsets_deg if model.table is None else ()
        assert describe_odd_angles(name, model.beam_table.elevation_deg, offsets_deg) is None, name


@pytest.mark.slow
def test_prints_what_is_read(tmp_path: Path, run_egvs: Any) -> None:
    metadata = write(tmp_path, "metadata.json", NESTED)
    table = write(tmp_path, "rings.csv", "elevation_deg,azimuth_deg\n1,2\n-3,4\n")
    code, printed, _ = run_egvs("sensors", str(metadata), str(table), "VLP-16")
    words = " ".join(printed.split())
    assert code == 0
    assert "4 rings; azimuth offsets -3.1 to 3.2 deg, counter-clockwise" in words
    assert "columns: 1,024, the full circle; 4,096 beams" in words
    assert "beams leave 15.81 mm beside the axis (not simulated)" in words
    assert "2 single beams, one per row; azimuths 2 to 4 deg" in words
    assert "warning: 2 beams in a turn or frame" in words
    assert "VLP-16" in words
    (tmp_path / "scenario.toml").write_text(
        SCENARIO + '[sensors.mine]\nbeams = "rings.csv"\nrange_m = 80\n', encoding="utf-8"
    )
    code, printed, _ = run_egvs("sensors", "mine", "VLP-16", "--scenario", tmp_path)
    words = " ".join(printed.split())
    assert code == 0 and "mine beams: 2 of one turn or frame; scan pattern without rings" in words
    assert "view: azimuth 2 to 4 deg, elevation -3 to 1 deg range: 80 m" in words
    assert f"source: [sensors.mine] of {tmp_path / 'scenario.toml'}, beams from rings.csv" in words
    assert "mount: upright, unless [sites] or a row says otherwise" in words
    assert "warning: mine has 2 beams in a turn or frame" in words and "VLP-16 beams: 28800" in words
    code, _, error = run_egvs("sensors", "mime", "--scenario", tmp_path)
    assert code == 2 and "unknown sensor 'mime'. Did you mean mine?" in error
    code, _, error = run_egvs("sensors", str(tmp_path / "absent.json"))
    assert code == 2
    assert "absent.json: there is no such file. Check the path." in " ".join(error.split())


# ---- directions with dwell times


def write_directions(mini: Path, rows: str, samples: int) -> None:
    """Give the small sensor of the scenario a pattern of directions."""
    write(mini, "directions.csv", f"elevation_deg,azimuth_deg,dwell_s\n{rows}")
    file = mini / "scenario.toml"
    text = file.read_text(encoding="utf-8")
    head, _, rest = text.partition("elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n")
    pattern = f'pattern = {{kind = "file", file = "directions.csv", samples = {samples}}}\n'
    file.write_text(f"{head}{pattern}{rest}", encoding="utf-8")


def test_directions_get_their_share_of_the_pulses(tmp_path: Path) -> None:
    """Ten pulses, dwell times 1 : 4 : 5: one, four and five of them, each of the last two as several beams."""
    path = write(tmp_path, "d.csv", "elevation_deg,azimuth_deg,dwell_s\n1,2,0.05\n-3,4,0.2\n5,6,0.25\n")
    table = read_directions(path, 10)
    assert table.elevation_deg.tolist() == [1.0] + [-3.0] * 4 + [5.0] * 5
    assert table.weight is not None
    assert table.weight == pytest.approx(np.ones(10))
    few = read_directions(path, 2)
    assert few.weight == pytest.approx([0.2, 0.8, 1.0])
    assert few != table
    with pytest.raises(InputError, match="beams"):
        read_directions(path, 10_000_000)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("elevation_deg,azimuth_deg\n1,2\n", "expected a column dwell_s, got a table of beams"),
        ("elevation_deg,azimuth_offset_deg\n1,2\n", "expected a column dwell_s, got a table of rings"),
        ("elevation_deg,azimuth_deg,dwell_s\n1,2,0\n", "beam 0: dwell_s: expected seconds above 0, got 0"),
        ("elevation_deg,azimuth_deg,dwell_s\n1,2,-1\n", "beam 0: dwell_s: expected seconds above 0, got -1"),
        ("elevation_deg,azimuth_deg,dwell_s\n1,2,1e9\n", "beam 0: dwell_s: expected a number between"),
        ("elevation_deg,azimuth_deg,dwell_s\n1,2\n", "beam 0: expected 3 values, one per column, got 2"),
    ],
)
def test_rejects_wrong_directions(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_directions(write(tmp_path, "d.csv", text), 100)


def test_dwell_times_count_only_in_a_pattern(tmp_path: Path) -> None:
    path = write(tmp_path, "d.csv", "elevation_deg,azimuth_deg,dwell_s\n1,2,1\n")
    config = SensorConfig.from_dict({"beams": str(path), "range_m": 9})
    with pytest.raises(InputError, match=r"sensors\.u\.beams: d\.csv has dwell times"):
        resolve_sensor("u", {"u": config}, "here")


@pytest.mark.parametrize(
    "pattern",
    [
        {"kind": "file", "samples": 9},
        {"kind": "even", "samples": 9, "file": "d.csv", "azimuth_deg": (-1, 1), "elevation_deg": (-1, 1)},
        {"kind": "file", "samples": 9, "file": "d.csv", "azimuth_deg": (-1, 1)},
        {"kind": "even", "samples": 9, "azimuth_deg": (-1, 1)},
    ],
)
def test_rejects_contradictory_patterns(pattern: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be set for"):
        SensorConfig.from_dict({"range_m": 9, "pattern": pattern})


@pytest.mark.slow
def test_expected_hits_are_proportional_to_the_dwell_time(mini: Path, tmp_path: Path) -> None:
    """Equal dwell times and a pulse for each direction are the table itself; with half the pulses, half the hits."""
    small = scenario_sensor("small", egvs.load(mini), "here")
    angles = [f"{el},{az}" for az in range(small.azimuths) for el in small.elevations_deg]
    plain = hits_at_sites(mini, tmp_path / "plain")
    write_directions(mini, "".join(f"{row},0.01\n" for row in angles), len(angles))
    np.testing.assert_allclose(hits_at_sites(mini, tmp_path / "all"), plain, rtol=1e-6)
    file = mini / "scenario.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(f"samples = {len(angles)}", f"samples = {len(angles) // 2}"), encoding="utf-8")
    np.testing.assert_allclose(hits_at_sites(mini, tmp_path / "half"), 0.5 * plain, rtol=1e-6)
    assert scenario_sensor("small", egvs.load(mini), "here").pulses == len(angles) // 2


def test_sensor_beside_one_with_dwell_times_has_weights_of_one(mini: Path) -> None:
    write(mini, "directions.csv", "elevation_deg,azimuth_deg,dwell_s\n-9,0,1\n")
    other = "sensors.other={range_m=90, pattern={kind='file', file='directions.csv', samples=1}}"
    plain, beside = (egvs.build_scene(egvs.load(mini, settings)) for settings in ([], [other]))
    rows = [Scanner(scene).scan_site(scene.sites[0]).rows for scene in (plain, beside)]
    assert rows[0].weight is None
    assert rows[1].weight is not None
    assert set(rows[1].weight.tolist()) == {1.0}
    np.testing.assert_array_equal(rows[0].ends_m, rows[1].ends_m)


def hits_at_sites(folder: Path, out: Path) -> NDArray[np.float64]:
    """Return the expected hits of all voxels at the sites of a run, (sites, voxels)."""
    scenario = egvs.load(folder)
    egvs.run(scenario, out)
    context = open_folder(scenario, out)
    tpog = read_tpog(out / "tpog.parquet")
    scorer = Scorer(context.scene, tpog, out / "trajectories.parquet")
    return np.array([scorer.hits(scan.beams).ravel() for scan in empty_scans(context)], dtype=np.float64)


def test_clouds_draw_the_pulses_of_a_frame(mini: Path) -> None:
    """1,440 directions that meet the ground, with a chance of a quarter each: 360 pulses on average."""
    angles = [f"{el},{az}" for az in range(360) for el in (-10.0, -20.0, -30.0, -40.0)]
    write_directions(mini, "".join(f"{row},2.5\n" for row in angles), len(angles) // 4)
    scene = egvs.build_scene(egvs.load(mini))
    simulator = CloudSimulator(scene, Pose(10.0, 12.0, 5.0), scene.sensor("small"), "here")
    returns = [len(simulator.sweep(frame_of([]), sweep_rng(1, "here", number)).sweep.beam) for number in range(40)]
    assert np.mean(returns) == pytest.approx(360, abs=4 * math.sqrt(1440 * 0.25 * 0.75 / 40))
    assert len(set(returns)) > 10
