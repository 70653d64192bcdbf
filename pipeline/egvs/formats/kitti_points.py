"""Read the point clouds of KITTI's benchmarks: binary records of x, y, z in metres and intensity, float32.

There is no header. Files with further fields, as those of nuScenes, cannot be told from them by their content unless
their size differs; such points would be scattered over the whole range of float32.

Source: Geiger, Lenz, Urtasun 2012, the development kit of the benchmark (readme.txt).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats.point_clouds import stack_columns

_FIELDS = 4
_RECORD_BYTES = 4 * _FIELDS


def read(path: Path, where: str) -> FloatArray:
    """Return all points, (n, 3) float64; InputError at ``where`` if the size is not that of whole records."""
    with open_input(path) as file:
        data = file.read()
    if len(data) % _RECORD_BYTES:
        problem = f"expected records of {_RECORD_BYTES} bytes (x, y, z, intensity as float32), got {len(data):,} bytes"
        raise InputError(where, problem, "Convert the file to PCD.")
    return stack_columns(list(np.frombuffer(data, "<f4").reshape(-1, _FIELDS).T[:3]))
