"""What ``egvs run`` prints at its end: the answer to "which pole?" in a few lines, or with all that is known."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from egvs.artefacts import parquet, readers
from egvs.artefacts.readers import PeriodRanking
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.cli import stage_summary
from egvs.cli.console import (
    LINE_WIDTH,
    Column,
    console,
    make_table,
    print_sentences,
    wrap_lines,
)
from egvs.core.errors import Diagnostic, collect_warnings
from egvs.core.wording import by_number, number_of
from egvs.report import ranking_text, reliability, sections
from egvs.report.extension_sections import read_sections
from egvs.report.sensor_text import detection_level, has_losses, range_note, upper_limit_note
from egvs.results.labels import SCORE_LABELS, ScoreLabel, join_names
from egvs.results.levels import NO_DETECTORS, DetectionLevel, read_levels
from egvs.results.ranking import Pole, RankedSite, Ranking, describe_mount, is_named_after_pole, site_titles
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import NOTICED
from egvs.sensors import sites
from egvs.traffic.signal_descriptions import format_plan

_FILE_WIDTH = 150

MAX_LINES = 12
"""Lines of an answer without details, with those of the most serious warning."""

MIN_POLES, DEFAULT_POLES = 3, 5
"""Poles that are listed at least, and at most, unless another number is asked for."""

_MAX_SIGNALS = 2
"""Further signals are left to the report."""

_TILT_STEP_DEG = 6.0
"""The best tilt is not searched between tilts that are nearer to one another."""

_MAX_PERIODS = 4
"""With more periods, their ranks are left to ``--all`` and the report."""


def print_answer(
    folder: Path,
    scenario: Scenario,
    record: RunRecord,
    *,
    poles: int | None = None,
    with_details: bool = False,
    lines_before: int = 0,
) -> None:
    """Print the answer of a finished run: in at most :data:`MAX_LINES` lines, or all that is known.

    Parameters
    ----------
    folder
        The run folder.
    scenario, record
        Its scenario and its record.
    poles
        How many of the best poles are listed; None for as many as there is room for, with details for all.
    with_details
        Whether all that is known is printed.
    lines_before
        Number of lines with warnings that were printed before.
    """
    run_folder = RunFolder(folder)
    ranked = Ranking.read(run_folder.scores)
    if not ranked.best[0].score > 0:
        for warning in collect_warnings([record.stages["score"].summary]):
            print_sentences([str(warning)])
        print_sentences([f"report: {run_folder.report}"])
    elif with_details:
        _print_details(run_folder, ranked, scenario, record, poles)
    else:
        _print_short(run_folder, ranked, scenario, record, poles, MAX_LINES - lines_before)


def _print_short(
    folder: RunFolder, ranked: Ranking, scenario: Scenario, record: RunRecord, poles: int | None, max_lines: int
) -> None:
    """Print the best site and its lead, the best poles, the worst lane, what was assumed, and where the rest is."""
    best = ranked.best[0]
    has_relief = sites.has_relief(scenario)
    groups = read_levels(folder.levels, ranked.sites[0].site)
    found = detection_level(scenario, scenario.score.ranking_detectors, ranked.sites[0].sensor, groups)
    titles = site_titles(ranked.sites, has_relief=has_relief)
    headline = ranking_text.headline(ranked, has_traffic=True, found=found, titles=titles)
    before = wrap_lines(f"{headline}. {ranking_text.short_lead(ranked)}")
    for part in read_sections(folder, scenario, record.stages):
        for warning in part.warnings:
            before += wrap_lines(warning.sentence)
    after = []
    if record.stages["score"].summary.get("missed") and (worst := _worst_location(folder, best)):
        after += wrap_lines(f"Worst lane: {worst}.", 1)
    if missing := sections.describe_missing_traffic(_warnings(record)):
        after += wrap_lines(missing, 1)
    if on_road := sections.describe_poles_on_road(ranked.poles[:MIN_POLES], _warnings(record)):
        after += wrap_lines(f"Careful: {join_names(on_road)}.", 1)
    if limits := reliability.describe_limits(ranked):
        after += wrap_lines(limits, 1)
    plans = record.traffic_summary.get("signals", ())
    if assumed := sections.main_assumptions(sections.assumptions(scenario, plans)):
        after += wrap_lines(assumed, 1)
    if (hint := _finer_tilts(folder, ranked)) and max_lines - len(before) - len(after) - 2 > MIN_POLES:
        after.append(hint)
    after.append(f"report: {folder.report} (has everything; --verbose prints it)")
    room = max_lines - len(before) - len(after) - 1
    count = poles or min(DEFAULT_POLES, max(MIN_POLES, room))
    out = console(LINE_WIDTH, soft_wrap=False)
    for line in before:
        out.print(line)
    out.print(_short_table(ranked, PeriodRanking.read(folder.path), count, has_relief))
    for line in after:
        out.print(line, soft_wrap=True)  # a path that is broken into lines cannot be copied


def _finer_tilts(folder: RunFolder, ranked: Ranking) -> str:
    """Return the command that searches tilts, where the best one may lie beside those that were tried; else empty.

    That is where the best site has the steepest or the flattest tilt on its pole, or where the next one is further away
    than :data:`_TILT_STEP_DEG`.
    """
    best = ranked.best[0]
    on_pole = next(pole for pole in ranked.poles if pole.name == best.pole).sites
    others = [site.pitch_deg - best.pitch_deg for site in on_pole if site.sensor == best.sensor]
    steeper, flatter = [-step for step in others if step < 0], [step for step in others if step > 0]
    if not (steeper or flatter):
        return ""
    if steeper and flatter and max(min(steeper), min(flatter)) <= _TILT_STEP_DEG:
        return ""
    return f"Finer tilts: {shlex.join(['egvs', 'place', str(folder.path), '--count', '1', '--refine'])}"


def _worst_location(folder: RunFolder, best: RankedSite) -> str:
    """Return the lane, turn or crossing where the smallest share of vehicles is found; empty if none is below all."""
    for blindspots in readers.read_blindspots(folder.blindspots, {best.site}):
        return next((location.in_words() for location in blindspots.worst), "")
    return ""


def _print_details(
    folder: RunFolder, ranked: Ranking, scenario: Scenario, record: RunRecord, poles: int | None
) -> None:
    """Print all that is known of the ranking."""
    out = console(_FILE_WIDTH)
    out.print()
    _print_ranking(out, folder.path, ranked, scenario, record, poles)
    traffic_summary = record.traffic_summary
    plans = traffic_summary.get("signals", ())
    sentences = signal_sentences(plans)
    on_road = sections.describe_poles_on_road(ranked.poles[: sections.NAMED_POLES], _warnings(record))
    if missing := sections.describe_missing_traffic(_warnings(record)):
        sentences.append(missing)
    if caveats := sections.describe_caveats(scenario, "ranking", on_road, plans):
        sentences.append(caveats)
    sentences += reliability.describe_reliability(ranked, traffic_summary, scenario.score.ranking_detectors)
    sensors = [site.sensor for site in ranked.sites]
    if ranked.has_noticed and (note := upper_limit_note(scenario, sensors)):
        sentences.append(note)
    if note := range_note(sensors, is_modelled=has_losses(scenario, sensors)):
        sentences.append(note)
    print_sentences(sentences)
    if len(set(sensors)) == 1:
        out.print(
            f"Which sensor? {shlex.join(['egvs', 'compare', str(folder.path), '--sensors', 'NAME,NAME'])} (or all)"
        )
    out.print(f"report: {folder.report}")


def signal_sentences(plans: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the plans of the signals in the region, one sentence each, and how many more there are."""
    sentences = [format_plan(plan) for plan in plans[:_MAX_SIGNALS]]
    more = len(plans) - _MAX_SIGNALS
    if more > 0:
        sentences.append(
            f"{number_of(more, 'more signal')} {by_number(more, 'is', 'are')} in the region; see the report."
        )
    return sentences


