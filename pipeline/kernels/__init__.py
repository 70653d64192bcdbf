"""Numba kernels: they take and fill arrays and know no paths, no configuration, no logging."""
