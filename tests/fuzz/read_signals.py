"""Reads recorded signals and writes their program into a network in place of a verb, for the fuzzer.

The network has a program already, so that netconvert is not needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.cli import exit
from egvs.extensions.tracks.new import signal_programs
from egvs.extensions.tracks.new import signals as recorded_signals
from egvs.formats.georeference import WorldFrame
from tests.traffic.crossing import NETWORK

VERB = "read-signals"
RESULT = "plan.net.xml"
FRAME = WorldFrame("EPSG:32632", (-500000.0, -5400000.0))

PROGRAM = '    <tlLogic id="c" type="static" programID="0" offset="0">\n    </tlLogic>\n    <junction id="c"'
SIGNALISED = (
    NETWORK.replace('    <junction id="c"', PROGRAM, 1)
    .replace('via=":c_0_0" dir="s"', 'via=":c_0_0" tl="c" linkIndex="0" dir="s"', 1)
    .replace('via=":c_1_0" dir="l"', 'via=":c_1_0" tl="c" linkIndex="1" dir="l"', 1)
)
"""The made-up junction, with a program without phases."""


def kml(lanes: Sequence[tuple[str, str, str, Sequence[tuple[float, float]]]]) -> str:
    """Lanes as KML: source, sinks, groups, and the points of each in metres of :data:`FRAME`."""
    marks = []
    for source, sinks, groups, points_m in lanes:
        degrees = FRAME.to_degrees(np.array(points_m, dtype=np.float64))
        points = " ".join(f"{lon:.9f},{lat:.9f},0" for lon, lat in degrees.tolist())
        values = (("Source", source), ("Sink", sinks), ("SignalGroup", groups))
        data = "".join(f'<Data name="{name}"><value>{value}</value></Data>' for name, value in values)
        marks.append(
            f"<Placemark><LineString><coordinates>{points}</coordinates></LineString>"
            f"<ExtendedData>{data}</ExtendedData></Placemark>"
        )
    head = '<?xml version="1.0"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>\n'
    return head + "\n".join(marks) + "\n</Folder></Document></kml>\n"


def main(arguments: Sequence[str]) -> None:
    """Read the files and write the network; an error ends the process as on the command line."""
    paths = [Path(argument) for argument in arguments]
    with exit.report_errors():
        signals = recorded_signals.read_signals(paths)
        where = ", ".join(arguments)
        plan = signal_programs.apply_signals(SIGNALISED, "c", signals, FRAME, where)
        Path(RESULT).write_text("\n".join([plan.network, *plan.notes]), encoding="utf-8")
