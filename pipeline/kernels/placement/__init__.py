"""Kernels of placement: what several sensors see together."""
