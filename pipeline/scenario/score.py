"""``[score]``: how a site is scored, and by which score sites are ranked."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from pipeline.core.strict_model import StrictModel
from pipeline.scenario.types import Name, Point2

VehicleClass = Literal[
    "pedestrian", "wheelchair", "bicycle", "scooter", "moped", "motorcycle", "passenger", "private", "hov", "taxi",
    "bus", "coach", "delivery", "truck", "trailer", "evehicle", "emergency", "authority", "army", "vip", "tram",
    "rail_urban",
    "subway", "rail", "rail_electric", "rail_fast", "ship", "container", "cable_car", "aircraft", "drone", "custom1",
    "custom2",
]  # fmt: skip
"""SUMO's vClasses."""

OtherScore = Literal[
    "expected_detections", "seen_well", "points_on_target", "entropy_seen", "coverage", "expected_visibility"
]  # fmt: skip
"""Scores beside the EGVS."""

RECOMMENDED: OtherScore = "expected_detections"
"""The score that the study recommends (docs/validity.md), and that new scenarios rank by."""


_AT_ONE_METRE, _POWER = 10.0, 1.16
"""Through the gammas that rank best on the study's training junctions (docs/validity.md, B): 2, 5 and 10 for voxels of
0.25, 0.5 and 1 m; 1, 2 and 5 with moving occlusion. A line through three points each, of one sensor, no law."""


def gamma_for(voxel_m: float, *, moving_occlusion: bool) -> float:
    r"""The gamma that ``"auto"`` stands for: :math:`10 (d / 1 m)^{1.16}` for voxels of d metres, half of that with
    moving occlusion; to two significant digits."""
    gamma = _AT_ONE_METRE * voxel_m**_POWER
    return float(f"{gamma / 2 if moving_occlusion else gamma:.2g}")


def enclosing(polygon_m: tuple[Point2, ...]) -> tuple[Point2, ...]:
    """The corners of a polygon; ValueError where they enclose no area."""
    import shapely

    if (why := shapely.is_valid_reason(shapely.Polygon(polygon_m))) != "Valid Geometry":
        raise ValueError(f"no polygon that encloses an area ({why})")
    return polygon_m


class ZoneModel(StrictModel):
    """A part of the region in which vehicles count more, or less."""

    polygon_m: tuple[Point2, ...] = Field(min_length=3, description="Its corners in the world frame, in order")
    weight: float = Field(ge=0, description="How much a vehicle counts whose centre is in it; 1 elsewhere")

    _encloses = field_validator("polygon_m")(enclosing)


class WeightsModel(StrictModel):
    """How much vehicles count in the scores over vehicles: a vehicle's kind times every zone that holds its centre."""

    kinds: dict[VehicleClass, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Weight of each SUMO vClass, 1 where none stands here; people on foot and on bicycles are to be "
        "seen only where they have one, as in pedestrian = 2",
    )
    zones: dict[Name, ZoneModel] = Field(default_factory=dict, description="Parts of the region by a name of your own")

    @property
    def are_given(self) -> bool:
        """Whether there are any."""
        return bool(self.kinds or self.zones)

    @property
    def in_words(self) -> str:
        """Names and weights: "bus 3, zone crosswalk 2"."""
        kinds = [f"{kind} {weight:g}" for kind, weight in self.kinds.items()]
        return ", ".join([*kinds, *(f"zone {name} {zone.weight:g}" for name, zone in self.zones.items())])


class ScoreModel(StrictModel):
    """How a site is scored."""

    gamma: Annotated[float, Field(ge=0, allow_inf_nan=True)] | Literal["auto"] = Field(
        "auto",
        description="Beams in a voxel above this number count no more; may be inf. 'auto': by the size of the voxels, "
        "10 (voxel_m / 1 m)^1.16 (2 for 0.25 m, 10 for 1 m), half of that with moving_occlusion",
    )
    rank_by: Literal["egvs", OtherScore] = Field("egvs", description="The score that sites are ranked by")
    others: tuple[OtherScore, ...] = Field(
        (RECOMMENDED,),
        description="Further scores that scores.parquet gets, beside egvs and the one that ranks",
    )
    weights: WeightsModel = WeightsModel()
    keep_visibility: tuple[str, ...] | Literal["all"] = Field(
        (), description="Sites whose hits in every voxel are written to visibility.parquet"
    )
    blindspots: bool = Field(True, description="Write blindspots.parquet: where each site misses vehicles")
    standard_error: bool = Field(True, description="Say how far each score may be off because the traffic was short")

    @field_validator("gamma", mode="before")
    @classmethod
    def _from_json(cls, gamma: Any) -> Any:
        return math.inf if gamma == "inf" else gamma

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