def _warnings(record: RunRecord) -> list[Diagnostic]:
    return collect_warnings(stage.summary for stage in record.stages.values())


def flow_source(scenario: Scenario) -> str:
    """Return what the simulated flows of a scenario are compared with, in words."""
    if sections.assumes_flows(scenario):
        return stage_summary.ASSUMED_FLOWS
    return stage_summary.COUNTS


def _print_ranking(
    out: Console, folder: Path, ranked: Ranking, scenario: Scenario, record: RunRecord, poles: int | None
) -> None:
    """Print the verdict, the best poles, the lanes seen worst, and how the order by EGVS differs."""
    hint = ranking_text.recorded_frames_hint(scenario, ranked, record.stages)
    groups = read_levels(RunFolder(folder).levels, ranked.sites[0].site)
    found = detection_level(scenario, scenario.score.ranking_detectors, ranked.sites[0].sensor, groups)
    print_sentences([verdict(ranked, hint, found)])
    for part in read_sections(RunFolder(folder), scenario, record.stages):
        for warning in part.warnings:
            print_sentences([f"{warning.sentence} See {RunFolder(folder).report}#{part.section.name}"])
    summary = record.stages["score"].summary
    if ranked.by.counts_vehicles and "weights" in summary:
        print_sentences([f"Vehicles are weighted: {summary['weights']}."])
    out.print()
    out.print(poles_table(ranked, PeriodRanking.read(folder), poles))
    out.print()
    if location := _location(ranked.best[0]):
        out.print(location)
    if missed := summary.get("missed"):
        print_sentences([missed])
    for key in ("zones", "zones_for_pedestrians"):
        if in_zones := summary.get(key):
            print_sentences([in_zones])
    if other_order := order_by_egvs(ranked, parquet.read_metadata(RunFolder(folder).scores, "scores")):
        print_sentences([other_order])
    if preference := ranking_text.noticed_preference(ranked):
        print_sentences([preference])


