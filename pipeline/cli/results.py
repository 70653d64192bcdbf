"""What came of a command: the ranking, files and costs of a run; what verify found; what a new scenario holds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from pipeline.artefacts import tables
from pipeline.artefacts.period_ranking import PeriodRanking
from pipeline.artefacts.readers import SEPARABLE
from pipeline.artefacts.run_record import RunRecord
from pipeline.cli.terminal import NARROW, WIDE, console, in_words, table, value_in_words
from pipeline.core.findings import warnings_of
from pipeline.report.evidence import disagreement, setting_of
from pipeline.report.ranking import ScoredSite, beside, poles_of
from pipeline.report.score_words import SCORES, ScoreWords

if TYPE_CHECKING:
    from pipeline.checks.checking import Checked
    from pipeline.importers.openstreetmap import NewScenario

_FILE_WIDTH = 150

_ROOMY = 130
"""Terminals with so many columns get the entropy seen as well as the score beside the one that ranks."""


def ranking_table(sites: Sequence[ScoredSite], width: int = WIDE, top: int | None = None) -> Table:
    """The ``top`` sites (all by default) by rank; without poses and sensors where the terminal is narrow."""
    is_wide, has_errors = width >= NARROW, any(site.egvs_se is not None for site in sites)
    by, other = SCORES[sites[0].rank_by if sites else "egvs"], beside(sites)
    names = ["rank", "site", *(["x m", "y m", "z m", "sensor"] if is_wide else []), by.head]
    names += ["std error", "beats next"] if has_errors else []
    names += ["of best", *([other.head] if other is not None else [])]
    names += ["entropy seen"] if other is None or width >= _ROOMY else []
    names = [*dict.fromkeys(names), *(["beams in ROI"] if is_wide else [])]
    ranking = table(names, left=("site", "sensor"), whole=[name for name in names if name != "site"])
    by_rank = sorted(sites, key=lambda site: site.rank)
    shown = by_rank[:top]
    if not all(site.is_separable for site in shown):
        chance = f"the chance that it truly scores higher is below {SEPARABLE:.0%}"
        ranking.caption = f"~ not separable from the next site: {chance}"
    best = max((site.score for site in sites), default=0.0)
    for site in shown:
        sure = "" if site.is_separable else "~ "
        cells = {
            "rank": str(site.rank), "site": site.site, "x m": f"{site.x_m:.2f}", "y m": f"{site.y_m:.2f}",
            "z m": f"{site.z_m:.2f}", "sensor": site.sensor, "entropy seen": f"{site.entropy_seen:.1%}",
            **{its.head: _value(its, site) for its in (other, by) if its is not None},
            "std error": by.error(site.score, site.score_se),
            "beats next": "-" if site.beats_next is None or site is by_rank[-1] else f"{sure}{site.beats_next:.0%}",
            "of best": f"{site.score / best:.1%}" if best > 0 else "-",
            "beams in ROI": str(site.beams_in_roi),
        }  # fmt: skip
        ranking.add_row(*(cells[name] for name in names))
    return ranking


def _value(by: ScoreWords, site: ScoredSite) -> str:
    """A site's value of a score; of the EGVS to a tenth of a bit."""
    value = site.value_of(by.name)
    return "-" if value is None else f"{value:.1f}" if by.name == "egvs" else by.value(value)


def poles_table(sites: Sequence[ScoredSite], top: int | None = None) -> Table:
    """The ``top`` poles' best candidates, how they are mounted, and by how much they beat the worst ones there."""
    by = SCORES[sites[0].rank_by if sites else "egvs"]
    names = ("rank", "pole", "best candidate", "z m", "yaw deg", "pitch deg", by.head, "of", "beats worst by")
    rows = table(
        names, left=("pole", "best candidate"), whole=[n for n in names if n not in ("pole", "best candidate")]
    )
    rows.title, rows.title_justify = "best of each pole", "left"
    for pole in poles_of(sorted(sites, key=lambda site: site.rank))[:top]:
        best = pole.best
        rows.add_row(
            str(best.rank), pole.name, best.site, f"{best.z_m:g}", f"{best.yaw_deg:.1f}", f"{best.pitch_deg:.1f}",
            _value(by, best), str(len(pole.sites)), "-" if pole.gain is None else f"{pole.gain:.1%}",
        )  # fmt: skip
    return rows


def print_run(folder: Path, record: RunRecord, *, anything_ran: bool, top: int | None = None) -> None:
    """The ranking, the artefacts, and what each stage cost."""
    out = console(_FILE_WIDTH)
    _print_scores(out, folder, record, top)
    stages = Table("stage", "artefact", "seconds", "peak MB", box=None, pad_edge=False)
    for stage, done in record.stages.items():
        names = "\n".join(str(folder / name) for name in done.artefacts)
        stages.add_row(stage, names, f"{done.cost.seconds:.2f}", f"{done.cost.peak_mb:.0f}")
    out.print(stages)
    if not anything_ran:
        out.print("nothing to do: no stage's inputs changed since the last run")


