"""Obstacles that are dropped on the map, as one table ``[what_if.obstacles]`` of the scenario."""

from __future__ import annotations

from typing import Any

import tomlkit

from egvs.extensions.desk.refusals import RefusalError, parse_number, require_text
from egvs.scenario.model import Scenario

TABLE = "obstacles"
MOST = 50
_NUMBERS = {
    "x_m": (-1e8, 1e8), "y_m": (-1e8, 1e8), "yaw_deg": (-360.0, 360.0), "length_m": (0.1, 100.0),
    "width_m": (0.1, 100.0), "height_m": (0.1, 100.0),
}  # fmt: skip


def describe_obstacles(scenario: Scenario) -> list[dict[str, Any]]:
    """Return the boxes of the table; the kind of each is its name."""
    table = scenario.what_if.get(TABLE)
    boxes = () if table is None else table.boxes
    return [
        {"name": box.kind, "kind": box.kind.rstrip("0123456789"), **box.model_dump(include=set(_NUMBERS))}
        for box in boxes
    ]


def write_obstacles(document: Any, given: object) -> None:
    """Write the boxes into the table; without any, it is removed."""
    if not isinstance(given, list) or len(given) > MOST or not all(isinstance(each, dict) for each in given):
        raise RefusalError(422, f"expected a list of at most {MOST} obstacles", "", "obstacles")
    boxes = tomlkit.array().multiline(True)
    names = set()
    for each in given:
        name = require_text(each, "name")
        if name in names:
            raise RefusalError(422, f"there are two obstacles {name!r}", "", "name")
        names.add(name)
        box = tomlkit.inline_table()
        box.update({key: parse_number(each.get(key), key, *limits) for key, limits in _NUMBERS.items()})
        box["kind"] = name
        boxes.append(box)
    tables = document.setdefault("what_if", tomlkit.table())
    tables.pop(TABLE, None)
    if boxes:
        tables[TABLE] = {"share": 1.0}
        tables[TABLE]["boxes"] = boxes
    elif not tables:
        del document["what_if"]
