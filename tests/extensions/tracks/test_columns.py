"""Tables of recorded tracks: cells, units, limits, keys of another table, companions."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import columns
from egvs.extensions.tracks.columns import Table
from tests.extensions.tracks.hand import assert_one_message

PATH = Path("t.csv")


def table(*texts: str) -> Table:
    return Table(PATH, {"a": texts}, [line + 2 for line in range(len(texts))])


@pytest.mark.parametrize("packed", [False, True])
def test_reads_columns_by_name_in_any_case_and_order(tmp_path: Path, packed: bool) -> None:
    text = b'\xef\xbb\xbfB , "a",c\r\n\r\n 2,1,x\r\n4,"3, 5",\r\n'
    path = tmp_path / "t.csv"
    path.write_bytes(gzip.compress(text) if packed else text)
    read = columns.read_table(path, ("a", "b"), ("d",))
    assert dict(read.columns) == {"a": ["1", "3, 5"], "b": ["2", "4"]}
    assert list(read.lines) == [3, 4]
    assert columns.has_columns(path.read_bytes() if not packed else text, "A", "b")


def test_column_in_same_case_is_preferred(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("X,x\n1,2\n")
    assert columns.read_table(path, ("x",)).texts("x") == ["2"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "expected a column 'a', got none"),
        (b"a,b\n", "contains no rows"),
        (b"b,c\n1,2\n", "expected a column 'a', got b, c"),
        (b"a,A,b\n1,2,3\n", ""),
        (b"b,b,a\n1,2,3\n", "the column 'b' occurs 2 times"),
        (b"a,b\n1,2\n3\n", "line 3: expected 2 cells, got 1"),
        (b"a,b\n1,5,2\n", "line 2: expected 2 cells, got 3"),
        (b"a,b\n1,\xff\n", "not utf-8 text"),
        (b'a,b\n1,"' + b"x" * 200_000 + b'"\n', "field larger than field limit"),
    ],
)
def test_tables_that_do_not_fit(tmp_path: Path, text: bytes, expected: str) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(text)
    if expected:
        assert_one_message(lambda: columns.read_table(path, ("a",), ("b",)), expected)
    else:
        columns.read_table(path, ("a",), ("b",))


@pytest.mark.parametrize(
    ("end", "expected"),
    [(b"\n" * 2000, "has more than 1,000 blank lines one after another"), (b" " * 17_000_000, "unterminated line")],
)
def test_endless_blanks_get_one_message(tmp_path: Path, end: bytes, expected: str) -> None:
    path = tmp_path / "t.csv.gz"
    path.write_bytes(gzip.compress(b"a\n1\n" + end))
    assert_one_message(lambda: columns.read_table(path, ("a",)), expected)


def test_empty_cells_at_the_end_of_a_row_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("a,b\n1,2,,\n")
    assert columns.read_table(path, ("a", "b")).texts("b") == ["2"]


@pytest.mark.parametrize("text", ["x", "", "nan", "inf", "1e400", "1_0", "٣", "0x10", "1\x00"])
def test_rejects_texts_that_are_no_numbers(text: str) -> None:
    assert_one_message(lambda: table("1", text).numbers("a"), "t.csv: line 3: a: expected a number, got")


def test_optional_numbers_are_nan_where_missing() -> None:
    assert np.array_equal(table("1", "", "None", "-2.5e1").optional_numbers("a"), [1, math.nan, math.nan, -25], True)
    assert np.isnan(table("1").optional_numbers("b")).all()


def test_one_long_text_takes_no_memory_for_all_rows() -> None:
    assert_one_message(lambda: table(*["1"] * 100_000, "x" * 100_000).numbers("a"), "expected a number, got 'xxx")


def test_units_and_limits() -> None:
    assert table("1500").times_s("a", 0.001)[0] == 1.5
    assert table("10").positions_m("a", 0.3048)[0] == pytest.approx(3.048)
    assert table("180").angles_rad("a", math.radians(1))[0] == pytest.approx(math.pi)
    assert np.array_equal(table("10", "0", "").sizes_m("a", 0.3048), [3.048, math.nan, math.nan], True)
    assert np.array_equal(table("10", "0", "").heights_m("a", 0.1), [1.0, 0.0, math.nan], True)
    assert_one_message(
        lambda: table("1600000000000").times_s("a"), "expected a time from -1e+10 to 1e+10 s, got 1.6e+12"
    )
    assert_one_message(
        lambda: table("1e9").positions_m("a"), "expected a coordinate from -1e+08 to 1e+08 m, got 1e+09 m"
    )
    assert_one_message(lambda: table("1e9").heights_m("a"), "expected a height")
    assert_one_message(lambda: table("-1").sizes_m("a"), "expected a size from 0 to 100 m, got -1 m")
    assert_one_message(lambda: table("400").sizes_m("a"), "expected a size from 0 to 100 m, got 400 m")
    assert_one_message(lambda: table("1e5").angles_rad("a"), "expected an angle")


def test_classes_are_matched_by_text_in_lower_case() -> None:
    assert table("Car", "PKW").classes("a", {"car": "car", "pkw": "car"}) == ["car", "car"]
    assert_one_message(lambda: table("car", "cart").classes("a", {"car": "car"}), "line 3: a: unknown class 'cart'")


def test_rows_of_keys() -> None:
    assert table("7", "8").rows_of(["8", "7", "8"], "a", PATH).tolist() == [1, 0, 1]
    assert_one_message(lambda: table("7").rows_of(["8"], "a", Path("u.csv")), "u.csv: a '8' is not in t.csv")
    assert_one_message(lambda: table("7", "7").rows_of([], "a", PATH), "t.csv: line 3: a: '7' occurs twice")


def test_companion_may_be_gzipped(tmp_path: Path) -> None:
    (tmp_path / "07_meta.csv.gz").touch()
    for name in ("07_tracks.csv", "07_tracks.csv.gz"):
        assert columns.companion(tmp_path / name, "_tracks.csv", "_meta.csv").name == "07_meta.csv.gz"
    (tmp_path / "07_meta.csv").touch()
    assert columns.companion(tmp_path / "07_tracks.csv", "_tracks.csv", "_meta.csv").name == "07_meta.csv"
    assert_one_message(
        lambda: columns.companion(tmp_path / "08_tracks.csv", "_tracks.csv", "_meta.csv"),
        "08_tracks.csv: expected the file 08_meta.csv beside it",
    )
    assert_one_message(
        lambda: columns.companion(tmp_path / "tracks8.csv", "_tracks.csv", "_meta.csv"),
        "expected a name that ends with _tracks.csv, got tracks8.csv",
    )
