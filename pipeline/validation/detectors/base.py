"""What a detector is: it knows the site that it works at, takes a sweep, and gives boxes with scores.

A detector is an entry point of the group ``egvs.detectors`` (``name = "module:Class"``). One that also takes what
several sensors see in the same instant has a method more, see :class:`JointDetector`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, TypeGuard

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


class JointSiteDetector(Protocol):
    """A detector at several sites at once, for one instant after another."""

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """The vehicles in the sweeps of one instant, one of each sensor in the order of the sites."""
        raise NotImplementedError


class JointDetector(Detector, Protocol):
    """A detector that can also look at the fused cloud of several sensors.

    What is known of each sensor holds for its own points alone: its background, and what it can see from where it is.
    """

    def together(self, views: Sequence[SiteView], roi: Roi) -> JointSiteDetector:
        """The detector at some sites, at least one; at a single one it finds what :meth:`Detector.at` finds there."""
        raise NotImplementedError


def is_joint(detector: Detector) -> TypeGuard[JointDetector]:
    """Whether a detector can look at fused clouds."""
    return callable(getattr(detector, "together", None))
