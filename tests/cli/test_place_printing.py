"""What ``egvs place`` prints at its end."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from egvs.cli import console as cli_console
from egvs.cli import place
from egvs.placement import plan
from egvs.report.plan_section import plan_headline
from egvs.results.levels import DetectionLevel, GroupLevel, NoticedShare, format_range
from egvs.results.plans import FusedPlan, PlannedSensor, PlanStep, RefinementSummary, SensorPlan
from egvs.results.ranking import site_titles
from egvs.scenario.score_config import PlacementConfig

FIRST_LINE = "The plan a, b should find 99.2 ± 0.3 % of vehicles; proved: no plan within the rules is better.\n"
LAST_LINES = """\
A second sensor adds 4.7 ± 0.5 percentage points to the share of vehicles found: 99.2 %, against 94.5 % with one. \
Try --count 3 to see what a third adds.
Joint shares assume one independent detector per sensor (an upper end); fused clouds, only one (docs/placement.md).
"""


def sensor(order: int, site: str, gain: float, score: float, **values: float) -> PlannedSensor:
    pose = {"x_m": 0.0, "y_m": 0.0, "z_m": 3.0, "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}
    return PlannedSensor(
        order, site, site, **pose, sensor="VLP-32C", forced=False, gain=gain, score=score, cost=0.0, loss=0.04, **values
    )


def placed_two(
    score: str = "expected_detections",
    scale: float = 1.0,
    sites: tuple[tuple[str, ...], ...] = (("a",), ("a", "b")),
    cost: float = 0.0,
    **changes: Any,
) -> SensorPlan:
    """A proved plan of two sensors; of its joint scores, errors and gains, 1 is ``scale``; a sensor costs ``cost``."""
    curve = (
        PlanStep(1, 0.9455 * scale, 0.9455 * scale, True, 0.009 * scale, 0.009 * scale, 1.0, sites[0], cost, 1.0, 1.0),
        PlanStep(
            2, 0.9922 * scale, 0.0467 * scale, True, 0.003 * scale, 0.005 * scale, 0.999, sites[1], 2 * cost, 1.0, 1.0
        ),
    )
    placed = SensorPlan(
        sensors=(
            sensor(1, "a", curve[0].gain, curve[0].score, gain_se=curve[0].gain_se, score_se=curve[0].score_se),
            sensor(2, "b", curve[1].gain, curve[1].score, gain_se=curve[1].gain_se, score_se=curve[1].score_se),
        ),
        curve=curve, score=score, request=PlacementConfig(count=2).model_dump(mode="json"), joint=curve[1].score,
        joint_of_all=0.9942 * scale, cost=2 * cost, candidates=12, zones=(), is_best=True, fewest_is_proved=None,
        errors_from="10 blocks of 100 frames",
    )  # fmt: skip
    return replace(placed, **changes)


def printed(placed: SensorPlan, capsys: pytest.CaptureFixture[str]) -> str:
    place.print_placement(placed)
    return capsys.readouterr().out


def test_shares_are_per_cent_with_errors_in_percentage_points(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(placed_two(), capsys)
    assert text.startswith(FIRST_LINE)
    assert text.endswith(LAST_LINES)
    assert "adds, % points  found together  lost if it fails, % points" in text
    first, second = (line for line in text.splitlines() if line.startswith(("1", "2")))
    assert "4.7 ± 0.5          99.2 %                         4.0" in second
    assert "±" not in first  # the error of a share is mostly that of its level, which is in the first sentence
    assert "± of differences and zones is one standard error, from 10 blocks of 100 frames" in text


@pytest.mark.parametrize("width", [80, 160])
def test_tables_fit_the_terminal_and_cut_no_value(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    out = Console(width=width, record=True, file=StringIO(), highlight=False)
    monkeypatch.setattr(cli_console, "console", lambda *_, **__: out)
    sites = ("south@4.5m-12deg", "north@4.5m-12deg")
    placed = placed_two(sites=(sites[1:], sites))
    sensors = tuple(replace(row, site=site) for row, site in zip(placed.sensors, sites, strict=True))
    place.print_placement(replace(placed, sensors=sensors))
    lines = out.export_text().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    text = " ".join(" ".join(lines).split())
    for value in ("99.2 %", "4.7 ± 0.5", "VLP-32C", "lost if", *sites):
        assert value in text
    assert "…" not in text


def test_values_in_fused_clouds_follow_the_assumption(capsys: pytest.CaptureFixture[str]) -> None:
    steps = (
        PlanStep(1, 0.9455, 0.9455, True, 0.009, 0.009, 1.0),
        PlanStep(2, 0.9713, 0.0258, True, 0.004, 0.006, 0.999),
    )
    first = "In fused clouds, the last sensor adds 2.6 ± 0.6 percentage points"
    assert printed(placed_two(fused=FusedPlan(steps)), capsys).endswith(f"{LAST_LINES}{first}.\n")
    text = printed(placed_two(fused=FusedPlan(steps, searched=True)), capsys)
    assert text.endswith(f"{first}; no swap of one sensor finds more.\n")
    better = FusedPlan(steps, ("c", "a"), PlanStep(2, 0.9753, 0.004, True, 0.004, 0.002, 0.98), searched=True)
    text = printed(placed_two(fused=better), capsys)
    assert text.endswith(f"{first}; c, a should find 0.4 ± 0.2 percentage points more there.\n")
    noticed = FusedPlan(steps, noticed=NoticedShare(0.985, 0.011, 0.985, 0.985))
    text = printed(placed_two(fused=noticed), capsys)
    assert text.endswith(f"{first}. People would notice 98 ± 10 % of vehicles there.\n")
    alone = FusedPlan(steps[:1], noticed=NoticedShare(0.985, 0.011, 0.985, 0.985))
    text = printed(placed_two(fused=alone), capsys)
    assert text.endswith(f"{LAST_LINES}People would notice 98 ± 10 % of vehicles in the sweeps of this sensor.\n")
    assert printed(placed_two(fused=FusedPlan(steps[:1])), capsys).endswith(LAST_LINES)


def test_the_curve_is_printed_only_where_it_has_other_sites(capsys: pytest.CaptureFixture[str]) -> None:
    """Otherwise the table of the plan has what one sensor alone finds."""
    assert "sensors  found together" not in printed(placed_two(), capsys)
    text = printed(placed_two(sites=(("c",), ("a", "b"))), capsys)
    rows = text.partition("sensors  found together")[2].splitlines()
    assert [row.split()[0] for row in rows[1:4]] == ["1", "2", "±"]  # the plan itself is a row, too


def test_a_plan_takes_at_most_250_words(capsys: pytest.CaptureFixture[str]) -> None:
    """Three sensors, other sites for fewer, costs, fused clouds, assumptions, files."""
    two = placed_two(cost=3000.0, sites=(("c",), ("a", "b")))
    third = PlanStep(3, 0.995, 0.0028, True, 0.002, 0.001, 0.99, ("a", "b", "d"), 9000.0, 1.0, 1.0)
    sensors = (*two.sensors, sensor(3, "d", 0.0028, 0.995, gain_se=0.001, score_se=0.002))
    steps = (*two.curve, third)
    fused = FusedPlan(steps, ("c", "a"), steps[2], searched=True, noticed=NoticedShare(0.985, 0.011, 0.985, 0.985))
    files = tuple(Path("runs/r", name) for name in ("placement.parquet", "curve.parquet", "report.html"))
    placed = replace(two, sensors=sensors, curve=steps, fused=fused, files=files)
    caveat = "Assumed, not measured: traffic (1,240 vehicles an hour in 12 movements); positions of the poles; 1 more."
    place.print_placement(placed, ["replaces the plan for --count 2"], [caveat], CLUSTER)
    assert len(capsys.readouterr().out.split()) <= 250


def test_bits_have_thousands_separators(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(placed_two("egvs", 100_000.0), capsys)
    assert "EGVS together, bit" in text
    assert "The plan a, b scores 99,220 ± 300 bit;" in text
    assert "A second sensor adds 4,670 ± 500 bit (4.7 % of the plan's score) to EGVS: 99,220 bit" in text


def test_reason_is_printed_where_errors_are_unknown(capsys: pytest.CaptureFixture[str]) -> None:
    placed = placed_two()
    curve = tuple(replace(step, score_se=math.nan, gain_se=math.nan, beats_previous=math.nan) for step in placed.curve)
    sensors = tuple(sensor(row.order, row.site, row.gain, row.score) for row in placed.sensors)
    text = printed(replace(placed, curve=curve, sensors=sensors, errors_from="score.standard_error is false"), capsys)
    assert "no standard errors: score.standard_error is false" in text
    assert "±" not in text
    assert "A second sensor adds 4.7 percentage points" in text


def test_best_single_site_that_is_not_part_of_the_plan_is_named() -> None:
    text = place.describe_absent_best(placed_two(sites=(("c",), ("a", "b"))))
    assert text is not None
    assert text.startswith("The best single site, c, is not part of this plan")


def test_best_single_site_in_the_plan_or_a_single_sensor_needs_no_sentence() -> None:
    assert place.describe_absent_best(placed_two()) is None
    one = placed_two()
    assert place.describe_absent_best(replace(one, sensors=one.sensors[:1], curve=one.curve[:1])) is None


def test_costs_are_printed_only_where_they_are_set(capsys: pytest.CaptureFixture[str]) -> None:
    assert "cost" not in printed(placed_two(), capsys)
    text = printed(placed_two(cost=3000.0), capsys)
    assert sum("  cost" in line for line in text.splitlines()) == 1
    assert "The plan a, b for 6000 should find" in text


def test_ends_with_what_was_assumed(capsys: pytest.CaptureFixture[str]) -> None:
    caveat = "Before you trust this plan: assumed, not measured: positions of the poles."
    place.print_placement(placed_two(), caveats=[caveat])
    assert capsys.readouterr().out.splitlines()[-1] == caveat


def test_replaced_plan_is_named_by_its_options() -> None:
    two = {"count": 2, "budget": None, "reach": None, "survives": 0}
    assert place.describe_replaced(two, {**two, "count": 3}) == "replaces the plan for --count 2"
    bought = {**two, "count": None, "budget": 30000.0}
    assert place.describe_replaced(bought, two) == "replaces the plan for --budget 30000"
    assert place.describe_replaced(two, {**two, "refine": {}}) == "replaces the plan for --count 2 without --refine"
    refined = {**two, "refine": {"move_m": 1.0}}
    assert place.describe_replaced(refined, two) == "replaces the plan for --count 2 with --refine"
    assert place.describe_replaced(two, {**two, "survives": 1}) == (
        "replaces the plan for --count 2 with other settings in [placement]"
    )


CLUSTER = DetectionLevel(("cluster",))
FUSED = FusedPlan((PlanStep(1, 0.73, 0.73, True, 0.01), PlanStep(2, 0.861, 0.131, True, 0.01)))


def test_first_line_has_the_error_of_the_level_and_the_fused_value() -> None:
    """Whoever quotes the first line quotes what is known; the error of the traffic alone is in the table."""
    placed = placed_two(fused=FUSED)
    assert place.describe_plan(placed, CLUSTER).startswith(
        "The plan a, b should find 99 ± 6 % of vehicles (86 ± 6 % in fused clouds); proved"
    )
    unknown = DetectionLevel(("pointpillars_sensor",))
    assert "The plan a, b has sensors for whose detectors the level was not measured;" in place.describe_plan(
        placed, unknown
    )
    trucks = GroupLevel("larger vehicles", 90, 0.2, 0.8, None, NoticedShare(0.9, None, 0.9, 0.9))
    cars = GroupLevel("cars", 300, 0.8, 0.7, None, NoticedShare(0.9, None, 0.9, 0.9))
    detector = DetectionLevel(("cluster",), (cars, replace(trucks, road_users="people")))
    assert detector.range is not None
    outside = detector.range.outside
    assert detector.joint_text(0.7, 0.01) == format_range(0.7 - outside, 0.7 + outside)


def test_refined_plan_has_its_score_and_poses_in_the_first_line(capsys: pytest.CaptureFixture[str]) -> None:
    """A name such as "a@3m+aim" is that of the candidate, which the sensor has left."""
    placed = placed_two(joint=0.995, refinement=RefinementSummary(0.9922, 1.0, 1.01, 9, 0, 2, 1.0))
    moved = [
        replace(row, site=f"{row.site}@3m+aim", z_m=3.1234, pitch_deg=-3.58, score=0.995, score_se=0.002)
        for row in placed.sensors
    ]
    placed = replace(placed, sensors=tuple(moved))
    line = place.describe_plan(placed)
    assert line.startswith("The plan pole a, 3.123 m up, tilted 3.6° down; pole b, 3.123 m up, tilted 3.6° down")
    assert " should find 99.5 ± 0.2 % of vehicles; proved: no plan within the rules is better, at the poses of " in line
    text = printed(placed, capsys)
    assert "+aim" not in text.partition("± is one")[0]
    headline = plan_headline(placed, site_titles(placed.sensors, is_moved=True), CLUSTER)
    assert headline == (
        "The plan of 2 sensors should find 90 to 100 % of vehicles: pole a, 3.123 m up, tilted 3.6° down; "
        "pole b, 3.123 m up, tilted 3.6° down"
    )


def test_fused_values_of_a_plan_survive_its_file() -> None:
    values = json.loads(json.dumps(placed_two(fused=FUSED).to_json()))["fused"]
    assert values == [[0.73, 0.01], [0.861, 0.01]]


def test_files_of_the_earlier_plan_are_named(tmp_path: Path) -> None:
    placed = placed_two()
    earlier = [plan.mount_of(row) for row in placed.sensors]
    names = ("geojson/plan.geojson", "geojson/sites.geojson", "x.kml", "../sheets/installation_a.pdf")
    for name in (f"export/{name}" for name in names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert place.outdated_handovers(tmp_path, earlier, placed) == ""
    for other in (earlier[:1], [(*earlier[0][:-2], -10.0, 0.0), earlier[1]]):
        assert place.outdated_handovers(tmp_path, other, placed) == (
            "sheets/installation_a.pdf, export/geojson/plan.geojson, export/x.kml show the earlier plan; "
            "repeat egvs sheets and egvs export."
        )
    assert place.outdated_handovers(tmp_path / "sheets", earlier[:1], placed) == ""


def test_files_come_last(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(placed_two(files=(Path("runs/r/placement.parquet"), Path("runs/r/report.html"))), capsys)
    assert text.endswith(f"{LAST_LINES}runs/r/placement.parquet\nruns/r/report.html\n")


@pytest.mark.slow
def test_sensor_with_a_price_and_no_site_is_named(mini: Path, run_egvs: Any) -> None:
    scenario = mini / "scenario.toml"
    scenario.write_text(scenario.read_text() + '\n[costs]\nsensor = { small = 8000, "OS1-64" = 12000 }\n')
    request = ("place", mini, "--budget", "20000", "--out", mini / "out")
    code, text, _ = run_egvs(*request)
    assert code == 0 and "No plan has OS1-64: add it to sites.sensor." in " ".join(text.split())
    scenario.write_text(scenario.read_text().replace('sensor = "small"', 'sensor = ["small", "OS1-64"]'))
    code, text, _ = run_egvs(*request)
    assert code == 0 and "No plan has" not in text
    one_each = ("--budget", "30000", "--set", "placement.most_per_pole=1")
    code, text, _ = run_egvs("place", mini, "--out", mini / "out", *one_each)
    assert code == 0 and "small was a candidate, too, but is not in this plan." in text
    rules = "The limit of 1 sensor per pole (most_per_pole) and the budget forbid a third sensor beside them."
    assert rules in " ".join(text.split())
