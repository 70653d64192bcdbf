r"""Assumes how much traffic crosses a junction of which nobody has counts.

What a score depends on is the flow through the region of interest, so that is what is fixed: how many vehicles an hour
come in by each street and leave by each other. It depends on these streets alone, not on how much of the town is
simulated around them. (A number of vehicles for the whole network does the opposite: the share of them that passes the
junction falls as the network grows.)

Steps: find where streets come into the region and where they leave it (gates); each lane of a gate carries
:data:`PER_LANE_H` vehicles an hour, by the class of its road; balance the flows from gate to gate as Furness' doubly
constrained growth factors do (https://archive.nptel.ac.in/content/storage2/courses/105101087/08-Ltexhtml/p6/p.html),

.. math:: q_{ij} = a_i \, b_j \, w_{ij}, \qquad \sum_j q_{ij} = q_i, \qquad
          \sum_i q_{ij} \approx q_j \sum_i q_i / \sum_j q_j,

with w 1 where one can drive from gate i to gate j without turning back, and 0 elsewhere. What comes in is met exactly,
what leaves as well as can be.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.importers.junctions import Region, Streets
from pipeline.scenario.traffic import CountModel
from pipeline.traffic.network import Edge

PER_LANE_H = {
    "motorway": 600.0, "trunk": 400.0, "primary": 250.0, "secondary": 200.0, "tertiary": 150.0, "unclassified": 60.0,
    "residential": 40.0, "living_street": 20.0, "service": 10.0,
}  # fmt: skip
"""Vehicles an hour and lane by OpenStreetMap's class of road, on an ordinary day outside the peaks.

Round figures of the order that planners reckon with; no source stands behind them.
"""

_OTHER_H = 40.0
_CAR = "passenger"
_LEAST_M2 = 10.0
_ROUNDS = 3
"""Where what comes in cannot all leave by lanes of the same class, more rounds would leave whole turns empty."""


def flows(streets: Streets, roi: Region) -> list[CountModel]:
    """Vehicles an hour from each gate of the region to each other; none where no street leads in and out."""
    edges, inside = streets.network.edges, _inside(streets, roi)
    links = [(int(a), int(b)) for a, b, turns_back in streets.network.links(_CAR) if not turns_back]
    after: dict[int, list[int]] = {i: [] for i in inside}
    for a, b in links:
        if a in after and b in after:
            after[a].append(b)
    entered = {b for onward in after.values() for b in onward}
    gates_in = [i for i in inside if i not in entered]
    gates_out = [i for i in inside if not after[i]]
    reached = [_reached(i, after) for i in gates_in]
    may = np.zeros((len(gates_in), len(gates_out)))
    for a, i in enumerate(gates_in):
        for b, o in enumerate(gates_out):
            may[a, b] = o in reached[a] and edges[o].to_node != edges[i].from_node
    rates = balanced(may, [flow_h(edges[i]) for i in gates_in], [flow_h(edges[o]) for o in gates_out])
    return [
        _count(edges[i], edges[o], float(round(rates[a, b])))
        for a, i in enumerate(gates_in)
        for b, o in enumerate(gates_out)
        if round(rates[a, b]) > 0
    ]


def balanced(may: NDArray[np.float64], in_h: Sequence[float], out_h: Sequence[float]) -> NDArray[np.float64]:
    """Flows (in, out) where ``may`` is above 0; rows add up to ``in_h``, columns to shares of ``out_h`` if they can."""
    rates = may.copy()
    rows, columns = np.array(in_h, dtype=np.float64), np.array(out_h, dtype=np.float64)
    for _ in range(_ROUNDS):
        for axis, wanted in ((0, columns), (1, rows)):
            sums = rates.sum(axis=axis)
            scale = np.divide(wanted, sums, out=np.zeros_like(wanted), where=sums > 0)
            rates = rates * (scale[None, :] if axis == 0 else scale[:, None])
    return rates


def _inside(streets: Streets, roi: Region) -> list[int]:
    """The roads for cars that cover some of the region."""
    return [
        i
        for i, edge in enumerate(streets.network.edges)
        if edge.lanes_for(_CAR) and streets.areas[edge.id].intersection(roi.area).area >= _LEAST_M2
    ]


def _reached(start: int, after: dict[int, list[int]]) -> set[int]:
    reached, todo = {start}, [start]
    while todo:
        new = [i for i in after[todo.pop()] if i not in reached]
        reached.update(new)
        todo += new
    return reached


def flow_h(edge: Edge) -> float:
    """Vehicles an hour on all lanes of a street, by the class of its road.

    netconvert calls a street with tracks in it "highway.secondary|railway.tram".
    """
    roads = [part.removeprefix("highway.") for part in edge.type.split("|") if part.startswith("highway.")]
    rates = [PER_LANE_H.get(road.removesuffix("_link"), _OTHER_H) for road in roads]
    return max(rates, default=_OTHER_H) * edge.lanes_for(_CAR)


def _count(start: Edge, end: Edge, per_hour: float) -> CountModel:
    if start is end:
        return CountModel(edge=start.id, per_hour=per_hour)
    return CountModel(from_edge=start.id, to_edge=end.id, per_hour=per_hour)
