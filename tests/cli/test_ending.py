"""How the program ends, whatever the system has against its files and whatever standard output is.

Evidence: real processes with streams that are closed, full, in another encoding or read by nobody; a process that may
not read what is closed to it, as one of no administrator may not.
"""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from egvs.cli import exit
from tests.processes import EGVS, python

FEWER_RIGHTS = """
import ctypes
from pathlib import Path
# No capability is left (capset(2)): what its owner may not read, this process may not either.
ctypes.CDLL(None).capset((ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)())
from egvs.cli.app import main
main()
"""


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """A line of the shell with ``egvs`` in it."""
    words = line.replace("egvs", f"'{sys.executable}' -c '{EGVS}'", 1)
    line = f"set -o pipefail; unset PYTHONUNBUFFERED; {words}"
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.system
def test_closed_streams_are_no_error(mini: Path, tmp_path: Path) -> None:
    closed = "import os, sys\nfor n in (0, 1, 2): os.close(n)\nsys.stdin = sys.stdout = sys.stderr = None\n"
    done = python(closed + EGVS, "run", mini, "--out", tmp_path / "out")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.system
def test_names_that_an_encoding_does_not_know_are_printed_as_escapes(mini: Path, tmp_path: Path) -> None:
    sites = mini / "sites.csv"
    sites.write_text(sites.read_text().replace("pole_a", "柱"), encoding="utf-8")
    ascii_only = "import sys\nsys.stdout = open(1, 'w', encoding='ascii', closefd=False)\n"
    done = python(ascii_only + EGVS, "run", mini, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "\\u67f1" in done.stdout


@pytest.mark.slow
@pytest.mark.system
def test_full_streams_are_reported_and_closed_ones_are_not() -> None:
    full = shell("egvs sensors > /dev/full")
    told = "egvs: standard output, or a file: No space left on device"
    assert (full.returncode, full.stderr.split(" (")[0], len(full.stderr.splitlines())) == (1, told, 1)
    short = shell("egvs --help > /dev/full")
    assert (short.returncode, len(short.stderr.splitlines())) == (1, 1), short.stderr
    unread = shell("egvs effects | true")
    assert (unread.returncode in (0, 1), unread.stderr) == (True, "")


def test_a_full_disk_is_reported_with_the_file_and_the_free_space(tmp_path: Path) -> None:
    free_mb = shutil.disk_usage(tmp_path).free / 1e6
    error = OSError(errno.ENOSPC, "Error writing bytes to file", str(tmp_path / "new" / "tpog.parquet"))
    message, code = exit.describe_os_error(error)
    start, end = f"{tmp_path}/new/tpog.parquet: No space left on device (", f" MB are free in {tmp_path})"
    assert (code, message.startswith(start), message.endswith(end)) == (1, True, True)
    told_mb = float(message.removeprefix(start).removesuffix(end).replace(",", ""))
    assert told_mb == pytest.approx(free_mb, rel=0.2)
    message, _ = exit.describe_os_error(OSError(errno.EDQUOT, "over quota"))
    assert message.startswith("standard output, or a file: Disk quota exceeded (") and str(Path.cwd()) in message


@pytest.mark.parametrize(
    ("number", "name", "code", "message"),
    [
        (errno.EACCES, "a.csv", 2, "a.csv: Permission denied"),
        (errno.EISDIR, "a.csv", 2, "a.csv: Is a directory"),
        (errno.ENOENT, "a.csv", 2, "a.csv: No such file or directory"),
        (errno.ENAMETOOLONG, "a.csv", 2, "a.csv: File name too long"),
        (errno.EIO, "a.csv", 1, "a.csv: Input/output error"),
        (errno.EBADF, 7, 1, "system: Bad file descriptor"),
        (errno.ENOENT, None, 1, "system: No such file or directory"),
    ],
)
def test_errors_that_a_user_can_correct_are_input_errors(
    number: int, name: str | int | None, code: int, message: str
) -> None:
    error = OSError(number, os.strerror(number)) if name is None else OSError(number, os.strerror(number), name)
    assert exit.describe_os_error(error) == (message, code)


_PLACE = "{mini}/scenario.toml: "
CLOSED = {
    "fcd.csv": _PLACE + "traffic.fcd = 'fcd.csv': cannot be read ({mini}/fcd.csv: Permission denied); "
    "a file that may be read",
    "sites.csv": _PLACE + "sites.file = 'sites.csv': cannot be read ({mini}/sites.csv: Permission denied); "
    "a file that may be read",
    "scenario.toml": "{mini}/scenario.toml: cannot be read (Permission denied); a file that may be read",
}


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("name", CLOSED)
def test_a_file_that_may_not_be_read_is_wrong_input(mini: Path, tmp_path: Path, name: str) -> None:
    (mini / name).chmod(0)
    done = python(FEWER_RIGHTS, "run", mini, "--out", tmp_path / "out")
    last_line = done.stderr.splitlines()[-1]
    assert done.returncode == 2
    assert last_line.startswith("egvs: ") and str(mini) in last_line and "Permission denied" in last_line


@pytest.mark.slow
@pytest.mark.system
def test_a_folder_that_may_not_be_entered_is_wrong_input(mini: Path, tmp_path: Path) -> None:
    mini.chmod(0o400)
    try:
        done = python(FEWER_RIGHTS, "check", mini)
    finally:
        mini.chmod(0o700)
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert str(mini) in done.stderr


def test_no_memory_is_one_message(mini: Path, run_egvs, monkeypatch: pytest.MonkeyPatch) -> None:
    from egvs.runs import run as run_module

    def run(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 7 TiB")

    monkeypatch.setattr(run_module, "run", run)
    code, _, error = run_egvs("run", mini)
    assert code == 1
    assert error.startswith("egvs: not enough memory (Unable to allocate 7 TiB). Use larger voxels")
    assert "Traceback" not in error
