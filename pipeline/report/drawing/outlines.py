"""The outlines of the static world seen from above, in world-frame metres (x east, y north).

Steps: project each solid's triangles, leave out the ground and what lies outside; unite the triangles of a kind; sort
the kinds by what they look like on a map; cut at the map's edge.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.report.drawing.map_frame import Box
from pipeline.world.mesh import World

_SMALL_M2 = 4.0
"""A solid with less footprint is street furniture."""
_GREEN = ("tree", "crown", "canopy", "hedge", "bush", "vegetation", "forest", "wood")


@dataclass(frozen=True)
class Outlines:
    """All outlines of one look (``large``, ``green`` or ``small``: the class of the style sheet): kinds in words, and
    closed rings (n, 2), world frame, metres, holes among them (even-odd).
    """

    look: str
    kinds: tuple[str, ...]
    rings: tuple[NDArray[np.float64], ...]


def outlines_of(world: World, box: Box) -> tuple[Outlines, ...]:
    """The outlines of the static world within ``box``, buildings first, trees last; without the ground."""
    import shapely

    corners = world.triangles_m[:, :, :2]
    low, high = world.bounds_xy_m
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area_m2 = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    shown = (area_m2 > 1e-6) & (high > box[:2]).all(axis=1) & (low < box[2:]).all(axis=1)
    kinds = (
        np.array([kind for _, kind in world.solids])[world.solid_of_face]
        if len(world.faces)
        else np.empty(0, dtype=str)
    )
    by_look: dict[str, tuple[list[str], list[Any]]] = {look: ([], []) for look in ("large", "small", "green")}
    for kind in sorted(set(kinds[shown].tolist()) - {"ground"}):
        of_kind = shown & (kinds == kind)
        shape = shapely.union_all(shapely.polygons(corners[of_kind]))
        names, shapes = by_look[_look(kind, shape.area / len(np.unique(world.solid_of_face[of_kind])))]
        names.append(kind.replace("_", " "))
        shapes.append(shape)
    frame = shapely.box(box[0] - 1.0, box[1] - 1.0, box[2] + 1.0, box[3] + 1.0)
    return tuple(
        Outlines(look, tuple(names), tuple(_rings(shapely.intersection(shapely.union_all(shapes), frame))))
        for look, (names, shapes) in by_look.items()
        if names
    )


def _look(kind: str, area_m2: float) -> str:
    if area_m2 < _SMALL_M2 and "crown" not in kind:
        return "small"
    return "green" if any(word in kind.lower() for word in _GREEN) else "large"


def _rings(shape: Any) -> Iterable[NDArray[np.float64]]:
    import shapely

    for part in shapely.get_parts(shape):
        if part.geom_type == "Polygon":
            yield from (shapely.get_coordinates(ring) for ring in (part.exterior, *part.interiors))
