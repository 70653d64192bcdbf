"""Formats of walls."""

from egvs.core.readers import Reader

READERS = (Reader("wall list", "map", "egvs_wall_list", suffixes=(".walls",), gives=("solids",)),)
