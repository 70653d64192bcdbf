"""A made-up junction, and vehicles that drive through it along lines that a person can follow.

The road "in" comes from the west on y = 0 and ends at x = -10; "out" leads east from x = 10; "north" leads north from
(0, 10). The speed limit is 10 m/s. Straight on, the junction's lane is the line from (-10, 0) to (10, 0); the left turn
waits at (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core.grid import FloatArray
from egvs.tracks.resampling import ResampledTracks, UnknownBoxes
from egvs.traffic.network import Network, read_net_xml

PERIOD_S = 0.5

NETWORK = """<net version="1.20">
    <location netOffset="0.00,0.00" convBoundary="-110,0,110,110" origBoundary="0,0,0,0" projParameter="!"/>
    <edge id=":c_0" function="internal"><lane id=":c_0_0" index="0" speed="10" length="20" shape="-10,0 10,0"/></edge>
    <edge id=":c_1" function="internal"><lane id=":c_1_0" index="0" speed="10" length="10" shape="-10,0 0,0"/></edge>
    <edge id=":c_2" function="internal"><lane id=":c_2_0" index="0" speed="10" length="10" shape="0,0 0,10"/></edge>
    <edge id="in" from="w" to="c"><lane id="in_0" index="0" speed="10" length="100" shape="-110,0 -10,0"/></edge>
    <edge id="out" from="c" to="e"><lane id="out_0" index="0" speed="10" length="100" shape="10,0 110,0"/></edge>
    <edge id="north" from="c" to="n"><lane id="north_0" index="0" speed="10" length="100" shape="0,10 0,110"/></edge>
    <junction id="c" type="priority" x="0" y="0" incLanes="in_0" intLanes=":c_0_0 :c_1_0" shape="-10,-5 10,5"/>
    <junction id="w" type="dead_end" x="-110" y="0" incLanes="" intLanes="" shape="-110,0"/>
    <junction id="e" type="dead_end" x="110" y="0" incLanes="out_0" intLanes="" shape="110,0"/>
    <junction id="n" type="dead_end" x="0" y="110" incLanes="north_0" intLanes="" shape="0,110"/>
    <junction id=":c_2_0" type="internal" x="0" y="0" incLanes=":c_1_0" intLanes=":c_0_0"/>
    <connection from="in" to="out" fromLane="0" toLane="0" via=":c_0_0" dir="s" state="M"/>
    <connection from="in" to="north" fromLane="0" toLane="0" via=":c_1_0" dir="l" state="m"/>
    <connection from=":c_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":c_1" to="north" fromLane="0" toLane="0" via=":c_2_0" dir="l" state="m"/>
    <connection from=":c_2" to="north" fromLane="0" toLane="0" dir="l" state="M"/>
</net>
"""


def read_network(folder: Path) -> Network:
    """Return the network."""
    path = folder / "crossing.net.xml"
    path.write_text(NETWORK, encoding="utf-8")
    return read_net_xml(path)


@dataclass(frozen=True)
class Drive:
    """A vehicle: its distance along its way at a time, and the corners of the way."""

    at_m: Callable[[FloatArray], FloatArray]
    begin_s: float
    end_s: float
    way_m: Sequence[tuple[float, float]] = ((-110.0, 0.0), (110.0, 0.0))


LEFT = ((-110.0, 0.0), (0.0, 0.0), (0.0, 110.0))


def constant(speed_m_s: float, begin_s: float = 0.0, start_m: float = 0.0) -> Callable[[FloatArray], FloatArray]:
    """Return a motion at constant speed."""
    return lambda time_s: start_m + speed_m_s * (time_s - begin_s)


def boxes_of(drives: Sequence[Drive]) -> ResampledTracks:
    """Return the boxes of vehicles, in the order of ``drives``, as if they had been resampled."""
    frames, tracks, rows = [], [], []
    for number, drive in enumerate(drives):
        frame = np.arange(round(drive.begin_s / PERIOD_S), round(drive.end_s / PERIOD_S) + 1)
        corners = np.array(drive.way_m)
        step = np.diff(corners, axis=0)
        along_m = np.append(0.0, np.cumsum(np.hypot(*step.T)))
        at_m = drive.at_m(frame * PERIOD_S)
        piece = np.clip(np.searchsorted(along_m, at_m, side="right") - 1, 0, len(step) - 1)
        xy_m = [np.interp(at_m, along_m, corners[:, axis]) for axis in (0, 1)]
        rows.append(np.column_stack([*xy_m, np.arctan2(step[piece, 1], step[piece, 0])]))
        frames.append(frame)
        tracks.append(np.full(frame.size, number))
    x_m, y_m, yaw_rad = np.concatenate(rows).T
    frame, track = np.concatenate(frames), np.concatenate(tracks)
    order = np.lexsort((track, frame))
    none = UnknownBoxes(
        np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 2)), np.empty(0)
    )
    return ResampledTracks(
        frame[order], track[order], x_m[order], y_m[order], yaw_rad[order], np.zeros(order.size), 0, 0, none
    )
