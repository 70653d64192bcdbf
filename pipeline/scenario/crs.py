"""The keys of ``[crs]``: where the world frame lies on the Earth."""

from __future__ import annotations

from pydantic import Field, model_validator

from pipeline.core.strict_model import StrictModel
from pipeline.scenario.types import Point2


class CrsModel(StrictModel):
    """Where the world frame lies on the Earth; without it, the SUMO network's own <location> says so."""

    epsg: int | None = Field(
        None, ge=1, description="Code of a projected coordinate reference system in metres, e.g. 25832"
    )
    offset_m: Point2 = Field(
        (0.0, 0.0), description="Added to its easting and northing to reach x, y (SUMO's netOffset)"
    )
    zero_height_m: float = Field(
        0.0, ge=-12_000, le=9_000, description="Height that measured scans with a coordinate system give for z = 0"
    )

    @model_validator(mode="after")
    def _offset_of_something(self) -> CrsModel:
        if self.epsg is None and self.offset_m != (0.0, 0.0):
            raise ValueError("offset_m without epsg: a network's <location> has its own")
        return self
