"""The region of interest and its grid of voxels.

A grid has an ``origin_m`` (world frame, metres), a ``voxel_m`` (edge length) and a ``shape`` (voxels along x, y, z).
Voxel (ix, iy, iz) is the half-open box [origin + i * voxel, origin + (i + 1) * voxel) on each axis.

The grid's own frame has its zero at ``origin_m``. Every position is first moved there in float64, so that a scene far
from the world's zero loses no digits.

:meth:`Grid.segments` converts a sensor and its beams to voxel units. Decimals are used as they are written (0.3 m are
three voxels of 0.1 m, though 0.3 / 0.1 is 2.9999999999999996), and a coordinate within ``PLANE_TOLERANCE_M`` of a plane
between voxels is on it. So moving a scene by 0.1 m does not change which voxels its beams cross.

The paper (arXiv 2504.06772, Eq. 1) prints the number of voxels as the *sum* w/d + l/d + h/d; it is the product.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.core.limits import VOXELS

PLANE_TOLERANCE_M = 1e-9
"""A coordinate this close to a plane between voxels is on the plane."""

FloatArray = NDArray[np.float64]
"""Array of float64, of the shape that each docstring states."""

IntArray = NDArray[np.int64]
"""Array of int64, of the shape that each docstring states."""

BoolArray = NDArray[np.bool_]
"""Array of bool, of the shape that each docstring states."""

XY = tuple[float, float]
"""x, y in metres."""

Vec3 = tuple[float, float, float]
"""Three numbers along x, y, z."""


@dataclass(frozen=True)
class Roi:
    """The region of interest: an axis-aligned box in the world frame, without a voxel size."""

    origin_m: Vec3
    size_m: Vec3

    @classmethod
    def around(cls, center_m: Vec3, size_m: Vec3) -> Roi:
        """Return the box of ``size_m`` around ``center_m``; its corner is computed in decimals and rounded once."""
        x, y, z = (float(_as_fraction(c) - _as_fraction(s) / 2) for c, s in zip(center_m, size_m, strict=True))
        return cls((x, y, z), size_m)


@dataclass(frozen=True)
class Grid:
    """A regular grid of cubes over the region of interest.

    Examples
    --------
    >>> roi = Roi.around((0.0, 0.0, 1.5), (60.0, 40.0, 3.0))
    >>> Grid.over(roi, voxel_m=0.5)
    Grid(origin_m=(-30.0, -20.0, 0.0), voxel_m=0.5, shape=(120, 80, 6))
    """

    origin_m: Vec3
    voxel_m: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, roi: Roi, voxel_m: float, where: str = "roi") -> Grid:
        """Divide a region of interest into voxels.

        Parameters
        ----------
        roi
            The region.
        voxel_m
            Edge length of a voxel.
        where
            Key of the region in the scenario, for messages.

        Raises
        ------
        InputError
            When the size is not a whole number of voxels along an axis (in decimals: 0.3 / 0.1 is 3), or when there are
            more voxels than :data:`egvs.core.limits.VOXELS`.
        """
        shape = []
        for axis, size in zip("xyz", roi.size_m, strict=True):
            count = _as_fraction(size) / _as_fraction(voxel_m)
            if count.denominator != 1:
                nearest = [n * _as_fraction(voxel_m) for n in (count // 1, count // 1 + 1) if n > 0]
                raise InputError(
                    f"{where}.size_m",
                    f"{size:g} m along {axis} is not a whole number of voxels of {voxel_m:g} m",
                    f"The nearest sizes that fit are {' or '.join(map(_format_number, nearest))} m.",
                )
            shape.append(int(count))
        nx, ny, nz = shape
        if nx * ny * nz > VOXELS.maximum:
            total = f"{' x '.join(map(_format_number, shape))} = {_format_number(nx * ny * nz)} voxels"
            hint = f"Use larger voxels or a smaller region. {VOXELS.hint}"
            raise InputError(f"{where}.voxel_m", f"{voxel_m:g} m gives {total}", hint)
        return cls(roi.origin_m, float(voxel_m), (nx, ny, nz))

    @property
    def roi(self) -> Roi:
        """The box that the grid covers."""
        nx, ny, nz = (float(n * _as_fraction(self.voxel_m)) for n in self.shape)
        return Roi(self.origin_m, (nx, ny, nz))

    def to_grid_m(self, points_world_m: FloatArray) -> FloatArray:
        """Convert world positions (..., 3) in metres to the grid's frame, float64 metres."""
        moved: FloatArray = np.asarray(points_world_m, dtype=np.float64) - np.asarray(self.origin_m)
        return moved

    def segments(self, position_world_m: Vec3, ends_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Convert a sensor and its beams to voxel units of the grid's frame.

        Parameters
        ----------
        position_world_m
            The sensor, finite.
        ends_m
            Ends of its beams relative to the sensor, along the world's axes, metres, (n, 3) float64.

        Returns
        -------
        o, d
            The sensor (3,), and the beams (n, 3): a component is exactly 0 where the whole beam is on a plane.
        """
        o = np.array([self._in_voxels(p, z) for p, z in zip(position_world_m, self.origin_m, strict=True)])
        with np.errstate(over="ignore"):
            d = ends_m / self.voxel_m
        flat = (ends_m <= PLANE_TOLERANCE_M) & (ends_m >= -PLANE_TOLERANCE_M)
        np.copyto(d, 0.0, where=flat & (o == np.rint(o)))
        return o, d

    def _in_voxels(self, position_m: float, origin_m: float) -> float:
        """Distance of a coordinate from the origin in voxels: in decimals, snapped to a close plane, rounded once."""
        exact = (_as_fraction(position_m) - _as_fraction(origin_m)) / _as_fraction(self.voxel_m)
        plane = round(exact)
        if abs(exact - plane) * _as_fraction(self.voxel_m) <= _as_fraction(PLANE_TOLERANCE_M):
            return float(plane)
        return float(exact)

    def to_json(self) -> dict[str, Any]:
        """The form in the metadata of artefacts."""
        return {"origin_m": list(self.origin_m), "voxel_m": self.voxel_m, "shape": list(self.shape)}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Grid:
        """The inverse of :meth:`to_json`."""
        x, y, z = (float(v) for v in value["origin_m"])
        nx, ny, nz = (int(n) for n in value["shape"])
        return cls((x, y, z), float(value["voxel_m"]), (nx, ny, nz))


def _format_number(value: Fraction | int) -> str:
    """A number, however large."""
    return f"{float(value):g}" if value < 10**300 else "more than 1e+300"


def _as_fraction(value: float) -> Fraction:
    """The decimal number that a person wrote, not the binary one that is stored (0.1 is 1/10)."""
    return Fraction(repr(float(value)))
