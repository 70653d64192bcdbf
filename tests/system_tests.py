"""Files and folders in which every test counts as `system`."""

from __future__ import annotations

SYSTEM = (
    "tests/core/test_sandbox",
    "tests/creation/",
    "tests/drawing/test_svg_figures",
    "tests/effects/test_articulated",
    "tests/effects/test_pedestrians_bicycles",
    "tests/effects/test_slope",
    "tests/extensions/city/test_roundabout",
    "tests/extensions/city/test_town_flow",
    "tests/extensions/hardware/installation/",
    "tests/extensions/maps/test_",
    "tests/extensions/tracks/new/",
    "tests/extensions/tracks/test_recorded_tracks",
    "tests/extensions/validation/test_held_out_departures",
    "tests/formats/test_osm",
    "tests/runs/",
    "tests/studies/",
    "tests/traffic/",
)
"""Starts of paths. SUMO runs there, fonts are listed, or whole runs are made, interrupted and compared."""
