"""Sensor design: elevations of a lane at a known distance, by hand, and designs that are never worse than their start.

The lane: cars of 1.8 m x 1.5 m at y = -2, within 4 m of x = 10; the pole is at y = 12, 3 m high. The near side of a car
is 13.1 m away and the far edge of its roof at most 16.2 m, so all returns from cars have elevations between
-atan(3 / 13.1) = -12.9 and -atan(1.5 / 16.2) = -5.3 degrees.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import egvs
from egvs.artefacts.tpog import PeriodBlocks
from egvs.core.errors import InputError
from egvs.effects.returns import ReturnProbability
from egvs.extensions.hardware.design import (
    MIN_GAP_DEG,
    DesignResult,
    ElevationCurve,
    design_sensor,
    second_half_groups,
    start_elevations,
)
from egvs.extensions.hardware.design_request import ELEVATION_BOUNDS_DEG, DesignRequest
from egvs.runs.run_context import open_folder
from egvs.scoring.target_scores import DETECTORS, TARGET_SCORES, detection_chances
from egvs.scoring.targets import visible_targets, weighted_mean
from egvs.sensors.sensor import CATALOGUE, Sensor, resolve_sensor
from egvs.stages.scene_inputs import with_losses_of_all
from egvs.stages.site_scoring import SiteScoring
from tests.conftest import write_mini

pytest.importorskip("cma", reason="the extra egvs[place] is not installed")
pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[3]
LOWEST_DEG = -math.degrees(math.atan(3.0 / 13.1))
HIGHEST_DEG = -math.degrees(math.atan(1.5 / 16.2))

SENSORS = """
[sensors.coarse]
elevations_deg = [-44, 14]
channels = 8
azimuth_step_deg = 5
range_m = 60

[sensors.narrow]
elevations_deg = [-12, -6]
channels = 8
azimuth_step_deg = 5
range_m = 60
"""


def one_lane(folder: Path) -> Path:
    """A region of 8 m with one lane; a car passes every four seconds."""
    made = write_mini(folder / "lane")
    text = (made / "scenario.toml").read_text()
    text = text.replace("center_m = [20, 0, 2.5]", "center_m = [10, 0, 2.5]")
    text = text.replace("size_m = [40, 20, 5]", "size_m = [8, 20, 5]")
    (made / "scenario.toml").write_text(text + SENSORS)
    lines = ["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed"]
    for frame in range(40):
        time_s = 0.5 * frame
        for car in range(6):
            x_m = 2.0 + 3.0 * (time_s - 4.0 * car)
            if 0.0 <= x_m <= 40.0:
                lines.append(f"{time_s:.2f};car{car};{x_m:.3f};-2.0;90.0;car;3.0")
    (made / "fcd.csv").write_text("\n".join(lines) + "\n")
    return made


def design(path: Path, out: Path, **request: Any) -> DesignResult:
    values = {"pole": "pole_a", "sensors": ("coarse",), "evaluations": 20, **request}
    return design_sensor(egvs.load(path), DesignRequest(**values), out, jobs=1)


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DesignResult]:
    """Eight free channels for the lane, from a sensor with elevations from -44 to 14 degrees."""
    folder = tmp_path_factory.mktemp("design")
    path = one_lane(folder)
    return path, design(path, folder / "run", channels=8, elevation_evaluations=150)


@pytest.mark.slow
def test_elevations_concentrate_on_the_lane(designed: tuple[Path, DesignResult]) -> None:
    result = designed[1]
    assert result.start is not None and result.designed is not None
    pitch_deg = result.designed.pose.pitch_deg
    yaw_off_deg = (result.designed.pose.yaw_deg + 90.0) % 360.0  # the lane is at yaw -90
    tilt_deg = pitch_deg * math.cos(math.radians(yaw_off_deg))

    def in_lane(sensor: Sensor) -> int:
        elevations = [value + tilt_deg for value in sensor.elevations_deg]
        return sum(LOWEST_DEG - 1.0 <= value <= HIGHEST_DEG + 1.0 for value in elevations)

    assert in_lane(result.start.sensor) <= 2  # 58 degrees in 7 steps of 8.3
    assert in_lane(result.designed.sensor) >= 5  # of 8
    assert result.designed.search_score > 2.5 * result.start.search_score
    assert result.designed.score > result.start.score


def test_designs_are_not_worse_than_their_start(designed: tuple[Path, DesignResult]) -> None:
    """The mount, than the candidate at the pole; the elevations, than those of the base sensor."""
    path, result = designed
    assert result.start is not None and result.designed is not None
    assert result.designed.search_score >= result.start.search_score
    assert result.start.sensor.elevations_deg == result.catalogue[0].sensor.elevations_deg
    assert result.start.search_score == result.catalogue[0].search_score
    assert result.chosen is result.designed

    context = open_folder(egvs.load(path), path.parent / "run", jobs=1)
    scan = egvs.Scanner(context.scene).scan(context.scene.site("pole_a").pose, result.catalogue[0].sensor)
    scoring = SiteScoring(context)
    assert scoring.targets is not None
    visible = scoring.targets.visible(egvs_beams(scan))
    values = TARGET_SCORES["expected_detections"](visible, DETECTORS)
    record = scoring.targets.record
    is_first = record.numbers[record.frame] < 20
    assert result.catalogue[0].search_score >= weighted_mean(values[is_first])


def egvs_beams(scan: Any) -> Any:
    from egvs.scoring.visibility import Beams

    return Beams.of(scan)


def test_scores_are_those_of_the_other_frames(designed: tuple[Path, DesignResult]) -> None:
    """Twin: the run's vehicles of frames 20 to 39, seen from the mount by the complete record."""
    path, result = designed
    context = open_folder(egvs.load(path), path.parent / "run", jobs=1)
    scoring = SiteScoring(context)
    assert scoring.targets is not None and result.designed is not None
    record = scoring.targets.record
    assert result.frames == (20, 20)
    for one in (*result.catalogue, result.designed):
        scan = egvs.Scanner(context.scene).scan(one.pose, one.sensor)
        values = TARGET_SCORES["expected_detections"](scoring.targets.visible(egvs_beams(scan)), DETECTORS)
        is_first = record.numbers[record.frame] < 20
        assert one.search_score == pytest.approx(weighted_mean(values[is_first]))
        assert one.score == pytest.approx(weighted_mean(values[~is_first]))
    assert result.designed.difference.value == pytest.approx(result.designed.score - result.catalogue[0].score)


