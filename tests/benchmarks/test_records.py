"""Records of benchmarks: nothing is lost between the tables and the history page, and bad files are rejected."""

from __future__ import annotations

import json
import statistics
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from benchmarks import history, records
from benchmarks.records import Machine, Record, limit_results, parse_quantity, table_results

suite = pytest.importorskip("benchmarks.__main__", reason="benchmarks need modules that only POSIX systems have")

MACHINE = Machine(
    processor="Model 7", cores=2, memory_gb=8.0, system="Linux x86_64", python="3.11.7", libraries={"numpy": "2.4.6"}
)
START = datetime(2026, 3, 1, tzinfo=UTC)
LIMITS = [("  two threads", "1.9 x", "1.7 x", True), ("memory", "1,200 MB = too much", "1024 MB", False)]
TABLES = {"further": [("a|b", 0.25, 3), ("text", "none"), ("infinite", float("inf"))]}


def make_record(day: int, ms: float, machine: Machine = MACHINE, commit: str | None = "8f14e45fceea167a") -> Record:
    """A record of one benchmark that took some milliseconds."""
    results = limit_results([("site", f"{ms} ms", "20 ms", ms < 20)])
    return Record(
        egvs="1.0", commit=commit, has_local_changes=False, time_utc=START + timedelta(days=day),
        machine=machine, results=tuple(results),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2.35 s = SUMO + 2.10 s", (2.35, "s")),
        ("1,024 MB", (1024.0, "MB")),
        ("-0.5 %", (-0.5, "%")),
        ("1e-3", (1e-3, "")),
        ("12", (12.0, "")),
        ("none", (None, "")),
        ("", (None, "")),
    ],
)
def test_quantity_at_the_beginning_of_a_cell(text: str, expected: tuple[float | None, str]) -> None:
    assert parse_quantity(text) == expected


@pytest.mark.system
def test_record_survives_the_file(tmp_path: Path) -> None:
    record = Record.of([*limit_results(LIMITS), *table_results(TABLES)])
    path = tmp_path / "new" / "record.json"
    record.write(path)
    assert Record.read(path) == record
    content = json.loads(path.read_text(encoding="utf-8"))
    memory = content["results"][1]
    assert (memory["value"], memory["unit"], memory["limit"], memory["reached"]) == (1200.0, "MB", "1024 MB", False)
    assert [r["cells"] for r in content["results"][2:]] == [[0.25, 3.0], ["none"], [None]]
    assert content["machine"]["cores"] >= 1 and content["machine"]["processor"]


@pytest.mark.system
def test_commit_and_local_changes(tmp_path: Path) -> None:
    assert records.read_commit(tmp_path) == (None, False)
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    (tmp_path / "file").write_text("1")
    for arguments in (["init", "-q"], ["add", "file"], ["commit", "-qm", "first"]):
        subprocess.run([*git, *arguments], check=True)
    commit, has_local_changes = records.read_commit(tmp_path)
    assert commit is not None and len(commit) == 40 and not has_local_changes
    (tmp_path / "untracked").write_text("1")
    assert records.read_commit(tmp_path) == (commit, False)
    (tmp_path / "file").write_text("2")
    assert records.read_commit(tmp_path) == (commit, True)


def test_suite_writes_what_it_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(suite, "measure_limits", lambda: LIMITS)
    monkeypatch.setattr(suite, "FURTHER_TABLES", {title: lambda rows=rows: rows for title, rows in TABLES.items()})
    monkeypatch.setattr(records, "read_commit", lambda folder: ("abc", True))
    assert suite.main(["--json", str(tmp_path / "a.json")]) == 0
    record = Record.read(tmp_path / "a.json")
    printed = capsys.readouterr().out
    assert [r.name for r in record.results] == ["two threads", "memory", "a|b", "text", "infinite"]
    assert all(r.name in printed for r in record.results)
    assert (record.commit, record.has_local_changes) == ("abc", True)


def test_suite_rejects_a_file_that_cannot_be_written_before_it_measures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(suite, "measure_limits", lambda: pytest.fail("measured"))
    assert suite.main(["--json", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_change_is_relative_to_the_median_of_earlier_records() -> None:
    values = [10.0, 14.0, 11.0, 12.0, 15.0]
    page = history.history_page(make_record(day, ms) for day, ms in reversed(list(enumerate(values))))
    expected = 15.0 / statistics.median(values[:-1]) - 1
    row = next(line for line in page.splitlines() if line.startswith("| site"))
    assert row == f"| site | 10 ms | 14 ms | 11 ms | 12 ms | 15 ms | **{expected:+.0%}** |"
    assert "**+30%**" in row


def test_small_changes_are_not_bold_and_missed_limits_are_marked() -> None:
    page = history.history_page([make_record(0, 20.0, commit=None), make_record(1, 21.0)])
    assert "| site | 20 ms ! | 21 ms ! | +5% |" in page
    assert "2026-03-01 (no commit)" in page and "2026-03-02 8f14e45f" in page


def test_old_columns_are_dropped_but_count_for_the_change() -> None:
    count = history.COLUMNS + 3
    page = history.history_page([make_record(day, 10.0) for day in range(count - 1)] + [make_record(count, 5.0)])
    row = next(line for line in page.splitlines() if line.startswith("| site"))
    assert row.count(" ms") == history.COLUMNS and row.endswith("| **-50%** |")


def test_machines_are_not_compared() -> None:
    other = MACHINE.model_copy(update={"processor": "Model 8"})
    page = history.history_page([make_record(0, 10.0), make_record(1, 100.0, other)])
    assert page.count("\n## ") == 2
    assert page.count("| site |") == 2 and "%** |" not in page


def test_page_from_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / "a.json", tmp_path / "b.json"]
    for day, path in enumerate(paths):
        make_record(day, 10.0 + day).write(path)
    assert history.main([*map(str, paths), "--to", str(tmp_path / "new" / "page.md")]) == 0
    assert "| site | 10 ms | 11 ms | +10% |" in (tmp_path / "new" / "page.md").read_text(encoding="utf-8")
    assert "2 records" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format"),
        ({"machine": {}}, "machine.processor"),
        ({"results": [{"table": "a"}]}, "results.0.name"),
        ({"more": 1}, "more"),
    ],
)
def test_bad_record_is_rejected_with_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, object], message: str
) -> None:
    path = tmp_path / "a.json"
    make_record(0, 10.0).write(path)
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    assert history.main([str(path), "--to", str(tmp_path / "page.md")]) == 2
    error = capsys.readouterr().err
    assert f"a.json: {message}: " in error and error.count("\n") == 1
    assert not (tmp_path / "page.md").exists()


def test_no_record_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(history, "FOLDER", tmp_path)
    assert history.main([]) == 2
    assert "make bench BENCH=" in capsys.readouterr().err
