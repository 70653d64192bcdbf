"""Programs write to their folder only, and end with the process that started them."""

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from egvs.core import sandbox
from egvs.core.errors import RunError
from egvs.traffic import sumo
from tests.traffic.helpers import fake_sumo

pytestmark = pytest.mark.system

LINUX = sys.platform.startswith("linux")


def has_landlock():
    return LINUX and ctypes.CDLL(None).syscall(444, None, ctypes.c_size_t(0), ctypes.c_uint32(1)) >= 1


@pytest.mark.skipif(not has_landlock(), reason="this kernel has no Landlock")
def test_sumo_cannot_write_outside_its_folder(tmp_path, monkeypatch):
    user_file, foreign = tmp_path / "own", tmp_path / "foreign"
    user_file.mkdir()
    foreign.write_text("kept")
    monkeypatch.setattr(sumo, "sumo_environment", lambda: dict(os.environ))
    for attempt in (f"echo x > {foreign}", "echo x > ../new", f"rm {foreign}", f"mv {foreign} here", "mkdir ../new"):
        fake_sumo(tmp_path, monkeypatch, f"echo mine > mine && echo gone > /dev/null || exit 3\n{attempt} || exit 9")
        with pytest.raises(RunError, match=r"sumo ended with exit code [29]"):
            sumo.run_program("sumo", [], user_file)
        assert ((user_file / "mine").read_text(), foreign.read_text()) == ("mine\n", "kept")
        assert not (tmp_path / "new").exists()


@pytest.mark.skipif(not has_landlock(), reason="this kernel has no Landlock")
def test_sumo_tool_cannot_write_outside_its_folder(tmp_path, monkeypatch):
    (tmp_path / "tools").mkdir()
    (tmp_path / "own").mkdir()
    text = "import pathlib, sys\npathlib.Path('mine').write_text('x')\npathlib.Path(sys.argv[1]).write_text('x')\n"
    (tmp_path / "tools" / "tool.py").write_text(text)
    monkeypatch.setattr(sumo, "sumo_home", lambda: tmp_path)
    assert sumo.run_tool("tool.py", ["here"], tmp_path / "own") == ""
    with pytest.raises(RunError, match=r"tool\.py ended with exit code 1:(.|\n)*PermissionError"):
        sumo.run_tool("tool.py", [str(tmp_path / "foreign")], tmp_path / "own")
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == ["here", "mine", "tool.py"]


PARENT = """
import sys
from pathlib import Path
from egvs.traffic import sumo
sumo.run_program("sumo", [], Path(sys.argv[1]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not LINUX, reason="elsewhere the launcher watches a pipe")
def test_sumo_ends_with_a_killed_parent(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "alive")
    fake_sumo(tmp_path, monkeypatch, "exec 3> alive; echo $$ >&3; while :; do :; done")
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(tmp_path)])
    with (tmp_path / "alive").open() as alive, parent:
        assert int(alive.readline()) > 0
        parent.send_signal(signal.SIGKILL)
        assert alive.read() == ""  # the end comes when nobody holds the other end any more: when the child is dead


WATCHED = """
import sys
from egvs.core import sandbox
sys.exit(sandbox.run_watched(sys.argv[1:]))
"""


def test_watched_program_ends_when_the_pipe_is_closed():
    command = [sys.executable, "-c", WATCHED, "/bin/sh", "-c", "echo runs; while :; do :; done"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as launcher:
        assert launcher.stdin is not None and launcher.stdout is not None
        assert launcher.stdout.readline() == b"runs\n"
        launcher.stdin.close()
        assert launcher.stdout.read() == b""
    assert launcher.returncode != 0


def test_watched_program_returns_its_exit_code():
    command = [sys.executable, "-c", WATCHED, "/bin/sh", "-c", "exit 5"]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as launcher:
        assert launcher.wait() == 5


def test_sandbox_imports_no_module_of_the_package():
    assert "egvs" not in Path(sandbox.__file__).read_text(encoding="utf-8").split('"""', 2)[2]
