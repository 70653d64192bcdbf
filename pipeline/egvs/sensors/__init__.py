"""Sensors and sites: beams, poses, candidate sites, and the empty scan from a pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.sensors.scanner import Scan, Scanner
    from egvs.sensors.scene import Scene
    from egvs.sensors.sensor import Sensor
    from egvs.sensors.sites import Pose, Site, candidate_sites

__all__ = ["Pose", "Scan", "Scanner", "Scene", "Sensor", "Site", "candidate_sites"]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "scanner": ["Scan", "Scanner"],
        "scene": ["Scene"],
        "sensor": ["Sensor"],
        "sites": ["Pose", "Site", "candidate_sites"],
    },
)
