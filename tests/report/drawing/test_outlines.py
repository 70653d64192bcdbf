"""Of very many small triangles, squares are drawn: they cover the triangles, and hardly more."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from egvs.report import basemap


def test_squares_cover_small_triangles_and_leave_large_ones_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    small = rng.uniform(1, 9, (200, 1, 2)) + rng.uniform(0, 0.4, (200, 3, 2))
    triangles = np.concatenate([small, [[[20.0, 1.0], [29.0, 1.0], [20.0, 9.0]]]])
    box = (0.0, 0.0, 30.0, 10.0)
    exact = basemap.union_of_triangles(triangles, box)
    assert exact.equals(shapely.union_all(shapely.polygons(triangles)))
    monkeypatch.setattr(basemap, "_MAX_SMALL_TRIANGLES", 199)
    drawn = basemap.union_of_triangles(triangles, box)
    assert drawn.buffer(1e-9).covers(exact)
    assert exact.buffer(2 * 0.25 * 2**0.5 + 0.4).covers(drawn)
    right = shapely.box(15, 0, 30, 10)
    assert shapely.intersection(drawn, right).equals(shapely.intersection(exact, right))
