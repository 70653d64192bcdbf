"""Numba kernels: functions of arrays that import only each other."""
