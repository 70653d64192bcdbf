"""Files and folders in which every test counts as `system`."""

from __future__ import annotations

SYSTEM = (
    "tests/effects/test_articulated",
    "tests/effects/test_pedestrians_bicycles",
    "tests/effects/test_slope",
    "tests/importers/",
    "tests/installation/",
    "tests/runs/",
    "tests/studies/",
    "tests/traffic/",
)
"""Starts of paths. SUMO runs there, or whole runs are made, interrupted and compared."""
