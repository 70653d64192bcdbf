"""``[score]``, ``[placement]``, ``[costs]``.

``[score]``: how a site is scored, and by which score sites are ranked.

``[placement]`` and ``[costs]``: what is asked of a plan of several sensors, and what it costs.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from egvs.scenario.fields import Name, NotNegative, Point2, Positive, StrictModel

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

DEFAULT_SCORE: OtherScore = "expected_detections"
"""The score that the study recommends (docs/validity.md), and that new scenarios rank by."""

_AT_ONE_METRE, _POWER = 10.0, 1.16
"""Through the gammas that rank best on the study's training junctions (docs/validity.md, B): 2, 5 and 10 for voxels of
0.25, 0.5 and 1 m; 1, 2 and 5 with moving occlusion. A line through three points each, of one sensor, no law."""


def default_gamma(voxel_m: float, *, moving_occlusion: bool) -> float:
    r"""The gamma that ``"auto"`` stands for: :math:`10 (d / 1 m)^{1.16}` for voxels of d metres, half of that with
    moving occlusion; to two significant digits."""
    gamma = _AT_ONE_METRE * voxel_m**_POWER
    return float(f"{gamma / 2 if moving_occlusion else gamma:.2g}")


def checked_polygon(polygon_m: tuple[Point2, ...]) -> tuple[Point2, ...]:
    """The corners of a polygon; ValueError where they enclose no area."""
    import shapely

    if (why := shapely.is_valid_reason(shapely.Polygon(polygon_m))) != "Valid Geometry":
        raise ValueError(f"no polygon that encloses an area ({why})")
    return polygon_m


class ZoneConfig(StrictModel):
    """A part of the region in which vehicles count more, or less."""

    polygon_m: tuple[Point2, ...] = Field(min_length=3, description="Its corners in the world frame, in order")
    weight: float = Field(ge=0, description="How much a vehicle counts whose centre is in it; 1 elsewhere")

    _encloses = field_validator("polygon_m")(checked_polygon)


class WeightsConfig(StrictModel):
    """How much vehicles count in the scores over vehicles: a vehicle's kind times every zone that holds its centre."""

    kinds: dict[VehicleClass, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Weight of each SUMO vClass, 1 where none stands here; people on foot and on bicycles are to be "
        "seen only where they have one, as in pedestrian = 2",
    )
    zones: dict[Name, ZoneConfig] = Field(default_factory=dict, description="Parts of the region by a name of your own")

    @property
    def are_given(self) -> bool:
        """Whether there are any."""
        return bool(self.kinds or self.zones)

    @property
    def in_words(self) -> str:
        """Names and weights: "bus 3, zone crosswalk 2"."""
        kinds = [f"{kind} {weight:g}" for kind, weight in self.kinds.items()]
        return ", ".join([*kinds, *(f"zone {name} {zone.weight:g}" for name, zone in self.zones.items())])


class ScoreConfig(StrictModel):
    """How a site is scored."""

    gamma: Annotated[float, Field(ge=0, allow_inf_nan=True)] | Literal["auto"] = Field(
        "auto",
        description="Beams in a voxel above this number count no more; may be inf. 'auto': by the size of the voxels, "
        "10 (voxel_m / 1 m)^1.16 (2 for 0.25 m, 10 for 1 m), half of that with moving_occlusion",
    )
    rank_by: Literal["egvs", OtherScore] = Field("egvs", description="The score that sites are ranked by")
    others: tuple[OtherScore, ...] = Field(
        (DEFAULT_SCORE,),
        description="Further scores that scores.parquet gets, beside egvs and the one that ranks",
    )
    weights: WeightsConfig = WeightsConfig()
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
    def additional(self) -> tuple[OtherScore, ...]:
        """The scores beside the EGVS that are asked for, each once: the one that ranks first."""
        first = () if self.rank_by == "egvs" else (self.rank_by,)
        return (*first, *(name for name in self.others if name not in first))


Share = Annotated[float, Field(gt=0, le=1)]
Turn = Annotated[float, Field(ge=-360, le=360)]
Tilt = Annotated[float, Field(ge=-90, le=90)]


