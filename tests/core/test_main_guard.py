"""A script without a main guard gets an error before any worker process starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CALL = "from egvs.core.main_guard import check_main_guard\ndef work():\n    check_main_guard()\n"
UNGUARDED = ["work()", "if True:\n    work()", "if __name__ == '__main__':\n    pass\nwork()"]
GUARDED = ["if __name__ == '__main__':\n    work()", "if len(__name__) and '__main__' == __name__:\n    work()"]


def run_script(path: Path, end: str) -> subprocess.CompletedProcess[str]:
    path.write_text(CALL + end, encoding="utf-8")
    return subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=60)


@pytest.mark.system
@pytest.mark.parametrize("end", UNGUARDED)
def test_names_script_line_and_guard(tmp_path: Path, end: str) -> None:
    run = run_script(tmp_path / "trial.py", end)
    line = (CALL + end).count("\n") + 1
    message = run.stderr.splitlines()[-1]
    assert f"trial.py: line {line} starts worker processes" in message and 'if __name__ == "__main__":' in message


@pytest.mark.system
@pytest.mark.parametrize("end", GUARDED)
def test_accepts_guarded_scripts(tmp_path: Path, end: str) -> None:
    run = run_script(tmp_path / "trial.py", end)
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.system
def test_accepts_code_without_a_file() -> None:
    subprocess.run([sys.executable, "-c", CALL + "work()"], check=True, timeout=60)
