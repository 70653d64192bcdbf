"""Simulated point clouds with traffic."""
