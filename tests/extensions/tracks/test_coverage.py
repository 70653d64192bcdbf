"""The area that a recording could see: given, or estimated from tracks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.extensions.tracks import coverage
from egvs.extensions.tracks.cleaning import CleanTracks, clean_tracks
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.traffic.class_sizes import CLASS_SIZES
from tests.conftest import collection, feature
from tests.extensions.tracks.rows import make_tracks

REGION = Roi((0.0, 0.0, 0.0), (100.0, 50.0, 5.0))
WORLD = Georeference(None, REGION, "scenario.toml")
NO_LANES = np.empty((0, 2))


def square(x0_m: float, y0_m: float, x1_m: float, y1_m: float) -> dict[str, object]:
    ring = [[x0_m, y0_m], [x1_m, y0_m], [x1_m, y1_m], [x0_m, y1_m], [x0_m, y0_m]]
    return feature({"type": "Polygon", "coordinates": [ring]})


BOW_TIE = feature({"type": "Polygon", "coordinates": [[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]]})


def write(folder: Path, *features: dict[str, object], crs: str | None = None) -> Path:
    path = folder / "coverage.geojson"
    path.write_text(collection(*features, crs=crs))
    return path


def rectangle_of_tracks(vanish_at_m: float | None = None) -> CleanTracks:
    """Return tracks on ten parallel lines of 40 m, in y from 0 to 18 m; one may end at x."""
    rows = []
    for lane in range(10):
        stop_m = vanish_at_m if lane == 5 and vanish_at_m is not None else 40.0
        for k in range(int(stop_m) + 1):
            rows.append((f"t{lane}", "car", 100.0 * lane + 0.1 * k, float(k), 2.0 * lane))
    return clean_tracks(make_tracks(*rows), CLASS_SIZES)


def test_reads_coverage_polygon(tmp_path: Path) -> None:
    """Half of a region of 100 m x 50 m."""
    area = coverage.read(write(tmp_path, square(0, 0, 50, 50)), WORLD, REGION, NO_LANES)
    assert area.share == pytest.approx(0.5)
    np.testing.assert_array_equal(area.contains(np.array([[49.0, 25.0], [51.0, 25.0]])), [True, False])
    assert area.to_json() == {"source": "given", "share": 0.5, "of": "area of the region of interest"}


def test_several_polygons_are_joined(tmp_path: Path) -> None:
    path = write(tmp_path, square(0, 0, 50, 50), square(40, 0, 75, 50))
    assert coverage.read(path, WORLD, REGION, NO_LANES).share == pytest.approx(0.75)


def test_share_of_lanes(tmp_path: Path) -> None:
    """Three of four points of lanes are inside."""
    lanes_m = np.array([[10.0, 5.0], [20.0, 5.0], [30.0, 5.0], [60.0, 5.0]])
    area = coverage.read(write(tmp_path, square(0, 0, 50, 50)), WORLD, REGION, lanes_m)
    assert (area.share, area.of_lanes) == (0.75, True)


def test_degrees_are_converted(tmp_path: Path) -> None:
    frame = WorldFrame("EPSG:25832", (-500_000.0, -5_600_000.0))
    corners = frame.to_degrees(np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 50.0], [0.0, 50.0], [0.0, 0.0]]))
    polygon = feature({"type": "Polygon", "coordinates": [corners.tolist()]})
    path = write(tmp_path, polygon, crs="urn:ogc:def:crs:OGC:1.3:CRS84")
    world = Georeference(frame, REGION, "scenario.toml")
    assert coverage.read(path, world, REGION, NO_LANES).share == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "expected a GeoJSON FeatureCollection"),
        ("{", "is not valid JSON"),
        (json.dumps({"features": [], "crs": None}), "contains no valid polygon"),
        (collection(feature({"type": "Point", "coordinates": [1, 2]})), "contains no valid polygon"),
        (collection(feature({"type": "Polygon", "coordinates": [[[0, 0], [1]]]})), "feature 0"),
        (collection(BOW_TIE, square(0, 0, 5, 9)), "contains no valid polygon"),
        (collection(square(200, 0, 300, 50)), "covers no part of the region"),
        (collection(BOW_TIE), "contains no valid polygon"),
    ],
)
def test_rejects_damaged_file(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "coverage.geojson"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        coverage.read(path, WORLD, REGION, NO_LANES)


def test_estimate_is_the_hull_of_the_tracks() -> None:
    """Positions in 40 m x 18 m, widened by 2 m: 44 m x 22 m without the corners."""
    area = coverage.estimate(rectangle_of_tracks(), REGION, NO_LANES)
    assert area.area.area == pytest.approx(44 * 22 - (4 - np.pi) * 4, rel=0.01)
    assert area.share == pytest.approx(42 * 20 / 5000, rel=0.02)
    assert (area.hidden_ends, area.ends) == (0, 18)


def test_track_that_ends_inside_is_counted() -> None:
    """The sixth of ten lines, in the middle of a wide area, stops half way."""
    rows = []
    for lane in range(30):
        stop_m = 40.0 if lane == 15 else 80.0
        rows += [(f"t{lane}", "car", 100.0 * lane + 0.1 * k, float(k), 2.0 * lane) for k in range(int(stop_m) + 1)]
    area = coverage.estimate(clean_tracks(make_tracks(*rows), CLASS_SIZES), REGION, NO_LANES)
    assert area.hidden_ends == 1


def test_warns_of_small_share() -> None:
    (warning,) = coverage.estimate(rectangle_of_tracks(), REGION, NO_LANES).warnings("scenario.toml: traffic.tracks")
    assert "recorded positions cover about 17 % of the area of the region of interest" in str(warning)


def test_single_position_is_a_circle() -> None:
    tracks = clean_tracks(make_tracks(("a", "car", 0.0, 10.0, 10.0)), CLASS_SIZES)
    area = coverage.estimate(tracks, REGION, NO_LANES)
    assert area.area.area == pytest.approx(np.pi * 4, rel=0.02)
