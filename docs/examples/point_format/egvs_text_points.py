"""Formats of points as text."""

from egvs.core.readers import Reader

READERS = (Reader("XYZ", "points", "egvs_xyz", suffixes=(".xyz",)),)
