"""Numba kernels: they fill arrays and know no paths, configuration or logging."""

from pathlib import Path

from pipeline.kernels import compile_cache

compile_cache.keep_beside(Path(__file__).resolve().parent)
