"""Tells where a scenario's world frame lies on the Earth.

Steps: take the projection and offset of ``[crs]``, or those of the SUMO network's ``<location>`` (netconvert wrote
there what it did to longitude and latitude); where both are given, hold them against one another.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import files
from egvs.core.errors import InputError
from egvs.formats.georeference import MAX_SCALE_ERROR, Georeference, WorldFrame, utm_epsg
from egvs.scenario.model import Scenario
from egvs.traffic import network, sumo, sumo_folder
from egvs.traffic.network import Location

_TOLERANCE_M = 10.0
"""Datums of one place differ by less, once transformed; a forgotten offset or another zone by far more."""

_NO_PROJECTION = ("", "!")
"""What SUMO writes where a network was not made from a map."""


def scenario_georeference(scenario: Scenario) -> Georeference:
    """Where the world frame lies, if the scenario or its network says it; a network of OpenStreetMap is converted.

    InputError where ``[crs]`` names nothing that fits: no projection in metres, one that stretches lengths, or another
    place than the network says; or where the network's own projection stretches lengths.
    """
    stated, own = _declared_frame(scenario), _network_frame(scenario)
    box, place = scenario.roi.box, str(scenario.file)
    if own is not None:
        _check_network(own, scenario)
    if stated is not None:
        _check_stretch(stated, scenario)
        if own is not None:
            _check_agreement(stated, own, scenario)
    return Georeference(stated or own, box, place)


def world_frame_settings(scenario: Scenario) -> dict[str, Any]:
    """What :func:`scenario_georeference` depends on, as a stage's settings hold it: ``world_frame``, or nothing where
    it is not known.

    No map is converted for it.
    """
    found: dict[str, Any] = {}
    if scenario.crs.epsg is not None:
        found["crs"] = [scenario.crs.epsg, *scenario.crs.offset_m]
    if (path := _network_path(scenario)) is not None:
        if network.is_osm(path):
            found |= {"map": files.hash_file(path), "sumo": sumo.sumo_version()}
        elif (location := network.read_location(path)) is not None and location.projection not in _NO_PROJECTION:
            found["location"] = [location.projection, *location.offset_m]
    return {"world_frame": found} if found else {}


def network_world_frame(location: Location | None) -> WorldFrame | None:
    """The frame of a network, or of a ``.poly.xml``, that says where it lies; None where it does not, or in SUMO's own
    words that PROJ does not know."""
    if location is None or location.projection in _NO_PROJECTION:
        return None
    try:
        return WorldFrame.from_projection(location.projection, location.offset_m, "<location>")
    except InputError:  # "-", ".": SUMO's own rough projections
        return None


def _declared_frame(scenario: Scenario) -> WorldFrame | None:
    crs = scenario.crs
    if crs.epsg is None:
        return None
    return WorldFrame.from_projection(f"EPSG:{crs.epsg}", crs.offset_m, f"{scenario.file}: crs.epsg")


def _network_path(scenario: Scenario) -> Path | None:
    """The network's file, where it is there: a scan needs none, and who reads traffic tells that it is missing."""
    try:
        path = sumo_folder.network_path(scenario)
    except InputError:
        return None
    return path if path is not None and path.is_file() else None


def _network_frame(scenario: Scenario) -> WorldFrame | None:
    if (path := _network_path(scenario)) is None:
        return None
    if network.is_osm(path):
        status = path.stat()
        return network_world_frame(_converted_location(path, status.st_mtime_ns, status.st_size))
    return network_world_frame(network.read_location(path))


@lru_cache(maxsize=4)
def _converted_location(path: Path, changed_ns: int, size: int) -> Location | None:
    """Where netconvert puts a map; the file's time and size tell one map from another under the same name."""
    del changed_ns, size
    with files.temporary_folder() as folder:
        made = folder / sumo_folder.NETWORK_FILE
        sumo_folder.convert_osm(path, made)
        return network.read_location(made)


def _check_stretch(frame: WorldFrame, scenario: Scenario) -> None:
    x, y, _ = scenario.roi.center_m
    place, stretch = f"{scenario.file}: crs", frame.scale_factor((x, y))
    if abs(stretch - 1.0) <= MAX_SCALE_ERROR:
        return
    lon_deg, lat_deg = frame.to_degrees(np.array([[x, y]]))[0]
    if not np.isfinite(lon_deg + lat_deg):
        found = f"epsg = {scenario.crs.epsg} has no place ({x:g}, {y:g}) less offset_m, the centre of roi"
        raise InputError(place, found, "the network's netOffset as offset_m, or roi.center_m in this system")
    found = (
        f"epsg = {scenario.crs.epsg} draws lengths {stretch:.3g} times as long at the region of interest"
        f" (longitude {lon_deg:.5f}, latitude {lat_deg:.5f})"
    )
    right = f"a system that keeps lengths there, for example epsg = {utm_epsg(lon_deg, lat_deg)}, with its offset_m"
    raise InputError(place, found, right)


def _check_network(network_frame: WorldFrame, scenario: Scenario) -> None:
    x, y, _ = scenario.roi.center_m
    if abs((stretch := network_frame.scale_factor((x, y))) - 1.0) > MAX_SCALE_ERROR:
        found = (
            f"its <location> ({network_frame.projection}) draws lengths {stretch:.3g} times as long at the "
            f"region of interest"
        )
        right = "a projection that keeps lengths there: netconvert takes UTM for a map (--proj.utm)"
        raise InputError(f"{scenario.file}: the network", found, right)


def _check_agreement(declared: WorldFrame, network_frame: WorldFrame, scenario: Scenario) -> None:
    centre = np.array([scenario.roi.center_m[:2]])
    lon_deg, lat_deg = network_frame.to_degrees(centre)[0]
    apart_m = float(np.hypot(*(declared.from_degrees(network_frame.to_degrees(centre)) - centre)[0]))
    if not apart_m <= _TOLERANCE_M:
        found = (
            f"epsg = {declared.projection.removeprefix('EPSG:')} with offset_m = {list(declared.offset_m)} puts the"
            f" region of interest {apart_m:,.0f} m from where the network's <location> puts it"
            f" (longitude {lon_deg:.5f}, latitude {lat_deg:.5f})"
        )
        right = (
            f"no [crs], or one that agrees: netOffset {list(network_frame.offset_m)}, projParameter "
            f"{network_frame.projection!r}"
        )
        raise InputError(f"{scenario.file}: crs", found, right)