def verdict(ranked: Ranking, hint: str = "", found: DetectionLevel = NO_DETECTORS) -> str:
    """Return a few sentences: the best site, how clearly it leads and, if unclear, the ``hint`` on what helps.

    ``found`` as for :func:`egvs.report.ranking_text.level`.
    """
    sentences = [f"{ranking_text.headline(ranked, has_traffic=True, found=found)}."]
    if lead := ranking_text.lead(ranked, hint):
        sentences.append(lead)
    return " ".join(sentences)


def _location(site: RankedSite) -> str:
    """Return the geographic position of a site, in one sentence; empty where the scenario has no reference system."""
    if site.latitude_deg is None or site.longitude_deg is None:
        return ""
    return f"{site.site} is at latitude {site.latitude_deg:.6f}, longitude {site.longitude_deg:.6f}."


def order_by_egvs(ranked: Ranking, metadata: Mapping[str, Any]) -> str:
    """Return how the order by EGVS differs, in one sentence; empty where the EGVS ranks or has the same best site."""
    by_egvs = ranking_text.best_sites(ranked.sites, "egvs")
    if ranked.by.name == "egvs" or not by_egvs or by_egvs[0] == ranked.sites[0].site:
        return ""
    names = join_names(by_egvs)
    return (
        f"The EGVS (gamma {metadata['gamma']:g}) measures the traffic's uncertainty that beams cross, not "
        f"{ranked.by.noun}, and prefers {names}."
    )


