"""The line of a finished stage, and the warnings of a command."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import egvs
from egvs.artefacts.run_record import ResourceUsage, StageRecord
from egvs.cli import answer
from egvs.cli.console import ProgressDisplay
from egvs.cli.stage_summary import describe_summary
from egvs.core.errors import WARNINGS_KEY, Diagnostic
from egvs.report import reliability
from egvs.scenario.model import Scenario

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"


def described(scenario: Scenario) -> str:
    summary = {"frames": 10, "counts": [{"geh": 0.21}, {"geh": 0.1}]}
    return describe_summary("traffic", summary, with_details=False, flow_source=answer.flow_source(scenario))


def test_flows_are_compared_with_counts_only_where_some_were_counted() -> None:
    scenario = egvs.load(SCENARIOS / "hill", ["assumed=['positions of the poles']"])
    assert described(scenario) == "10 frames; largest GEH against the counts 0.2"
    guessed = egvs.load(SCENARIOS / "hill", ["assumed=['traffic (256 vehicles an hour)']"])
    assert described(guessed) == "10 frames; largest GEH against the assumed flows 0.2"


def test_occupancy_counts_road_users_where_people_are_among_them() -> None:
    summary = {"occupied_voxels": 9, "static_voxels": 0, "boxes_in_roi": 4.7, "memory_frames": 1.0}
    assert "4.7 vehicles in the region on average" in describe_summary("tpog", summary, with_details=False)
    summary["with_people"] = True
    text = describe_summary("tpog", summary, with_details=True)
    assert "4.7 road users in the region on average" in text and "with_people" not in text


def report_warnings(capsys: pytest.CaptureFixture[str], state: str, *rules: str, **options: bool) -> list[str]:
    """Return what the display of a command prints of warnings of these rules, of a stage that ends in a state."""
    warnings = [Diagnostic(rule, "scenario.toml", f"a problem of {rule}" * 30, "Do something.") for rule in rules]
    summary = {"sites": 2, WARNINGS_KEY: [warning.to_json() for warning in warnings]}
    record = StageRecord("key", {}, {}, summary, ResourceUsage(1.0, 1.0))
    with ProgressDisplay("test", **options) as screen:
        screen.stage_event("score", state, record)
        screen.stage_event("score", state, record)  # of another run of the same command
    return [line for line in capsys.readouterr().err.splitlines() if line and not line.startswith("score ")]


def test_one_line_says_how_many_warnings_there_are_and_shows_the_most_serious(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rules = ("similar names", "equal sites", "weights", "overlaps in roi", "sites on lanes")
    for state, is_run in (("done", False), ("fetched", False), ("skipped", True)):
        lines = report_warnings(capsys, state, *rules, is_run=is_run)
        assert lines[0].startswith("5 warnings; the most serious: scenario.toml: a problem of overlaps in roi")
        assert len(lines) == 2
        assert max(map(len, lines)) <= 100
    assert report_warnings(capsys, "done", "weights")[0].startswith("warning: scenario.toml: a problem of weights")
    details = report_warnings(capsys, "done", *rules, with_details=True)
    assert len(details) == 5
    assert all(line.endswith("Do something.") for line in details)


def test_warnings_of_unchanged_stages_are_those_of_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert report_warnings(capsys, "skipped", "weights", "overlaps") == ["2 warnings, as in the run"]
    assert report_warnings(capsys, "skipped", "weights", with_details=True) == ["1 warning, as in the run"]
    assert report_warnings(capsys, "skipped") == []


def test_rules_by_severity_exist() -> None:
    """A renamed rule would silently become one of the less serious."""
    source = "".join(path.read_text(encoding="utf-8") for path in Path(egvs.__file__).parent.rglob("*.py"))
    for rule in {rule for rules in reliability._BY_SEVERITY for rule in rules}:
        assert re.search(rf'Diagnostic\(\s*"{rule}"', source), rule
