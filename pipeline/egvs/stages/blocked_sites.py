"""Warns of sites whose sensor sees little but what is around it, such as its own mast.

The stage that casts the beams measures the share that ends near the sensor: the scan stage, or the score stage where
scans are not kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.world import supports

NEAR_M = 0.5
"""Beams that end closer to the sensor have met what it is mounted on, or mounted in."""


def near_share(ends_m: FloatArray, weight: FloatArray | None) -> float:
    """Return the share of beams that end within :data:`NEAR_M` of the sensor; 0 without beams.

    Parameters
    ----------
    ends_m
        Ends of the beams relative to the sensor, (n, 3).
    weight
        Share of its beam of each row, (n,); None where every row is one beam.
    """
    is_near = (ends_m**2).sum(axis=1) < NEAR_M**2
    if not is_near.any():
        return 0.0
    return float(np.average(is_near, weights=weight))


def warn_blocked_sites(near_shares: Mapping[str, float]) -> Iterator[Diagnostic]:
    """Warn about the sites of which most beams end near the sensor; ``near_shares`` by site."""
    blocked = [f"{site} ({format_percent(share, 0)})" for site, share in near_shares.items() if share > 0.5]
    if blocked:
        count = f"{len(blocked)} of {len(near_shares)} sites"
        problem = f"most beams of {count} end within {NEAR_M:g} m of the sensor: {', '.join(blocked)}"
        kinds = ", ".join(supports.KINDS)
        hint = (
            f"Move the sensor away from the solid, or set the kind of its mast (one of {kinds}; at most"
            f" {supports.MAX_WIDTH_M:g} m across), which is then left out of the scan."
        )
        yield Diagnostic("blocked sites", "sites", problem, hint)
