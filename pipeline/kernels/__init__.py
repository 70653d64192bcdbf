"""Numba kernels: they fill arrays, and import nothing of this program but each other."""

from pathlib import Path

from pipeline.kernels import compile_cache

compile_cache.keep_beside(Path(__file__).resolve().parent)
