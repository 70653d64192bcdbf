"""Longitude and latitude of tracks, converted to the UTM zone of their middle."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.tracks.model import TrackFrame
from egvs.formats.georeference import WGS84, WorldFrame, utm_epsg

_MAX_SPREAD_DEG = 1.0
_MAX_LAT_DEG = 84.0
_NORTH_STEP_DEG = 1e-5


def to_utm(
    lon_deg: FloatArray, lat_deg: FloatArray, error: Callable[[int, str], InputError], crs: str = WGS84
) -> tuple[FloatArray, TrackFrame]:
    """Convert longitude and latitude to easting and northing.

    Parameters
    ----------
    lon_deg, lat_deg
        Degrees, (n,), n > 0.
    error
        Makes the error for a row and a problem.
    crs
        The geographic coordinate reference system.

    Returns
    -------
    xy_m
        Easting and northing, (n, 2) float64.
    frame
        The UTM zone of the middle of all positions.

    Raises
    ------
    InputError
        For a position that is not on the Earth, or more than a degree from the middle of all.
    """
    middle_deg = float(np.median(lon_deg)), float(np.median(lat_deg))
    is_far = np.maximum(np.abs(lon_deg - middle_deg[0]), np.abs(lat_deg - middle_deg[1])) > _MAX_SPREAD_DEG
    for row in np.flatnonzero((np.abs(lat_deg) > _MAX_LAT_DEG) | (np.abs(lon_deg) > 180.0) | is_far):
        problem = f"longitude {lon_deg[row]:g}, latitude {lat_deg[row]:g} is no place near the other positions"
        raise error(int(row), problem)
    frame = WorldFrame(f"EPSG:{utm_epsg(*middle_deg)}")
    return frame.from_crs(np.column_stack([lon_deg, lat_deg]), crs), TrackFrame(frame.projection)


def grid_turn_rad(lon_deg: FloatArray, lat_deg: FloatArray, frame: TrackFrame) -> FloatArray:
    """Return by how much the grid of a frame is turned against true north, (n,) float64.

    Yaw from grid east = yaw from true east + this.

    Parameters
    ----------
    lon_deg, lat_deg
        Degrees (WGS 84), (n,).
    frame
        A projected frame.
    """
    projection = WorldFrame(str(frame.crs))
    here = projection.from_lon_lat(np.column_stack([lon_deg, lat_deg]))
    north = projection.from_lon_lat(np.column_stack([lon_deg, lat_deg + _NORTH_STEP_DEG])) - here
    return np.arctan2(-north[:, 0], north[:, 1])
