"""Learns from what detectors find and miss how likely they find a vehicle, from what a site sees of it."""
