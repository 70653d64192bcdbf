"""Zones: named parts of the region, with corners in the scenario or in a file.

The file is GeoJSON, a format of :mod:`egvs.formats.vector_files`, or CSV with one row per corner: ``zone`` and ``x_m,
y_m`` (world frame), or longitude and latitude. Of a file with several areas, a zone takes those of its own name. World
frame, metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.core.errors import InputError
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import ZoneArea
from egvs.sensors import site_files
from egvs.world import footprints, geolocation

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

WEIGHTS_KEY = "score.weights.zones"
PLACEMENT_KEY = "placement.zones"

_MIN_CORNERS = 3


def weight_zones(scenario: Scenario) -> dict[str, BaseGeometry]:
    """Return the areas of ``[score.weights.zones]`` by name, as :func:`zone_areas`."""
    return zone_areas(scenario, scenario.score.weights.zones, WEIGHTS_KEY)


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


def _read_areas(path: Path, world: Georeference) -> dict[str, BaseGeometry]:
    """Return the areas of a file by name; parts of the same name are joined."""
    import shapely

    if path.suffix.lower() == ".csv":
        return _read_corners(path, world)
    parts: dict[str, list[BaseGeometry]] = {}
    for name, polygon in footprints.read_named_polygons(path, world):
        parts.setdefault(name, []).append(polygon)
    return {name: shapely.union_all(polygons) for name, polygons in parts.items()}


def _read_corners(path: Path, world: Georeference) -> dict[str, BaseGeometry]:
    """Return the polygons of a CSV with one row per corner, by name."""
    import shapely

    corners: dict[str, list[tuple[float, float]]] = {}
    for row in site_files.read_csv(path, world):
        name = str(row.columns.get("zone") or "").strip()
        if not name:
            raise InputError(row.where, "zone is missing", "Use the columns zone, x_m, y_m, one row per corner.")
        corners.setdefault(name, []).append(site_files.row_position_m(row))
    areas: dict[str, BaseGeometry] = {}
    for name, points in corners.items():
        if len(points) < _MIN_CORNERS:
            raise InputError(f"{path}: zone {name}", f"expected at least {_MIN_CORNERS} corners, got {len(points)}")
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
    names = list(names)
    listed = ", ".join(names[:most]) or "no area"
    return f"{listed} and {len(names) - most} more" if len(names) > most else listed
