"""Plans among other solids: the score is that of a run with these solids; nothing changes where no solid is added."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.placement import changed_plan
from egvs.results.plans import SensorPlan
from egvs.runs import stage_registry
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.stages.base import StageContext
from egvs.studies.what_if import prepare_runs
from tests.conftest import write_mini

LORRY = "boxes = [{x_m = 20, y_m = 5, length_m = 12, width_m = 2.5, height_m = 3.8}]"


def open_run(scenario: Scenario, run: Path) -> StageContext:
    return open_folder(scenario, run, recorded=stage_registry.recorded_digests(RunRecord.read(run)))


@pytest.mark.slow
@pytest.mark.parametrize("score", ["expected_detections", "egvs"])
def test_score_among_other_solids_is_that_of_a_run_with_them(score: str, tmp_path: Path) -> None:
    settings = (f"score.rank_by={score}", "placement.count=2")
    scenario = egvs.load(write_mini(tmp_path / "mini"), settings)
    egvs.place(scenario, tmp_path / "run")
    plan, context = SensorPlan.read(RunFolder(tmp_path / "run")), open_run(scenario, tmp_path / "run")
    assert plan is not None
    same = changed_plan.score_in_other_world(context, plan, context)
    assert (same.joint, same.joint_se) == (plan.joint, pytest.approx(plan.joint_se, rel=1e-9))
    assert same.change_se == pytest.approx(0.0, abs=1e-12 * plan.joint)

    _, other = prepare_runs(tmp_path / "mini", (*settings, f"what_if.lorry={{share = 1, {LORRY}}}"))
    there = egvs.place(other.scenario, other.folder)
    opened = open_run(other.scenario, other.folder)
    changed = changed_plan.score_in_other_world(context, plan, opened)
    assert (changed.joint, changed.joint_se) == (there.joint, pytest.approx(there.joint_se, rel=1e-9))
    assert 0.0 < changed.change_se < changed.joint_se + plan.joint_se
    assert changed.joint < plan.joint
    assert "rule out" in changed_plan.describe_in_other_world(context, plan, opened, {plan.sensors[1].site})


@pytest.mark.slow
def test_what_if_says_what_changes_for_the_plan(tmp_path: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    toml = write_mini(tmp_path / "mini") / "scenario.toml"
    toml.write_text(f"{toml.read_text()}\n[what_if.lorry]\nshare = 0.5\n{LORRY}\n")
    assert "the plan of" not in run_egvs("what-if", "mini")[1]
    run_egvs("place", "mini", "--count", "2")
    number = r"[\d,]+ ± [\d,]+ bit"
    sentence = rf"With lorry, the plan of 2 sensors changes from {number} to {number} \(by -{number}\)\."
    assert re.search(sentence, run_egvs("what-if", "mini")[1])
