"""``[placement]`` and ``[costs]``: what is asked of a plan of several sensors, and what it costs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.core.strict_model import StrictModel
from pipeline.scenario.score import enclosing
from pipeline.scenario.types import Name, NotNegative, Point2, Positive

Share = Annotated[float, Field(gt=0, le=1)]


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
        description="Of traffic with periods: their mix, or the period of which the least is seen, as a share of what all "
        "candidates together would",
    )
    survives: int = Field(
        0, ge=0, le=1, description="1: what counts is what is left when the sensor that is missed most has failed"
    )

    @model_validator(mode="after")
    def _no_name_in_both(self) -> PlacementModel:
        for key in ("forced", "excluded"):
            names = getattr(self, key)
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"{key} names {twice[0]} twice")
        if both := [name for name in self.forced if name in self.excluded]:
            raise ValueError(f"{both[0]} is forced and excluded: it can be one of them")
        if self.survives and self.count is not None and self.count < 2:
            raise ValueError("survives = 1 with count = 1: nothing is left when the only sensor fails; a count above 1")
        return self
