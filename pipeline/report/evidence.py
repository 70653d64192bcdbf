"""What the study says of scores (docs/validity.md), and where two of them rank the first sites of a run otherwise.

The numbers stand here alone, taken from the study's tables: Spearman's rho of a score with what a detector finds, over
the sites of the junctions that chose nothing. What is not measured is not there, and nothing is said of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.report.ranking import ScoredSite
from pipeline.report.score_words import SCORES
from pipeline.scenario.score import RECOMMENDED

FIRST = 3
"""So many of the best sites are held against each other."""

RHO: Mapping[str, Mapping[str, float]] = json.loads(
    Path(__file__).with_name("evidence.json").read_text(encoding="utf-8")
)
"""Score -> detector -> rho with AP (BEV + 3D, IoU 0.7), given sites and grid of these junctions together: the table of
all scores under F in docs/validity-tables.md. The EGVS goes by its setting, as :func:`setting_of` names it."""


def setting_of(gamma: float, voxel_m: float, *, moving_occlusion: bool = False) -> str:
    """The EGVS of a run, as :data:`RHO` names it."""
    return f"egvs (gamma {gamma:g}, {'moving occlusion, ' if moving_occlusion else ''}voxel {voxel_m:g})"


def disagreement(sites: Sequence[ScoredSite], egvs: str, rho: Mapping[str, Mapping[str, float]] | None = None) -> str:
    """Where the EGVS and the recommended score put other sites first: which ones, and which of the two goes better with
    detection; nothing where they agree, or a score is not there.

    Parameters
    ----------
    egvs
        The setting of the run's EGVS, see :func:`setting_of`.
    rho
        Evidence, :data:`RHO` by default.
    """
    by_egvs, by_other = (_first(sites, name) for name in ("egvs", RECOMMENDED))
    if not by_egvs or not by_other or (by_egvs[0] == by_other[0] and set(by_egvs) == set(by_other)):
        return ""
    noun = SCORES[RECOMMENDED].noun
    what = f"The EGVS has {_listed(by_egvs)} first, {noun} has {_listed(by_other)}"
    return f"{what}: {_verdict(noun, egvs, RHO if rho is None else rho)}"


def _first(sites: Sequence[ScoredSite], name: str) -> tuple[str, ...]:
    """The best sites by one score, those of equal scores in the order of the sites; none where a value is missing."""
    values = [site.value_of(name) for site in sites]
    if any(value is None for value in values):
        return ()
    ranked = sorted(zip(sites, values, strict=True), key=lambda its: -float(its[1] or 0.0))
    return tuple(site.site for site, _ in ranked[:FIRST])


def _verdict(noun: str, egvs: str, rho: Mapping[str, Mapping[str, float]]) -> str:
    """Which of the two detection agrees with, as far as was measured."""
    theirs, own = rho.get(RECOMMENDED, {}), rho.get(egvs, {})
    shared = [name for name in theirs if name in own]
    if not shared:
        known = " and ".join(f"{value:.2f} ({name})" for name, value in theirs.items())
        besides = f"; {noun} goes with it at rho {known}, see docs/validity.md" if known else ""
        return f"how well this setting of the EGVS goes with detection was not measured{besides}."
    numbers = " and ".join(f"{theirs[name]:.2f} against {own[name]:.2f} ({name})" for name in shared)
    better = [theirs[name] > own[name] for name in shared]
    who = noun if all(better) else "the EGVS" if not any(better) else "neither"
    where = "rho with what is detected at junctions that chose nothing"
    return f"detection agrees with {who}, {where}: {numbers}; see docs/validity.md."


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + f" and {names[-1]}" if len(names) > 1 else names[0]
