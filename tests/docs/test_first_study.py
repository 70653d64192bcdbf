"""docs/validity.md and docs/validity-tables.md agree with the tables of the first study, which are kept as data."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.across_junctions import table_files

DOCS = Path(__file__).resolve().parents[2] / "docs"
DATA = Path("data", "validity")


def test_page_of_tables_links_and_shows_each_file() -> None:
    page = (DOCS / "validity-tables.md").read_text(encoding="utf-8")
    headings = {table.section for table in table_files.read(DOCS / DATA)[1]}
    assert set(re.findall(r"^## (.*)$", page, re.MULTILINE)) == headings
    for file in table_files.file_names(DOCS / DATA):
        assert f"({DATA.as_posix()}/{file})" in page
        assert f"<!-- study table {Path(file).stem} -->" in page


def test_every_number_of_the_answers_is_in_the_tables() -> None:
    """Numbers with a decimal point: those are measured."""
    answers = (DOCS / "validity.md").read_text(encoding="utf-8").partition("\n## Answers\n")[2]
    answers = answers.partition("\n## Detectors that measure heights")[0]  # numbers of other programs follow
    shown = set(re.findall(r"\d+\.\d+", table_files.page("", *table_files.read(DOCS / DATA))))
    settings = {"0.25", "0.5", "4.5", "0.7"}
    assert answers
    assert set(re.findall(r"\d+\.\d+", answers)) <= shown | settings