def print_stage(folder: Path, stage: str, record: RunRecord, *, top: int | None = None) -> None:
    """What one stage wrote."""
    out = console(_FILE_WIDTH)
    if stage == "score":
        _print_scores(out, folder, record, top)
    done = record.stages[stage]
    for name in (*done.artefacts, *done.summary.get("clouds", ())):
        out.print(str(folder / name))


def print_verification(folder: Path, differences: list[str]) -> None:
    """What verify found."""
    well = ["every artefact is as the run made it, and a second run makes the same bytes"]
    for line in differences or well:
        console(_FILE_WIDTH).print(f"{folder}: {line}")


def print_check(checked: Checked) -> None:
    """All findings, errors first, those of one rule together."""
    out = console(_FILE_WIDTH)
    for what, findings in (("error", checked.errors), ("warning", checked.warnings)):
        if findings:
            out.print(f"{len(findings)} {what}{'s' if len(findings) > 1 else ''}")
        for rule in dict.fromkeys(finding.rule for finding in findings):
            out.print(f"  {rule}")
            for finding in findings:
                if finding.rule == rule:
                    out.print(f"    {finding}")
    if not checked.findings:
        out.print("nothing found")
    out.print(f"{checked.sites} sites, {checked.solids} solids and {checked.lanes} lanes held against one another")


def print_new_scenario(made: NewScenario) -> None:
    """What ``egvs new`` made."""
    out = console(_FILE_WIDTH)
    for key, value in made.to_json().items():
        out.print(f"{key}: {in_words(value) if isinstance(value, dict) else value_in_words(value)}")
    hourly = made.to_json()["assumed_traffic"]["vehicles_per_hour"]
    out.print(
        f"warning: the traffic is assumed ({hourly:,} vehicles an hour), and the order of sites hangs on it; put what "
        f"was counted there into [traffic] of {made.folder / 'scenario.toml'} before you build on a ranking"
    )
    out.print(f"next: egvs run {made.folder}")


def period_table(by_period: PeriodRanking, top: int | None = None) -> Table:
    """The ``top`` sites (all by default) by their rank in the mix, with rank and share of the best in each period."""
    names = ["mix", "site", *by_period.periods]
    ranking = table(names, left=("site",), whole=[name for name in names if name != "site"])
    weights = zip(by_period.periods, by_period.shares, strict=True)
    ranking.caption = f"rank and share of the best in each period; in the mix: {', '.join(_weights(weights))}"
    for site, rank, periods in by_period.sites[:top]:
        ranking.add_row(str(rank), site, *(f"{its.rank} ({its.of_best:.1%})" for its in periods))
    return ranking


def _weights(weights: Iterable[tuple[str, float]]) -> list[str]:
    return [f"{name} {share:.1%}" for name, share in weights]


def _in_sentences(folder: Path, record: RunRecord, sites: Sequence[ScoredSite]) -> list[str]:
    """What the best site does, where its score says that in words; and where another score has others first."""
    about = tables.read_metadata(folder / "scores.parquet", "scores")
    best = next((site for site in sites if site.rank == 1), None)
    first = [] if best is None or best.rank_by == "egvs" else [f"{best.site} {best.by.sentence(best.score)}"]
    if first and best is not None and best.by.counts_vehicles and "weights" in about:
        first[0] += ", which are weighted"
    hidden = "moving_occlusion" in record.scenario.get("effects", {})
    other = disagreement(sites, setting_of(float(about["gamma"]), about["grid"]["voxel_m"], moving_occlusion=hidden))
    return [*first, *([other] if other else [])]


def _print_scores(out: Console, folder: Path, record: RunRecord, top: int | None) -> None:
    """The ranking of the ``top`` sites, the best of each pole, and the audit's worst case where there was one."""
    sites = ScoredSite.read(folder / "scores.parquet")
    if not any(site.score > 0 for site in sites):
        for warning in warnings_of([record.stages["score"].summary]):
            out.print(str(warning))
        return
    out.print(ranking_table(sites, out.width, top))
    for line in _in_sentences(folder, record, sites):
        out.print(line)
    if top is not None and len(sites) > top:
        out.print(f"... and {len(sites) - top} more: without --top, in {folder / 'scores.parquet'} or in the report")
    if len({site.pole for site in sites}) < len(sites):
        out.print(poles_table(sites, top))
    by_period = PeriodRanking.read(folder)
    if by_period is not None:
        out.print(period_table(by_period, top))
    summary = record.stages["score"].summary
    if missed := summary.get("missed"):
        out.print(missed)
    audit = summary.get("audit")
    if audit:
        out.print(
            f"audit: chords add up to {audit['worst_sum']:.1e} of a beam's length at worst, longest piece in no voxel "
            f"{audit['longest_gap_m'] * 1e6:.2f} micrometres, misplaced chords {audit['misplaced_chords']}, "
            f"voxels visited twice {audit['voxels_visited_twice']}"
        )
