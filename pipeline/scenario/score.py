"""``[score]``: how a site is scored, and by which score sites are ranked."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from pipeline.core.strict_model import StrictModel

OtherScore = Literal["entropy_seen", "points_on_target", "seen_well"]
"""Scores beside the EGVS."""


class ScoreModel(StrictModel):
    """How a site is scored."""

    gamma: float = Field(
        10.0, ge=0, allow_inf_nan=True, description="Beams in a voxel above this number count no more; may be inf"
    )
    rank_by: Literal["egvs", OtherScore] = Field("egvs", description="The score that sites are ranked by")
    others: tuple[OtherScore, ...] = Field(
        ("seen_well",), description="Further scores that scores.parquet gets, beside egvs and the one that ranks"
    )
    keep_visibility: tuple[str, ...] | Literal["all"] = Field(
        (), description="Sites whose hits in every voxel are written to visibility.parquet"
    )
    standard_error: bool = Field(True, description="Say how far each score may be off because the traffic was short")

    @field_validator("others")
    @classmethod
    def _each_once(cls, others: tuple[OtherScore, ...]) -> tuple[OtherScore, ...]:
        if twice := sorted({name for name in others if others.count(name) > 1}):
            raise ValueError(f"{twice[0]} stands there twice")
        return others

    @property
    def asked(self) -> tuple[OtherScore, ...]:
        """The scores beside the EGVS that are asked for, each once: the one that ranks first."""
        first = () if self.rank_by == "egvs" else (self.rank_by,)
        return (*first, *(name for name in self.others if name not in first))
