"""The counts of a scenario as movements of a diagram: names, numbers, and where their arrows begin and end."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from egvs.core.numbers import number_or_nan
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scenario.signal_config import ASSUMED_PLANS
from egvs.traffic import capacity
from egvs.traffic.approach_names import approach_name
from egvs.traffic.directions import arrival_side
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import CAR, Edge, Network


def describe_movements(scenario: Scenario, network: Network | None) -> dict[str, Any]:
    """Return movements and approaches of the counts, in the order of the counts; empty without a network.

    Of a scenario with periods, ``scenario`` is that of one of them.
    """
    counts = scenario.traffic.counts
    if network is None or not counts:
        return {"movements": [], "approaches": [], "total_per_h": 0}
    x_m, y_m, _ = scenario.roi.center_m
    names = MovementNames(network, (x_m, y_m), counts)
    edges = {edge.id: edge for edge in network.edges}
    problems = {
        place: f"{per_h:,.0f} vehicles an hour exceed what {lanes} lanes can carry, {lanes * capacity.LANE_PER_H:,.0f}"
        for place, per_h, lanes in capacity.find_excess(network, names, counts)
    }
    movements = []
    approaches: dict[str, dict[str, Any]] = {}
    for index, count in enumerate(counts):
        movement = names.movement(count.edge or count.from_edge or "", count.to_edge)
        edge = movement.approach[-1]
        approach = approach_name(arrival_side(movement.heading), movement.street) or "junction"
        way_out = None if count.to_edge is None else edges[count.to_edge]
        movements.append({
            "index": index, "approach": approach, "turn": movement.turn, "to": movement.way_out,
            "count_per_h": count.per_hour, "from_m": _nearer_end(edge, x_m, y_m), "via_m": [x_m, y_m],
            "to_m": None if way_out is None else _nearer_end(way_out, x_m, y_m),
            "problem": problems.get(f"{approach} {movement.turn}".strip(), ""),
        })  # fmt: skip
        lanes = edge.lanes_for(CAR)
        approaches.setdefault(approach, {
            "approach": approach, "at_m": movements[-1]["from_m"], "lanes": lanes,
            "limit_per_h": lanes * capacity.LANE_PER_H, "problem": problems.get(approach, ""),
        })  # fmt: skip
    total = sum(count.per_hour for count in counts)
    return {"movements": movements, "approaches": list(approaches.values()), "total_per_h": total}


def _nearer_end(edge: Edge, x_m: float, y_m: float) -> list[float]:
    """Return the end of the middle line of an edge that is nearer to a point."""
    lanes = [lane.shape_m[:, :2] for lane in edge.lanes if lane.permission.admits(CAR)] or [edge.lanes[0].shape_m]
    ends_m = np.array([[lane[0, :2], lane[-1, :2]] for lane in lanes]).mean(axis=0)
    distance_m = np.hypot(*(ends_m - (x_m, y_m)).T)
    return [round(value, 2) for value in ends_m[distance_m.argmin()].tolist()]


def describe_signals(scenario: Scenario, tables: dict[str, list[dict[str, str]]]) -> list[dict[str, Any]]:
    """Return the plans of signals; those that are not in a table have no phases here.

    Parameters
    ----------
    scenario
        The scenario.
    tables
        The rows of each table of the scenario, by its file name.
    """
    described = []
    title = scenario.description if len(scenario.traffic.signals) == 1 else ""
    for name, plan in scenario.traffic.signals.items():
        rows = tables.get(plan.file or "", [])
        phases: dict[str, dict[str, Any]] = {}
        for row in rows:
            phase = phases.setdefault(row.get("phase", ""), {
                "name": row.get("phase", ""), "green_s": number_or_nan(row.get("green_s", "")), "green": [],
            })  # fmt: skip
            phase["green"].append({"approach": row.get("approach", ""), "turns": row.get("movement", "").split()})
        if not all(math.isfinite(phase["green_s"]) for phase in phases.values()):
            phases = {}
        described.append({
            "name": name, "title": title or name, "file": plan.file or SCENARIO_FILE,
            "actuated": plan.type == "actuated", "assumed": ASSUMED_PLANS in scenario.assumed,
            "yellow_s": plan.yellow_s, "all_red_s": plan.all_red_s, "phases": list(phases.values()),
        })  # fmt: skip
    return described
