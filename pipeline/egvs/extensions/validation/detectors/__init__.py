"""Detectors that validation runs on point clouds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.extensions.validation.detectors.base import (
        Detector,
        JointDetector,
        JointSiteDetector,
        SiteDetector,
        detector_names,
        make_detector,
    )
    from egvs.extensions.validation.detectors.cluster import Cluster
    from egvs.extensions.validation.detectors.pointpillars import PointPillars
    from egvs.extensions.validation.detectors.range_image import RangeImage

__all__ = [
    "Cluster",
    "Detector",
    "JointDetector",
    "JointSiteDetector",
    "PointPillars",
    "RangeImage",
    "SiteDetector",
    "detector_names",
    "make_detector",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "base": ["Detector", "JointDetector", "JointSiteDetector", "SiteDetector", "detector_names", "make_detector"],
        "cluster": ["Cluster"],
        "pointpillars": ["PointPillars"],
        "range_image": ["RangeImage"],
    },
)
