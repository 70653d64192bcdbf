"""Writes a plan: ``placement.parquet``, one row a sensor, and ``curve.parquet``, how much each number of them is
worth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.artefacts import checksums, schemas, tables
from pipeline.artefacts.readers import PLACEMENT_SUMS
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario

if TYPE_CHECKING:
    from pipeline.placement.placing import Placement

PLACEMENT, CURVE = "placement.parquet", "curve.parquet"


def check(folder: Path) -> None:
    """InputError where a folder stands in the place of a file that is written."""
    for name in (PLACEMENT, CURVE):
        if (folder / name).is_dir():
            raise InputError(folder / name, "is a folder", "a file, or nothing, where a plan is written")


def write(folder: Path, scenario: Scenario, placed: Placement, stages: Mapping[str, str]) -> tuple[Path, Path]:
    """Write both files; their paths.

    Parameters
    ----------
    stages
        Keys of the stages that the plan was made from, by name.
    """
    about = _about(scenario, placed, stages)
    (folder / PLACEMENT_SUMS).unlink(missing_ok=True)
    picks, points = placed.picks, placed.solution.curve
    bounds = {point.count: point.bound for point in points}
    columns: dict[str, Any] = {
        "order": np.arange(1, len(picks) + 1, dtype=np.int32),
        "site": [pick.site.name for pick in picks],
        "pole": [pick.site.pole or pick.site.name for pick in picks],
        **{key: [asdict(pick.site.pose)[key] for pick in picks] for key in _POSE},
        "sensor": [pick.site.sensor for pick in picks],
        "forced": [pick.is_forced for pick in picks],
        **{key: [getattr(pick, key) for pick in picks] for key in ("gain", "score", "cost", "loss")},
        "bound": [bounds.get(number, bounds[min(bounds)]) for number in range(1, len(picks) + 1)],
    }
    moves = _MOVES if placed.moves is not None else ()
    columns |= {key: [getattr(pick, key) for pick in picks] for key in moves}
    with tables.writer(folder / PLACEMENT, "placement", moves) as out:
        out.write(columns)
        out.describe(about)
    curve = {
        "count": np.array([point.count for point in points], dtype=np.int32),
        "score": [point.worth.joint for point in points],
        "value": [point.worth.value for point in points],
        "bound": [point.bound for point in points],
        "cost": list(placed.curve_costs),
        "met": [point.worth.met >= 0.0 for point in points],
        "sites": [json.dumps(list(names), ensure_ascii=False) for names in placed.curve_sites],
    }
    tables.write(folder / CURVE, "curve", curve, about)
    written = folder / PLACEMENT, folder / CURVE
    checksums.write(folder / PLACEMENT_SUMS, written)
    return written


_POSE = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
_MOVES = ("moved_m", "gain_by_refining")
"""Columns that a plan has whose sensors were to move."""
_COUNTED = ("before", "value_before", "value", "tried", "impossible", "turns")
"""What is told of its moves; how long they took is no part of a file."""


def _about(scenario: Scenario, placed: Placement, stages: Mapping[str, str]) -> dict[str, Any]:
    asked = scenario.placement.model_dump(mode="json")
    settings = {
        "placement": asked,
        "costs": scenario.costs.model_dump(mode="json"),
        "score": scenario.score.model_copy(update={"gamma": scenario.gamma}).model_dump(mode="json"),
    }
    solution, moves = placed.solution, placed.moves
    return {
        "schema": schemas.VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_of(settings)},
        "inputs": files.hash_of({**settings, "stages": dict(stages)}),
        "seed": scenario.seed,
        "stages": dict(stages),
        "plan": {
            "score": placed.score,
            "asked": asked,
            "candidates": placed.candidates,
            "joint": placed.joint,
            "value": solution.point.worth.value,
            "bound": solution.point.bound,
            "certificate": placed.certificate,
            "together": placed.together,
            "cost": placed.cost,
            "is_best": solution.is_best,
            "fewest_is_proved": solution.fewest_is_proved,
            "zones": [asdict(zone) for zone in placed.zones],
            **({} if moves is None else {"moves": {key: getattr(moves, key) for key in _COUNTED}}),
        },
    }
