"""The area that a recording could see.

Occupancy outside it is unknown: boxes there are left out, and results say what share of the region of interest it is.
A user may state it. Otherwise it is estimated as the concave hull of all recorded positions, widened by the half width
of a lane. Tracks that begin or end well inside it show that something hid them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core import reading
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.core.wording import format_percent
from egvs.extensions.tracks.cleaning import CleanTracks
from egvs.formats.georeference import Georeference, declared_crs, geojson_coordinates

HULL_RATIO = 0.2
"""Concavity of the hull: 0 follows every point, 1 is convex (shapely.concave_hull)."""

MARGIN_M = 2.0
"""The hull of centres is widened by this much."""

INSIDE_M = 15.0
"""A track begins or ends inside if it does so farther than this from the edge."""

MIN_SHARE, MAX_HIDDEN_SHARE = 0.5, 0.25
"""A smaller share of the region, or a larger share of hidden ends, gets a warning."""

_MAX_POINTS = 20_000


@dataclass(frozen=True)
class Coverage:
    """What a recording could see.

    Attributes
    ----------
    area
        In the world frame, metres.
    is_given
        Whether the user stated it.
    share
        Share of the lanes in the region of interest; without a network, of its area.
    of_lanes
        Whether ``share`` is that of the lanes.
    hidden_ends, ends
        How many tracks begin or end well inside, and how many ends there are; 0 if the area is given.
    """

    area: BaseGeometry
    is_given: bool
    share: float
    of_lanes: bool
    hidden_ends: int = 0
    ends: int = 0

    def contains(self, xy_m: FloatArray) -> BoolArray:
        """Return whether points (n, 2) are inside, (n,)."""
        return _contains(self.area, xy_m)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON."""
        values = {
            "source": "given" if self.is_given else "estimated",
            "share": round(self.share, 4),
            "of": self._of_what,
        }
        if self.ends:
            values |= {"hidden_ends": self.hidden_ends, "ends": self.ends}
        return values

    @property
    def _of_what(self) -> str:
        return "lanes in the region of interest" if self.of_lanes else "area of the region of interest"

    def warnings(self, where: str) -> Iterator[Diagnostic]:
        """Warn about a small coverage, and about tracks that begin or end inside it."""
        if self.share < MIN_SHARE:
            kind = "the given coverage is" if self.is_given else "recorded positions cover about"
            problem = f"{kind} {format_percent(self.share, 0)} of the {self._of_what}; elsewhere the traffic is unknown"
            yield Diagnostic("coverage", where, problem, "Make the region smaller, or use more recordings.")
        if self.hidden_ends > MAX_HIDDEN_SHARE * max(self.ends, 1):
            problem = (
                f"{self.hidden_ends} of {self.ends} ends of tracks lie more than {INSIDE_M:g} m inside the recorded"
                " area: something hid the road users, or they parked or left the road there"
            )
            yield Diagnostic("coverage", where, problem, "State what the recording could see in traffic.coverage.")


def estimate(tracks: CleanTracks, region: Roi, lanes_m: FloatArray) -> Coverage:
    """Estimate the coverage of a recording from its positions.

    Parameters
    ----------
    tracks
        The tracks, in the world frame.
    region
        The region of interest.
    lanes_m
        Points of equal spacing on the lanes there, (n, 2); none without a network.
    """
    xy_m = np.column_stack([tracks.x_m, tracks.y_m])
    step = -(-len(xy_m) // _MAX_POINTS)
    hull = shapely.concave_hull(shapely.multipoints(xy_m[::step]), ratio=HULL_RATIO)
    area = shapely.union(hull, shapely.convex_hull(hull) if hull.area == 0 else hull).buffer(MARGIN_M)

    is_first = np.diff(tracks.track, prepend=-1) != 0
    is_last = np.append(is_first[1:], True)
    # the recording itself cuts the tracks that are there when it begins and ends
    begin_s, end_s = tracks.time_s.min(), tracks.time_s.max()
    step_s = max(tracks.report.step_s, 1e-6)
    is_first &= tracks.time_s > begin_s + step_s
    is_last &= tracks.time_s < end_s - step_s
    ends_m = np.concatenate([xy_m[is_first], xy_m[is_last]])
    points = shapely.points(ends_m)
    hidden = shapely.contains(area, points) & (shapely.distance(shapely.boundary(area), points) > INSIDE_M)
    return Coverage(area, False, _share(area, region, lanes_m), len(lanes_m) > 0, int(hidden.sum()), len(ends_m))


def read(path: Path, world: Georeference, region: Roi, lanes_m: FloatArray) -> Coverage:
    """Read a coverage from GeoJSON.

    Parameters
    ----------
    path
        A file with polygons.
    world
        The world frame.
    region, lanes_m
        As for :func:`estimate`.

    Raises
    ------
    InputError
        When the file is damaged, has no polygon, or does not cover any part of the region.
    """
    document = reading.read_json(path)
    where = str(path)
    hint = "Use a GeoJSON FeatureCollection with polygons of what the recording could see."
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(where, "expected a GeoJSON FeatureCollection", hint)
    features = document["features"]
    declared = declared_crs(document, where)
    coordinates = world.read_coordinates(geojson_coordinates(features), where, declared)
    areas = []
    for number, feature in enumerate(features):
        with reading.translate_errors(f"{where}: feature {number}", hint):
            areas.append(shapely.geometry.shape(feature["geometry"]))
    with reading.translate_errors(where, hint, "contains no valid polygon"):
        area = shapely.transform(shapely.unary_union(areas), coordinates.to_world)
    if area.is_empty or area.area == 0 or not area.is_valid:
        raise InputError(where, "contains no valid polygon", hint)
    if _share(area, region, np.empty((0, 2))) == 0:
        raise InputError(where, "covers no part of the region of interest", "Check its coordinates.")
    return Coverage(area, True, _share(area, region, lanes_m), len(lanes_m) > 0)


def _contains(area: BaseGeometry, xy_m: FloatArray) -> BoolArray:
    shapely.prepare(area)
    inside: BoolArray = shapely.intersects_xy(area, xy_m[:, 0], xy_m[:, 1])
    return inside


def _share(area: BaseGeometry, region: Roi, lanes_m: FloatArray) -> float:
    if len(lanes_m):
        return float(_contains(area, lanes_m).mean())
    (x_m, y_m), (width_m, depth_m) = region.origin_m[:2], region.size_m[:2]
    box = shapely.box(x_m, y_m, x_m + width_m, y_m + depth_m)
    return float(shapely.intersection(box, area).area / box.area)
