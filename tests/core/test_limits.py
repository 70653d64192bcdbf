"""Bounds are held, are told in the message, and can be raised; readers' exceptions become the file's message."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import pytest

from egvs.core import limits
from egvs.core.errors import InputError, RunError
from egvs.core.reading import translate_errors

LIMITS = [value for value in vars(limits).values() if isinstance(value, limits.Limit)]


def test_limit_is_checked_reported_and_raised_by_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    limits.POINTS.check("a.ply", 30_000_000)
    with pytest.raises(InputError) as refused:
        limits.POINTS.check("a.ply", 30_000_001)
    message = "a.ply: has 30,000,001 points. The limit is 30,000,000 points; set EGVS_MAX_POINTS to raise it."
    assert str(refused.value) == message
    monkeypatch.setenv("EGVS_MAX_POINTS", "30000001")
    limits.POINTS.check("a.ply", 30_000_001)
    with pytest.raises(InputError):
        limits.POINTS.check("a.ply", float("nan"))


@pytest.mark.parametrize("text", ["", "0", "-1", "1e9", "many", "٣", "9" * 19])
def test_rejects_invalid_value_of_variable(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("EGVS_MAX_FILE_MB", text)
    with pytest.raises(InputError, match=r"^EGVS_MAX_FILE_MB: expected the maximum number of MB .*for example 1000\.$"):
        _ = limits.FILE.maximum


def test_names_of_limits_are_unique() -> None:
    names = [limit.name for limit in LIMITS]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"EGVS_MAX_[A-Z_]+", name) for name in names)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (RecursionError("maximum"), "it is nested too deeply"),
        (ValueError("first\nsecond"), "first"),
        (KeyError("x"), "KeyError 'x'"),
        (AssertionError(), "AssertionError"),
        (OverflowError("too large"), "too large"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, ""), "it is not utf-8 text: byte 0 is 0xff"),
    ],
)
def test_translate_errors_names_the_file(error: Exception, message: str) -> None:
    with pytest.raises(InputError) as refused, translate_errors("x.ply", "Use a mesh."):
        raise error
    assert str(refused.value) == f"x.ply: cannot be read ({message}). Use a mesh."
    assert refused.value.__cause__ is error


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), "it needs more memory than is available). Use a smaller file, or a machine with more memory."),
        (PermissionError(errno.EACCES, "Permission denied"), "Permission denied). Check the path and the permissions."),
    ],
)
def test_errors_of_the_machine_do_not_blame_the_file(error: Exception, expected: str) -> None:
    with pytest.raises(InputError) as refused, translate_errors("x.ply", "Use a mesh."):
        raise error
    assert str(refused.value) == f"x.ply: cannot be read ({expected}"


@pytest.mark.parametrize(
    "error", [InputError("y", "z"), RunError("no"), OSError(errno.ENOSPC, "No space"), SystemExit()]
)
def test_translate_errors_passes_other_errors(error: BaseException) -> None:
    with pytest.raises(type(error)) as passed, translate_errors("x.ply"):
        raise error
    assert passed.value is error


def test_documentation_lists_every_limit() -> None:
    page = (Path(__file__).parents[2] / "docs" / "limits.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `EGVS_MAX_")]
    defaults = {limit: str(limit.default) if limit.unit == "MB" else f"{limit.default:,}" for limit in LIMITS}
    assert rows == [f"| `{limit.name}` | {value} {limit.unit} | {limit.what} |" for limit, value in defaults.items()]
