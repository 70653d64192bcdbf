"""Numba kernels: functions of arrays that import only each other."""

from __future__ import annotations

from pathlib import Path

from egvs.kernels import jit

jit.use_cache_folder(Path(__file__).resolve().parent)
