"""A plan of several sensors that was made of what a run ran on: who stands where, what each adds, what is proved."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import Tpog, read_placement
from pipeline.artefacts.run_record import StageRecord
from pipeline.report.drawing import placement as drawing
from pipeline.report.drawing.map_frame import MapSite
from pipeline.report.drawing.maps import Backdrop
from pipeline.report.drawing.placement import CurveStep, PlannedPole
from pipeline.report.score_words import SCORES, ScoreWords

PLACEMENT = ("placement.parquet", "curve.parquet")
"""Shown where a plan of the same settings and files was made in the run's folder."""


@dataclass(frozen=True)
class Planned:
    """One sensor of the plan: the columns of ``placement.parquet`` that the page shows."""

    order: int
    site: str
    pole: str
    sensor: str
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    forced: bool
    gain: float
    score: float
    cost: float
    loss: float


@dataclass(frozen=True)
class Enough:
    """What the best plan of so many sensors is worth; shares of what all candidates together would be."""

    count: int
    sites: tuple[str, ...]
    share: float
    certificate: float
    cost: float


@dataclass(frozen=True)
class PlacementSummary:
    """What ``egvs place`` found.

    Attributes
    ----------
    by
        The joint score in words.
    picks
        In the order in which they would be put up.
    curve
        For 1, 2, ... sensors.
    proof
        What is proved, in a sentence.
    before
        The joint score as the candidates hang, where sensors were to move from there; None else.
    map, chart
        Figures, SVG text.
    """

    by: ScoreWords
    picks: tuple[Planned, ...]
    curve: tuple[Enough, ...]
    joint: float
    together: float
    cost: float
    candidates: int
    proof: str
    objective: str
    zones: tuple[Mapping[str, Any], ...]
    before: float | None
    map: str
    chart: str

    @classmethod
    def read(
        cls,
        out: Path,
        stages: Mapping[str, StageRecord],
        candidates: Sequence[MapSite],
        tpog: Tpog,
        backdrop: Backdrop,
    ) -> PlacementSummary | None:
        """The plan in a run's folder; None where there is none of what ``stages`` ran on."""
        found = read_placement(*(out / name for name in PLACEMENT))
        if found is None:
            return None
        rows, points, about = found
        if any(name not in stages or stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        picks = tuple(Planned(**{name: row[name] for name in Planned.__dataclass_fields__}) for row in rows)
        its = about["plan"]
        by, together = SCORES[its["score"]], its["together"] or math.inf
        curve = tuple(
            Enough(
                row["count"],
                tuple(json.loads(row["sites"])),
                row["score"] / together,
                _certificate(row["value"], row["bound"]),
                row["cost"],
            )
            for row in points
        )
        whole = 1.0 if its["asked"]["objective"] == "worst" else together  # of which values are shares already
        steps = [CurveStep(row["count"], row["value"] / whole, row["bound"] / whole) for row in points]
        occupied = tpog.counts.sum(axis=2) / tpog.frames
        names = ", ".join(pick.site for pick in picks)
        return cls(
            by=by,
            picks=picks,
            curve=curve,
            joint=its["joint"],
            together=its["together"],
            cost=its["cost"],
            candidates=its["candidates"],
            proof=_proof(its, len(picks)),
            objective=_objective(its["asked"]),
            zones=tuple(its["zones"]),
            before=its["moves"]["before"] if "moves" in its else None,
            map=drawing.plan_map(
                tpog.grid,
                occupied,
                backdrop,
                candidates,
                _poles(picks, its["joint"], by),
                f"Map of the plan: {names}.",
            ),
            chart=drawing.curve(
                steps, "How much each number of sensors is worth, and what no plan of so many exceeds."
            ),
        )

    @property
    def share(self) -> float:
        """Of what all candidates together would be worth."""
        return self.joint / self.together if self.together else 0.0

    def lost(self, pick: Planned) -> float:
        """The share of the plan's score that goes when a sensor fails."""
        return pick.loss / self.joint if self.joint else 0.0


def _certificate(value: float, bound: float) -> float:
    """The share of the best possible that is proved; 1 up to the rounding of bounds."""
    return 1.0 if bound <= value * (1.0 + 2e-9) else value / bound


def _proof(its: Mapping[str, Any], sensors: int) -> str:
    proved = f"at least {math.floor(1e4 * its['certificate']) / 1e2:.2f} % of the best possible is proved"
    if its["fewest_is_proved"] is not None:
        if sensors == 1:
            return "one is enough"
        fewer = f"{sensors - 1} sensor{'' if sensors == 2 else 's'}"
        return f"that {fewer} cannot reach it is {'proved' if its['fewest_is_proved'] else 'not proved'}"
    return "that no plan within the rules is better is proved" if its["is_best"] else proved


def _objective(asked: Mapping[str, Any]) -> str:
    """What was asked for, where it is not the joint score itself; empty else."""
    parts = ["the period that is seen worst"] if asked["objective"] == "worst" else []
    parts += ["what is left when the sensor that is missed most has failed"] if asked["survives"] else []
    return " and ".join(parts)


def _poles(picks: Sequence[Planned], joint: float, by: ScoreWords) -> list[PlannedPole]:
    """One mark a place; sensors at one place share it."""
    places: dict[tuple[float, float], list[Planned]] = {}
    for pick in picks:
        places.setdefault((pick.x_m, pick.y_m), []).append(pick)
    return [
        PlannedPole(
            x_m,
            y_m,
            ", ".join(str(pick.order) for pick in those),
            f"{those[0].site}{f' +{len(those) - 1}' if len(those) > 1 else ''}: {_part(those, joint):.0%}",
            "; ".join(
                f"{p.order}. {p.site}, {p.z_m:g} m high, adds {by.value(p.gain)} {by.unit}".strip() for p in those
            ),
        )
        for (x_m, y_m), those in places.items()
    ]


def _part(picks: Sequence[Planned], joint: float) -> float:
    return sum(pick.gain for pick in picks) / joint if joint else 0.0
