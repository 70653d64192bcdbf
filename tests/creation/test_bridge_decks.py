"""Decks of bridges: where a lane is high above the ground, closed, as thick and wide as stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from egvs.creation.map_parts import MappedMesh
from egvs.creation.terrain.bridge_decks import CLEARANCE_M, EDGE_M, THICKNESS_M, bridge_decks
from egvs.creation.terrain.draping import drape_network, roads_above_others
from egvs.creation.terrain.ground_heights import ground_points
from egvs.formats import ply
from egvs.traffic import network
from egvs.world import terrain
from tests.creation.draped_roads import VALLEY, Function, build

LANE = '<net><edge id="a"><lane id="a_0" shape="{}" width="{}"/></edge></net>'
ZERO = Function(lambda x, y: np.zeros(len(x)))


def solid(mesh: MappedMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)


def test_slab_lies_below_the_lane() -> None:
    """40 m of a lane of 4 m that climbs from 3 m to 5 m: 40 x 5 x 1 m."""
    (deck,) = bridge_decks(LANE.format("0,0,3 40,0,5", 4), ZERO, 0.0)
    assert (deck.name, deck.kind, deck.is_closed) == ("deck_a_0_0", "bridge", True)
    found = solid(deck)
    assert found.is_watertight and found.volume == pytest.approx(40 * (4 + 2 * EDGE_M) * THICKNESS_M)
    assert found.bounds == pytest.approx(np.array([[0, -2.5, 2], [40, 2.5, 5]]))


def test_slab_of_a_bend_is_closed() -> None:
    angle = np.linspace(0, np.pi / 2, 10)
    shape = " ".join(f"{30 * np.cos(a):.4f},{30 * np.sin(a):.4f},6" for a in angle)
    (deck,) = bridge_decks(LANE.format(shape, 3), ZERO, 0.0)
    assert solid(deck).is_watertight
    assert solid(deck).volume == pytest.approx(30 * np.pi / 2 * 4, rel=0.02)


def test_only_stretches_above_the_clearance_have_a_deck() -> None:
    """The lane is level at z = 0; the ground falls below it by 10 m between x = 40 and 60; unknown after 200 m."""
    ditch = Function(lambda x, y: np.where(x > 200, np.nan, np.where((x > 40) & (x < 60), 90.0, 100.0)))
    (deck,) = bridge_decks(LANE.format("0,0 300,0", 3), ditch, 100.0)
    assert solid(deck).bounds[:, 0].tolist() == [40, 60]  # one sample into the ground at each end
    low = Function(lambda x, y: np.full(len(x), -CLEARANCE_M))
    assert bridge_decks(LANE.format("0,0 300,0", 3), low, 0.0) == ()
    assert bridge_decks("<net/>", low, 0.0) == ()


@pytest.mark.slow
@pytest.mark.system
def test_bridge_over_a_valley_is_a_deck_and_the_ground_goes_below(tmp_path: Path) -> None:
    from shapely.geometry import box

    draped = drape_network(build(tmp_path), VALLEY, (0.0, 0.0), {"bc": 1, "-bc": 1})
    assert set(roads_above_others(draped.text)) == {
        (upper, lower) for upper in ("bc", "-bc") for lower in ("uv", "-uv")
    }
    decks = bridge_decks(draped.text, VALLEY, draped.zero_height_m)
    lanes = {deck.name.rpartition("_")[0].removeprefix("deck_") for deck in decks}
    assert lanes == {"bc_0", "bc_1", "-bc_0"} and all(solid(deck).is_watertight for deck in decks)
    middle = next(solid(deck) for deck in decks if deck.name.startswith("deck_bc_0"))
    ends_m = VALLEY.of(np.array([100.0]), np.zeros(1))[0] - draped.zero_height_m
    assert middle.bounds[:, 2] == pytest.approx([ends_m - THICKNESS_M, ends_m], abs=0.01)

    (tmp_path / "draped.net.xml").write_text(draped.text)
    points = ground_points(VALLEY, box(0, -100, 300, 100), 5.0) - np.array([0, 0, draped.zero_height_m])
    ply.write(tmp_path / "terrain.ply", points)
    ground = terrain.triangulate_ground(network.read_net_xml(tmp_path / "draped.net.xml"), beyond_m=points)
    x = np.linspace(130, 170, 9)
    below = ground.height_m(x, np.zeros(9))
    assert below == pytest.approx(VALLEY.of(x, np.zeros(9)) - draped.zero_height_m, abs=0.2)
    assert not roads_above_others(drape_network(build(tmp_path), VALLEY, (0.0, 0.0)).text)
