"""Columns of the user that the schema of an artefact does not name, such as those of a sites file."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence

import pyarrow as pa

ExtraValue = str | int | float | bool | None
ExtraValues = Mapping[str, ExtraValue]


def extra_columns(rows: Sequence[ExtraValues], taken: Collection[str]) -> dict[str, pa.Array]:
    """Return columns for values that the schema of an artefact does not name.

    Types follow from the values: booleans, integers, floats and strings; a column of several kinds is text.

    Parameters
    ----------
    rows
        Values of each row by name, n rows.
    taken
        Column names of the artefact; a name that is taken gets the prefix ``given_``.

    Returns
    -------
    dict
        Name -> nullable column (n,), in the order of first occurrence; null where a row has no such value.
    """
    columns: dict[str, pa.Array] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        free_name = name
        while free_name in taken or free_name in columns:
            free_name = f"given_{free_name}"
        columns[free_name] = _extra_column([row.get(name) for row in rows])
    return columns


def _extra_column(values: list[ExtraValue]) -> pa.Array:
    kinds = set(map(type, values)) - {type(None)}
    if kinds == {bool}:
        return pa.array(values, type=pa.bool_())
    if kinds == {int}:
        return pa.array(values, type=pa.int64())
    if kinds and kinds <= {int, float}:
        return pa.array([None if value is None else float(value) for value in values], type=pa.float64())
    texts = [value if isinstance(value, str | None) else json.dumps(value) for value in values]
    return pa.array(texts, type=pa.string())
