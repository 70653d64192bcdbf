"""Measurements of plans of several sensors."""
