"""Scale and arrow have their sizes, and lie where no solid hides them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from egvs.core.grid import Roi
from egvs.explore import map_symbols
from egvs.world.mesh import World

ROI = Roi((100.0, 200.0, 0.0), (60.0, 40.0, 5.0))


@pytest.mark.parametrize(("longest_m", "length_m"), [(9.99, 5.0), (10.0, 10.0), (3.0, 2.0), (0.7, 0.5), (700.0, 500.0)])
def test_scale_is_a_round_length(longest_m: float, length_m: float) -> None:
    assert map_symbols.scale_length_m(longest_m) == length_m


def test_bar_and_arrow_have_their_lengths() -> None:
    bar, arrow = map_symbols.scale_mesh(20.0, 0.5).points, map_symbols.arrow_mesh(8.0).points
    assert (bar[:, 0].min(), bar[:, 0].max()) == (0.0, 20.0)
    assert arrow[arrow[:, 1].argmax()].tolist() == [0.0, 8.0, 0.0]


def house(low: tuple[float, float], high: tuple[float, float]) -> World:
    """A building of 8 m."""
    box = trimesh.creation.box(bounds=[(*low, 0.0), (*high, 8.0)])
    faces = np.asarray(box.faces, dtype=np.int32)
    return World(np.asarray(box.vertices), faces, np.zeros(len(faces), np.int32), (("house", "building"),))


def test_symbols_lie_in_the_middle_of_the_southern_edge() -> None:
    far_away = house((900.0, 900.0), (910.0, 910.0))
    assert map_symbols.clear_place_m(ROI, far_away, 10.0, 10.0) == (125.0, 188.5)


def test_symbols_avoid_a_building() -> None:
    x, y = map_symbols.clear_place_m(ROI, house((120.0, 150.0), (140.0, 200.0)), 10.0, 10.0)
    assert y == 188.5
    assert x + 10.0 < 120.0 or x > 140.0
