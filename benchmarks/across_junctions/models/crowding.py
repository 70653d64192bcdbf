r"""How crowded each vehicle is, as seen from a site: what makes detectors merge or truncate vehicles in queues.

All values are computed from the empty scan and the recorded boxes, like :mod:`egvs.scoring.targets`, per vehicle, site
and frame.

*Gaps as seen from the sensor*, in plan view, to vehicles that are at most :data:`NEIGHBOUR_M` away. Neighbours that
share azimuths with the vehicle are in front or behind; their gap is that along the line of sight. Neighbours that share
ranges but no azimuth are beside; their gap is an angle, and the arc at the nearest range of the vehicle.

*Merged silhouettes*. ``cluster`` links points that are closer than :math:`\max(0.6\,m, 0.02 r)` at the range r. The
``link_gap`` is the distance between the points of the vehicle and those of its nearest neighbour in this unit: below 1,
both become one cluster. The points of a vehicle are bounded by a rectangle along its axes.

*Hidden share*: the share of the vehicle's beams that other road users stop.

*Incidence*: the angle between the line of sight and the normal of the upright side that is seen best.

Limits: gaps and silhouettes are those of boxes. Neighbours outside the region of interest count for gaps, but have no
points, so they do not merge. Gaps are in plan view: from above, a low vehicle in front may hide nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from benchmarks.across_junctions.models import crowding_kernels
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.core.grid import FloatArray, IntArray
from egvs.kernels import vehicle_visibility
from egvs.scoring.targets import TargetRecord, VisibleTargets

NEIGHBOUR_M = 10.0
"""Largest distance of neighbours, and the largest gap."""

MAX_BESIDE_DEG = 45.0
"""The largest gap beside a vehicle."""

LINK_M, LINK_PER_RANGE = 0.6, 0.02
"""Distance of points that ``cluster`` links: the larger of the first, in metres, and the second times the range."""

MAX_LINK_GAP = 4.0
"""The largest gap between points, in linking distances."""

VEHICLE_CLASSES = {
    "passenger": "car",
    "private": "car",
    "taxi": "car",
    "evehicle": "car",
    "hov": "car",
    "delivery": "van",
    "emergency": "van",
    "truck": "truck",
    "trailer": "truck",
    "bus": "bus",
    "coach": "bus",
    "motorcycle": "motorcycle",
    "moped": "motorcycle",
}
"""Class of each vClass of SUMO that is a vehicle (:meth:`egvs.artefacts.traffic_frames.TrafficFrame.are_vehicles`); a
car for all others."""

CLASSES = ("car", "van", "truck", "bus", "motorcycle")


class NeighbourPairs(NamedTuple):
    """Neighbours of the targets of a record, the same for all sites.

    Attributes
    ----------
    starts, boxes
        Neighbours boxes[starts[i]:starts[i + 1]] are those of target i, (n + 1,) and (p,) int64.
    plan
        Rectangle of each box, (b, 6) float64.
    target_of_box
        The target of each box, -1 for none, (b,) int64.
    """

    starts: IntArray
    boxes: IntArray
    plan: FloatArray
    target_of_box: IntArray

    @classmethod
    def of(cls, record: TargetRecord) -> NeighbourPairs:
        """List the vehicles at most :data:`NEIGHBOUR_M` from each target, in plan view.

        People are not neighbours, nor are other parts of the same vehicle.
        """
        boxes = record.all_boxes
        plan = np.empty((len(boxes.values), 6))
        vehicle_visibility.footprints(boxes.values, plan)
        target_of_box = np.full(len(plan), -1, dtype=np.int64)
        target_of_box[record.row] = np.arange(len(record))
        starts = np.zeros(len(record) + 1, dtype=np.int64)
        listed = np.empty(0, dtype=np.int64)
        for _ in range(2):  # counts, then lists
            crowding_kernels.near_pairs(
                record.row, record.frame, boxes.starts, plan, boxes.are_vehicles, boxes.vehicle, NEIGHBOUR_M, starts,
                listed,
            )  # fmt: skip
            listed = np.empty(starts[-1], dtype=np.int64) if not len(listed) else listed
        return cls(starts, listed, plan, target_of_box)


_PAIRS: WeakKeyDictionary[TargetRecord, NeighbourPairs] = WeakKeyDictionary()


def neighbour_pairs(record: TargetRecord) -> NeighbourPairs:
    """Return the neighbours of a record's targets; they are listed once for all sites."""
    pairs = _PAIRS.get(record)
    if pairs is None:
        pairs = _PAIRS[record] = NeighbourPairs.of(record)
    return pairs


