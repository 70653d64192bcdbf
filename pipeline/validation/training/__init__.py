"""Trains the detector on simulated sweeps of junctions; the only part that needs PyTorch."""
