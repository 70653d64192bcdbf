"""The section on what-ifs: what the page says of answers written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from egvs.artefacts.command_results import CommandResult, write_results
from egvs.results.command_entries import DIGEST_KEY, what_if_digest
from egvs.scenario.model import Scenario
from tests.report.small_runs import render_report, run_to_scores, section_text

STAGES = {"traffic": "", "tpog": ""}
"""Inputs of stages as in :func:`tests.report.small_runs.make_record`."""

BOX = {"x_m": 2.0, "y_m": 2.0, "length_m": 1.0, "width_m": 1.0, "height_m": 1.0}
TABLES = {"lorry": {"share": 0.25, "boxes": [BOX]}}


@pytest.fixture
def run(tmp_path: Path) -> tuple[Scenario, Path]:
    return run_to_scores(tmp_path, what_if=TABLES)


def write(out: Path, values: dict[str, Any], stages: dict[str, str] = STAGES) -> None:
    write_results(out / "what_if.json", {"lorry": CommandResult(stages, values)})


def what_if_values(scenario: Scenario) -> dict[str, Any]:
    return {
        "share": 0.25, "best_before": "a1", "best_present": "b1", "best_expected": "b1",
        "change": {"value": -12.5, "se": 3.25, "better": 0.0}, "rival": "b1", "overtakes": 0.97,
        "conclusion": "lorry (25 % of the time): b1 becomes the best site instead of a1.",
        "tables": ["lorry"], DIGEST_KEY: what_if_digest(scenario, ["lorry"]),
    }  # fmt: skip


def test_shows_what_if(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    write(out, what_if_values(scenario))
    text = section_text(render_report(scenario, out), "what-if")
    assert text is not None
    assert "lorry 25 % a1 b1 b1 -12" in text
    assert "97 % (b1)" in text
    assert "b1 becomes the best site instead of a1." in text


def test_what_if_of_other_tables_is_not_shown(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    write(out, what_if_values(scenario))
    assert section_text(render_report(scenario, out), "what-if")
    changed = scenario.what_if["lorry"].model_copy(update={"share": 0.5})
    for tables in ({"lorry": changed}, {}):
        other = scenario.model_copy(update={"what_if": tables})
        assert section_text(render_report(other, out), "what-if") is None


def test_what_if_digest_covers_contents_of_files(run: tuple[Scenario, Path]) -> None:
    scenario, _ = run
    table = scenario.what_if["lorry"].model_copy(update={"footprints": ("works.geojson",)})
    scenario = scenario.model_copy(update={"what_if": {"works": table}})
    assert what_if_digest(scenario, ["works"]) is None  # no such file
    (scenario.folder / "works.geojson").write_text("1")
    first = what_if_digest(scenario, ["works"])
    (scenario.folder / "works.geojson").write_text("2")
    assert None is not first != what_if_digest(scenario, ["works"])


@pytest.mark.slow
def test_what_if_of_other_traffic_is_not_shown(run: tuple[Scenario, Path]) -> None:
    """The page is the same, byte for byte, as without the file."""
    scenario, out = run
    before = render_report(scenario, out)
    write(out, what_if_values(scenario), {"traffic": "other inputs"})
    assert render_report(scenario, out) == before
    write(out, what_if_values(scenario), {"traffic": "", "score": ""})  # score was not recorded
    assert render_report(scenario, out) == before
    write(out, what_if_values(scenario))
    assert render_report(scenario, out) != before
