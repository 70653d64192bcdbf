"""The line of a finished stage."""

from __future__ import annotations

from pathlib import Path

import egvs
from egvs.cli import answer
from egvs.cli.stage_summary import describe_summary
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
