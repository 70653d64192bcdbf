"""Repaired polygons equal those of GEOS; what would take long is refused with the name of its limit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.polygons import PairCount, check_crossings, check_edge_pairs, repair_polygon


def random_ring(corners: int, digits: int = 6, seed: int = 1) -> shapely.Polygon:
    return shapely.Polygon(np.random.default_rng(seed).random((corners, 2)).round(digits) * 10)


def star(corners: int) -> shapely.Polygon:
    step = next(step for step in range(corners // 2 - 1, 0, -1) if math.gcd(step, corners) == 1)
    angles = 2 * np.pi * step * np.arange(corners) / corners
    return shapely.Polygon(np.column_stack([np.cos(angles), np.sin(angles)]))


def comb(teeth: int, *knot: tuple[float, float]) -> shapely.Polygon:
    corners = [(i + x, y) for i in range(teeth) for x, y in ((0.0, 1.0), (0.0, 50.0), (0.5, 50.0), (0.5, 1.0))]
    return shapely.Polygon([*knot, *corners, (teeth, 0.0), (0.0, 0.0)])


def chain_of_bow_ties(corners: int) -> shapely.Polygon:
    there = [(float(i), float(i % 2)) for i in range(corners // 2)]
    return shapely.Polygon([*there, *((x, 1 - y) for x, y in reversed(there))])


def houses(rows: int, columns: int) -> shapely.MultiPolygon:
    return shapely.MultiPolygon([shapely.box(x, y, x + 1, y + 1) for x in range(columns) for y in range(rows)])


KNOT = ((-5.0, -5.0), (-4.0, -4.0), (-5.0, -4.0), (-4.0, -5.0))
SHAPES = {
    "bow tie": shapely.Polygon([(0, 0), (2, 2), (2, 0), (0, 2)]),
    "star": star(21),
    "comb with a knot": comb(30, *KNOT),
    "bow ties": chain_of_bow_ties(40),
    "ring that runs twice": shapely.Polygon([(0, 0), (9, 0), (9, 9), (0, 9)] * 2),
    "touches itself": shapely.Polygon([(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)]),
    "hole outside": shapely.Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(3, 3), (6, 3), (6, 6), (3, 6)]]),
    "nested holes": shapely.Polygon(
        shapely.box(-9, -9, 9, 9).exterior, [shapely.box(-i, -i, i, i).exterior for i in range(1, 6)]
    ),
    **{f"random {n}.{digits}": random_ring(n, digits, n) for n in (4, 5, 7, 12, 30) for digits in (1, 2, 6)},
}


def polygons(shape: BaseGeometry) -> BaseGeometry:
    """The polygons of a shape, in a fixed order; GEOS puts them beside lines."""
    areas = [part for part in shapely.get_parts(shape) if "Polygon" in part.geom_type]
    return shapely.normalize(shapely.MultiPolygon(list(shapely.get_parts(areas))))


@pytest.mark.parametrize("name", SHAPES)
def test_repaired_area_equals_that_of_geos(name: str) -> None:
    repaired = repair_polygon(SHAPES[name], name)
    assert repaired.is_valid and "Polygon" in repaired.geom_type
    assert shapely.equals_exact(polygons(repaired), polygons(shapely.make_valid(SHAPES[name])))


def test_keeps_valid_polygon_and_empties_flat_one() -> None:
    square = shapely.box(0, 0, 1, 1)
    assert repair_polygon(square, "a") is square
    assert repair_polygon(shapely.Polygon([(0, 0), (1, 1), (2, 2)]), "a").is_empty


def lines_of(*shapes: shapely.Polygon) -> list[BaseGeometry]:
    return [shape.exterior for shape in shapes]


@pytest.mark.parametrize(
    "check",
    [
        lambda: repair_polygon(random_ring(900), "a.json"),
        lambda: repair_polygon(star(901), "a.json"),
        lambda: check_edge_pairs(shapely.LineString([(i * 0.1, i % 2 * 50) for i in range(9000)]), "a.json", 1.6),
        lambda: check_edge_pairs(shapely.MultiPoint(np.zeros((900, 2))), "a.json", 1.0),
        lambda: check_crossings(
            lines_of(comb(400), shapely.transform(comb(400), lambda xy: xy[:, ::-1] * (8, 0.125))), "a.json"
        ),
    ],
    ids=["random corners", "star", "zigzag", "points", "crossed combs"],
)
def test_rejects_what_takes_long(check) -> None:
    message = r"^a\.json: has more than 100,000 pairs of edges .*The limit is .*; set EGVS_MAX_EDGE_PAIRS to raise it"
    with pytest.raises(InputError, match=message):
        check()


@pytest.mark.parametrize(
    ("work", "what"),
    [
        (lambda count: repair_polygon(random_ring(60), "a", count), "side by side"),
        (lambda count: repair_polygon(shapely.MultiPolygon([random_ring(60)] * 3), "a", count), "side by side"),
        (lambda count: check_edge_pairs(shapely.MultiPoint(np.zeros((60, 2))), "a", 1.0, count), "side by side"),
        (lambda count: check_crossings(lines_of(random_ring(60)), "a", count), "that cross"),
    ],
    ids=["rings", "parts", "points", "crossings"],
)
def test_pairs_of_one_file_are_added_up(monkeypatch: pytest.MonkeyPatch, work, what: str) -> None:
    monkeypatch.setenv(limits.EDGE_PAIRS.name, "9000")
    count = PairCount("a.json")
    work(count)
    message = rf"^a: has, with those before it in the file, more than 9,000 pairs of edges {what}\. The limit"
    with pytest.raises(InputError, match=message):
        for _ in range(100):
            work(count)


@pytest.mark.slow
def test_dense_lines_and_small_bad_rings_do_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(limits.EDGE_PAIRS.name, "10")
    count = PairCount()
    for _ in range(100):
        repair_polygon(SHAPES["bow tie"], "a", count)
        repair_polygon(SHAPES["bow ties"], "a", count)
        check_edge_pairs(shapely.LineString([(i * 0.5, 0.0) for i in range(100)]), "a", 1.0, count)
    assert not count.pairs.total()


def test_parts_are_repaired_one_by_one() -> None:
    """Houses that share walls all remain, and so does what two parts have in common."""
    assert repair_polygon(houses(20, 20), "a").equals(shapely.box(0, 0, 20, 20))
    overlapping = shapely.MultiPolygon([shapely.box(0, 0, 4, 4), shapely.box(2, 2, 6, 6)])
    assert repair_polygon(overlapping, "a").area == 16 + 16 - 4
    bow_tie = shapely.transform(SHAPES["bow tie"], lambda xy: xy + 10)
    mixed = shapely.MultiPolygon([*overlapping.geoms, bow_tie, shapely.Polygon([(0, 0), (1, 1), (2, 2)])])
    assert repair_polygon(mixed, "a").area == 28 + 2


@pytest.mark.slow
def test_accepts_long_valid_shapes() -> None:
    check_crossings([houses(40, 40)], "tiles")
    check_edge_pairs(shapely.LineString([(i * 0.01, math.sin(i * 0.001)) for i in range(50_000)]), "dense lane", 1.6)
    assert repair_polygon(comb(700), "comb").is_valid


@pytest.mark.parametrize("name", ["lanes", "outlines"])
def test_network_with_endless_crossings_is_rejected(name: str) -> None:
    from egvs.traffic.network import Junction, Lane, Permission

    points = np.random.default_rng(1).random((1500, 2)) * 100
    text = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
    where = "a.net.xml: here"
    shape = (
        Lane(text, where, None, 9.0, Permission(None, frozenset()))
        if name == "lanes"
        else Junction(text, where, "j", "priority", (0.0, 0.0), ())
    )
    with pytest.raises(InputError, match=r"^a\.net\.xml: here: has more than 100,000 pairs of edges side by side"):
        _ = shape.shape_m
