"""The sentences and numbers of the report, in plain words."""

from __future__ import annotations

import math

from pipeline.report.ranking import CLOSE, Ranking, ScoredSite


def headline(ranking: Ranking, has_traffic: bool) -> str:
    """The outcome in one sentence."""
    best, others = ranking.best, len(ranking.sites) - 1
    top = best[0]
    if not has_traffic:
        return "No traffic in the region: the sites cannot be ranked"
    if not top.score > 0:
        return "No site sees anything of the traffic" if others else f"{top.site} sees nothing of the traffic"
    sees = f"sees {share(top.entropy_seen)} of the traffic’s uncertainty"
    if top.rank_by != "egvs":
        sees = top.by.sentence(top.score)
    if not others:
        return f"{top.site}, the only site, {sees}"
    if ranking.is_tie:
        same = f"All {len(best)} sites score the same"
        return f"{same}: each {sees}" if top.rank_by != "egvs" or len({s.entropy_seen for s in best}) == 1 else same
    if len(best) > 1:
        few = len(best) <= 4
        names = ", ".join(s.site for s in best[:-1]) if few else f"{top.site} and {len(best) - 2} others"
        return f"{names} and {best[-1].site} share the first place of {others + 1}: {top.site} {sees}"
    outcome = f"{top.site} is the best of {others + 1} sites"
    return outcome if top.rank_by == "egvs" else f"{outcome}: it {sees}"


def lead(ranking: Ranking) -> str:
    """By how much the best leads, and who comes close; nothing where nobody leads."""
    if ranking.is_tie or not ranking.best[0].score > 0:
        return ""
    second = ranking.sites[len(ranking.best)]
    behind = 1 - ranking.of_best(second)
    by = f"{behind:.1%}" if behind >= 0.0005 else "less than 0.1%"
    subject, whose = ("It leads", "its") if len(ranking.best) == 1 else ("They lead", "their")
    text = f"{subject} {second.site}, the next, by {by} of {whose} score."
    if not ranking.best[-1].is_separable:  # the last of the best is the one beside the next
        text += " With this much traffic they cannot be told apart."
    if len(ranking.close) > 1:
        names = ", ".join(s.site for s in ranking.close[:4])
        more = f" and {len(ranking.close) - 4} more" if len(ranking.close) > 4 else ""
        text += f" Within {CLOSE:.0%} of the best are {len(ranking.close)} others: {names}{more}."
    return text


def beside_entropy_seen(ranking: Ranking) -> str:
    """What entropy seen says beside the EGVS; nothing where another score ranks."""
    top, most = (max(sites, key=lambda site: site.entropy_seen) for sites in (ranking.best, ranking.sites))
    if ranking.is_tie or top.rank_by != "egvs" or not top.egvs > 0:
        return ""
    if most.entropy_seen - top.entropy_seen < 0.0005:
        it = "It" if len(ranking.best) == 1 else top.site
        return f"{it} also sees most of the traffic’s uncertainty, {share(top.entropy_seen)}."
    return (
        f"{most.site}, rank {most.rank}, sees more of the traffic’s uncertainty ({share(most.entropy_seen)} against "
        f"{share(top.entropy_seen)}), but with fewer beams on it. A voxel counts as "
        f"seen from one beam on, and one beam detects no vehicle."
    )


def site_caption(site: ScoredSite, voxels_seen: int, voxels: int) -> str:
    """One site in numbers."""
    return (
        f"{site.site}: rank {site.rank}, {site.by.told(site.score)}, at x = {plain(site.x_m)} m, "
        f"y = {plain(site.y_m)} m, z = {plain(site.z_m)} m, with a {site.sensor}. "
        f"It sees {whole(voxels_seen)} of {whole(voxels)} uncertain voxels. "
        f"{whole(site.returns)} of its {whole(site.beams_in_roi)} beams towards the region end on the ground "
        f"or on what stands there."
    )


def share_of_limit(site: ScoredSite) -> float | None:
    """A score as a share of what no site could exceed."""
    limit = site.egvs_limit
    return site.egvs / limit if limit > 0 and math.isfinite(limit) else None


def share(value: float) -> str:
    """A share in per cent."""
    return f"{value:.1%}"


def whole(value: float) -> str:
    """A number without decimals, thousands apart."""
    return f"{value:,.0f}"


def plain(value: float) -> str:
    """A number as a person would write it."""
    return f"{value:,.2f}".rstrip("0").rstrip(".")


def degrees(value: float) -> str:
    """A longitude or latitude, to about a decimetre."""
    return f"{value:.6f}"


def duration(seconds: float) -> str:
    """A time in hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{seconds:g} s"
    hours, minutes = divmod(minutes, 60)
    return " ".join(f"{n} {unit}" for n, unit in ((hours, "h"), (minutes, "min"), (rest, "s")) if n)
