"""``[score]``: how a site is scored, and by which score sites are ranked."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipeline.core.strict_model import StrictModel

OtherScore = Literal["entropy_seen", "points_on_target", "seen_well"]
"""Scores beside the EGVS."""


_AT_ONE_METRE, _POWER = 10.0, 1.16
"""Through the gammas that rank best on the study's training junctions (docs/validity.md, B): 2, 5 and 10 for voxels of
0.25, 0.5 and 1 m; 1, 2 and 5 with moving occlusion. A line through three points each, of one sensor, no law."""


def gamma_for(voxel_m: float, *, moving_occlusion: bool) -> float:
    r"""The gamma that ``"auto"`` stands for: :math:`10 (d / 1 m)^{1.16}` for voxels of d metres, half of that with
    moving occlusion; to two significant digits."""
    gamma = _AT_ONE_METRE * voxel_m**_POWER
    return float(f"{gamma / 2 if moving_occlusion else gamma:.2g}")


class ScoreModel(StrictModel):
    """How a site is scored."""

    gamma: Annotated[float, Field(ge=0, allow_inf_nan=True)] | Literal["auto"] = Field(
        "auto",
        description="Beams in a voxel above this number count no more; may be inf. 'auto': by the size of the voxels, "
        "10 (voxel_m / 1 m)^1.16 (2 for 0.25 m, 10 for 1 m), half of that with moving_occlusion",
    )
    rank_by: Literal["egvs", OtherScore] = Field("egvs", description="The score that sites are ranked by")
    others: tuple[OtherScore, ...] = Field(
        ("seen_well",), description="Further scores that scores.parquet gets, beside egvs and the one that ranks"
    )
    keep_visibility: tuple[str, ...] | Literal["all"] = Field(
        (), description="Sites whose hits in every voxel are written to visibility.parquet"
    )
    blindspots: bool = Field(True, description="Write blindspots.parquet: where each site misses vehicles")
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
