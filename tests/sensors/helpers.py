"""Candidate sites and sensors for the tests of sensors."""

from __future__ import annotations

from pathlib import Path

import egvs
from egvs.sensors import sites


def sites_from(mini: Path, rows: str = "", **sites_keys: str) -> tuple[sites.Site, ...]:
    """The candidates of the small scenario with these rows of ``sites.csv`` and these keys of ``[sites]``."""
    if rows:
        (mini / "sites.csv").write_text(rows)
    return sites.candidate_sites(egvs.load(mini, [f"sites.{key}={value}" for key, value in sites_keys.items()]))


def angles_of(candidates: tuple[sites.Site, ...]) -> list[tuple[str, float, float, float]]:
    return [(site.name, site.pose.z_m, site.pose.yaw_deg, site.pose.pitch_deg) for site in candidates]


def site_positions(candidates: tuple[sites.Site, ...]) -> list[tuple[str, float, float, float]]:
    return [(site.name, *site.pose.position_m) for site in candidates]
