"""Footprints are built as they are given, repaired with a count, or rejected with a reason; none is dropped."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import DiagnosticsError, InputError
from egvs.world.footprints import to_polygons
from tests.conftest import collection, feature
from tests.world.static_worlds import COURT, FRAME, HOLE, SQUARE, build, build_located, polygon, volumes


@pytest.mark.parametrize(
    ("rings", "area"),
    [
        ([SQUARE], 16),
        ([SQUARE[::-1]], 16),
        ([COURT, HOLE], 300),
        ([COURT[::-1], HOLE[::-1]], 300),
        ([COURT, HOLE, [[11, 11], [12, 11], [11.5, 12], [11, 11]]], 299.5),
        ([COURT, [[10, 10], [15, 20], [20, 15], [10, 10]]], 400 - 37.5),  # the hole touches the ring in a point
        ([[[0, 0], [10, 0], [10, 10], [5, 1], [0, 10], [0, 0]]], 100 - 45),
        ([[[0, 0], [1000, 0], [1000, 1e-6], [0, 0]]], 5e-4),
    ],
)
def test_prism_is_closed_and_has_its_volume(tmp_path, rings, area):
    world, counts = build(tmp_path, polygon(*rings, base_m=2.5, height_m=7.0))
    assert world.closed.all()
    assert volumes(world) == pytest.approx([area * 4.5], rel=1e-9)
    assert world.triangles_m[..., 2].min() == 2.5
    assert world.triangles_m[..., 2].max() == 7.0
    assert not counts.repaired
    assert not counts.ignored


def test_points_are_discs_and_lines_are_strips(tmp_path):
    world, counts = build(
        tmp_path,
        feature({"type": "Point", "coordinates": [5, 5]}, height_m=3, radius_m=0.5, kind="pole"),
        feature(
            {"type": "LineString", "coordinates": [[0, 0], [10, 0], [10, 10]]}, height_m=1, radius_m=0.25, kind="wall"
        ),
        feature({"type": "MultiPoint", "coordinates": [[20, 5], [22, 5]]}, height_m=3, radius_m=0.5, kind="pole"),
    )
    assert world.closed.all()
    disc = 16 / 2 * 0.25 * math.sin(2 * math.pi / 16) * 3
    assert volumes(world)[[0, 2, 3]] == pytest.approx([disc] * 3, rel=1e-12)
    assert volumes(world)[1] == pytest.approx(10.0, rel=0.02)  # the bend is mitred, the ends are flat
    assert counts.built == {"pole": 3, "wall": 1}


@pytest.mark.parametrize(
    ("features", "repaired", "area"),
    [
        ([polygon([[0, 0], [4, 0], [4, 0], [4, 4], [4, 4], [4, 4], [0, 4], [0, 0]])], {"doubled points": 3}, [16]),
        # two triangles that share a corner, as one ring
        (
            [polygon([[0, 0], [4, 0], [2, 2], [4, 4], [0, 4], [2, 2], [0, 0]])],
            {"rings that touched themselves": 1},
            [4, 4],
        ),
        # the same, with a line to one side of it: what is mended is a collection, in which several polygons are one
        (
            [polygon([[0, 0], [4, 0], [2, 2], [4, 4], [0, 4], [2, 2], [0, 0], [0, -3], [0, 0]])],
            {"rings that touched themselves": 1},
            [4, 4],
        ),
        # a ring that runs round its own hole and back through a point
        (
            [polygon([[0, 0], [9, 0], [9, 9], [0, 9], [0, 0], [2, 3], [3, 6], [6, 3], [0, 0]])],
            {"rings that touched themselves": 1},
            [81 - 12],
        ),
    ],
)
def test_repairs_and_counts_unambiguous_rings(tmp_path, features, repaired, area):
    world, counts = build(tmp_path, *features)
    assert dict(counts.repaired) == repaired
    assert world.closed.all()
    assert sorted(volumes(world)) == pytest.approx(sorted(5 * a for a in area), rel=1e-12)


@pytest.mark.parametrize(
    ("geometry", "reason"),
    [
        ({"type": "Polygon", "coordinates": [[[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]]]}, "Self-intersection"),
        ({"type": "Polygon", "coordinates": [SQUARE, [[9, 9], [9, 10], [10, 9], [9, 9]]]}, "Hole lies outside"),
        ({"type": "Polygon", "coordinates": [SQUARE, [[2, 2], [9, 2], [2, 9], [2, 2]]]}, "not a valid polygon"),
        (
            {"type": "Polygon", "coordinates": [COURT, HOLE, [[16, 16], [17, 16], [16, 17], [16, 16]]]},
            "Holes are nested",
        ),
        (
            {"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [2, 0], [0, 0]]]},
            "not a valid polygon|encloses no area",
        ),
        (
            {"type": "Polygon", "coordinates": [[[1, 1], [1, 1], [1, 1], [1, 1]]]},
            "not a valid polygon|encloses no area",
        ),
        ({"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [0, 0]]]}, "not a valid polygon"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [math.nan, 0], [4, 4], [0, 0]]]}, "expected finite coordinates"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [math.inf, 0], [4, 4], [0, 0]]]}, "expected finite coordinates"),
        ({"type": "Polygon", "coordinates": []}, "is empty"),
        ({"type": "MultiPolygon", "coordinates": [[SQUARE], [SQUARE]]}, "not a valid polygon"),
        ({"type": "GeometryCollection", "geometries": []}, "is empty"),
        ({"type": "Polygon", "coordinates": [[[0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 0, 1]]]}, "z coordinates"),
        ({"type": "Point", "coordinates": [1, 1]}, "radius_m is missing"),
        ({"type": "Curve", "coordinates": [1, 1]}, "expected a GeoJSON geometry"),
        (None, "expected a GeoJSON geometry"),
    ],
)
def test_rejects_invalid_geometry(tmp_path, geometry, reason):
    with pytest.raises(InputError, match=rf"s\.geojson: feature 1 \(bad\).*({reason})"):
        build(tmp_path, polygon(SQUARE), feature(geometry, height_m=3, name="bad"))


def test_closes_open_ring(tmp_path):
    assert volumes(build(tmp_path, polygon(SQUARE[:-1]))[0]) == pytest.approx([80], rel=1e-12)


@pytest.mark.parametrize(
    "values", [{"height_m": 0}, {"height_m": 2, "base_m": 3}, {"height_m": "5"}, {"height_m": None}, {"height_m": True}]
)
def test_rejects_invalid_heights(tmp_path, values):
    with pytest.raises(InputError, match="height_m"):
        build(tmp_path, polygon(SQUARE, **values))


def test_converts_and_counts_features_in_degrees(tmp_path):
    """Radii and heights stay metres; what is null is as if it were not there, as a GIS writes it."""
    square, lamp = [FRAME.to_degrees(np.array(some, dtype=float)).tolist() for some in (SQUARE, [[9, 9]])]
    more = {"name": None, "kind": None, "base_m": None}
    degrees = (polygon(square, **more), feature({"type": "Point", "coordinates": lamp[0]}, height_m=5, radius_m=0.1))
    metres = (polygon(SQUARE), feature({"type": "Point", "coordinates": [9, 9]}, height_m=5, radius_m=0.1))
    (tmp_path / "s.geojson").write_text(collection(*degrees, crs="OGC:CRS84"))
    world, counts = build_located(tmp_path, footprints=["s.geojson"])
    assert np.array_equal(world.vertices_m, build(tmp_path, *metres)[0].vertices_m)
    assert counts.repaired == {"features in WGS 84 (CRS84), brought into the world frame": 2}
    assert world.solids[0] == ("s_0", "footprint")


def test_drops_and_counts_lines_next_to_polygon(tmp_path):
    """GDAL makes a collection of a polygon whose thin corner fell together."""
    thin = {"type": "LineString", "coordinates": [[4, 4], [6, 4]]}
    both = {"type": "GeometryCollection", "geometries": [{"type": "Polygon", "coordinates": [SQUARE]}, thin]}
    world, counts = build(tmp_path, feature(both, height_m=3))
    assert volumes(world) == pytest.approx([48], rel=1e-12)
    assert counts.repaired == {"lines and points beside polygons, left out": 1}


def test_repairs_rings_that_cross_due_to_rounding_only(tmp_path):
    """A notch of 1 cm is turned over by 6 digits of a degree; a bow-tie crosses whatever the digits."""
    notched = [[0, 0], [4, 0], [4, 4], [2.01, 4], [2.0, -0.02], [1.99, 4], [0, 4], [0, 0]]
    (tmp_path / "s.geojson").write_text(
        collection(polygon(FRAME.to_degrees(np.array(notched)).tolist()), crs="OGC:CRS84")
    )
    world, counts = build_located(tmp_path, footprints=["s.geojson"])
    assert counts.repaired["rings that rounded degrees made cross"] == 1
    assert volumes(world).sum() == pytest.approx(80, rel=0.01)
    with pytest.raises(InputError, match="is not a valid polygon"):
        build(tmp_path, polygon(notched))
    tie = FRAME.to_degrees(np.array([[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]], dtype=float)).tolist()
    (tmp_path / "s.geojson").write_text(collection(polygon(tie), crs="OGC:CRS84"))
    with pytest.raises(InputError, match="is not a valid polygon"):
        build_located(tmp_path, footprints=["s.geojson"])


def test_reports_all_wrong_features_at_once(tmp_path: Path) -> None:
    """Twenty by name, then how many more; what ``egvs new`` notes beside a height is no misspelt height."""
    wrong = [polygon(SQUARE, name=f"w{number}", height_m=None, height_from="levels") for number in range(23)]
    with pytest.raises(DiagnosticsError) as caught:
        build(tmp_path, polygon(SQUARE), polygon(SQUARE, height_m="tall", name="t"), *wrong)
    messages = [str(finding) for finding in caught.value.findings]
    assert len(messages) == 21
    assert "feature 1 (t): height_m: expected metres, at most 1e+08, got 'tall'" in messages[0]
    assert "feature 2 (w0): height_m is missing" in messages[1]
    assert "4 more invalid features" in messages[-1]


@pytest.mark.parametrize("kind", ["Polygon", "LineString", "MultiPoint"])
def test_number_of_edges_side_by_side_has_a_limit(kind):
    """Two thousand corners have a million crossings, which took a minute to repair; ten thousand took all memory."""
    angle = np.pi * 2 * (999 * np.arange(2000) % 2001) / 2001
    star = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle)]).round(6).tolist()
    star.append(star[0])
    geometry = {"type": kind, "coordinates": [star] if kind == "Polygon" else star}
    with pytest.raises(InputError, match=r"100,000 pairs of edges side by side\. The limit is .*EGVS_MAX_EDGE_PAIRS"):
        to_polygons(geometry, {"radius_m": 20}, "star", Counter(), keep_crossing_parts=True)


def test_number_of_corners_has_a_limit(tmp_path, monkeypatch):
    """The time to triangulate a polygon can grow with the cube of its holes: 200,000 would take hours."""
    holes = [[[x, 1], [x, 2], [x + 0.5, 2], [x + 0.5, 1], [x, 1]] for x in range(1, 10)]
    walls = polygon([[0, 0], [20, 0], [20, 20], [0, 20], [0, 0]], *holes, height_m=3)
    monkeypatch.setenv("EGVS_MAX_CORNERS", "40")
    world, _ = build(tmp_path, walls)
    assert volumes(world) == pytest.approx([3 * (400 - 9 * 0.5)])
    monkeypatch.setenv("EGVS_MAX_CORNERS", "39")
    message = r"has 40 corners\. The limit is 39 corners; set EGVS_MAX_CORNERS to raise it"
    with pytest.raises(DiagnosticsError, match=message):
        build(tmp_path, walls)


def test_pairs_of_edges_add_up_over_a_file(tmp_path, monkeypatch):
    """One wall that runs back and forth is built; of ten, those that are too many are rejected."""
    zigzag = {"type": "LineString", "coordinates": [[0.01 * x, 10 * (x % 2)] for x in range(40)]}
    wall = feature(zigzag, height_m=1, radius_m=0.25)
    monkeypatch.setenv("EGVS_MAX_EDGE_PAIRS", "5000")
    build(tmp_path, wall)
    message = r"feature 4 .* has, with those before it in the file, more than 5,000 pairs of edges side by side"
    with pytest.raises(DiagnosticsError, match=message):
        build(tmp_path, *[wall] * 10)