class CostsConfig(StrictModel):
    """What a candidate costs, in any currency; a column ``cost`` of the sites file says it of a row in their place."""

    sensor: dict[str, NotNegative] = Field(default_factory=dict, description="Of each sensor by its name")
    pole: NotNegative = Field(0.0, description="Of a pole, once for all sensors at it")
    metre: NotNegative = Field(0.0, description="Of each metre of a sensor's height z_m")

    @property
    def are_given(self) -> bool:
        """Whether any is."""
        return bool(self.sensor or self.pole or self.metre)


class ZoneDemand(StrictModel):
    """A part of the region that a plan must see."""

    polygon_m: tuple[Point2, ...] = Field(min_length=3, description="Its corners in the world frame, in order")
    share: Share = Field(description="Of its entropy: of the voxels whose centre is in it")
    by: int = Field(1, ge=1, description="Sensors that must see a voxel for it to count")

    _encloses = field_validator("polygon_m")(checked_polygon)


class RefinementConfig(StrictModel):
    """How far the sensors of a plan may move from their candidates' poses; those that are forced stay."""

    radius_m: NotNegative | None = Field(
        None,
        description="A pole in plan; one of sites.along along its line, by half the spacing if not given. Else 0",
    )
    within_m: tuple[tuple[Point2, ...], ...] = Field(
        (), description="Polygons: a pole that stands in one may be anywhere in it, whatever radius_m says"
    )
    heights_m: tuple[Positive, Positive] | None = Field(
        None, description="Lowest and highest z_m; those of all candidates where it is not given"
    )
    yaw_deg: tuple[Turn, Turn] | None = Field(None, description="From, to; any where it is not given")
    pitch_deg: tuple[Tilt, Tilt] = Field((-30.0, 10.0), description="Lowest and highest, nose up positive")
    roll_deg: tuple[Turn, Turn] | None = Field(
        None, description="From, to; as the candidate has it where it is not given"
    )
    evaluations: int = Field(300, ge=20, description="Poses that are tried for a sensor in its turn")

    _enclose = field_validator("within_m")(lambda polygons: tuple(map(checked_polygon, polygons)))

    @field_validator("heights_m", "yaw_deg", "pitch_deg", "roll_deg")
    @classmethod
    def _ascending(cls, ends: tuple[float, float] | None) -> tuple[float, float] | None:
        if ends is not None and ends[0] > ends[1]:
            raise ValueError(f"{ends[0]:g} to {ends[1]:g}: the lower end comes first")
        return ends


class PlacementConfig(StrictModel):
    """What is asked of a plan; options of ``egvs place`` take the place of keys."""

    count: int | None = Field(None, ge=1, description="Sensors at most, those forced among them")
    budget: Positive | None = Field(None, description="Cost at most, see [costs]; forced candidates are free")
    reach: Share | None = Field(
        None, description="The fewest sensors that reach this share of what all candidates together would"
    )
    forced: tuple[str, ...] = Field((), description="Candidates that are there already: part of every plan")
    excluded: tuple[str, ...] = Field((), description="Candidates, or poles, that are part of none")
    most_per_pole: int | None = Field(None, ge=1, description="Sensors at one pole at most")
    least_distance_m: NotNegative = Field(0.0, description="Between any two sensors")
    zones: dict[Name, ZoneDemand] = Field(default_factory=dict, description="Parts of the region that must be seen")
    objective: Literal["mean", "worst"] = Field(
        "mean",
        description="Of traffic with periods: their mix, or the period of which the least is seen, as a share of what "
        "all candidates together would",
    )
    periods: tuple[str, ...] = Field(
        (), description='Those of which objective = "worst" takes the worst; all by default'
    )
    survives: int = Field(
        0, ge=0, le=1, description="1: what counts is what is left when the sensor that is missed most has failed"
    )
    refine: RefinementConfig | None = Field(
        None, description="Let the sensors of the plan move, as --refine does; within what the keys of this table say"
    )

    @model_validator(mode="after")
    def _no_name_in_both(self) -> PlacementConfig:
        for key in ("forced", "excluded", "periods"):
            names = getattr(self, key)
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"{key} names {twice[0]} twice")
        if both := [name for name in self.forced if name in self.excluded]:
            raise ValueError(f"{both[0]} is forced and excluded: it can be one of them")
        if self.survives and self.count is not None and self.count < 2:
            raise ValueError("survives = 1 with count = 1: nothing is left when the only sensor fails; a count above 1")
        return self
