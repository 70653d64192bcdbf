"""Makes Arrow columns of what rows say beyond an artefact's own columns; their types follow from the values.

Truth values, whole numbers, numbers and texts have a type of their own; a column of several kinds is text. All may be
null. A name that the artefact has itself gets ``given_`` in front.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence

import pyarrow as pa

Row = Mapping[str, str | int | float | bool | None]


def foreign_columns(rows: Sequence[Row], taken: Collection[str]) -> dict[str, pa.Array]:
    """One nullable column (n,) a name that any of the ``rows`` (n) has, in order; null where a row has it not."""
    columns: dict[str, pa.Array] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        free = name
        while free in taken or free in columns:
            free = f"given_{free}"
        columns[free] = _column([row.get(name) for row in rows])
    return columns


def _column(values: list[str | int | float | bool | None]) -> pa.Array:
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return pa.array(values, type=pa.bool_())
    if kinds == {int}:
        return pa.array(values, type=pa.int64())
    if kinds and kinds <= {int, float}:
        return pa.array([None if value is None else float(value) for value in values], type=pa.float64())
    texts = [value if isinstance(value, str | None) else json.dumps(value) for value in values]
    return pa.array(texts, type=pa.string())
