"""What ``egvs accuracy`` and ``egvs compare`` print.

An accuracy study: what each setting costs, how far its scores are off, and which setting is recommended. A comparison:
runs in columns, the agreement of their rankings, and the differences of their settings.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from egvs.cli import study_conclusions
from egvs.cli.console import NARROW, WIDE, Column, console, format_or_dash, make_table, print_sentences
from egvs.report.formatting import SCORE_LABELS
from egvs.studies.study_settings import MEASURES, SCENARIO, TRAFFIC
from egvs.studies.traffic_options import OPTION_KNOBS, SeedSpread

if TYPE_CHECKING:
    from egvs.studies.accuracy import AccuracyStudy
    from egvs.studies.run_comparison import ComparedRun, Comparison, Difference, RankAgreement, SiteResult
    from egvs.studies.score_errors import SeedComparison, SettingResult

_MAX_FRAMES = 1e8
"""Traffic with more frames than this cannot be simulated in practice."""


def print_study(study: AccuracyStudy, command: str) -> None:
    """Print an accuracy study; ``command`` runs the scenario, and is printed with the recommended options."""
    out = console(WIDE)
    is_wide = out.width >= WIDE - 10
    approximations = [row for row in study.rows if row.kind not in (MEASURES, TRAFFIC)]
    measures = [row for row in study.rows if row.kind == MEASURES]

    title = "settings that approximate the same number, compared with the reference"
    out.print(_settings_table(title, approximations, has_errors=True, is_wide=is_wide))
    out.print(f"reference: {_describe_reference(study)}. * on the Pareto front of time and error, = recommended")
    out.print(f"seconds are medians; stages were repeated {study.repeated} times to measure them\n")
    if measures:
        title = "settings that measure something else, compared with the scenario on the same traffic"
        out.print(_settings_table(title, measures, has_errors=False, is_wide=is_wide))
    _print_traffic_options(out, study)
    if not is_wide:
        out.print("for seconds by stage, memory and disk, widen the window or see accuracy.parquet")

    for reason in dict.fromkeys(study.skipped.values()):
        names = [name for name, skip_reason in study.skipped.items() if skip_reason == reason]
        out.print(f"skipped, {reason}: {'; '.join(names)}")
    if study.seeds is not None:
        _print_seeds(out, study.seeds)
    for better, worse, probability, frames in study.neighbours[:3]:
        needed = "no feasible amount of traffic would tell them apart"
        if frames < _MAX_FRAMES:
            needed = f"about {frames:,.0f} frames would tell them apart"
        out.print(f"{better} above {worse}: probability {probability:.0%}; {needed}")
    for path in study.files:
        out.print(str(path))
    out.print()
    out.print(_describe_recommendation(study, command))
    if not study.all_zero:
        print_sentences(study_conclusions.accuracy_conclusion(study))


def _print_traffic_options(out: Console, study: AccuracyStudy) -> None:
    """Print what SUMO's step, sublanes and routing cost and change, and what other seeds change."""
    options = [row for row in study.rows if row.kind == TRAFFIC]
    if not options:
        return
    (scenario,) = (row for row in study.rows if row.kind == SCENARIO)
    spread = SeedSpread.from_rows(options)
    options.sort(key=lambda row: (OPTION_KNOBS.index(row.knob), row.setting))
    title = "options of the traffic: another draw of it, compared with the scenario, beside other seeds"
    out.print(make_table(study_conclusions.traffic_columns(scenario, spread), [scenario, *options], title=title))
    if math.isnan(spread.tpog):
        out.print("fewer than two other seeds ran within the budget, so the spread of seeds is unknown")
        return
    explained = "busy: processor seconds, and times those of the scenario; TPOG: change of the occupancy"
    out.print(f"{explained}; scores: largest change")
    limits = f"TPOG {spread.tpog:.1%}, scores {spread.score:.1%}"
    out.print(f"spread of {spread.seeds} other seeds: up to {limits}")


def _describe_reference(study: AccuracyStudy) -> str:
    for row in study.rows:
        if row.kind == "reference":
            factor = study.reference_factor
            return f"traffic {factor} times as long, with a largest standard error of {row.error_se:.2%}"
    return "the scenario itself, because longer traffic is not available, or not within the budget"


