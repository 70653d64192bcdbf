"""Normals of the surfaces that a sweep meets, from the returns around each return in the grid of pulses."""

from __future__ import annotations

import math

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.beam_angles import BeamAngles

_APART_DEG = 0.8
"""Neighbours are at least this far away, so that range noise turns normals little."""
_MIN_STRAIGHT = math.cos(math.radians(30.0))
"""The lines to the neighbours above and below, and to the left and right, turn by at most this angle on one surface."""


def surface_normals(range_m: FloatArray, angles: BeamAngles) -> FloatArray:
    """Return the unit normal at each return, towards the sensor, (channels, azimuths, 3).

    The normal is perpendicular to the lines between the returns to the left and to the right, and above and below.

    Parameters
    ----------
    range_m
        Range of each pulse, (channels, azimuths), NaN without a return.
    angles
        Directions of the pulses.

    Returns
    -------
    ndarray
        NaN where one of the five returns is missing, or they are not on one surface.
    """
    order = angles.ascending
    # Channels with other azimuth offsets are shifted, so that a column has one azimuth, to half a step.
    offset_deg = angles.azimuth_offset_deg[order]
    shift = np.round((offset_deg - offset_deg[0]) / angles.grid_step_deg).astype(np.int64)
    to_azimuth = (np.arange(angles.azimuths)[None, :] - shift[:, None]) % angles.azimuths
    rays = np.take_along_axis(angles.directions()[order], to_azimuth[..., None], axis=1)
    ranges = np.take_along_axis(range_m[order], to_azimuth, axis=1)
    points = rays * ranges[..., None]
    columns = max(1, round(_APART_DEG / angles.grid_step_deg))
    left, right = np.roll(points, columns, axis=1), np.roll(points, -columns, axis=1)
    if not angles.is_full_circle:
        left[:, :columns] = np.nan
        right[:, -columns:] = np.nan
    elevation_deg = angles.elevation_deg[order]
    last = len(order) - 1
    below = points[np.clip(np.searchsorted(elevation_deg, elevation_deg - _APART_DEG, side="right") - 1, 0, last)]
    above = points[np.clip(np.searchsorted(elevation_deg, elevation_deg + _APART_DEG, side="left"), 0, last)]
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.cross(right - left, above - below)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        straight = np.minimum(_cosine(above - points, points - below), _cosine(right - points, points - left))
        away = (normal * rays).sum(axis=-1) > 0
    normal[away] *= -1.0
    normal[~(straight > _MIN_STRAIGHT)] = np.nan
    result = np.empty_like(normal)
    result[order[:, None], to_azimuth] = normal
    return result


def _cosine(a: FloatArray, b: FloatArray) -> FloatArray:
    cosine: FloatArray = (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    return cosine


def incidence_angles_deg(range_m: FloatArray, angles: BeamAngles) -> FloatArray:
    """Return the angle of incidence at each return, (channels, azimuths); NaN where the surface is not known."""
    cosine = -(surface_normals(range_m, angles) * angles.directions()).sum(axis=-1)
    incidence: FloatArray = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return incidence
