"""What a sensor brings to a city, in words."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.report.score_words import SCORES


@dataclass(frozen=True)
class GainWords:
    """What is added up over junctions: at the head of a column, on an axis, and how many digits it has."""

    head: str
    label: str
    digits: int

    def value(self, value: float) -> str:
        """In a table."""
        return f"{value:,.{self.digits}f}"


def gain_words(rank_by: str) -> GainWords:
    """Of the score that ranks."""
    by = SCORES[rank_by]
    if rank_by == "egvs":
        return GainWords("EGVS bit", by.label, 0)
    if rank_by in _VEHICLES:
        return GainWords(_VEHICLES[rank_by], f"{_VEHICLES[rank_by]}, at a time", 2)
    return GainWords(f"{by.head} × vehicles", f"{by.noun} times the vehicles there at a time", 2)


_VEHICLES = {"expected_detections": "vehicles found", "seen_well": "vehicles seen well"}
