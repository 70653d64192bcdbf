"""Readers of exported files that share nothing with what writes them, and the map projection from its formulas."""

from __future__ import annotations

import math
import struct


def points_of_wkb(blob: bytes) -> list[tuple[float, float]]:
    """The positions of a geometry as Well-Known Binary without heights, in its order."""
    points, _ = _read(blob, 0)
    return points


def _read(blob: bytes, at: int) -> tuple[list[tuple[float, float]], int]:
    order = "<" if blob[at] else ">"
    (kind,) = struct.unpack_from(f"{order}I", blob, at + 1)
    at += 5
    if kind == 1:
        return [struct.unpack_from(f"{order}2d", blob, at)], at + 16
    (count,) = struct.unpack_from(f"{order}I", blob, at)
    at, points = at + 4, []
    for _ in range(count):
        if kind == 2:
            points.append(struct.unpack_from(f"{order}2d", blob, at))
            at += 16
        elif kind == 3:
            (corners,) = struct.unpack_from(f"{order}I", blob, at)
            at += 4
            for _ in range(corners):
                points.append(struct.unpack_from(f"{order}2d", blob, at))
                at += 16
        else:
            inner, at = _read(blob, at)
            points += inner
    return points, at


def points_of_gpkg(blob: bytes) -> list[tuple[float, float]]:
    """The same of a geometry of a GeoPackage, which has a header in front (GeoPackage 1.4, 2.1.3)."""
    assert blob[:2] == b"GP"
    envelope = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}[(blob[3] >> 1) & 7]
    return points_of_wkb(blob[8 + envelope :])


def utm32(lon_deg: float, lat_deg: float) -> tuple[float, float]:
    """Easting and northing in UTM zone 32 north on GRS 80 by Krüger's series (Karney 2011, Eq. 7 to 11, 35), to a
    micrometre."""
    a, f = 6378137.0, 1 / 298.257222101
    n = f / (2 - f)
    lam, phi = math.radians(lon_deg - 9.0), math.radians(lat_deg)
    e = math.sqrt(f * (2 - f))
    tau = math.sinh(math.asinh(math.tan(phi)) - e * math.atanh(e * math.sin(phi)))
    xi, eta = math.atan2(tau, math.cos(lam)), math.asinh(math.sin(lam) / math.hypot(tau, math.cos(lam)))
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    )
    north = xi + sum(c * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, c in enumerate(alpha, 1))
    east = eta + sum(c * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, c in enumerate(alpha, 1))
    radius = 0.9996 * a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return 500000.0 + radius * east, radius * north