def poles_table(ranked: Ranking, by_period: PeriodRanking | None, count: int | None) -> Table:
    """Return the best poles, how their best candidates are mounted, and what they achieve."""
    poles = ranked.poles[:count]
    columns = [
        Column[Pole]("", lambda pole: str(1 + poles.index(pole))),
        Column[Pole]("pole", lambda pole: pole.name, "left", wrap=True),
        *_mount_columns(ranked.sites, poles),
        Column[Pole](ranked.by.head, lambda pole: ranked.by.value(pole.best.score)),
    ]
    if ranked.has_errors:
        columns.append(Column("std error", lambda pole: ranked.by.error(pole.best.score, pole.best.score_se)))
    if ranked.has_noticed:
        columns.append(Column(SCORE_LABELS[NOTICED].head, lambda pole: pole.best.noticed_cell))
    if ranked.companion_score is not None:
        columns.append(_companion_column(ranked.companion_score))
    if by_period is not None and len(by_period.periods) <= _MAX_PERIODS:
        columns += _period_columns(by_period)
    return make_table(columns, poles)


def _describe_best(site: RankedSite, *, has_relief: bool) -> str:
    mount = describe_mount(site, has_relief=has_relief)
    return mount if is_named_after_pole(site) else f"{site.site}: {mount}"


def _short_table(ranked: Ranking, by_period: PeriodRanking | None, count: int, has_relief: bool) -> Table:
    """Return the best poles with what differs most: mount, score, distance to the best one, and ranks by period."""
    best, poles = ranked.best[0], ranked.poles[:count]

    def behind(pole: Pole) -> str:
        if pole.best.score == best.score:
            return "-"
        se = math.nan if pole.best.behind_best_se is None else pole.best.behind_best_se
        return ranked.by.change(best.score - pole.best.score, se)

    columns = [
        Column[Pole]("", lambda pole: str(1 + poles.index(pole))),
        Column[Pole]("pole", lambda pole: pole.name, "left"),
        Column[Pole]("best mount", lambda pole: _describe_best(pole.best, has_relief=has_relief), "left"),
    ]
    if len({site.sensor for site in ranked.sites}) > 1:
        columns.append(Column("sensor", lambda pole: pole.best.sensor, "left"))
    columns.append(Column(ranked.by.head, lambda pole: ranked.by.value(pole.best.score)))
    columns.append(Column(f"behind, {ranked.by.change_head}".rstrip(", "), behind))
    if ranked.has_noticed:
        columns.append(Column(SCORE_LABELS[NOTICED].head, lambda pole: pole.best.noticed_cell))
    if by_period is not None and len(by_period.periods) <= _MAX_PERIODS:
        columns += _period_columns(by_period)
    return make_table(columns, poles, truncate=True)


def _mount_columns(sites: Sequence[RankedSite], poles: Sequence[Pole]) -> list[Column[Pole]]:
    """Return columns for what differs: site, sensor, yaw and pitch only where there are several."""
    columns: list[Column[Pole]] = []
    if any(pole.best.site != pole.name for pole in poles):
        columns.append(Column("best site", lambda pole: pole.best.site, "left", wrap=True))
    if len({site.sensor for site in sites}) > 1:
        columns.append(Column("sensor", lambda pole: pole.best.sensor, "left"))
    columns.append(Column("z m", lambda pole: f"{pole.best.z_m:.4g}"))
    if any(site.yaw_deg or site.pitch_deg for site in sites):
        columns.append(Column("ccw yaw deg", lambda pole: f"{pole.best.yaw_deg:.0f}"))
        columns.append(Column("pitch deg", lambda pole: f"{pole.best.pitch_deg:z.0f}"))
    return columns


def _companion_column(label: ScoreLabel) -> Column[Pole]:
    def text(pole: Pole) -> str:
        value = pole.best.value_of(label.name)
        return "-" if value is None else label.value(value)

    return Column(label.head, text)


def _period_columns(by_period: PeriodRanking) -> list[Column[Pole]]:
    """Return the rank of the best site of a pole in each period."""
    ranks = {row.site: row.by_period for row in by_period.sites}

    def text(number: int, pole: Pole) -> str:
        return str(ranks[pole.best.site][number].rank)

    return [Column(f"in {name}", partial(text, number)) for number, name in enumerate(by_period.periods)]
