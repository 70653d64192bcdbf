r"""Queues and speeds on the approaches of a junction: simulated against observed.

Steps of :func:`measure_approach`: take the vehicles on the path that leads to the stop line; sort those of each frame
that stand by their distance from it; follow the queue from the stop line backwards.

**Queue.** In one frame, standing vehicles (below :data:`QUEUE_SPEED_M_S`) belong to the queue if the gap to the vehicle
ahead, or of the first one to the stop line, is at most :data:`MAX_GAP_M`. Its length is the distance from the stop
line to the rear of the last one, over all lanes of the approach; 0 without a queue. The number that is compared is the
95th percentile over the frames, which is what a queue observed at a junction usually means (Highway Capacity Manual:
"95th-percentile queue").

**Speed.** The mean speed over the vehicles and frames in the last :data:`SPEED_OVER_M` before the stop line: distance
that they drive there, divided by their time there (space mean speed), standing vehicles included.

World frame, in plan: x east, y north, metres, seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray, IntArray
from egvs.traffic.approaches import ApproachMovement
from egvs.traffic.network import LANE_WIDTH_M, Edge, Network

QUEUE_SPEED_M_S = 5.0 / 3.6
MAX_GAP_M = 20.0
SPEED_OVER_M = 100.0
PERCENTILE = 95.0

MAX_QUEUE_M = 400.0
"""How far from the stop line queues are followed."""
_SIGNAL_TYPES = frozenset({"traffic_light", "traffic_light_unregulated", "traffic_light_right_on_red"})
_MIN_COSINE = 0.7
"""Vehicles whose heading differs by more than 45 degrees from the path are on other roads."""


@dataclass(frozen=True)
class ApproachPath:
    """The way to a stop line.

    Attributes
    ----------
    title
        Its name, from :func:`egvs.traffic.approach_names.approach_name`.
    line_m
        From the stop line backwards, shape (n, 2).
    half_width_m
        Greatest distance of its vehicles' centres from the line.
    """

    title: str
    line_m: FloatArray
    half_width_m: float


@dataclass(frozen=True)
class VehicleFrames:
    """Boxes of vehicles, one row per vehicle and frame.

    Attributes
    ----------
    frame, vehicle
        Number of the frame and of the vehicle, shape (n,), int64.
    at_m
        Centres, shape (n, 2).
    yaw_rad, length_m
        Heading, counter-clockwise from east, and length, shape (n,).
    period_s
        Time between two frames.
    """

    frame: IntArray
    vehicle: IntArray
    at_m: FloatArray
    yaw_rad: FloatArray
    length_m: FloatArray
    period_s: float

    def between(self, first: int, end: int) -> VehicleFrames:
        """Return the vehicles in some frames, ``end`` excluded."""
        inside = (self.frame >= first) & (self.frame < end)
        return VehicleFrames(
            self.frame[inside], self.vehicle[inside], self.at_m[inside], self.yaw_rad[inside], self.length_m[inside],
            self.period_s,
        )  # fmt: skip

    def speeds_m_s(self) -> FloatArray:
        """Return the speed from each frame to the vehicle's next one, or from the former one at its end; shape (n,).

        NaN for vehicles that are in single frames only.
        """
        order = np.lexsort((self.frame, self.vehicle))
        frame, vehicle, at_m = self.frame[order], self.vehicle[order], self.at_m[order]
        follows = (vehicle[1:] == vehicle[:-1]) & (frame[1:] == frame[:-1] + 1)
        step_m_s = np.hypot(*np.diff(at_m, axis=0).T) / self.period_s
        ahead = np.append(np.where(follows, step_m_s, np.nan), np.nan)
        behind = np.append(np.nan, np.where(follows, step_m_s, np.nan))
        speeds = np.empty(len(order))
        speeds[order] = np.where(np.isnan(ahead), behind, ahead)
        return speeds


@dataclass(frozen=True)
class ApproachTraffic:
    """What happens on an approach.

    Attributes
    ----------
    queue_m
        95th percentile of the queue.
    mean_queue_m
        Its mean over the frames.
    speed_kmh
        Mean speed before the stop line; NaN without vehicles.
    vehicles
        Number of vehicles on the path.
    """

    queue_m: float
    mean_queue_m: float
    speed_kmh: float
    vehicles: int


def approach_paths(movements: Sequence[ApproachMovement], network: Network) -> Mapping[str, ApproachPath]:
    """Return the path of each approach by its title.

    A path follows the edges of the movement backwards, and then the road that leads straight to them, up to a junction
    with signals. Of several carriageways with one title, the one with most lanes is taken.
    """
    before = _straight_predecessors(network)
    signals = {junction.id for junction in network.junctions if junction.type in _SIGNAL_TYPES}
    paths: dict[str, ApproachPath] = {}
    lanes: dict[str, int] = {}
    for movement in movements:
        edges = list(movement.edges)
        if not edges or len(edges[-1].lanes) <= lanes.get(movement.approach_title, 0):
            continue
        lanes[movement.approach_title] = len(edges[-1].lanes)
        paths[movement.approach_title] = _make_path(movement.approach_title, edges, before, signals)
    return paths


def _make_path(title: str, edges: list[Edge], before: Mapping[str, Edge], signals: set[str]) -> ApproachPath:
    parts = [_middle_lane(edge) for edge in reversed(edges)]
    length_m = sum(polylines.length_m(part) for part in parts)
    known = {edge.id for edge in edges}
    first = edges[0]
    while length_m < MAX_QUEUE_M and first.from_node not in signals and first.id in before:
        first = before[first.id]
        if first.id in known:
            break
        known.add(first.id)
        parts.append(_middle_lane(first))
        length_m += polylines.length_m(parts[-1])
    widest = max(len(edge.lanes) for edge in edges)
    width_m = max(lane.width_m or LANE_WIDTH_M for edge in edges for lane in edge.lanes)
    return ApproachPath(title, np.vstack(parts), (widest / 2 + 0.5) * width_m)


def _middle_lane(edge: Edge) -> FloatArray:
    """Return the lane in the middle of an edge from its end to its start, shape (n, 2)."""
    return edge.lanes[len(edge.lanes) // 2].shape_m[::-1, :2]


def _straight_predecessors(network: Network) -> dict[str, Edge]:
    """Return the edge from which each edge is reached straight on; only where there is exactly one."""
    sources: dict[str, set[int]] = {}
    for connection in network.connections:
        if connection.direction == "s":
            sources.setdefault(network.edges[connection.target].id, set()).add(connection.source)
    return {edge: network.edges[next(iter(numbers))] for edge, numbers in sources.items() if len(numbers) == 1}


def measure_approach(path: ApproachPath, boxes: VehicleFrames, first: int, end: int) -> ApproachTraffic:
    """Return queue and speed on an approach.

    Parameters
    ----------
    path
        The approach.
    boxes
        The vehicles.
    first, end
        The frames that count, ``end`` excluded.
    """
    import shapely

    boxes = boxes.between(first, end)  # vehicles of another period may have the same names
    line = shapely.LineString(path.line_m)
    points = shapely.points(boxes.at_m)
    distance_m = shapely.line_locate_point(line, points)
    near = shapely.dwithin(line, points, path.half_width_m) & (distance_m > 0) & (distance_m < MAX_QUEUE_M)
    ahead_m = polylines.points_at(path.line_m, np.maximum(distance_m - 1.0, 0.0))
    there_m = polylines.points_at(path.line_m, distance_m)
    heading = ahead_m - there_m
    scale = np.hypot(*heading.T)
    along = np.cos(boxes.yaw_rad) * heading[:, 0] + np.sin(boxes.yaw_rad) * heading[:, 1]
    near &= along > _MIN_COSINE * scale

    speeds = boxes.speeds_m_s()[near]
    frame, distance_m, half_m = boxes.frame[near], distance_m[near], boxes.length_m[near] / 2
    close = (distance_m < SPEED_OVER_M) & ~np.isnan(speeds)
    mean_m_s = float(speeds[close].mean()) if close.any() else float("nan")
    standing = speeds < QUEUE_SPEED_M_S
    queues_m = queue_lengths_m(frame[standing] - first, distance_m[standing], half_m[standing], end - first)
    return ApproachTraffic(
        float(np.percentile(queues_m, PERCENTILE)),
        float(queues_m.mean()),
        3.6 * mean_m_s,
        len(np.unique(boxes.vehicle[near])),
    )


def queue_lengths_m(frame: IntArray, distance_m: FloatArray, half_m: FloatArray, frames: int) -> FloatArray:
    """Return the length of the queue in each frame, shape (frames,).

    Parameters
    ----------
    frame, distance_m, half_m
        Frame, distance of the centre from the stop line, and half the length of each standing vehicle, shape (n,).
    frames
        Number of frames.

    >>> frame, half_m = np.zeros(3, dtype=np.int64), np.full(3, 2.0)
    >>> queue_lengths_m(frame, np.array([5.0, 12.0, 60.0]), half_m, 2)  # the third is 44 m behind the second
    array([14.,  0.])
    """
    lengths_m = np.zeros(frames)
    order = np.lexsort((distance_m, frame))
    for index in order:
        row = frame[index]
        if distance_m[index] - half_m[index] - lengths_m[row] <= MAX_GAP_M:
            lengths_m[row] = max(lengths_m[row], distance_m[index] + half_m[index])
    return lengths_m