@dataclass(frozen=True, eq=False)
class Crowding:
    """How crowded each vehicle-frame is as seen from one site, (n,) float64 each.

    Attributes
    ----------
    front_gap_m, behind_gap_m
        Gap along the line of sight to the nearest neighbour in front, and behind, 0 to :data:`NEIGHBOUR_M`.
    beside_gap_deg, beside_gap_m
        Gap to the nearest neighbour beside, as an angle (0 to :data:`MAX_BESIDE_DEG`), and as an arc at the vehicle's
        nearest range (0 to :data:`NEIGHBOUR_M`).
    link_gap
        Gap between the vehicle's points and those of its nearest neighbour, in linking distances, 0 to
        :data:`MAX_LINK_GAP`.
    hidden_share
        Share of the beams on the vehicle that other road users stop, 0 to 1; 0 where no beam would meet it.
    incidence_deg
        Angle of incidence on the upright side that is seen best, 0 to 90.
    """

    front_gap_m: FloatArray
    behind_gap_m: FloatArray
    beside_gap_deg: FloatArray
    beside_gap_m: FloatArray
    link_gap: FloatArray
    hidden_share: FloatArray
    incidence_deg: FloatArray


def measure_crowding(visible: VisibleTargets) -> Crowding:
    """Return how crowded the vehicles are that a site sees."""
    record = visible.record
    pairs = neighbour_pairs(record)
    front_m = np.full(len(record), NEIGHBOUR_M)
    behind_m = np.full(len(record), NEIGHBOUR_M)
    beside_rad = np.full(len(record), np.deg2rad(MAX_BESIDE_DEG))
    x_m, y_m = visible.sensor_m[:2].tolist()
    views = np.zeros((len(pairs.plan), 4))
    crowding_kernels.sight_gaps(
        x_m, y_m, record.row, pairs.starts, pairs.boxes, pairs.plan, views, front_m, behind_m, beside_rad
    )
    flat_m = np.hypot(*(pairs.plan[record.row, :2] - visible.sensor_m[:2]).T)
    beside_gap_m = np.where(beside_rad < np.deg2rad(MAX_BESIDE_DEG), beside_rad * views[record.row, 2], NEIGHBOUR_M)

    reach_m = np.maximum(LINK_M, LINK_PER_RANGE * flat_m)
    point_gap_m = MAX_LINK_GAP * reach_m
    has_points = visible.points > 0.0
    crowding_kernels.point_gaps(
        pairs.starts, pairs.boxes, pairs.target_of_box, _spanned(visible), has_points, point_gap_m
    )

    cosine = np.cos(np.deg2rad(visible.depression_deg))
    end_on = np.sqrt(np.maximum(1.0 - visible.side**2, 0.0))
    alone = visible.points_alone
    is_met = alone > 0.0
    hidden = 1.0 - np.divide(visible.points, alone, out=np.ones(len(record)), where=is_met)
    return Crowding(
        front_gap_m=front_m,
        behind_gap_m=behind_m,
        beside_gap_deg=np.rad2deg(beside_rad),
        beside_gap_m=np.minimum(beside_gap_m, NEIGHBOUR_M),
        link_gap=point_gap_m / reach_m,
        hidden_share=np.clip(hidden, 0.0, 1.0),
        incidence_deg=np.rad2deg(np.arccos(np.minimum(cosine * np.maximum(visible.side, end_on), 1.0))),
    )


def _spanned(visible: VisibleTargets) -> FloatArray:
    """Return the rectangles that the points of each vehicle span in plan view, (n, 6); undefined without points."""
    spanned = neighbour_pairs(visible.record).plan[visible.record.row]
    bounds_m = np.where(visible.points[:, None, None] > 0.0, visible.bounds_m, 0.0)
    along_m, across_m = 0.5 * (bounds_m[:, 0] + bounds_m[:, 1]).T
    cosine, sine = spanned[:, 2], spanned[:, 3]
    spanned[:, 0] += along_m * cosine - across_m * sine
    spanned[:, 1] += along_m * sine + across_m * cosine
    spanned[:, 4:6] = 0.5 * (bounds_m[:, 1] - bounds_m[:, 0])
    return spanned


def vehicle_classes(record: TargetRecord) -> IntArray:
    """Return the index in :data:`CLASSES` of each vehicle-frame, (n,) int64. People are not vehicles: -1."""
    by_kind = [
        -1 if kind in NON_VEHICLE_KINDS else CLASSES.index(VEHICLE_CLASSES.get(kind, "car")) for kind in record.kinds
    ]
    return np.array(by_kind, dtype=np.int64)[record.kind]
