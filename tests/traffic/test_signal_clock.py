"""The clock of a program that replays recorded signals."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from egvs.core.errors import InputError
from egvs.traffic.network import read_net_xml
from egvs.traffic.signal_clock import SignalClock
from tests.traffic.crossing import NETWORK

CLOCK = SignalClock(-250.0, 40.0, 100.0, 40.0)
"""Second 300 of the simulation shows second 50 of the recording."""

PROGRAM = '<tlLogic id="c" type="static" programID="0" offset="0"><phase duration="400" state="G"/>{param}</tlLogic>'


def network_with(folder: Path, param: str) -> Path:
    path = folder / "net.xml"
    path.write_text(
        NETWORK.replace('    <junction id="c"', f'    {PROGRAM.format(param=param)}\n    <junction id="c"', 1)
    )
    return path


def test_clock_is_written_and_read(tmp_path: Path) -> None:
    program = ElementTree.fromstring(PROGRAM.format(param=CLOCK.to_param()))
    assert SignalClock.from_program(program) == CLOCK
    network = read_net_xml(network_with(tmp_path, CLOCK.to_param()))
    assert network.signal_clock == CLOCK
    assert network.cycle_s == 40.0


def test_other_programs_have_no_clock(tmp_path: Path) -> None:
    network = read_net_xml(network_with(tmp_path, '<param key="other" value="x"/>'))
    assert network.signal_clock is None
    assert network.cycle_s == 400.0


@pytest.mark.parametrize("value", ["1 2 3", "a b c d", ""])
def test_rejects_damaged_clock(tmp_path: Path, value: str) -> None:
    param = CLOCK.to_param().replace(CLOCK.to_param().split('"')[3], value)
    with pytest.raises(InputError, match="invalid <tlLogic id='c'>"):
        read_net_xml(network_with(tmp_path, param))


@pytest.mark.parametrize(
    ("begin_s", "first_s", "last_s", "problem"),
    [
        (300.0, 50.0, 100.0, ""),
        (310.0, 50.0, 100.0, "at the first frame, the recorded signals are 10 s later than the people"),
        (290.0, 50.0, 100.0, "at the first frame, the recorded signals are 10 s earlier than the people"),
        (300.0, 50.0, 130.0, "the signals were not recorded for 30.0 of 80.0 s"),
        (280.0, 30.0, 90.0, "the signals were not recorded for 10.0 of 60.0 s"),
    ],
)
def test_people_need_the_signals_of_their_time(begin_s: float, first_s: float, last_s: float, problem: str) -> None:
    assert CLOCK.problem(begin_s, first_s, last_s) == problem
