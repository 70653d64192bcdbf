"""Arguments, variables and limits of the shell that cannot work end a command with one message and exit code 2."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.cli import environment, exit
from egvs.core import platform
from egvs.core.errors import InputError
from tests.conftest import write_mini
from tests.processes import EGVS

NOT_UTF8 = os.fsdecode(b"a\xff")


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (["run", "SCENARIO", "--out", ""], "--out"),
        (["run", "SCENARIO", "--out="], "--out"),
        (["export", "SCENARIO", "--to", ""], "--to"),
        (["check", ""], "an argument"),
    ],
)
def test_rejects_empty_arguments(run_egvs: Any, mini: Path, arguments: list[str], where: str) -> None:
    code, _, error = run_egvs(*(str(mini) if word == "SCENARIO" else word for word in arguments))
    assert code == 2
    assert error == f"egvs: {where}: expected a value, got an empty text. Give a value, or leave the option out.\n"
    assert not (mini / "run.json").exists()


def test_overrides_may_be_empty(mini: Path) -> None:
    environment.check_environment(["run", str(mini), "--set", "traffic.fcd=", "--set=traffic.fcd="])


def test_rejects_empty_run_folder(mini: Path) -> None:
    with pytest.raises(InputError, match="out: expected a folder, got an empty text"):
        egvs.run(egvs.load(mini), "")


def test_rejects_names_that_are_not_utf8(
    run_egvs: Any, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mini(tmp_path / NOT_UTF8)
    for arguments in (("check", tmp_path / NOT_UTF8), ("run", mini, "--out", tmp_path / NOT_UTF8 / "out")):
        code, _, error = run_egvs(*arguments)
        assert (code, error.count("\n")) == (2, 1)
        assert "expected a name in UTF-8" in error
    with pytest.raises(InputError, match="the scenario: expected a name in UTF-8"):
        egvs.load(tmp_path / NOT_UTF8)
    with pytest.raises(InputError, match="the run folder: expected a name in UTF-8"):
        egvs.run(egvs.load(mini), tmp_path / NOT_UTF8 / "out")
    monkeypatch.chdir(tmp_path / NOT_UTF8)
    assert "the working directory: expected a name in UTF-8" in run_egvs("check", ".")[2]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EGVS_STORE", NOT_UTF8)
    assert "EGVS_STORE: expected a name in UTF-8" in run_egvs("check", mini)[2]


def test_reports_file_names_that_are_not_utf8(capsys: pytest.CaptureFixture[str]) -> None:
    """Names that the program finds in a folder, which no argument contains."""
    with pytest.raises(SystemExit) as end, exit.report_errors():
        NOT_UTF8.encode("utf-8")
    assert end.value.code == 2
    assert "the name of the file is not UTF-8. Rename it." in capsys.readouterr().err


def test_rejects_numba_without_compiler(run_egvs: Any, mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    code, _, error = run_egvs("run", mini, "--out", mini / "out")
    assert code == 2
    assert error.startswith("egvs: NUMBA_DISABLE_JIT: numba must compile")
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    assert run_egvs("check", mini)[0] == 0


@pytest.mark.system
@pytest.mark.skipif(not platform.HAS_POSIX, reason="only POSIX limits the address space")
@pytest.mark.parametrize("limit_kb", [600_000, 1_000_000, 3_500_000])
def test_rejects_small_address_space(mini: Path, limit_kb: int) -> None:
    line = f"ulimit -v {limit_kb}; exec '{sys.executable}' -c '{EGVS}' check '{mini}'"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    limit_mb = limit_kb * 1024 / 1e6
    expected = f"egvs: ulimit -v: expected at least 4,000 MB of address space, got {limit_mb:,.0f} MB. "
    assert done.stderr == expected + "Raise the limit: ulimit -v 4000000.\n"


def test_library_that_finds_no_memory_is_no_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end, exit.report_errors():
        raise ImportError("libtbb.so.12: failed to map segment from shared object")
    assert end.value.code == 1
    assert capsys.readouterr().err.startswith("egvs: not enough memory (libtbb.so.12: failed to map segment")
    with pytest.raises(ImportError, match="no module"), exit.report_errors():
        raise ImportError("no module of this name")


@pytest.mark.slow
@pytest.mark.parametrize("to", ["gpkg", "geotiff"])
def test_full_disk_in_library_that_exports(
    run_egvs: Any, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    pyogrio, errors = pytest.importorskip("pyogrio"), pytest.importorskip("rasterio.errors")
    egvs.run(egvs.load(mini), tmp_path / "run")

    def fail(*_: object, **__: object) -> None:
        raise (pyogrio.errors.DataLayerError if to == "gpkg" else errors.RasterioIOError)("no such table")

    def probe(folder: Path, _: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(folder))

    monkeypatch.setattr("pyogrio.write_arrow" if to == "gpkg" else "rasterio.open", fail)
    monkeypatch.setattr("egvs.core.files._write_probe", probe)
    code, _, error = run_egvs("export", tmp_path / "run", "--to", to)
    assert (code, error.count("\n")) == (1, 1)
    assert "No space left on device" in error
    assert not list((tmp_path / "run").glob("export/*"))
