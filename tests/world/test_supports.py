"""Which solids of a world can carry a sensor, and the world without them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.stages.inputs import Inputs
from egvs.world.mesh import World
from egvs.world.supports import Supports, without_solids
from tests.conftest import collection, feature


def pole(x_m: float, kind: str = "pole", radius_m: float = 0.1) -> dict:
    point = {"type": "Point", "coordinates": [x_m, 0]}
    return feature(point, name=f"at_{x_m}", kind=kind, height_m=5, radius_m=radius_m)


def rectangle(length_m: float, width_m: float, turned_deg: float = 0.0) -> dict:
    """A sign around the origin."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * [length_m / 2, width_m / 2]
    cosine, sine = math.cos(math.radians(turned_deg)), math.sin(math.radians(turned_deg))
    ring = corners @ np.array([[cosine, sine], [-sine, cosine]])
    return feature({"type": "Polygon", "coordinates": [ring.tolist()]}, name="board", kind="sign", height_m=5)


def world_of(mini: Path, *solids: dict) -> World:
    (mini / "statics.geojson").write_text(collection(*solids))
    return Inputs(egvs.load(mini)).world


def names(world: World, x_m: float, y_m: float) -> list[str]:
    return [world.solids[solid][0] for solid in Supports.of(world).at(x_m, y_m)]


def test_only_poles_masts_and_signs_are_supports(mini: Path) -> None:
    kinds = ("pole", "mast", "sign", "Pole", "building", "tree_trunk", "barrier", "mast_arm")
    world = world_of(mini, *(pole(10.0 * i, kind) for i, kind in enumerate(kinds)))
    assert [bool(names(world, 10.0 * i, 0)) for i in range(len(kinds))] == [True] * 4 + [False] * 4


@pytest.mark.parametrize(("radius_m", "is_support"), [(0.1, True), (0.5, True), (0.51, False)])
def test_support_is_at_most_one_metre_across(mini: Path, radius_m: float, is_support: bool) -> None:
    assert bool(names(world_of(mini, pole(0.0, radius_m=radius_m)), 0, 0)) is is_support


@pytest.mark.parametrize("turned_deg", [0, 30, 45])
@pytest.mark.parametrize(("length_m", "is_support"), [(1.0, True), (1.01, False)])
def test_width_does_not_depend_on_orientation(mini: Path, length_m: float, turned_deg: float, is_support: bool) -> None:
    assert bool(names(world_of(mini, rectangle(length_m, 1.0, turned_deg)), 0, 0)) is is_support


@pytest.mark.parametrize(("x_m", "is_support"), [(0.0, True), (0.59, True), (0.6, True), (0.61, False)])
def test_support_is_within_half_a_metre_of_the_sensor_in_plan(mini: Path, x_m: float, is_support: bool) -> None:
    assert bool(names(world_of(mini, pole(0.0, radius_m=0.1)), x_m, 0)) is is_support


def test_world_without_solids_has_no_support(mini: Path) -> None:
    assert names(world_of(mini), 0, 0) == []


def test_world_without_a_solid_keeps_the_numbers_of_faces(mini: Path) -> None:
    world = world_of(mini, pole(0.0), pole(9.0))
    other = without_solids(world, (0,))
    assert other.solids == world.solids
    assert np.array_equal(other.solid_of_face, world.solid_of_face)
    is_removed = world.solid_of_face == 0
    assert np.array_equal(other.faces[~is_removed], world.faces[~is_removed])
    assert (np.ptp(other.triangles_m[is_removed], axis=1) == 0).all()
