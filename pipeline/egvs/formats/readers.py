"""Formats of point clouds that this package reads; see :mod:`egvs.formats.point_clouds`."""

from __future__ import annotations

from egvs.core.readers import Reader

READERS = (
    Reader("CSV", "points", "egvs.formats.csv_points", suffixes=(".csv",)),
    Reader("KITTI", "points", "egvs.formats.kitti_points", suffixes=(".bin",)),
    Reader("E57", "points", "egvs.formats.e57", suffixes=(".e57",)),
    Reader("LAS", "points", "egvs.formats.las", suffixes=(".las", ".laz")),
    Reader("PCD", "points", "egvs.formats.pcd", suffixes=(".pcd",)),
    Reader("PLY", "points", "egvs.formats.ply", suffixes=(".ply",)),
)
