"""What a file of floating car data may say of itself, so that it need not be guessed from its rows.

Rows alone do not tell whether a time without any was watched. A Parquet file may say it, as one JSON object under the
metadata key ``egvs``: that frame k is at k times ``period_ms`` on its clock, and how many there are, with vehicles or
without; how large the vehicles of each type are. Its positions are metres of the world frame then. The file's columns
stay those of SUMO, so that whatever reads SUMO's Parquet reads it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from pipeline.core.errors import InputError
from pipeline.core.reading import documents
from pipeline.core.strict_model import StrictModel
from pipeline.scenario.types import Name, Positive
from pipeline.traffic import fcd
from pipeline.traffic.boxes import Size

_NAMES_IT = "period_ms"
"""A key that no other file of this program has there."""


class StatedSize(StrictModel):
    """A type of vehicles."""

    length_m: Positive
    width_m: Positive
    height_m: Positive
    vclass: Name


class StatedFcd(StrictModel):
    """What a file says of itself."""

    period_ms: int = Field(ge=1)
    frames: int = Field(ge=1, le=2**32 - 1)
    types: dict[Annotated[str, Field(min_length=1)], StatedSize]

    @property
    def sizes(self) -> dict[str, Size]:
        """The types' sizes."""
        return {name: Size(t.length_m, t.width_m, t.height_m, t.vclass) for name, t in self.types.items()}

    @classmethod
    def about(cls, period_ms: int, frames: int, sizes: dict[str, Size]) -> StatedFcd:
        """For a file that is to be written."""
        return cls(
            period_ms=period_ms,
            frames=frames,
            types={name: StatedSize(**vars(size)) for name, size in sorted(sizes.items())},
        )


def read(path: Path) -> StatedFcd | None:
    """What a finished file says of itself; None where it says nothing.

    InputError where what it says makes no sense.
    """
    if not path.is_file() or (raw := fcd.stated(path)) is None:
        return None
    right = "an unaltered file; make it again"
    try:
        values: Any = documents.json_value(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"its metadata is no JSON ({error})", right) from None
    if not isinstance(values, dict) or _NAMES_IT not in values:
        return None
    try:
        return StatedFcd.of({key: value for key, value in values.items() if key != "schema"})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(path, f"its metadata says {key} = {str(first['input'])[:80]}", right) from None
