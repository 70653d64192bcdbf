"""What ``egvs place`` prints at its end."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from egvs.cli import console as cli_console
from egvs.cli import place
from egvs.placement.fused_score import FusedPlan
from egvs.results.plans import PlannedSensor, PlanStep
from egvs.scenario.score_config import PlacementConfig

LAST_LINES = """\
The plan a, b should find 99.2 ± 0.3 % of vehicles, 99.8 % of what all 12 candidates reach together; \
proved: no plan within the rules is better.
A second sensor adds 4.7 ± 0.5 percentage points to the share of vehicles found: 99.2 %, against 94.5 % with one. \
Try --count 3 to see what a third adds.
Joint shares are for sensors that detect each by itself, and assume that they miss vehicles independently of each \
other; near 100 % they are upper ends (docs/placement.md).
"""


def sensor(order: int, site: str, gain: float, score: float, **values: float) -> PlannedSensor:
    pose = {"x_m": 0.0, "y_m": 0.0, "z_m": 3.0, "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}
    return PlannedSensor(
        order, site, site, **pose, sensor="VLP-32C", forced=False, gain=gain, score=score, cost=0.0, loss=0.04, **values
    )


def placed_two(score: str = "expected_detections", scale: float = 1.0, **changes: Any) -> Any:
    """A proved plan of two sensors; of its joint scores, errors and gains, 1 is ``scale``."""
    steps = (
        PlanStep(1, 0.9455 * scale, 0.9455 * scale, True, 0.009 * scale, 0.009 * scale, 1.0),
        PlanStep(2, 0.9922 * scale, 0.0467 * scale, True, 0.003 * scale, 0.005 * scale, 0.999),
    )
    points = [SimpleNamespace(certificate=1.0, count=1), SimpleNamespace(certificate=1.0, count=2)]
    points[-1].plan_value = SimpleNamespace(joint=steps[-1].score)
    placed = SimpleNamespace(
        score=score, steps=steps, joint_of_all=0.9942 * scale, candidates=12, refinement=None, fused=None, zones=(),
        zone_results=(), files=(),
        sensors=(
            sensor(1, "a", steps[0].gain, steps[0].score, gain_se=steps[0].gain_se, score_se=steps[0].score_se),
            sensor(2, "b", steps[1].gain, steps[1].score, gain_se=steps[1].gain_se, score_se=steps[1].score_se),
        ),
        curve_sites=(("a",), ("a", "b")), curve_costs=(0.0, 0.0),
        has_errors=True, errors_from="10 blocks of 100 frames",
        solution=SimpleNamespace(curve=points, point=points[-1], fewest_is_proved=None, is_best=True),
    )  # fmt: skip
    for name, value in changes.items():
        setattr(placed, name, value)
    return placed


def printed(placed: Any, capsys: pytest.CaptureFixture[str]) -> str:
    place.print_placement(placed, PlacementConfig(count=2))
    return capsys.readouterr().out


def test_shares_are_per_cent_with_errors_in_percentage_points(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(placed_two(), capsys)
    assert text.endswith(LAST_LINES)
    assert "adds, % points  found together  lost if it fails, % points" in text
    assert " 4.7 ± 0.5    99.2 ± 0.3 %                         4.0" in text
    assert "± is one standard error, from 10 blocks of 100 frames" in text


@pytest.mark.parametrize("width", [80, 160])
def test_tables_fit_the_terminal_and_cut_no_value(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    out = Console(width=width, record=True, file=StringIO(), highlight=False)
    monkeypatch.setattr(cli_console, "console", lambda *_, **__: out)
    sites = ("south@4.5m-12deg", "north@4.5m-12deg")
    placed = placed_two(curve_sites=(sites[:1], sites))
    placed.sensors = tuple(replace(row, site=site) for row, site in zip(placed.sensors, sites, strict=True))
    place.print_placement(placed, PlacementConfig(count=2))
    lines = out.export_text().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    text = " ".join(" ".join(lines).split())
    for value in ("99.2 ± 0.3 %", "4.7 ± 0.5", "99.8 %", "VLP-32C", "lost if"):
        assert value in text
    assert "…" not in text
    assert sum(line.rstrip().endswith("south@4.5m-12deg, north@4.5m-12deg") for line in lines) == (width == 160)


def test_values_in_fused_clouds_follow_the_assumption(capsys: pytest.CaptureFixture[str]) -> None:
    steps = (
        PlanStep(1, 0.9455, 0.9455, True, 0.009, 0.009, 1.0),
        PlanStep(2, 0.9713, 0.0258, True, 0.004, 0.006, 0.999),
    )
    first = (
        "Found where all point clouds are fused before detection: 94.5 ± 0.9 % with the first sensor, 97.1 ± 0.4 % "
        "with 2 (the last one adds 2.6 ± 0.6 percentage points)"
    )
    assert printed(placed_two(fused=FusedPlan(steps)), capsys).endswith(f"{LAST_LINES}{first}.\n")
    text = printed(placed_two(fused=FusedPlan(steps, searched=True)), capsys)
    assert text.endswith(f"{first}; swapping a single sensor finds no more there.\n")
    better = FusedPlan(steps, ("c", "a"), PlanStep(2, 0.9753, 0.004, True, 0.004, 0.002, 0.98), searched=True)
    text = printed(placed_two(fused=better), capsys)
    assert text.endswith(f"{first}; c, a should find 0.4 ± 0.2 percentage points more there.\n")


def test_bits_have_thousands_separators(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(placed_two("egvs", 100_000.0), capsys)
    assert "EGVS together, bit" in text
    assert "The plan a, b scores 99,220 ± 300 bit, 99.8 % of what all 12 candidates reach together;" in text
    assert "A second sensor adds 4,670 ± 500 bit (4.7 % of the plan's score) to EGVS: 99,220 bit" in text


def test_reason_is_printed_where_errors_are_unknown(capsys: pytest.CaptureFixture[str]) -> None:
    placed = placed_two()
    steps = tuple(PlanStep(step.count, step.score, step.gain, True) for step in placed.steps)
    sensors = tuple(sensor(row.order, row.site, row.gain, row.score) for row in placed.sensors)
    text = printed(
        placed_two(steps=steps, sensors=sensors, has_errors=False, errors_from="score.standard_error is false"), capsys
    )
    assert "no standard errors: score.standard_error is false" in text
    assert "±" not in text
    assert "A second sensor adds 4.7 percentage points" in text


def test_best_single_site_that_is_not_part_of_the_plan_is_named() -> None:
    text = place.describe_absent_best(placed_two(curve_sites=(("c",), ("a", "b"))))
    assert text is not None
    assert text.startswith("The best single site, c, is not part of this plan")


def test_best_single_site_in_the_plan_or_a_single_sensor_needs_no_sentence() -> None:
    assert place.describe_absent_best(placed_two()) is None
    one = placed_two()
    one.sensors = one.sensors[:1]
    one.curve_sites = (("a",),)
    assert place.describe_absent_best(one) is None


def test_costs_are_printed_only_where_they_are_set(capsys: pytest.CaptureFixture[str]) -> None:
    assert "cost" not in printed(placed_two(), capsys)
    text = printed(placed_two(curve_costs=(3000.0, 6000.0)), capsys)
    assert sum("  cost" in line for line in text.splitlines()) == 2
    assert "The plan a, b for 6000 should find" in text


def test_ends_with_what_was_assumed(capsys: pytest.CaptureFixture[str]) -> None:
    caveat = "Before you trust this plan: assumed, not measured: positions of the poles."
    place.print_placement(placed_two(), PlacementConfig(count=2), caveat=caveat)
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
    text = printed(placed_two(files=("runs/r/placement.parquet", "runs/r/report.html")), capsys)
    assert text.endswith(f"{LAST_LINES}runs/r/placement.parquet\nruns/r/report.html\n")
