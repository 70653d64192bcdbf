"""The table of times has every command, and is written between the marks of its page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from benchmarks import verbs
from benchmarks.verbs import Row, Verb

from egvs.cli import city
from egvs.cli.app import COMMAND_GROUPS

PAGE = Path(__file__).parents[2] / "docs" / "scaling.md"


def test_every_command_is_measured() -> None:
    commands = {name for names in COMMAND_GROUPS.values() for name in names} - {"city"}
    commands |= {f"city {info.name or info.callback.__name__}" for info in city.app.registered_commands}
    assert {verb.name for verb in verbs.VERBS} == commands


def test_table_of_the_page_has_commands_as_they_are_measured() -> None:
    _, _, rest = PAGE.read_text(encoding="utf-8").partition(verbs.MARKS[0])
    table, end, _ = rest.partition(verbs.MARKS[1])
    assert end
    rows = re.findall(r"^\| `egvs (.+?)` \|", table, re.MULTILINE)
    assert "run short --out new" in rows
    assert set(rows) <= {verb.words for verb in verbs.VERBS}


def test_rows_have_a_dash_where_nothing_is_up_to_date() -> None:
    rows = [Row(Verb("run short", keeps=True), 3.0, 2.0, 0.25), Row(Verb("scores"), 0.5, 0.25, None)]
    assert verbs.markdown(rows, ["train"]).splitlines() == [
        "| command | cold s | warm s | up to date s |",
        "|---|---:|---:|---:|",
        "| `egvs run short` | 3.00 | 2.00 | 0.25 |",
        "| `egvs scores` | 0.50 | 0.25 | - |",
        "",
        "Not measured, because libraries of an extra were not installed: `egvs train`.",
    ]


def test_only_what_stands_between_the_marks_is_replaced(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    start, end = verbs.MARKS
    page.write_text(f"before\n{start}\nold\n{end}\nafter\n")
    verbs.write_between_marks(page, "new")
    assert page.read_text() == f"before\n{start}\nnew\n{end}\nafter\n"


def test_page_without_marks_is_an_error(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("no marks\n")
    with pytest.raises(ValueError, match="expected one pair of marks"):
        verbs.write_between_marks(page, "new")


def test_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        verbs.main(["fly"])
    assert "got fly" in capsys.readouterr().err
