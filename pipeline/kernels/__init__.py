"""Numba kernels: they take and fill arrays and know no paths, no configuration, no logging."""

from pathlib import Path

from pipeline.core import compiled

compiled.keep_beside(Path(__file__).resolve().parent)
