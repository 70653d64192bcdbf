"""The colours of exported layers: those of the report, in a few even classes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.export.layers import FOOTPRINTS, PLAN, REGION, Layer
from pipeline.report.drawing import colours

CLASSES = 9

PLAIN = {PLAN: "e8590c", FOOTPRINTS: "d5d8df", REGION: "1d2430"}
"""The colour of layers that have one only; ``OTHER`` is that of the others."""
OTHER = "31688e"


@dataclass(frozen=True)
class Shade:
    """Values from ``low`` to ``high`` and their colour, RRGGBB; the last class holds its upper end."""

    low: float
    high: float
    colour: str
    is_last: bool


def shades(layer: Layer) -> list[Shade]:
    """The classes of a layer's column, evenly spaced; none where all look the same."""
    if (span := layer.span) is None:
        return []
    low, high = span
    edges = [low + (high - low) * number / CLASSES for number in range(CLASSES)] + [high]
    stops = colours.ON_LIGHT[::-1] if layer.little_stands_out else colours.ON_LIGHT
    step = (len(stops) - 1) // (CLASSES - 1)
    return [
        Shade(edges[number], edges[number + 1], stops[number * step], number == CLASSES - 1)
        for number in range(CLASSES)
    ]


def colour(layer: Layer, value: float | None) -> str:
    """The colour of a row, RRGGBB, by its value of the layer's column."""
    found = shades(layer)
    if not found or value is None or not math.isfinite(value):
        return PLAIN.get(layer.name, OTHER)
    return next((its.colour for its in found if value < its.high), found[-1].colour)
