"""Libraries that a command does not need are not imported: they take longer than the command itself.

Each command runs in a new process, because imports are what is tested.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import write_mini

pytestmark = pytest.mark.system

ROUNDABOUT = Path(__file__).parents[2] / "scenarios" / "roundabout"
SHORT = ('traffic.hold="at_most"', "traffic.frames=40", "traffic.warmup_s=5", "tpog.blocks=4", "roi.voxel_m=1")

HEAVY = {"embreex", "matplotlib", "numba", "pandas", "pyproj", "scipy", "shapely", "sumolib", "traci", "trimesh"}
"""Libraries that only a stage that runs needs."""

OF_RESULTS = {"numpy", "pyarrow", "jinja2"}
"""Libraries that a command needs to read or print results."""

RUN_AND_LIST_MODULES = """
import json, sys
from egvs.cli.app import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print()
print(json.dumps(sorted(sys.modules)))
"""


def imported_modules(*arguments: object) -> tuple[str, set[str]]:
    """What a command prints, and the modules that it has imported at its end."""
    words = [sys.executable, "-c", RUN_AND_LIST_MODULES, *map(str, arguments)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    printed, _, names = done.stdout.rstrip("\n").rpartition("\n")
    return printed, set(json.loads(names))


def heavy(modules: set[str]) -> set[str]:
    """The heavy libraries among some modules."""
    return HEAVY & {name.partition(".")[0] for name in modules}


@pytest.mark.slow
def test_help_imports_no_library_of_arrays_or_models() -> None:
    printed, modules = imported_modules("--help")
    assert "Rank candidate sites" in printed
    assert not heavy(modules)
    assert not (OF_RESULTS | {"pydantic"}) & modules


@pytest.mark.slow
@pytest.mark.parametrize("words", [("run", "--help"), ("place", "--help")])
def test_help_of_a_command_imports_no_library_of_arrays(words: tuple[str, ...]) -> None:
    _, modules = imported_modules(*words)
    assert not heavy(modules)
    assert not OF_RESULTS & modules


@pytest.mark.slow
def test_run_without_changes_imports_no_library_of_a_stage(tmp_path: Path) -> None:
    settings = [word for setting in SHORT for word in ("--set", setting)]
    command = ("run", ROUNDABOUT, "--out", tmp_path / "run", *settings)
    printed, modules = imported_modules(*command)
    assert "no stage ran" not in printed
    assert heavy(modules) >= {"embreex", "numba", "scipy", "shapely"}

    printed_again, modules = imported_modules(*command)
    assert printed_again == printed
    assert not heavy(modules)
    assert "pyarrow.compute" not in modules


@pytest.mark.slow
def test_run_of_finished_file_without_changes_imports_no_library_of_a_stage(tmp_path: Path) -> None:
    command = ("run", write_mini(tmp_path / "mini"), "--out", tmp_path / "run")
    imported_modules(*command)
    assert not heavy(imported_modules(*command)[1])
