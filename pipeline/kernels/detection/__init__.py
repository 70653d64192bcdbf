"""Kernels of detectors, which find vehicles in point clouds."""