def _settings_table(title: str, rows: Sequence[SettingResult], *, has_errors: bool, is_wide: bool) -> Table:
    """Return settings with their times and errors; in narrow terminals without details."""
    columns: list[Column[SettingResult]] = [
        Column("", lambda row: "*" * row.front + "=" * row.recommended, "left"),
        Column("setting", lambda row: row.setting, "left", wrap=not is_wide),
        Column("seconds", lambda row: f"{row.seconds:.2f}"),
    ]
    if is_wide:
        columns += [
            Column("+-", lambda row: f"{row.seconds_spread:.2f}"),
            Column("busy", lambda row: f"{row.busy_s:.2f}"),
            Column("traffic", lambda row: f"{row.traffic_s:.2f}"),
            Column("tpog", lambda row: f"{row.tpog_s:.2f}"),
            Column("scan", lambda row: f"{row.scan_s:.2f}"),
            Column("score", lambda row: f"{row.score_s:.2f}"),
            Column("memory MB", lambda row: f"{row.peak_mb:.0f}"),
            Column("disk MB", lambda row: f"{row.bytes / 1e6:.1f}"),
        ]
    if has_errors:
        columns.append(Column("error", lambda row: f"{row.error:.2%}"))
        columns.append(Column("std error", lambda row: _format_share(row.error_se)))
    if has_errors and is_wide:
        columns.append(Column("vs baseline", lambda row: f"{row.own_change:.2%}"))
    columns.append(Column("tau", lambda row: f"{row.tau:.3f}"))
    if is_wide:
        columns.append(Column("rho", lambda row: f"{row.rho:.3f}"))
    columns.append(Column("same", _format_same_sites))
    columns.append(Column("regret", lambda row: f"{row.regret:.2%}"))
    return make_table(columns, rows, title=title)


def _format_share(share: float) -> str:
    return "-" if math.isnan(share) else f"{share:.2%}"


def _format_same_sites(row: SettingResult) -> str:
    """Return whether the best site and the best three sites are those of the reference."""
    same = []
    if row.best_kept:
        same.append("best")
    if row.best_three_kept:
        same.append("three")
    return ", ".join(same) or "-"


def _print_seeds(out: Console, seeds: SeedComparison) -> None:
    """Print how much the scores of independent runs scatter, beside their standard errors."""
    columns = [
        Column[int]("site", lambda i: seeds.sites[i], "left"),
        Column[int]("between runs", lambda i: f"{seeds.between[i]:.0f}"),
        Column[int]("standard error", lambda i: f"{seeds.within[i]:.0f}"),
        Column[int]("bias", lambda i: f"{seeds.bias[i]:.0f}"),
        Column[int]("expected bias", lambda i: f"{seeds.expected_bias[i]:.0f}"),
    ]
    title = f"{seeds.seeds} independent runs of {seeds.frames} frames, bit"
    out.print(make_table(columns, range(len(seeds.sites)), title=title, truncate=True))
    out.print(f"90 % intervals contain the pooled score of all runs in {seeds.covered:.1%} of cases")


def _describe_recommendation(study: AccuracyStudy, command: str) -> str:
    from egvs.studies.score_errors import MIN_TIME_SAVING

    if study.all_zero:
        return "every score is 0, so there is nothing to compare: check the region of interest and the traffic"
    candidates = [row for row in study.rows if row.kind in ("approximates", "scenario")]
    best = study.best
    if best is None and len(candidates) == 1:
        error = f"{candidates[0].judged:.2%}"
        return f"the budget only covered the scenario's own setting, with an error of {error}: increase --budget"
    if best is None:
        nearest = min(candidates, key=lambda row: row.judged)
        error = f"{nearest.judged:.2%}"
        return f"no setting is within {study.tolerance:.2%}; the closest is {nearest.setting!r}, with {error}"

    standard_error = "unknown" if math.isnan(best.error_se) else f"{best.error_se:.2%}"
    note = ""
    if any(row.judged <= study.tolerance and row.seconds < best.seconds for row in candidates):
        note = f" (cheaper settings save less than {MIN_TIME_SAVING:.0%})"
    sentence = (
        f"recommended within {study.tolerance:.2%}: {best.setting}, {best.seconds:.2f} s{note}, "
        f"error {best.error:.2%}, standard error {standard_error}"
    )
    return f"{sentence}\n  {command} {best.overrides}".rstrip()


_FILE_WIDTH = 190
_COLUMN_GAP = 2
"""Space that rich leaves between two columns."""
_POSITION_WIDTH, _DEGREES_WIDTH = 28, 26
"""Widths of the columns x, y, z together, and of longitude and latitude together."""


def print_comparison(comparison: Comparison, top: int | None = None) -> None:
    """Print runs side by side; only the ``top`` sites of the first run, if given."""
    out = console(_FILE_WIDTH, soft_wrap=False)
    for run in comparison.runs:
        out.print(f"{run.label}  {run.folder}", soft_wrap=True)
    out.print()
    for runs in _fit_to_width(comparison.runs, out.width):
        out.print(_site_table(comparison, runs, comparison.sites[:top], out.width))
        out.print()
    out.print(_agreement_table(comparison))
    out.print()
    if comparison.differences:
        out.print(_difference_table(comparison))
    else:
        out.print("their settings and files are the same")
    for note in comparison.notes:
        out.print(f"note: {note}", soft_wrap=True)


