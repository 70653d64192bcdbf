"""What ``egvs place`` prints at its end."""

from __future__ import annotations

import math
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from egvs.cli import console as cli_console
from egvs.cli import place
from egvs.results.levels import NoticedShare
from egvs.results.plans import FusedPlan, PlannedSensor, PlanStep, SensorPlan
from egvs.scenario.score_config import PlacementConfig

FIRST_LINE = "The plan a, b should find 99.2 ± 0.3 % of vehicles; proved: no plan within the rules is better.\n"
LAST_LINES = """\
A second sensor adds 4.7 ± 0.5 percentage points to the share of vehicles found: 99.2 %, against 94.5 % with one. \
Try --count 3 to see what a third adds.
Joint shares assume that sensors miss vehicles independently; near 100 % they are upper ends (docs/placement.md).
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
    assert " 4.7 ± 0.5    99.2 ± 0.3 %                         4.0" in text
    assert "± is one standard error, from 10 blocks of 100 frames" in text


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
    for value in ("99.2 ± 0.3 %", "4.7 ± 0.5", "VLP-32C", "lost if", *sites):
        assert value in text
    assert "…" not in text


def test_values_in_fused_clouds_follow_the_assumption(capsys: pytest.CaptureFixture[str]) -> None:
    steps = (
        PlanStep(1, 0.9455, 0.9455, True, 0.009, 0.009, 1.0),
        PlanStep(2, 0.9713, 0.0258, True, 0.004, 0.006, 0.999),
    )
    first = (
        "In fused clouds, the first 1 and 2 sensors find 94.5 ± 0.9 % and 97.1 ± 0.4 %; the last one adds "
        "2.6 ± 0.6 percentage points"
    )
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
    assert "sensors  found together" in printed(placed_two(sites=(("c",), ("a", "b"))), capsys)


def test_a_plan_takes_at_most_250_words(capsys: pytest.CaptureFixture[str]) -> None:
    """Three sensors, other sites for fewer, costs, fused clouds, assumptions, files."""
    two = placed_two(cost=3000.0, sites=(("c",), ("a", "b")))
    third = PlanStep(3, 0.995, 0.0028, True, 0.002, 0.001, 0.99, ("a", "b", "d"), 9000.0, 1.0, 1.0)
    sensors = (*two.sensors, sensor(3, "d", 0.0028, 0.995, gain_se=0.001, score_se=0.002))
    steps = (*two.curve, third)
    fused = FusedPlan(steps, ("c", "a"), steps[2], searched=True, noticed=NoticedShare(0.985, 0.011, 0.985, 0.985))
    files = tuple(Path("runs/r", name) for name in ("placement.parquet", "curve.parquet", "report.html"))
    placed = replace(two, sensors=sensors, curve=steps, fused=fused, files=files)
    caveat = (
        "Assumed, not measured: traffic (1,240 vehicles an hour in 12 movements); positions of the poles and 1 more."
    )
    place.print_placement(placed, ["replaces the plan for --count 2"], [caveat])
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
    assert place.describe_replaced(two, {**two, "survives": 1}) == (
        "replaces the plan for --count 2 with other settings in [placement]"
    )


def test_files_come_last(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(placed_two(files=(Path("runs/r/placement.parquet"), Path("runs/r/report.html"))), capsys)
    assert text.endswith(f"{LAST_LINES}runs/r/placement.parquet\nruns/r/report.html\n")
