"""Labelled sweeps of an installed LiDAR, held against the simulation of the same boxes."""
