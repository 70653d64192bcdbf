"""Joint placement: plans of several LiDARs, with proven bounds on their quality."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.placement.plan import JointScore, place

__all__ = ["JointScore", "place"]

__getattr__, __dir__ = lazy_exports(__name__, {"plan": ["JointScore", "place"]})
