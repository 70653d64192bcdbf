"""docs/validity.md agrees with the tables of the first study, and docs/data/files.csv lists all data of the pages."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.across_junctions import table_files

from tests.docs.pages import links

DOCS = Path(__file__).resolve().parents[2] / "docs"
DATA = DOCS / "data"


def test_list_of_data_has_each_file() -> None:
    linked = {link for name in ("README.md", "files.csv") for link in links((DATA / name).read_text(encoding="utf-8"))}
    files = {path.name for path in DATA.iterdir() if path.suffix in (".csv", ".json")}
    folders = {f"{path.name}/{table_files.INDEX}" for path in DATA.iterdir() if path.is_dir()}
    assert linked == files | folders
    for index in folders:
        folder = (DATA / index).parent
        assert {path.name for path in folder.glob("*.csv")} == set(table_files.file_names(folder))


def test_every_number_of_the_answers_is_in_the_tables() -> None:
    """Numbers with a decimal point: those are measured."""
    answers = (DOCS / "validity.md").read_text(encoding="utf-8").partition("\n## The first study\n")[2]
    answers = answers.partition("\n## ")[0]
    shown = set(re.findall(r"\d+\.\d+", table_files.page("", *table_files.read(DATA / "validity"))))
    settings = {"0.25", "0.5", "4.5", "1.5"}
    assert answers
    assert set(re.findall(r"\d+\.\d+", answers)) <= shown | settings
