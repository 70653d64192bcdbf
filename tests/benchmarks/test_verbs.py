"""The table of times has every command, and is written between the marks of its page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from benchmarks import verbs
from benchmarks.verbs import Row, Verb

from tests.docs.test_commands_page import program_commands

PAGE = Path(__file__).parents[2] / "docs" / "scaling.md"


def test_every_command_is_measured() -> None:
    commands = {name if name.startswith("city ") else name.split()[0] for name in program_commands()}
    assert {verb.name for verb in verbs.VERBS} == commands


def test_table_of_the_page_has_commands_as_they_are_measured() -> None:
    _, _, rest = PAGE.read_text(encoding="utf-8").partition(verbs.MARKS[0])
    table, end, _ = rest.partition(verbs.MARKS[1])
    assert end
    rows = re.findall(r"^\| `egvs (.+?)` \|", table, re.MULTILINE)
    assert "run short --out new" in rows
    assert set(rows) <= {verb.command_line for verb in verbs.VERBS}
    missing = [verb.name for verb in verbs.VERBS if verb.command_line not in rows]
    listed = re.findall(r"`egvs (.+?)`", table.partition("Not measured: ")[2])
    assert listed == missing


RUN, SCORES = Verb("run short", saves_results=True), Verb("scores")
RUN_LINE, SCORES_LINE = "| `egvs run short` | 3.00 | 2.00 | 0.25 |", "| `egvs scores` | 0.50 | 0.25 | - |"
HEAD = ["| command | cold s | warm s | up to date s |", "|---|---:|---:|---:|"]


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page with a row of each of two commands, and of one that is no longer measured; a third command has no row."""
    monkeypatch.setattr(verbs, "VERBS", (RUN, SCORES, Verb("train model")))
    path = tmp_path / "page.md"
    lines = [*HEAD, "| `egvs scores` | 9.00 | 8.00 | - |", RUN_LINE, "| `egvs old` | 1.00 | 1.00 | - |"]
    path.write_text("\n".join(["before", verbs.MARKS[0], *lines, "", "Not measured: x.", verbs.MARKS[1], "after\n"]))
    return path


def test_rows_have_a_dash_where_nothing_is_up_to_date() -> None:
    rows = [Row(RUN, 3.0, 2.0, 0.25), Row(SCORES, 0.5, 0.25, None)]
    assert ["| " + " | ".join(row.cells()) + " |" for row in rows] == [RUN_LINE, SCORES_LINE]


def test_only_rows_of_measured_commands_are_replaced(page: Path) -> None:
    verbs.update_page(page, [Row(SCORES, 0.5, 0.25, None)])
    table = [*HEAD, RUN_LINE, SCORES_LINE, "", "Not measured: `egvs train`."]
    assert page.read_text(encoding="utf-8").splitlines() == ["before", verbs.MARKS[0], *table, verbs.MARKS[1], "after"]


def test_first_measurements_fill_an_empty_table(page: Path) -> None:
    page.write_text("\n".join(verbs.MARKS), encoding="utf-8")
    verbs.update_page(page, [Row(RUN, 3.0, 2.0, 0.25)])
    assert RUN_LINE in page.read_text(encoding="utf-8").splitlines()


def test_page_without_marks_is_an_error(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("no marks\n")
    with pytest.raises(ValueError, match="expected one pair of marks"):
        verbs.update_page(page, [])


def test_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        verbs.main(["fly"])
    assert "got fly" in capsys.readouterr().err
