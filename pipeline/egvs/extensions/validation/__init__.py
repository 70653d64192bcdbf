"""Test whether a score predicts detection: simulated point clouds, detectors, average precision, correlation.

From a notebook::

    from egvs.extensions.validation import FrameSampling, validate_sites

    validate_sites(scenario, "runs/trial", sampling=FrameSampling(frames=100), detectors=["cluster"])
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.extensions.validation.held_out_traffic import FrameSampling
    from egvs.extensions.validation.site_validation import validate_sites

__all__ = [
    "FrameSampling",
    "validate_sites",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "held_out_traffic": ["FrameSampling"],
        "site_validation": ["validate_sites"],
    },
)
