"""Detector; by name; overlap suppression.

What a detector is: it knows the site that it works at, takes a sweep, and gives boxes with scores.

A detector is an entry point of the group ``egvs.detectors`` (``name = "module:Class"``). One that also takes what
several sensors see in the same instant has a method more, see :class:`JointDetector`.

Two vehicles are never in one place: of detections that overlap, one stays.

Finds detectors by name, through the entry points of the group ``egvs.detectors``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from egvs.core import plugins
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.validation.detection_metrics import paired_overlap
from egvs.validation.sweeps import Detections, SiteView, Sweep


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


MAX_OVERLAP = 0.1
"""Of two boxes whose intersection over union, seen from above, is more, one is left out."""


def suppress_overlaps(detections: Detections, weight: NDArray[np.float64] | NDArray[np.int64]) -> Detections:
    """The detections that hardly overlap a weightier one that stays; weightiest first, equals in their order.

    Parameters
    ----------
    weight
        (m,), what decides: scores, or numbers of points.
    """
    order = np.argsort(-weight, kind="stable")
    boxes = detections.boxes[order]
    reach_m = 0.5 * np.hypot(boxes[:, 3], boxes[:, 4])
    kept = list[int]()
    for row in range(len(boxes)):
        away_m = np.hypot(*(boxes[kept, :2] - boxes[row, :2]).T)
        rivals = boxes[kept][away_m < reach_m[kept] + reach_m[row]]
        if not (paired_overlap(np.repeat(boxes[row : row + 1], len(rivals), 0), rivals)[0] > MAX_OVERLAP).any():
            kept.append(row)
    return Detections(boxes[kept], detections.scores[order][kept])


DETECTORS_GROUP = "egvs.detectors"

_REQUIRED_LIBRARIES = {"cluster": "sklearn", "pointpillars": "onnxruntime"}
"""Of this program's own detectors; imported when one looks, long after it was made."""


def detector_names() -> list[str]:
    """Every detector that is installed."""
    return plugins.plugin_names(DETECTORS_GROUP)


def make_detector(name: str, location: str = "--detector") -> Detector:
    """A detector.

    Raises
    ------
    InputError
        When there is no such detector.
    MissingExtraError
        When the library that it needs is not installed.
    MissingBackendError
        When it cannot be imported, or is none.
    """
    if name not in detector_names():
        raise InputError(location, f"unknown detector {name!r}", f"one of {', '.join(['points', *detector_names()])}")
    if name in _REQUIRED_LIBRARIES:
        plugins.require_libraries(f"the detector {name}", "validate", _REQUIRED_LIBRARIES[name])
    found = plugins.load_plugin(DETECTORS_GROUP, name)
    if name != found.NAME:
        raise plugins.plugin_error(
            DETECTORS_GROUP, name, f"its NAME is {found.NAME!r}; right is {name!r}, as its entry point has it"
        )
    made: Detector = found()
    return made