@pytest.mark.slow
def test_seed_and_scenario_determine_the_design(designed: tuple[Path, DesignResult], tmp_path: Path) -> None:
    path, result = designed
    request = DesignRequest("pole_a", ("coarse",), None, 20, 8, ELEVATION_BOUNDS_DEG, 150)
    again = design_sensor(egvs.load(path), request, tmp_path / "run", jobs=2)
    assert again == result
    other = design_sensor(egvs.load(path, ["seed=8"]), request, tmp_path / "other", jobs=1)
    assert other.designed != result.designed


def test_sensor_that_looks_at_the_lane_is_chosen(designed: tuple[Path, DesignResult], tmp_path: Path) -> None:
    result = design(designed[0], tmp_path / "run", sensors=("coarse", "narrow"))
    assert [one.sensor.name for one in result.catalogue] == ["narrow", "coarse"]
    assert result.catalogue[0].difference.value == 0.0
    assert result.catalogue[1].difference.value < 0.0
    assert result.start is result.designed is None


@pytest.mark.slow
def test_command_writes_a_sensor_that_a_scenario_can_use(tmp_path: Path, monkeypatch: Any, run_egvs: Any) -> None:
    path = one_lane(tmp_path)
    monkeypatch.chdir(tmp_path)
    options = ("--pole", "pole_a", "--sensors", "coarse", "--channels", "8", "--elevations=-30,0", "--name", "mine")
    few = ("--evaluations", "20", "--elevation-evaluations", "20")
    code, printed, error = run_egvs("sensor", "design", "lane", *options, *few)
    assert code == 0, error
    text = (tmp_path / "sensors" / "mine.toml").read_text()
    table = tomllib.loads(text)["sensors"]["mine"]
    assert len(table["elevations_deg"]) == 8
    assert min(table["elevations_deg"]) >= -30 and max(table["elevations_deg"]) <= 0
    file = path / "scenario.toml"
    file.write_text(file.read_text().replace('sensor = "small"', 'sensor = "mine"') + "\n" + text)
    used = egvs.load(path).sensors["mine"]
    sensor = resolve_sensor("mine", {"mine": used}, "")
    assert (sensor.elevations_deg, sensor.azimuths, sensor.range_m) == (tuple(table["elevations_deg"]), 72, 60.0)
    assert "pole_a,10.000,12.000,3.000," in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--pole: no pole is given"),
        (("--pole", "nowhere"), "--pole: expected a pole with a simulated scan, got 'nowhere'. Choose one of pole_a"),
        (("--pole", "pole_a", "--sensors", "VLP-99"), "--sensors: unknown sensor 'VLP-99'"),
        (("--pole", "pole_a", "--channels", "1"), "--channels: expected 2 to"),
        (("--pole", "pole_a", "--channels", "8", "--elevations", "steep"), "--elevations: expected free, or two"),
        (("--pole", "pole_a", "--channels", "8", "--elevations=5,-5"), "--elevations: expected two ascending"),
        (("--pole", "pole_a", "--elevations=-5,5"), "--elevations: needs --channels"),
        (("--pole", "pole_a", "--name", "mine"), "--name: has no effect without --channels. Add --channels 32."),
        (("--pole", "pole_a", "--out", "sensors/a.toml"), "--out: has no effect without --channels"),
        (("--pole", "pole_a", "--elevation-evaluations", "50"), "--elevation-evaluations: has no effect without"),
        (("--pole", "pole_a", "--evaluations", "3"), "--evaluations: expected at least 20, got 3"),
    ],
)
def test_wrong_requests_get_one_message(
    mini: Path, monkeypatch: Any, run_egvs: Any, options: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(mini.parent)
    code, printed, error = run_egvs("sensor", "design", "mini", *options)
    assert (code, printed) == (2, "")
    assert message in error
    assert "Traceback" not in error
    assert not (mini.parent / "sensors").exists()


def test_groups_of_the_second_halves_by_hand() -> None:
    """Four simulations of 11 frames: the search has frames 0 to 4 of each, the scores have frames 5 to 10."""
    groups, starts = second_half_groups(PeriodBlocks("", 1.0, 44, 11, 3.0, seeds=4), 44)
    assert groups.are_seeds
    assert groups.frames.tolist() == [6, 6, 6, 6]
    assert starts.tolist() == [5, 16, 27, 38]
    groups, starts = second_half_groups(
        PeriodBlocks("", 1.0, 44, 11, 0.0), 44
    )  # one simulation: ten blocks of 22 frames
    assert not groups.are_seeds
    assert groups.frames.tolist() == [3, 3] + [2] * 8
    assert starts.tolist() == [22, 25, *range(28, 44, 2)]


@pytest.mark.slow
def test_scores_of_several_seeds_are_those_of_each_simulation(tmp_path: Path) -> None:
    """Twin: the vehicles of the second half of each simulation; the error by leaving out one simulation in turn."""
    simulated = ['traffic.network="network.net.xml"', "traffic.vehicles=28", "traffic.warmup_s=20", "traffic.frames=80"]
    keys = [*simulated, "traffic.seeds=4", "tpog.blocks=4", "score.sampled_frames=80"]
    scenario = egvs.load(ROOT / "scenarios" / "demo", keys)
    request = DesignRequest("kerb_NE", ("VLP-16",), None, 20)
    result = design_sensor(scenario, request, tmp_path / "run", jobs=2)
    assert result.frames == (40, 40)
    assert "4 simulations: the search saw the first half of each" in result.notes[0]

    context = open_folder(scenario, tmp_path / "run", jobs=1)
    scoring = SiteScoring(context)
    assert scoring.targets is not None
    (chosen,) = result.catalogue
    scan = egvs.Scanner(context.scene).scan(chosen.pose, chosen.sensor)
    losses = ReturnProbability.of(with_losses_of_all(context.scene), chosen.sensor)  # a design always has them
    visible = visible_targets(scoring.targets.record, egvs_beams(scan), losses)
    values = TARGET_SCORES["expected_detections"](visible, DETECTORS)
    frame = scoring.targets.record.numbers[scoring.targets.record.frame]
    simulation, number = np.divmod(frame, 20)
    assert chosen.search_score == pytest.approx(values[number < 10].mean())
    assert chosen.score == pytest.approx(values[number >= 10].mean())
    left_out = np.array([values[(number >= 10) & (simulation != one)].mean() for one in range(4)])
    pseudo = 4 * chosen.score - 3 * left_out
    of_traffic = ((pseudo - pseudo.mean()) ** 2).sum() / (4 * 3)
    cluster, pointpillars = (detection_chances(visible, (name,))[number >= 10].mean() for name in DETECTORS)
    assert chosen.score == pytest.approx((cluster + pointpillars) / 2)
    assert chosen.se == pytest.approx(math.sqrt(of_traffic + ((cluster - pointpillars) / 2) ** 2))


@pytest.mark.slow
def test_sensor_hangs_as_at_the_sites_of_the_pole(tmp_path: Path, run_egvs: Any) -> None:
    """Its own mount, although another sensor is at the site; the row that is printed gives the score of the search."""
    path = one_lane(tmp_path)
    text = (path / "scenario.toml").read_text()
    (path / "scenario.toml").write_text(text.replace("[sensors.narrow]", '[sensors.narrow]\nmount = "inverted"'))
    results = {}
    for setting in ("sites.roll_deg=0", "sites.roll_deg=10", "sensors.narrow.mount=upright", "sites.mount=upright"):
        scenario = egvs.load(path, [setting])
        request = DesignRequest("pole_a", ("narrow",), evaluations=20)
        results[setting] = design_sensor(scenario, request, tmp_path / "run", jobs=1).chosen
    rolls_deg = [result.pose.roll_deg for result in results.values()]
    assert rolls_deg == [180.0, -170.0, 0.0, 0.0]
    hung, rolled, stood, _ = results.values()
    assert len({hung.search_score, rolled.search_score, stood.search_score}) == 3
    options = ["--sensors", "narrow,coarse", "--evaluations", 20, "--set", "sites.roll_deg=10"]
    code, printed, error = run_egvs("sensor", "design", path, "--pole", "pole_a", *options)
    assert code == 0, error
    assert "upside down, rolled by 10°" in printed
    assert "the sensors are inverted, the roll is kept at 10° (narrow)" in printed.replace("\n", " ")
    assert ",10.000,upright,coarse" in printed or ",10.000,inverted,narrow" in printed


def test_record_without_vehicles_in_one_half_is_rejected(tmp_path: Path) -> None:
    path = one_lane(tmp_path)
    rows = (path / "fcd.csv").read_text().splitlines()
    moved = [row.replace("-2.0;90", "-200;90") for row in rows if row[0].isdigit() and float(row.split(";")[0]) >= 10]
    kept = [row for row in rows if not row[0].isdigit() or float(row.split(";")[0]) < 10] + moved
    (path / "fcd.csv").write_text("\n".join(kept) + "\n")
    with pytest.raises(InputError, match="no vehicle is in the region of interest in the second half"):
        design(path, tmp_path / "run")


@settings(max_examples=40)
@given(st.integers(2, 40), st.lists(st.floats(0, 1), min_size=9, max_size=9))
def test_curve_is_ascending_within_the_bounds(channels: int, point: list[float]) -> None:
    curve = ElevationCurve(tuple(np.linspace(-25.0, 5.0, channels).tolist()), -30.0, 10.0)
    elevations = np.array(curve.elevations(np.array(point[: 2 + curve.pieces])))
    assert len(elevations) == channels
    assert elevations.min() >= -30.0 and elevations.max() <= 10.0
    assert (np.diff(elevations) >= MIN_GAP_DEG - 1e-9).all()


@pytest.mark.parametrize("name", ["VLP-32C", "OS1-128", "VLP-16"])
def test_curve_gives_back_its_start(name: str) -> None:
    start = start_elevations(CATALOGUE[name], CATALOGUE[name].channels, ELEVATION_BOUNDS_DEG)
    curve = ElevationCurve(start, *ELEVATION_BOUNDS_DEG)
    assert start == tuple(sorted(CATALOGUE[name].elevations_deg))
    assert curve.elevations(curve.point(start)) == pytest.approx(start, abs=0.02)


def test_stretched_piece_keeps_relative_distances() -> None:
    """From -10, -8, 0 to elevations that begin at -20 and end at 0: all distances double."""
    curve = ElevationCurve((-10.0, -8.0, 0.0), -40.0, 20.0)
    point = curve.point((-10.0, -8.0, 0.0))
    point[:2] = [(-20.0 + 40.0) / 60.0, 40.0 / 60.0]
    assert curve.elevations(point) == pytest.approx((-20.0, -16.0, 0.0))


def test_search_starts_at_the_elevations_of_the_sensor() -> None:
    own = Sensor("own", (-1.0, -20.0, -5.0), (0.0,) * 3, 36, 50.0, "test")
    assert start_elevations(own, 3, (-30.0, 0.0)) == (-20.0, -5.0, -1.0)
    assert start_elevations(own, 5, (-30.0, 0.0)) == (-20.0, -15.25, -10.5, -5.75, -1.0)
    assert start_elevations(own, 3, (-10.0, 0.0)) == (-10.0, -5.5, -1.0)


@pytest.mark.slow
def test_designs_are_scored_with_losses(tmp_path: Path) -> None:
    """Also where the rule would leave them out: 13 m to the lane, and 600 m rated at 10 %."""
    path = one_lane(tmp_path)
    for rated_m, number in ((15, 0), (600, 1)):
        rated = [f"sensors.coarse.rated_range_m={rated_m}", "sensors.coarse.rated_reflectivity=0.1"]
        rated.append("sensors.small.rated_range_m=50")  # the sensor of the sites, which named losses act on
        scores = []
        for setting in ([], ["effects.range_limit={}"], ["effects.range_limit=false"]):
            scenario = egvs.load(path, [*rated, *setting])
            request = DesignRequest(pole="pole_a", sensors=("coarse",), evaluations=20)
            out = tmp_path / f"out{number}{len(scores)}"
            scores.append(design_sensor(scenario, request, out, jobs=1).catalogue[0].score)
        assert scores[0] == scores[1] < scores[2]
