"""The progress display: on a terminal, the elapsed time of the whole run in every stage; elsewhere, plain lines.

The terminal is a pseudo-terminal of 80 columns. What is shown is compared with the seconds that the run recorded, so
the tests ask the same of slow and of fast machines.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX only")

pytestmark = [pytest.mark.system, pytest.mark.slow]

ROUNDABOUT = Path(__file__).parents[2] / "scenarios" / "roundabout"
COLUMNS = 80
ELAPSED = re.compile(r"(\w+)[^\r\n]*? (\d+):(\d\d):(\d\d)")
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
MIN_STAGE_S = 2.5
"""A stage must last this long before its elapsed times are counted."""


def on_terminal(*arguments: object) -> str:
    """Run the command line in a pseudo-terminal, and return what it showed, without control sequences."""
    ours, theirs = pty.openpty()
    words = [sys.executable, "-m", "egvs", *(str(argument) for argument in arguments)]
    environment = os.environ | {"COLUMNS": str(COLUMNS), "TERM": "xterm-256color", "EGVS_MAX_BEAMS": "40000000"}
    with subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        parts = []
        while part := _read(ours):
            parts.append(part)
    os.close(ours)
    shown = b"".join(parts).decode()
    assert process.returncode == 0, shown
    return CONTROL.sub("", shown)


def _read(terminal: int) -> bytes:
    """Return the next output; empty at the end, which Linux reports as an error."""
    try:
        return os.read(terminal, 65536)
    except OSError:
        return b""


def elapsed_s(shown: str, stage: str | None = None) -> list[int]:
    """Return the different elapsed times in the order shown, of the bar of one stage or of all."""
    times = []
    for name, hours, minutes, seconds in ELAPSED.findall(shown):
        if stage in (None, name):
            times.append(3600 * int(hours) + 60 * int(minutes) + int(seconds))
    return list(dict.fromkeys(times))


@pytest.fixture(scope="module")
def long_scan(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, dict[str, float]]:
    """What a run with a long scan showed, and the seconds of its stages; the scan gets more beams until it is long."""
    from tests.conftest import write_mini

    folder = tmp_path_factory.mktemp("progress")
    scenario = write_mini(folder / "mini")
    for number, step_deg in enumerate((0.002, 0.001, 0.0005, 0.00025)):
        out = folder / f"run{number}"
        beams = f"sensors.small.azimuth_step_deg={step_deg}"
        shown = on_terminal("run", scenario, "--out", out, "--set", beams, "--set", "sensors.small.channels=16")
        stages = json.loads((out / "run.json").read_text())["stages"]
        seconds = {name: stage["cost"]["seconds"] for name, stage in stages.items()}
        if seconds["scan"] >= MIN_STAGE_S:
            break
    return shown, seconds


def test_elapsed_time_is_updated_each_second_of_a_long_stage(long_scan: tuple[str, dict[str, float]]) -> None:
    shown, seconds = long_scan
    assert seconds["scan"] >= MIN_STAGE_S
    assert len(elapsed_s(shown, "scan")) >= max(2, int(seconds["scan"]) // 2)  # a busy machine may skip some


def test_elapsed_time_goes_on_after_a_stage_is_complete(long_scan: tuple[str, dict[str, float]]) -> None:
    shown, seconds = long_scan
    times = elapsed_s(shown)
    assert times == sorted(times)
    assert times[-1] >= int(sum(seconds.values()))
    assert len(times) >= times[-1] // 2


def test_elapsed_time_is_shown_before_the_scenario_is_read(long_scan: tuple[str, dict[str, float]]) -> None:
    shown, _ = long_scan
    assert elapsed_s(shown, "run")[0] == 0


def test_bar_fits_on_one_line(long_scan: tuple[str, dict[str, float]]) -> None:
    shown, _ = long_scan
    bars = [line for line in re.split(r"[\r\n]+", shown) if ELAPSED.search(line)]
    assert bars
    assert max(len(bar) for bar in bars) <= COLUMNS


def test_stages_beside_sumo_are_shown_in_order_while_time_goes_on(tmp_path: Path) -> None:
    """SUMO is at work from the beginning; its progress is shown when its turn has come."""
    settings = ("traffic.frames=2000", "tpog.blocks=10", "roi.voxel_m=1")
    words = [word for setting in settings for word in ("--set", setting)]
    shown = on_terminal("run", ROUNDABOUT, "--out", tmp_path / "run", *words)
    lines = re.findall(r"^(\w+) +\d+\.\d s ", shown.replace("\r", "\n"), re.MULTILINE)
    assert lines == ["check", "statics", "scan", "traffic", "occupancy", "score", "report"]
    times = elapsed_s(shown)
    assert times == sorted(times)
    assert len(times) >= times[-1] // 2
    bars = re.findall(r"(\w+): frames simulated", shown)
    assert set(bars) <= {"traffic"}


def test_output_that_is_no_terminal_has_plain_lines(mini: Path) -> None:
    words = [sys.executable, "-m", "egvs", "run", mini, "--out", mini / "run"]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ | {"TERM": "xterm"})
    assert not CONTROL.search(done.stdout + done.stderr)
    assert not ELAPSED.search(done.stdout + done.stderr)
    assert re.search(r"^scan +\d", done.stderr, re.MULTILINE)
