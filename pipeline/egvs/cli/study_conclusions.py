"""The last sentence of ``egvs effects --ablation``: whether the best site stays first under the effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from egvs.core.wording import by_number, format_percent
from egvs.results.labels import join_names

if TYPE_CHECKING:
    from egvs.studies.effect_study import EffectChange


def ablation_conclusion(changes: Sequence[EffectChange]) -> str:
    """Return whether the best site stays first under the effects, and otherwise what choosing it loses.

    Parameters
    ----------
    changes
        The scores without effects, then with each effect alone, then with all of them where there are several.
    """
    plain = changes[0]
    alone = [change for change in changes[1:] if change.effect != "all"]
    scope = "the effect"
    if len(alone) > 1:
        scope = f"{'both' if len(alone) == 2 else f'all {len(alone)}'} effects, alone and together"
    if not any(score > 0 for score in plain.scores):
        return "Conclusion: every score is 0 without effects, so there is no first site."
    first = _first_sites(plain)
    subject, verb = join_names(first), by_number(len(first), "stays", "stay")
    moved = [change for change in changes[1:] if _first_sites(change) != first]
    if not moved:
        return f"Conclusion: {subject} {verb} first under {scope}."
    losses = []
    for change in moved:
        name = "all effects together" if change.effect == "all" else change.effect
        losses.append(
            f"{join_names(_first_sites(change))} under {name} (choosing {first[0]} loses "
            f"{format_percent(_loss(plain, change), 2)})"
        )
    return (
        f"Conclusion: {subject} {by_number(len(first), 'is', 'are')} first without effects, but {join_names(losses)}."
    )


def _first_sites(change: EffectChange) -> list[str]:
    """Return the sites of rank 1."""
    return [site for site, rank in zip(change.sites, change.ranks, strict=True) if rank == 1]


def _loss(plain: EffectChange, change: EffectChange) -> float:
    """Return the share of the best score that the first site without effects loses (the worst of several)."""
    highest = max(change.scores)
    if not highest > 0:
        return 0.0
    scores = dict(zip(change.sites, change.scores, strict=True))
    return 1.0 - min(scores[site] for site in _first_sites(plain)) / highest
