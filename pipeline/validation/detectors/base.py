"""What a detector is: it knows the site that it works at, takes a sweep, and gives boxes with scores.

A detector is an entry point of the group ``egvs.detectors`` (``name = "module:Class"``).
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

from pipeline.core.grid import Roi
from pipeline.validation.sweeps import Detections, SiteView, Sweep


class SiteDetector(Protocol):
    """A detector at one site, for one sweep after another."""

    def detect(self, sweep: Sweep) -> Detections:
        """The vehicles of one sweep, boxes in the world frame; the same for the same sweep, whatever came before."""
        raise NotImplementedError


class Detector(Protocol):
    """A way to find vehicles in sweeps. Made without arguments; can be sent to another process.

    Attributes
    ----------
    NAME, SOURCE
        As its entry point has it, and where it is published.
    """

    NAME: ClassVar[str]
    SOURCE: ClassVar[str]

    @property
    def settings(self) -> dict[str, Any]:
        """All that its boxes depend on beside its source and the sweep: parameters, sha256 of a model. JSON values."""
        raise NotImplementedError

    def at(self, view: SiteView, roi: Roi) -> SiteDetector:
        """The detector at one site; what depends on the site alone is made here. Vehicles outside the region of
        interest need not be found."""
        raise NotImplementedError
