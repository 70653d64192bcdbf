"""What was found wrong or doubtful, and how it travels."""

from __future__ import annotations

import json
from dataclasses import replace

from pipeline.artefacts.run_record import StageRecord
from pipeline.cli.progress import Screen
from pipeline.core.cost import Cost
from pipeline.core.findings import WARNINGS, Finding, FindingsError, seen_from, warnings_of

ONE = Finding("sites on lanes", "sites.csv: row 3 (k2)", "stands on lane e1_0", "move it by 2 m")


def test_warnings_come_back_from_summaries_as_they_were() -> None:
    summary = json.loads(json.dumps({WARNINGS: [ONE.to_json()]}))
    assert warnings_of([{}, summary]) == [ONE]


def test_all_errors_are_told_at_once() -> None:
    error = FindingsError([ONE, Finding("roi", "roi", "no lane inside", "")])
    assert str(error) == "sites.csv: row 3 (k2): stands on lane e1_0; move it by 2 m\nroi: no lane inside"
    assert error.exit_code == 2


def test_a_warning_is_a_line_of_its_own(capsys) -> None:
    record = StageRecord("", {}, {}, {"sites": 2, WARNINGS: [ONE.to_json()]}, Cost(seconds=1.0, peak_mb=1.0))
    Screen().stage_event("scan", "done", record)
    assert capsys.readouterr().err.splitlines()[1:] == [f"warning: {ONE}"]


def test_a_warning_names_files_as_seen_from_the_scenario(tmp_path) -> None:
    place = str(tmp_path / "maps" / "a.poly.xml")
    summary = {"solids": 1, WARNINGS: [replace(ONE, place=place).to_json(), ONE.to_json()]}
    assert [warning.place for warning in warnings_of([seen_from(tmp_path, summary)])] == ["maps/a.poly.xml", ONE.place]
    assert seen_from(tmp_path, {"solids": 1}) == {"solids": 1}
