"""The table of times has every command, and keeps the rows of those that are not measured again."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from benchmarks import verbs
from benchmarks.verbs import Row, Verb

from tests.docs.test_commands_page import program_commands

TABLE = Path(__file__).parents[2] / "docs" / "data" / "command_times.csv"


def test_every_command_is_measured() -> None:
    commands = {name if name.startswith("city ") else name.split()[0] for name in program_commands()}
    assert {verb.name for verb in verbs.VERBS} == commands


def test_table_of_the_docs_has_commands_as_they_are_measured() -> None:
    with TABLE.open(encoding="utf-8", newline="") as file:
        headings, *rows = csv.reader(file)
    assert tuple(headings) == verbs.HEADINGS
    assert [row[0] for row in rows] == [f"egvs {verb.command_line}" for verb in verbs.VERBS]
    assert sum(row[1] != "" for row in rows) > 25
    assert "<!-- data table command_times -->" in (TABLE.parents[1] / "scaling.md").read_text(encoding="utf-8")


RUN, SCORES = Verb("run short", saves_results=True), Verb("scores")
HEAD, RUN_LINE, SCORES_LINE = (
    "command,cold s,warm s,up to date s",
    "egvs run short,3.00,2.00,0.25",
    "egvs scores,0.50,0.25,-",
)


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A table with a row of each of two commands, and of one that is no longer measured; a third has no row."""
    monkeypatch.setattr(verbs, "VERBS", (RUN, SCORES, Verb("train model")))
    path = tmp_path / "table.csv"
    path.write_text("\n".join([HEAD, "egvs scores,9.00,8.00,-", RUN_LINE, "egvs old,1.00,1.00,-", ""]))
    return path


def test_rows_have_a_dash_where_nothing_is_up_to_date() -> None:
    rows = [Row(RUN, 3.0, 2.0, 0.25), Row(SCORES, 0.5, 0.25, None)]
    assert [",".join(row.cells()) for row in rows] == [RUN_LINE, SCORES_LINE]


def test_only_rows_of_measured_commands_are_replaced(table: Path) -> None:
    verbs.update_table(table, [Row(SCORES, 0.5, 0.25, None)])
    assert table.read_text(encoding="utf-8").splitlines() == [HEAD, RUN_LINE, SCORES_LINE, "egvs train model,,,"]


def test_first_measurements_make_the_table(table: Path) -> None:
    table.unlink()
    verbs.update_table(table, [Row(RUN, 3.0, 2.0, 0.25)])
    assert table.read_text(encoding="utf-8").splitlines() == [HEAD, RUN_LINE, "egvs scores,,,", "egvs train model,,,"]


def test_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        verbs.main(["fly"])
    assert "got fly" in capsys.readouterr().err
