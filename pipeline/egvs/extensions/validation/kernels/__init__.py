"""Compiled loops of the detectors and of their metrics; compiled as those of :mod:`egvs.kernels`."""
