"""The command, and ``egvs explore`` without a folder, which opens the same page."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("command", ["desk", "explore"])
def test_opens_the_page_over_the_present_folder(command: str, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "egvs", command, "--no-browser"]
    program = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert program.stdout is not None
        assert re.match(r"http://127\.0\.0\.1:\d+/\?key=[\w-]{32}  ", program.stdout.readline())
    finally:
        program.terminate()
        _, errors = program.communicate(timeout=60)
    assert "Traceback" not in errors


@pytest.mark.parametrize("options", [("--to", "page.html"), ("--view", "x"), ("--set", "seed=1")])
def test_explore_needs_a_folder_for_other_options(run_egvs, options: tuple[str, str]) -> None:
    code, _, err = run_egvs("explore", *options)
    assert code == 2 and "no folder is given" in err


def test_refuses_folders_and_ports_that_cannot_be_used(run_egvs, tmp_path: Path) -> None:
    code, _, err = run_egvs("desk", tmp_path / "nothing", "--no-browser")
    assert code == 2 and "no such folder" in err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, _, err = run_egvs("desk", tmp_path, "--no-browser", "--port", taken.getsockname()[1])
    assert code == 2 and "cannot be used" in err
