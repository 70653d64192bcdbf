"""Tables as CSV files and as Markdown."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from benchmarks.across_junctions import table_files
from benchmarks.across_junctions.table_files import Cell, Column, Table, number, with_interval

from egvs.extensions.validation.correlation import ConfidenceInterval


@pytest.fixture
def tables() -> list[Table]:
    """Two tables of one section that share a file, one of the same section with other columns, and one of another."""
    head = [Column("score"), Column("sites", "whole"), Column("rho", "two")]
    first = Table("A cluster", "A. Gamma | voxels", "Of cluster.", head, [["egvs", 42, [0.5, -0.12, 1.0]]])
    second = Table(
        "A points", "A. Gamma | voxels", "Of points.", head, [["egvs", 42, None], ["kl", None, [0.1, None, None]]]
    )
    other = Table("A sites", "A. Gamma | voxels", "By site.", [Column("site"), Column("AP", "one")], [["k1", 12.3456]])
    empty = Table("B", "B. Nothing", "Empty.", [Column("site")], [])
    return [first, second, other, empty]


def test_tables_survive_a_round_trip_through_csv(tables: list[Table], tmp_path: Path) -> None:
    table_files.write(tmp_path, ["Conditions."], tables)
    preface, back = table_files.read(tmp_path)
    assert back == tables and preface == ["Conditions."]
    names = ["a-gamma-voxels.csv", "a-gamma-voxels.csv", "a-sites.csv", "b-nothing.csv"]
    assert table_files.file_names(tmp_path) == names
    assert {path.name for path in tmp_path.glob("*.csv")} == set(names)


def test_files_of_earlier_tables_are_removed(tables: list[Table], tmp_path: Path) -> None:
    (tmp_path / "old.csv").write_text("table\n")
    table_files.write(tmp_path, [], tables[:1])
    assert [path.name for path in tmp_path.glob("*.csv")] == table_files.file_names(tmp_path)


def test_page_has_each_section_once(tables: list[Table]) -> None:
    page = table_files.page("Title", ["Conditions."], tables)
    assert page.startswith("# Title\n\nConditions.\n")
    assert [line for line in page.splitlines() if line.startswith("## ")] == ["## A. Gamma | voxels", "## B. Nothing"]
    assert "| score | sites | rho |\n| --- | ---: | ---: |\n| egvs | 42 | 0.50 (-0.12 to 1.00) |\n" in page


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (None, "-"),
        (0.456, "0.46"),
        (-0.001, "0.00"),
        ("a | b", "a \\| b"),
        ([0.5, None, None], "0.50"),
        ([0.5, -0.12, 1], "0.50 (-0.12 to 1.00)"),
    ],
)
def test_cells_as_text(cell: Cell, text: str) -> None:
    assert table_files.format_number(cell, "two") == text


def test_undefined_numbers_are_none() -> None:
    assert number(0.123456) == 0.1235 and number(math.nan) is None
    assert str(number(-0.00001)) == "0.0"
    interval = ConfidenceInterval(0.1, 0.9)
    assert with_interval(0.5, interval) == [0.5, 0.1, 0.9]
    assert with_interval(math.nan, interval) is None
