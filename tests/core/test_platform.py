"""Locks between open files, and the program without the modules that only POSIX systems have."""

from __future__ import annotations

import importlib
import ntpath
import os
import pkgutil
import subprocess
import sys
from pathlib import Path, PureWindowsPath

import pytest

import egvs
from egvs.core import platform
from tests.platform_tests import platform_modules, platform_tests

ROOT = Path(__file__).parents[2]


def open_file(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT)


needs_posix = pytest.mark.skipif(not platform.HAS_POSIX, reason="needs the locks of a POSIX system, or msvcrt")


@needs_posix
def test_lock_keeps_others_out_until_it_is_closed(tmp_path: Path) -> None:
    first, second = open_file(tmp_path / "lock"), open_file(tmp_path / "lock")
    assert platform.try_lock(first)
    assert not platform.try_lock(second)
    assert not platform.try_lock(second, shared=True)
    os.close(first)
    assert platform.try_lock(second)
    os.close(second)


@needs_posix
def test_shared_locks_exclude_only_exclusive_ones(tmp_path: Path) -> None:
    first, second, third = (open_file(tmp_path / "lock") for _ in range(3))
    assert platform.try_lock(first, shared=True)
    assert platform.try_lock(second, shared=True)
    assert not platform.try_lock(third)
    for descriptor in (first, second, third):
        os.close(descriptor)


def test_relative_paths_have_slashes_and_may_be_on_another_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    assert platform.relative_path(Path("/a/b/c"), Path("/a/d")) == "../b/c"
    monkeypatch.setattr(os, "path", ntpath)
    assert platform.relative_path(PureWindowsPath(r"C:\towns\a\map"), PureWindowsPath(r"C:\towns\runs")) == "../a/map"
    assert platform.relative_path(PureWindowsPath(r"D:\towns\a"), PureWindowsPath(r"C:\runs")) == "D:/towns/a"


@pytest.mark.slow
def test_peak_memory_grows_with_an_array() -> None:
    before_mb = platform.peak_memory_mb()
    size_mb = int(before_mb) + 100
    data = bytearray(b"x") * (size_mb * 2**20)
    assert platform.peak_memory_mb() > size_mb
    assert len(data) == size_mb * 2**20


@pytest.mark.skipif(platform.HAS_POSIX, reason="other tests import all modules where POSIX modules exist")
def test_all_modules_can_be_imported() -> None:
    for module in pkgutil.walk_packages(egvs.__path__, "egvs."):
        if module.name != "egvs.__main__" and ".training" not in module.name:  # PyTorch is an extra
            importlib.import_module(module.name)


@pytest.mark.slow
def test_portable_suite_has_tests_of_what_differs_between_systems() -> None:
    used_by = {"egvs.core.files", "egvs.core.resource_usage", "egvs.runs.locks", "egvs.formats.reader_process"}
    assert {"egvs.core.platform", *used_by} <= platform_modules()
    folder = ROOT / "tests"
    assert "test_peak_memory_grows_with_an_array" in platform_tests(folder / "core" / "test_platform.py")
    assert len(platform_tests(folder / "placement" / "test_plan.py")) > 10
    assert not platform_tests(folder / "kernels" / "test_traversal.py")


SOME_TESTS = """
import pytest
from egvs.core import files
from egvs.core.wording import number_of

@pytest.fixture
def written(tmp_path):
    files.write_text(tmp_path / "a.txt", "text")

def test_of_fixture(written): assert True
def test_of_command(run_egvs): assert run_egvs("run")
@pytest.mark.usefixtures("written")
def test_of_marked_fixture(): assert True
def test_of_words(tmp_path): assert number_of(2, "site")
def helper(): return number_of(3, "site")
def test_of_other_helper(): assert helper()
"""


@pytest.mark.slow
def test_portable_tests_are_those_that_use_a_module_of_the_platform(tmp_path: Path) -> None:
    path, with_setup = tmp_path / "test_some.py", tmp_path / "test_setup.py"
    path.write_text(SOME_TESTS)
    assert platform_tests(path) == {"test_of_fixture", "test_of_command", "test_of_marked_fixture"}
    with_setup.write_text(SOME_TESTS.replace("@pytest.fixture", "@pytest.fixture(autouse=True)"))
    assert len(platform_tests(with_setup)) == 5


WITHOUT_POSIX = """
import sys
import tests.without_posix
from egvs.cli.app import main
from egvs.core import platform

assert not platform.HAS_POSIX
sys.argv = ["egvs", "demo", sys.argv[1]]
main()
"""


@pytest.mark.slow
@pytest.mark.system
def test_demo_runs_without_posix_modules(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WITHOUT_POSIX, tmp_path / "demo"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "kerb_NE" in done.stdout
    assert (tmp_path / "demo" / "results" / "report.html").is_file()
