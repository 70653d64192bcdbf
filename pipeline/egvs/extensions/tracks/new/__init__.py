"""Recorded tracks and signals in new scenarios."""
