"""``[placement]`` and ``[costs]``: what is asked of a plan of several sensors, and what it costs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.core.strict_model import StrictModel
from pipeline.scenario.score import enclosing
from pipeline.scenario.types import Name, NotNegative, Point2, Positive

Share = Annotated[float, Field(gt=0, le=1)]
Turn = Annotated[float, Field(ge=-360, le=360)]
Tilt = Annotated[float, Field(ge=-90, le=90)]


class CostsModel(StrictModel):
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

    _encloses = field_validator("polygon_m")(enclosing)


class RefineModel(StrictModel):
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

    _enclose = field_validator("within_m")(lambda polygons: tuple(map(enclosing, polygons)))

    @field_validator("heights_m", "yaw_deg", "pitch_deg", "roll_deg")
    @classmethod
    def _ascending(cls, ends: tuple[float, float] | None) -> tuple[float, float] | None:
        if ends is not None and ends[0] > ends[1]:
            raise ValueError(f"{ends[0]:g} to {ends[1]:g}: the lower end comes first")
        return ends


class PlacementModel(StrictModel):
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
    refine: RefineModel | None = Field(
        None, description="Let the sensors of the plan move, as --refine does; within what the keys of this table say"
    )

    @model_validator(mode="after")
    def _no_name_in_both(self) -> PlacementModel:
        for key in ("forced", "excluded", "periods"):
            names = getattr(self, key)
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"{key} names {twice[0]} twice")
        if both := [name for name in self.forced if name in self.excluded]:
            raise ValueError(f"{both[0]} is forced and excluded: it can be one of them")
        if self.survives and self.count is not None and self.count < 2:
            raise ValueError("survives = 1 with count = 1: nothing is left when the only sensor fails; a count above 1")
        return self
