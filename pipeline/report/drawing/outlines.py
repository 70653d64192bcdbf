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
_MANY = 100_000
"""More small triangles of a kind than this are drawn as squares."""
_SMALL_M, _SQUARE_M = 0.5, 0.25
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
        shape = united(corners[of_kind], box)
        names, shapes = by_look[_look(kind, shape.area / len(np.unique(world.solid_of_face[of_kind])))]
        names.append(kind.replace("_", " "))
        shapes.append(shape)
    frame = shapely.box(box[0] - 1.0, box[1] - 1.0, box[2] + 1.0, box[3] + 1.0)
    return tuple(
        Outlines(look, tuple(names), tuple(_rings(shapely.intersection(shapely.union_all(shapes), frame))))
        for look, (names, shapes) in by_look.items()
        if names
    )


def united(triangles: NDArray[np.float64], box: Box) -> Any:
    """The area of triangles (n, 3, 2), a shapely geometry. Of very many, those that are small are drawn as squares: to
    unite hundreds of thousands that lie over one another takes minutes."""
    import shapely

    low, high = triangles.min(axis=1), triangles.max(axis=1)
    small = ((high - low) <= _SMALL_M).all(axis=1) & (low > box[:2]).all(axis=1) & (high < box[2:]).all(axis=1)
    if np.count_nonzero(small) <= _MANY:
        return shapely.union_all(shapely.polygons(triangles))
    first, last = (np.floor((at[small] - box[:2]) / _SQUARE_M).astype(np.int64) for at in (low, high))
    covered = np.zeros(last.max(axis=0) + 2, dtype=bool)
    for dx, dy in np.ndindex(*(last - first).max(axis=0) + 1):
        x, y = np.minimum(first + np.array([dx, dy]), last).T
        covered[x, y] = True
    edges = np.diff(covered.astype(np.int8), axis=1, prepend=0, append=0)
    (row, start), (_, end) = np.nonzero(edges == 1), np.nonzero(edges == -1)
    x0, y0 = box[:2]
    runs = shapely.box(x0 + row * _SQUARE_M, y0 + start * _SQUARE_M, x0 + (row + 1) * _SQUARE_M, y0 + end * _SQUARE_M)
    return shapely.union_all([*runs, shapely.union_all(shapely.polygons(triangles[~small]))])


def _look(kind: str, area_m2: float) -> str:
    if area_m2 < _SMALL_M2 and "crown" not in kind:
        return "small"
    return "green" if any(word in kind.lower() for word in _GREEN) else "large"


def _rings(shape: Any) -> Iterable[NDArray[np.float64]]:
    import shapely

    for part in shapely.get_parts(shape):
        if part.geom_type == "Polygon":
            yield from (shapely.get_coordinates(ring) for ring in (part.exterior, *part.interiors))