def _fit_to_width(runs: Sequence[ComparedRun], width: int) -> list[Sequence[ComparedRun]]:
    """Divide runs into tables that fit the width; the first run is in each table, to compare others with it."""
    widest_run = 0
    for run in runs:
        widths = [max(len(column.title), 8) + _COLUMN_GAP for column in _run_columns(run, width)]
        widest_run = max(widest_run, sum(widths))
    sites = [site for run in runs for site in run.sites.values()]
    used = 0
    if sites:
        used = max(len(site.site) for site in sites) + _COLUMN_GAP
    if width >= NARROW:
        used += _POSITION_WIDTH
        if any(site.longitude_deg is not None for site in sites):
            used += _DEGREES_WIDTH

    runs_per_table = max(2, (width - used) // widest_run)
    first, others = runs[:1], runs[1:]
    step = runs_per_table - 1
    return [(*first, *others[start : start + step]) for start in range(0, len(others), step)]


def _run_columns(run: ComparedRun, width: int) -> list[Column[str]]:
    """Return the columns of one run, whose rows are names of sites."""
    label = SCORE_LABELS[run.rank_by]

    def cell_text(text: Any, site_name: str) -> str:
        site = run.sites.get(site_name)
        if site is None:
            return "-"
        return str(text(site))

    score = Column(f"{run.label} {label.head}", partial(cell_text, lambda site: label.value(site.score)))
    error = Column(f"{run.label} error", partial(cell_text, partial(_format_error, run)))
    egvs = Column(f"{run.label} bit", partial(cell_text, lambda site: f"{site.egvs:.1f}"))
    share = Column(f"{run.label} of limit", partial(cell_text, lambda site: format_or_dash(site.share, ".1%")))
    rank = Column(f"{run.label} rank", partial(cell_text, lambda site: site.rank))

    columns = [score, error, egvs, rank]
    if run.rank_by == "egvs":
        columns = [egvs, error, share, rank]
    if width >= NARROW:
        return columns
    if len(run.label) == 1:
        return [column for column in columns if column is not error]
    return columns[-2:]


def _format_error(run: ComparedRun, site: SiteResult) -> str:
    standard_error = site.egvs_se if site.other is None else site.other_se
    return SCORE_LABELS[run.rank_by].error(site.score, standard_error)


def _site_table(comparison: Comparison, runs: Sequence[ComparedRun], names: Sequence[str], width: int) -> Table:
    """Return the scores of sites in several runs."""
    sites = {name: next(run.sites[name] for run in comparison.runs if name in run.sites) for name in names}
    columns = [Column[str]("site", str, "left", wrap=True)]
    for number, title in enumerate(("x m", "y m", "z m")):
        columns.append(Column(title, partial(_format_position, sites, number), min_width=NARROW))
    if any(site.longitude_deg is not None for site in sites.values()):
        for title, key in (("longitude", "longitude_deg"), ("latitude", "latitude_deg")):
            columns.append(Column(title, partial(_format_degrees, sites, key), min_width=NARROW))
    for run in runs:
        columns += _run_columns(run, width)
    return make_table(columns, names, width=width)


def _format_position(sites: dict[str, SiteResult], axis: int, name: str) -> str:
    return f"{sites[name].pose[axis]:.2f}"


def _format_degrees(sites: dict[str, SiteResult], key: str, name: str) -> str:
    return format_or_dash(getattr(sites[name], key), ".6f")


def _agreement_table(comparison: Comparison) -> Table:
    columns: list[Column[RankAgreement]] = [
        Column("runs", lambda pair: f"{pair.a}, {pair.b}", "left"),
        Column("common sites", lambda pair: str(pair.shared), wrap=True),
        Column("tau", lambda pair: format_or_dash(pair.tau, ".2f")),
        Column("rho", lambda pair: format_or_dash(pair.rho, ".2f")),
        Column("best", _format_best_sites, "left", wrap=True),
        Column("regret of the first run's best", lambda pair: format_or_dash(pair.regret_a, ".2%"), wrap=True),
    ]
    return make_table(columns, comparison.agreements)


def _format_best_sites(pair: RankAgreement) -> str:
    if not pair.shared:
        return "-"
    if pair.best_a == pair.best_b:
        return "the same: " + _format_names(pair.best_a)
    return f"{_format_names(pair.best_a)} / {_format_names(pair.best_b)}"


def _format_names(sites: tuple[str, ...]) -> str:
    names = ", ".join(sites[:2])
    if len(sites) > 2:
        names += f" and {len(sites) - 2} more"
    return names


def _difference_table(comparison: Comparison) -> Table:
    columns: list[Column[Difference]] = [Column("what differs", lambda row: row.what, "left")]
    for number, run in enumerate(comparison.runs):
        columns.append(Column(run.label, partial(_format_setting, number), "left"))
    return make_table(columns, comparison.differences)


def _format_setting(run: int, difference: Difference) -> str:
    value = difference.values[run]
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False)
