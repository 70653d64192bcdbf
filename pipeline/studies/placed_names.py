"""Writes names beside the points of a figure, where they cover no other name and no marker."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_PLACES = (("left", 6, -11), ("right", -8, -11), ("left", 6, 6), ("right", -8, 6))


class PlacedNames:
    """The names in one panel, after ``figure.draw_without_rendering()``.

    Parameters
    ----------
    axes
        The panel.
    points
        Its markers in the panel's data, (n, 2).
    """

    def __init__(self, axes: Any, points: NDArray[np.float64]) -> None:
        self._axes, self._renderer = axes, axes.figure.canvas.get_renderer()
        self._taken = [text.get_window_extent(self._renderer) for text in axes.texts]
        self._markers = axes.transData.transform(points)

    def place(self, text: str, x: float, y: float, size: float = 7.5) -> bool:
        """Write one name where there is room round its point; whether there was."""
        for align, right, up in _PLACES:
            name = self._axes.annotate(
                text, (x, y), xytext=(right, up), textcoords="offset points", fontsize=size, ha=align, zorder=2,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
            )  # fmt: skip
            box = name.get_window_extent(self._renderer)
            hides = any(box.overlaps(other) for other in self._taken)
            hides = hides or any(box.contains(*marker) for marker in self._markers)
            if not hides and self._axes.bbox.containsx(box.x0) and self._axes.bbox.containsx(box.x1):
                self._taken.append(box)
                return True
            name.remove()
        return False
