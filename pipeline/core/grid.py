"""The region of interest and its voxels: where a voxel is, and which one holds a point.

A grid has an ``origin_m`` (world frame, metres), a ``voxel_m`` (edge length) and a ``shape`` (voxels along x, y, z).
Voxel (ix, iy, iz) is the half-open box [origin + i * voxel, origin + (i + 1) * voxel) on each axis.

The grid's own frame has its zero at ``origin_m``. Every position is moved there in float64 before anything else is done
with it, so that a scene far from the world's zero loses no digits.

A sensor and its beams come into voxel units by :meth:`Grid.segments` alone. Decimals are taken as they are written (0.3
m are three voxels of 0.1 m, though 0.3 / 0.1 is 2.9999999999999996), and what is within ``ON_PLANE_M`` of a plane
between voxels lies on it. So a scene that is moved by 0.1 m looks to its grid as it did before.

The paper (arXiv 2504.06772, Eq. 1) prints the number of voxels as the *sum* w/d + l/d + h/d; it is the product.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.reading.limits import VOXELS

ON_PLANE_M = 1e-9
"""What is this close to a plane between voxels lies on it."""

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Roi:
    """The region of interest: an axis-aligned box in the world frame, without a voxel size."""

    origin_m: Vec3
    size_m: Vec3

    @classmethod
    def around(cls, center_m: Vec3, size_m: Vec3) -> Roi:
        """The box of ``size_m`` round ``center_m``; its corner is computed in exact decimals, then rounded once."""
        low = tuple(float(_exact(c) - _exact(s) / 2) for c, s in zip(center_m, size_m, strict=True))
        return cls(low, size_m)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Grid:
    """A regular grid of cubes over the region of interest."""

    origin_m: Vec3
    voxel_m: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, roi: Roi, voxel_m: float, place: str = "roi") -> Grid:
        """Cut ``roi`` into voxels.

        Raises
        ------
        InputError
            When the size is no whole number of voxels along an axis (decimal arithmetic: 0.3 / 0.1 is 3), naming the
            nearest sizes that fit; or when there are more voxels than :data:`pipeline.core.reading.limits.VOXELS`.
        """
        shape = []
        for axis, size in zip("xyz", roi.size_m, strict=True):
            count = _exact(size) / _exact(voxel_m)
            if count.denominator != 1:
                low, high = count // 1, count // 1 + 1
                near = " or ".join(_in_words(n * _exact(voxel_m)) for n in (low, high) if n > 0)
                raise InputError(
                    f"{place}.size_m",
                    f"{size:g} m along {axis} is no whole number of voxels of {voxel_m:g} m",
                    f"the nearest sizes that fit are {near} m",
                )
            shape.append(int(count))
        nx, ny, nz = shape
        if nx * ny * nz > VOXELS.most:
            found = f"{' x '.join(map(_in_words, shape))} = {_in_words(nx * ny * nz)} voxels"
            right = f"larger voxels or a smaller region; {VOXELS.right}"
            raise InputError(f"{place}.voxel_m", f"{voxel_m:g} m gives {found}", right)
        return cls(roi.origin_m, float(voxel_m), (nx, ny, nz))

    @property
    def roi(self) -> Roi:
        """The box that the grid covers."""
        nx, ny, nz = (float(n * _exact(self.voxel_m)) for n in self.shape)
        return Roi(self.origin_m, (nx, ny, nz))

    def to_grid_m(self, points_world_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """World positions (..., 3) in metres, float64 -> positions in the grid's frame in metres, float64."""
        moved: NDArray[np.float64] = np.asarray(points_world_m, dtype=np.float64) - np.asarray(self.origin_m)
        return moved

    def segments(
        self, position_world_m: Vec3, ends_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A sensor and its beams in voxel units of the grid's frame.

        Parameters
        ----------
        position_world_m
            The sensor, finite.
        ends_m
            Where its beams end, seen from there along the world's axes, (n, 3) float64.

        Returns
        -------
        o, d
            The sensor (3,), and the beams (n, 3): a component is exactly 0 where the whole beam lies on a plane.
        """
        o = np.array([self._in_voxels(p, z) for p, z in zip(position_world_m, self.origin_m, strict=True)])
        with np.errstate(over="ignore"):
            d = ends_m / self.voxel_m
        flat = (ends_m <= ON_PLANE_M) & (ends_m >= -ON_PLANE_M)
        np.copyto(d, 0.0, where=flat & (o == np.rint(o)))
        return o, d

    def _in_voxels(self, at_m: float, origin_m: float) -> float:
        """How many voxels a coordinate is from the origin: in exact decimals, moved to a plane that is near, rounded
        once."""
        exact = (_exact(at_m) - _exact(origin_m)) / _exact(self.voxel_m)
        plane = round(exact)
        return float(plane if abs(exact - plane) * _exact(self.voxel_m) <= _exact(ON_PLANE_M) else exact)

    def to_json(self) -> dict[str, Any]:
        """The form that the artefacts' metadata holds."""
        return {"origin_m": list(self.origin_m), "voxel_m": self.voxel_m, "shape": list(self.shape)}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Grid:
        """The inverse of :meth:`to_json`."""
        x, y, z = (float(v) for v in value["origin_m"])
        nx, ny, nz = (int(n) for n in value["shape"])
        return cls((x, y, z), float(value["voxel_m"]), (nx, ny, nz))


def _in_words(value: Fraction | int) -> str:
    """A number, however large."""
    return f"{float(value):g}" if value < 10**300 else "more than 1e+300"


def _exact(value: float) -> Fraction:
    """The decimal number that a person wrote, not the binary one that is stored (0.1 is 1/10)."""
    return Fraction(repr(float(value)))
