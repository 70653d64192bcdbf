"""Zones: named parts of the region, with corners in the scenario or in a file.

The file is GeoJSON, a format of :mod:`egvs.formats.vector_files`, or CSV with one row per corner: ``zone`` and ``x_m,
y_m`` (world frame), or longitude and latitude. Of a file with several areas, a zone takes those of its own name. World
frame, metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.core import limits
from egvs.core.errors import Diagnostic, InputError, raise_together
from egvs.core.polygons import PairCount, check_crossings
from egvs.core.wording import format_percent, list_first
from egvs.formats import spreadsheets
from egvs.formats.georeference import Georeference
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scenario.score_config import ZoneArea
from egvs.sensors import site_files
from egvs.world import footprints, geolocation

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

WEIGHTS_KEY = "score.weights.zones"
REPORTED_KEY = "score.zones"
PLACEMENT_KEY = "placement.zones"

_MIN_CORNERS = 3
_MIN_OUTSIDE = 0.01
"""Of the area of a zone."""


def weight_zones(scenario: Scenario) -> dict[str, BaseGeometry]:
    """Return the areas of ``[score.weights.zones]`` by name, as :func:`zone_areas`."""
    return zone_areas(scenario, scenario.score.weights.zones, WEIGHTS_KEY)


def reported_zones(scenario: Scenario) -> dict[str, BaseGeometry]:
    """Return the areas of the file ``[score] zones`` by name, in the order of the file; empty without the key.

    Raises
    ------
    InputError
        When the file cannot be read, an area has no name, encloses nothing or crosses itself, or is outside the region
        of interest.
    """
    file = scenario.score.zones
    if file is None:
        return {}

    import shapely

    path = scenario.find(file, REPORTED_KEY)
    areas = _read_areas(path, geolocation.scenario_georeference(scenario), need_names=True)
    if not areas:
        raise InputError(path, "expected at least one area, got none", f"Draw one, or remove {REPORTED_KEY}.")
    (west_m, south_m), (east_m, north_m) = region_bounds_m(scenario)
    region = shapely.box(west_m, south_m, east_m, north_m)
    for name, area in areas.items():
        if not area.intersects(region):
            x_m, y_m = shapely.get_coordinates(area.centroid)[0].tolist()
            problem = f"expected an area in the region of interest, got one around x {x_m:g} m, y {y_m:g} m"
            hint = f"Use corners within x {west_m:g} to {east_m:g} m and y {south_m:g} to {north_m:g} m."
            raise InputError(f"{path}: zone {name}", problem, hint)
    return areas


def warn_partly_outside(scenario: Scenario) -> Iterator[Diagnostic]:
    """Warn about zones of ``[score] zones`` that reach out of the region of interest, where nobody is counted."""
    import shapely

    (west_m, south_m), (east_m, north_m) = region_bounds_m(scenario)
    region = shapely.box(west_m, south_m, east_m, north_m)
    outside = {
        name: 1.0 - area.intersection(region).area / area.area for name, area in reported_zones(scenario).items()
    }
    parts = [f"{format_percent(share, 0)} of {name}" for name, share in outside.items() if share > _MIN_OUTSIDE]
    if parts:
        problem = (
            f"these parts of zones are outside the region of interest, so nobody in them counts: {', '.join(parts)}"
        )
        yield Diagnostic(
            "zones outside", f"{SCENARIO_FILE}: {REPORTED_KEY}", problem, "Draw them smaller, or enlarge roi."
        )


def region_bounds_m(scenario: Scenario) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the south-western and the north-eastern corner of the region of interest, world frame."""
    x_m, y_m, _ = scenario.roi.center_m
    width_m, length_m, _ = scenario.roi.size_m
    return (x_m - width_m / 2, y_m - length_m / 2), (x_m + width_m / 2, y_m + length_m / 2)


def reported_settings(scenario: Scenario) -> dict[str, Any]:
    """Return the areas of ``[score] zones`` for keys and hashes; empty without the key."""
    areas = reported_zones(scenario)
    if not areas:
        return {}

    import shapely

    return {"zones": [[name, shapely.to_wkb(area, hex=True)] for name, area in areas.items()]}


