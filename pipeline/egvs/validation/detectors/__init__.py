"""Detectors that validation runs on point clouds."""
