"""Detectors: their interface, finding them by name, and overlap suppression.

A detector is an entry point of the group ``egvs.detectors`` (``name = "module:Class"``). It is given a site, then takes
one sweep after another and returns boxes with scores. A detector that also takes the sweeps of several sensors has one
more method, see :class:`JointDetector`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeGuard, TypeVar

import numpy as np

from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core import plugins
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray, Roi
from egvs.extensions.validation.detection_metrics import paired_overlap

DETECTORS_GROUP = "egvs.detectors"

MAX_OVERLAP = 0.1
"""Two vehicles are never at one place: of two boxes with a larger overlap (IoU from above), one is dropped."""

_REQUIRED_LIBRARIES = {"cluster": "sklearn", "pointpillars": "onnxruntime"}
"""Library of each built-in detector, which it imports when it starts; checked when it is made."""


class SiteDetector(Protocol):
    """A detector at one site, for one sweep after another."""

    def detect(self, sweep: Sweep) -> Detections:
        """Return the vehicles of one sweep, with boxes in the world frame.

        Depends on the sweep only, not on earlier ones.
        """
        raise NotImplementedError


class Detector(Protocol):
    """A method to detect vehicles in sweeps. Made without arguments; can be sent to another process.

    Attributes
    ----------
    NAME
        Name of its entry point.
    SOURCE
        Publication.
    """

    NAME: ClassVar[str]
    SOURCE: ClassVar[str]

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that its boxes depend on besides its source code and the sweep, as JSON values.

        For example its parameters, and the sha256 of a model.
        """
        raise NotImplementedError

    def at_site(self, view: SiteView, roi: Roi) -> SiteDetector:
        """Prepare the detector for one site. Vehicles outside the region of interest need not be detected."""
        raise NotImplementedError


class JointSiteDetector(Protocol):
    """A detector at several sites at once, for one instant after another."""

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """Return the vehicles in the sweeps of one instant, one of each sensor in the order of the sites."""
        raise NotImplementedError


JointSiteDetectorT = TypeVar("JointSiteDetectorT", bound=JointSiteDetector, covariant=True)


@dataclass(frozen=True)
class AtOneSite(Generic[JointSiteDetectorT]):
    """A joint detector at a single site."""

    joint: JointSiteDetectorT

    def detect(self, sweep: Sweep) -> Detections:
        """Return the vehicles of one sweep."""
        return self.joint.detect((sweep,))


class JointDetector(Detector, Protocol):
    """A detector that can also process the fused cloud of several sensors.

    What is known about a sensor applies to its own points only: its background, and what it can see from its position.
    """

    def at_sites(self, views: Sequence[SiteView], roi: Roi) -> JointSiteDetector:
        """Prepare the detector for at least one site; for a single one, it detects the same as :meth:`at_site`."""
        raise NotImplementedError


def is_joint(detector: Detector) -> TypeGuard[JointDetector]:
    """Return whether a detector can process fused clouds."""
    return callable(getattr(detector, "at_sites", None))


def detector_names() -> list[str]:
    """Return the names of all installed detectors."""
    return plugins.plugin_names(DETECTORS_GROUP)


def make_detector(name: str, where: str = "--detector") -> Detector:
    """Return a detector.

    Parameters
    ----------
    name
        Its entry point.
    where
        The option that names it, for messages.

    Raises
    ------
    InputError
        If there is no such detector.
    MissingExtraError
        If the library that it needs is not installed.
    MissingBackendError
        If it cannot be imported, or is not a detector.
    """
    if name not in detector_names():
        raise InputError(where, f"unknown detector {name!r}", f"Use one of {', '.join(['points', *detector_names()])}.")
    if name in _REQUIRED_LIBRARIES:
        plugins.require_libraries(f"the detector {name}", "validate", _REQUIRED_LIBRARIES[name])
    detector_class = plugins.load_plugin(DETECTORS_GROUP, name)
    expected = f"a class with NAME, SOURCE, settings and at_site, see {__name__}"
    plugins.check_plugin(DETECTORS_GROUP, name, detector_class, ("NAME", "SOURCE", "settings", "at_site"), expected)
    if name != detector_class.NAME:
        problem = f"expected the NAME {name!r} of its entry point, got {detector_class.NAME!r}"
        raise plugins.plugin_error(DETECTORS_GROUP, name, problem)
    detector: Detector = detector_class()
    return detector


def suppress_overlaps(detections: Detections, weight: FloatArray | IntArray) -> Detections:
    """Drop detections that overlap one of larger weight.

    Parameters
    ----------
    detections
        The m detections.
    weight
        (m,), for example scores, or numbers of points.

    Returns
    -------
    Detections
        By descending weight; of equal weights, in their order.
    """
    order = np.argsort(-weight, kind="stable")
    boxes = detections.boxes[order]
    radius_m = 0.5 * np.hypot(boxes[:, 3], boxes[:, 4])
    selected: list[int] = []
    for row in range(len(boxes)):
        distance_m = np.hypot(*(boxes[selected, :2] - boxes[row, :2]).T)
        neighbours = boxes[selected][distance_m < radius_m[selected] + radius_m[row]]
        overlap = paired_overlap(np.repeat(boxes[row : row + 1], len(neighbours), 0), neighbours)[0]
        if not (overlap > MAX_OVERLAP).any():
            selected.append(row)
    return Detections(boxes[selected], detections.scores[order][selected])
