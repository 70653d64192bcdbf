"""What the page says of a sensor in words: markdown."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.explore.plan import MovingPlan
from pipeline.explore.session import Rating

MOST_LISTED = 20
"""Rows of the ranked list; the others are in the list to choose from."""

WORKING = "## working ..."
"""While a run with other settings is made."""

_SHARES = ("entropy_seen", "coverage", "expected_visibility", "expected_detections", "seen_well")
_STEERS = str.maketrans({sign: f"\\{sign}" for sign in "\\`*_{}[]()<>#+-.!|"})


def in_words(rating: Rating, rank_by: str, candidate: Rating, candidates: int) -> str:
    """What a sensor is worth where it is, beside its candidate; or why none can stand there."""
    told = "\n".join(
        f"- {'**cannot stand:**' if finding.is_error else '**warning:**'} {plain(str(finding))}"
        for finding in rating.findings
    )
    if not rating.stands:
        return f"## no score\n\n{told}"
    score, before = rating.scores[rank_by], candidate.scores[rank_by]
    more = f" ({score / before - 1.0:+.1%})" if before > 0.0 and rating.site.pose != candidate.site.pose else ""
    rows = "\n".join(f"| {plain(name)} | {value_in_words(name, value)} |" for name, value in rating.scores.items())
    head = f"## {value_in_words(rank_by, score)}{more}\n\nrank {rating.rank} of {candidates} by {plain(rank_by)}"
    return f"{head}\n\n| score | value |\n|---|---|\n{rows}\n\n{told}"


def notice(text: str) -> str:
    """What went wrong."""
    return f"**{plain(text)}**\n\n"


def drawn(triangles: int, of: int) -> str:
    """Whether the static world is drawn coarser than it is; nothing where it is not."""
    return f"{triangles:,} of {of:,} triangles are drawn; beams meet all of them." if triangles < of else ""


def plan(its: MovingPlan) -> str:
    """What the sensors of a plan are worth together as they are now, and where one more would be best."""
    names, value = ", ".join(map(plain, its.sites)), value_in_words(its.poses.asked.score, its.joint)
    more = ""
    if its.best_next is not None:
        name, gain = its.best_next
        more = f"; best for one more: {plain(name)} (+{gain:,.4g})"
    return f"\n\n**plan** {names}: together {value}{more}"


def ranking(ranked: Sequence[Rating], rank_by: str) -> str:
    """The best candidates as a table."""
    rows = "\n".join(
        f"| {its.rank} | {plain(its.site.name)} | {value_in_words(rank_by, its.scores[rank_by])} |"
        for its in ranked[:MOST_LISTED]
    )
    rest = f"\n\n... and {len(ranked) - MOST_LISTED} more" if len(ranked) > MOST_LISTED else ""
    return f"| rank | site | {plain(rank_by)} |\n|---|---|---|\n{rows}{rest}"


def choice(rating: Rating, rank_by: str) -> str:
    """A candidate in the list to choose from."""
    return f"{rating.rank}. {rating.site.name}: {value_in_words(rank_by, rating.scores[rank_by])}"


def value_in_words(name: str, value: float) -> str:
    """A score with as many digits as a planner reads."""
    return f"{value:.2%}" if name in _SHARES else f"{value:,.1f}" if abs(value) >= 100.0 else f"{value:.4g}"


def plain(text: str) -> str:
    """A text that markdown shows as it is."""
    return text.translate(_STEERS).replace("\n", " ")
