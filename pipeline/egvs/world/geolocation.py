"""Where a scenario's world frame is on the Earth.

It is the projection and offset of ``[crs]``, or those of the SUMO network's ``<location>``, in which netconvert writes
how it converted longitude and latitude. If both are given, they are compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core.errors import InputError
from egvs.formats.georeference import MAX_SCALE_ERROR, Georeference, WorldFrame, utm_epsg
from egvs.scenario.model import Scenario
from egvs.traffic import network, sumo_folder
from egvs.traffic.network import Location

_TOLERANCE_M = 10.0
"""Different datums differ by less once transformed; a forgotten offset or a wrong zone by far more."""

_SAME_OFFSET_M = 0.01
"""SUMO writes offsets with two digits."""

_NO_PROJECTION = ("", "!")
"""SUMO's entries for a network that was not made from a map."""


def scenario_georeference(scenario: Scenario) -> Georeference:
    """Return where the world frame of a scenario is, if the scenario or its network tells.

    Parameters
    ----------
    scenario
        The scenario.

    Raises
    ------
    InputError
        When a projection is not in metres or distorts lengths, or when ``[crs]`` contradicts the network.
    """
    declared = _declared_frame(scenario)
    stated = network_location(scenario)
    from_network = None if stated is None else network_world_frame(stated.location)
    if from_network is not None:
        _check_network_scale(from_network, scenario)
    if declared is not None:
        _check_declared_scale(declared, scenario)
        if from_network is not None:
            _check_agreement(declared, from_network, scenario)
    return Georeference(declared or from_network, scenario.roi.box, str(scenario.file))


def world_frame_settings(scenario: Scenario) -> dict[str, Any]:
    """Return what :func:`scenario_georeference` depends on, for the cache key of a stage.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    dict
        The key ``world_frame``; empty if the position is unknown.
    """
    settings: dict[str, Any] = {}
    if scenario.crs.epsg is not None:
        settings["crs"] = [scenario.crs.epsg, *scenario.crs.offset_m]
    path = _network_path(scenario)
    if path is not None:
        location = network.read_location(path)
        if location is not None and location.projection not in _NO_PROJECTION:
            settings["location"] = [location.projection, *location.offset_m]
    return {"world_frame": settings} if settings else {}


def network_world_frame(location: Location | None) -> WorldFrame | None:
    """Return the frame that a network or a ``.poly.xml`` declares in its ``<location>``.

    Parameters
    ----------
    location
        The location.

    Returns
    -------
    WorldFrame, or None
        None if there is no location, or in a notation of SUMO's own that PROJ does not know.
    """
    if location is None or location.projection in _NO_PROJECTION:
        return None
    try:
        return WorldFrame.from_projection(location.projection, location.offset_m, "<location>")
    except InputError:  # "-" and ".": approximate projections of SUMO
        return None


@dataclass(frozen=True)
class StatedLocation:
    """The ``<location>`` of a SUMO file; ``file`` names it in messages."""

    file: str
    location: Location

    def check_same(self, other: StatedLocation, hint: str) -> None:
        """Raise an InputError, at this file, when another file states another offset or projection."""
        difference = location_difference(self.location, other.location)
        if difference:
            own, others = difference
            raise InputError(self.file, f"its <location> states {own}, but that of {other.file} {others}", hint)


def location_difference(location: Location, other: Location) -> tuple[str, str] | None:
    """Return how two files of SUMO state different world frames: both statements, or None where they agree.

    Nothing is converted: without a projection, nobody knows whether two offsets count from the same origin.

    >>> location_difference(Location("!", (30.0, 0.0)), Location("!", (0.0, 0.0)))
    ('netOffset 30,0', 'netOffset 0,0')
    """
    offset_m = np.subtract(location.offset_m, other.offset_m)
    same_offset = bool(np.abs(offset_m).max() <= _SAME_OFFSET_M)
    same_projection = _normalized_projection(location) == _normalized_projection(other)
    if same_offset and same_projection:
        return None
    own, others = _describe_offset(location), _describe_offset(other)
    if same_projection:
        return own, others
    return f"{own} and {_describe_projection(location)}", f"{others} and {_describe_projection(other)}"


