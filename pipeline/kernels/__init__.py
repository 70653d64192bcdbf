"""Numba kernels: they take and fill arrays and know no paths, no configuration, no logging."""

from pathlib import Path

from pipeline.kernels import compile_cache

compile_cache.keep_beside(Path(__file__).resolve().parent)
