"""``[what_if.NAME]``: things that stand in the scene for a share of the time, for ``egvs what-if``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from egvs.scenario.fields import Coordinate, Name, Positive, StrictModel


class WhatIfBox(StrictModel):
    """A box on the ground, for example a container or a barrier."""

    x_m: Coordinate = Field(description="Centre of the box in the world frame")
    y_m: Coordinate = Field(description="Centre of the box in the world frame")
    yaw_deg: float = Field(0.0, description="Direction of its length, counter-clockwise from east")
    length_m: Positive = Field(description="Size along its direction")
    width_m: Positive = Field(description="Size across its direction")
    height_m: Positive = Field(description="Height above the ground")
    kind: Name = Field("obstacle", description="Kind of solid, shown in messages and in the report")


class WhatIfConfig(StrictModel):
    """Solids that are there for a share of the time. They have no effect on a run; ``egvs what-if`` evaluates them."""

    share: Annotated[float, Field(gt=0, le=1)] = Field(description="Share of the time with these solids, above 0, to 1")
    vehicles: str | None = Field(
        None,
        description="Table of parked vehicles: x_m, y_m (centre), yaw_deg, type (car, van, truck, bus, ...; a kind"
        " of traffic.kinds with this name sets its size)",
    )
    footprints: tuple[str, ...] = Field((), description="Files of further solids, as for statics.footprints")
    boxes: tuple[WhatIfBox, ...] = ()
    tree_scale: Positive | None = Field(
        None,
        description="Factor for the height and the width of all trees and hedges among statics.footprints, e.g. 1.4;"
        " the underside of a crown stays",
    )

    @model_validator(mode="after")
    def _check_not_empty(self) -> WhatIfConfig:
        if not (self.vehicles or self.footprints or self.boxes or self.tree_scale):
            raise ValueError("expected vehicles, footprints, boxes or tree_scale, got none of them")
        return self