def placement_zones(scenario: Scenario) -> dict[str, BaseGeometry]:
    """Return the areas of ``[placement.zones]`` by name, as :func:`zone_areas`."""
    return zone_areas(scenario, scenario.placement.zones, PLACEMENT_KEY)


def zone_areas(scenario: Scenario, zones: Mapping[str, ZoneArea], key: str) -> dict[str, BaseGeometry]:
    """Return the areas of zones by name: polygons in the world frame, metres, that may have holes or several parts.

    Parameters
    ----------
    scenario
        The scenario; file names are relative to its folder.
    zones
        The zones by name.
    key
        Their table in the scenario, for messages.

    Raises
    ------
    InputError
        When a file cannot be read, or has no valid area of the zone's name.
    """
    if not zones:
        return {}

    import shapely

    areas: dict[str, BaseGeometry] = {}
    polygons_by_file: dict[str, dict[str, BaseGeometry]] = {}
    for name, zone in zones.items():
        if zone.file is None:
            areas[name] = shapely.Polygon(zone.polygon_m)
            continue
        path = scenario.find(zone.file, f"{key}.{name}.file")
        if zone.file not in polygons_by_file:
            polygons_by_file[zone.file] = _read_areas(path, geolocation.scenario_georeference(scenario))
        areas[name] = _area_of_zone(name, polygons_by_file[zone.file], path)
    return areas


def file_settings(zones: Mapping[str, ZoneArea], areas: Mapping[str, BaseGeometry]) -> dict[str, Any]:
    """Return the areas that come from files, for keys and hashes; empty if there are none.

    Parameters
    ----------
    zones
        The zones by name.
    areas
        Their areas, from :func:`zone_areas`.
    """
    names = [name for name, zone in zones.items() if zone.file is not None]
    if not names:
        return {}

    import shapely

    return {"zone_files": {name: shapely.to_wkb(areas[name], hex=True) for name in names}}


def _read_areas(path: Path, world: Georeference, *, need_names: bool = False) -> dict[str, BaseGeometry]:
    """Return the areas of a file by name; parts of the same name are joined."""
    import shapely

    if path.suffix.lower() in spreadsheets.SUFFIXES:
        return _read_corners(path, world)
    parts: dict[str, list[BaseGeometry]] = {}
    for name, polygon in footprints.read_named_polygons(path, world, need_names=need_names):
        parts.setdefault(name, []).append(polygon)
    count = PairCount(path)
    for name, polygons in parts.items():
        check_crossings(polygons, f"{path}: zone {name}", count)
    return {name: shapely.union_all(polygons) for name, polygons in parts.items()}


def _read_corners(path: Path, world: Georeference) -> dict[str, BaseGeometry]:
    """Return the polygons of a CSV with one row per corner, by name."""
    import shapely

    corners: dict[str, list[tuple[float, float]]] = {}
    rows, errors = site_files.read_table(path, world)
    for row in rows:
        try:
            name = str(row.columns.get("zone") or "")
            if not name:
                raise InputError(row.where, "zone is missing", "Use the columns zone, x_m, y_m, one row per corner.")
            corners.setdefault(name, []).append(site_files.row_position_m(row))
        except InputError as error:
            errors.append(error)
    raise_together(errors, "zones")
    areas: dict[str, BaseGeometry] = {}
    for name, points in corners.items():
        if len(points) < _MIN_CORNERS:
            raise InputError(f"{path}: zone {name}", f"expected at least {_MIN_CORNERS} corners, got {len(points)}")
        limits.CORNERS.check(f"{path}: zone {name}", len(points))
        polygon = shapely.Polygon(points)
        if not polygon.is_valid:
            reason = shapely.is_valid_reason(polygon)
            problem = f"the corners do not enclose an area ({reason})"
            raise InputError(f"{path}: zone {name}", problem, "List the corners in their order around the zone.")
        areas[name] = polygon
    return areas


def _area_of_zone(name: str, areas: Mapping[str, BaseGeometry], path: Path) -> BaseGeometry:
    """Return the area of a zone's name, or the only one of its file."""
    if name in areas:
        return areas[name]
    if len(areas) == 1:
        return next(iter(areas.values()))
    raise InputError(path, f"expected an area named {name!r}, got {_listed(areas)}", "Name the zone as its area.")


def _listed(names: Iterable[str], most: int = 8) -> str:
    return list_first(list(names), most) or "no area"
