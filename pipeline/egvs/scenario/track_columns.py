"""The keys of ``[traffic.track_columns]``: which column of a user's own file of recorded tracks has which meaning."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from egvs.scenario.fields import StrictModel, find_duplicates

RoadUserClass = Literal[
    "car", "van", "truck", "bus", "trailer", "tram", "motorcycle", "bicycle", "pedestrian", "other"
]  # fmt: skip
"""Classes of road users in recorded traffic."""

Column = Annotated[str, Field(min_length=1)]

_KEYS_THAT_NEED = {
    "z": ("z_reference",),
    "yaw": ("yaw_unit", "yaw_convention"),
    "type": ("types",),
}
"""Keys that have no effect without the column before the colon."""


class TrackColumns(StrictModel):
    """Columns, units and conventions of a file of tracks, CSV with a header row or JSON lines.

    In JSON lines, a column is a key of the object on each line; a dot goes into an object or a list: ``position.x``,
    ``centre.0``.
    """

    time: Column = Field(description="Column with the time")
    id: Column = Field(description="Column with the name of the track, a text or a number")
    x: Column = Field(description="Column with the x coordinate, easting or longitude")
    y: Column = Field(description="Column with the y coordinate, northing or latitude")
    z: Column | None = Field(
        None, description="Column with the height of the position. It is reported only: boxes stand on the road"
    )
    yaw: Column | None = Field(
        None, description="Column with the direction of the front. By default, directions of motion are used"
    )
    length: Column | None = Field(None, description="Column with the length. By default a typical one of the class")
    width: Column | None = Field(None, description="Column with the width. By default a typical one of the class")
    height: Column | None = Field(None, description="Column with the height. By default a typical one of the class")
    type: Column | None = Field(None, description="Column with the class of the road user")
    types: dict[str, RoadUserClass] = Field(
        default_factory=dict,
        description='Classes of the texts in the column type, e.g. {PKW = "car"}. Names of classes need no entry',
    )
    default_type: RoadUserClass | None = Field(
        None, description="Class of rows without a text in the column type, or of all rows without such a column"
    )
    delimiter: str = Field(",", min_length=1, max_length=1, description="Character between the cells of a CSV file")
    time_unit: Literal["s", "ms", "us", "ns"] = Field("s", description="Unit of time")
    length_unit: Literal["m", "ft"] = Field(
        "m", description="Unit of sizes and z, and without crs of x and y; ft is the international foot, 0.3048 m"
    )
    yaw_unit: Literal["rad", "deg"] = Field("rad", description="Unit of yaw")
    yaw_convention: Literal["ccw_from_east", "cw_from_north"] = Field(
        "ccw_from_east",
        description="Where yaw is 0, and in which direction it grows. East and north are +x and +y of the coordinates;"
        " with longitude and latitude, true east and north",
    )
    reference: Literal["centre", "front"] = Field(
        "centre", description="Point of the box at x, y: its centre, or the middle of its front (needs length)"
    )
    z_reference: Literal["centre", "bottom"] = Field(
        "centre", description="Point of the box at z: its centre, or its bottom (needs height)"
    )
    crs: str | None = Field(
        None,
        description='Coordinate reference system of x and y: "lonlat" for degrees (WGS 84), a projection in metres'
        ' such as "EPSG:25832". By default x and y are in the world frame of the scenario',
    )

    @field_validator("delimiter")
    @classmethod
    def _check_delimiter(cls, delimiter: str) -> str:
        if delimiter in '"\n\r .+-' or delimiter.isalnum():
            raise ValueError(f"expected a character such as ',' ';' '|' or a tab, got {delimiter!r}")
        return delimiter

    @model_validator(mode="after")
    def _check_keys_agree(self) -> TrackColumns:
        names = [self.time, self.id, self.x, self.y]
        if duplicates := find_duplicates(names):
            raise ValueError(f"time, id, x and y are different columns, got {duplicates[0]!r} twice")
        for column, keys in _KEYS_THAT_NEED.items():
            unused = [key for key in keys if getattr(self, key) != self._default(key)]
            if getattr(self, column) is None and unused:
                raise ValueError(f"{unused[0]} has no effect without {column}")
        if self.type is None and self.default_type is None:
            raise ValueError("expected type, the column with the class, or default_type, the class of all tracks")
        if self.reference == "front" and self.length is None:
            raise ValueError('reference = "front" needs length: the centre is half a length behind the front')
        if self.z_reference == "bottom" and self.height is None:
            raise ValueError('z_reference = "bottom" needs height: the centre is half a height above the bottom')
        return self

    @classmethod
    def _default(cls, key: str) -> Any:
        return cls.model_fields[key].get_default(call_default_factory=True)
