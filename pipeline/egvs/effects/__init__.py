"""Effects beyond the plain scene, one module each: rain, fog, foliage and others."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.effects.base import Detect, Echo, Echoes, Effect, Expand, Traffic, TransmitScan, TransmitScore
    from egvs.effects.registry import effect_names, load_effect_class

__all__ = [
    "Detect",
    "Echo",
    "Echoes",
    "Effect",
    "Expand",
    "Traffic",
    "TransmitScan",
    "TransmitScore",
    "effect_names",
    "load_effect_class",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "base": ["Detect", "Echo", "Echoes", "Effect", "Expand", "Traffic", "TransmitScan", "TransmitScore"],
        "registry": ["effect_names", "load_effect_class"],
    },
)