def network_location(scenario: Scenario) -> StatedLocation | None:
    """Return the ``<location>`` of the network of a scenario; None if there is no network, or it states none."""
    path = _network_path(scenario)
    if path is None:
        return None
    location = network.read_location(path)
    return None if location is None else StatedLocation(f"the network {path.name}", location)


def _normalized_projection(location: Location) -> str:
    projection = " ".join(location.projection.split())
    return "" if projection in _NO_PROJECTION else projection


def _describe_offset(location: Location) -> str:
    x, y = location.offset_m
    return f"netOffset {x:.10g},{y:.10g}"


def _describe_projection(location: Location) -> str:
    projection = _normalized_projection(location)
    return f"projParameter {projection!r}" if projection else "no projection"


def _declared_frame(scenario: Scenario) -> WorldFrame | None:
    crs = scenario.crs
    if crs.epsg is None:
        return None
    return WorldFrame.from_projection(f"EPSG:{crs.epsg}", crs.offset_m, f"{scenario.file}: crs.epsg")


def _network_path(scenario: Scenario) -> Path | None:
    """The network, if the file exists: scans do not need it, and reading traffic reports that it is missing."""
    try:
        path = sumo_folder.network_path(scenario)
    except InputError:
        return None
    return path if path is not None and path.is_file() else None


def _check_declared_scale(frame: WorldFrame, scenario: Scenario) -> None:
    """Raise an InputError when the projection of ``[crs]`` distorts lengths at the region of interest."""
    x, y, _ = scenario.roi.center_m
    where = f"{scenario.file}: crs"
    scale = frame.scale_factor((x, y))
    if abs(scale - 1.0) <= MAX_SCALE_ERROR:
        return
    lon_deg, lat_deg = frame.to_degrees(np.array([[x, y]]))[0]
    if not np.isfinite(lon_deg + lat_deg):
        problem = f"the centre of roi, ({x:g}, {y:g}) minus offset_m, is outside the area of epsg = {scenario.crs.epsg}"
        raise InputError(where, problem, "Set offset_m to the network's netOffset, and roi.center_m in this system.")
    position = f"longitude {lon_deg:.5f}, latitude {lat_deg:.5f}"
    problem = f"epsg = {scenario.crs.epsg} scales lengths by {scale:.3g} at the region of interest ({position})"
    hint = f"Use a system with little distortion there, e.g. epsg = {utm_epsg(lon_deg, lat_deg)}, with its offset_m."
    raise InputError(where, problem, hint)


def _check_network_scale(frame: WorldFrame, scenario: Scenario) -> None:
    """Raise an InputError when the projection of the network distorts lengths at the region of interest."""
    x, y, _ = scenario.roi.center_m
    scale = frame.scale_factor((x, y))
    if abs(scale - 1.0) > MAX_SCALE_ERROR:
        problem = f"its <location> ({frame.projection}) scales lengths by {scale:.3g} at the region of interest"
        hint = "Use a projection with little distortion there, such as UTM (netconvert --proj.utm)."
        raise InputError(f"{scenario.file}: the network", problem, hint)


def _check_agreement(declared: WorldFrame, from_network: WorldFrame, scenario: Scenario) -> None:
    """Raise an InputError when ``[crs]`` and the network locate the region of interest differently."""
    centre = np.array([scenario.roi.center_m[:2]])
    lon_deg, lat_deg = from_network.to_degrees(centre)[0]
    distance_m = float(np.hypot(*(declared.from_lon_lat(from_network.to_degrees(centre)) - centre)[0]))
    if distance_m <= _TOLERANCE_M:
        return
    problem = (
        f"epsg = {declared.projection.removeprefix('EPSG:')} with offset_m = {list(declared.offset_m)} puts the"
        f" region of interest {distance_m:,.0f} m from where the network's <location> puts it"
        f" (longitude {lon_deg:.5f}, latitude {lat_deg:.5f})"
    )
    location = f"netOffset {list(from_network.offset_m)}, projParameter {from_network.projection!r}"
    raise InputError(f"{scenario.file}: crs", problem, f"Remove [crs], or make it agree: {location}.")
