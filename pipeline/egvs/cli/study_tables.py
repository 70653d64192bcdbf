"""What ``egvs compare`` prints: runs, poles, sensors, assumed heights, and settings side by side.

Runs in columns and poles or sites in rows, the agreement of their rankings, the best mount of each sensor, and the
differences of settings.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.table import Table

from egvs.cli.console import (
    LINE_WIDTH,
    NARROW,
    Column,
    console,
    format_or_dash,
    make_table,
    percent_or_dash,
    print_sentences,
)
from egvs.core.wording import list_first, number_of
from egvs.report.sensor_text import (
    costs_option,
    describe_order,
    describe_trust,
    explain_differences,
    explain_sensor_differences,
    noticed_preference,
    range_note,
)
from egvs.results.labels import SCORE_LABELS, join_names
from egvs.results.ranking import RankedSite, describe_roll, share_of_limit
from egvs.results.sensors import (
    ScoreDifference,
    SensorComparison,
    SensorResult,
    format_difference,
)
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED
from egvs.scenario.settings import effect_state

if TYPE_CHECKING:
    from egvs.studies.assumed_heights import HeightRuns, HeightSensitivity, RankedAgain
    from egvs.studies.run_comparison import ComparedPole, ComparedRun, Comparison, Difference, RankAgreement

_FILE_WIDTH = LINE_WIDTH
_MIN_RANKED = 5
"""With fewer common poles or sites, rank correlations say nothing, and are not printed."""
DEFAULT_ROWS = 5
"""Poles or sites that are listed, unless another number is asked for."""
_ALL_PAIRS_RUNS = 5
"""With more runs, the agreement of rankings is printed for pairs with the first run only."""
_COLUMN_GAP = 2
"""Space that rich leaves between two columns."""


def print_comparison(comparison: Comparison, top: int | None = None) -> None:
    """Print runs side by side.

    Parameters
    ----------
    comparison
        The runs.
    top
        How many poles or sites of the first run are printed; the best :data:`DEFAULT_ROWS` for None.
    """
    top = top or DEFAULT_ROWS
    out = console(_FILE_WIDTH, soft_wrap=False)
    for run in comparison.runs:
        out.print(f"{run.label}  {run.folder}  ({join_names(run.sensors)})", soft_wrap=True)
    out.print()
    for table in _result_tables(comparison, top, out.width):
        out.print(table)
    rows = len(comparison.poles if comparison.by == "pole" else comparison.sites)
    if rows > top:
        out.print(f"{number_of(rows - top, f'more {comparison.by}')}: --top {rows} lists all")
    out.print()
    if comparison.by == "pole":
        _print_pole_notes(out, comparison)
    out.print(_agreement_table(comparison))
    out.print()
    if comparison.sensors is not None:
        _print_sensors(out, comparison, comparison.sensors)
    if comparison.differences:
        _print_differences(out, comparison)
    elif len({run.folder for run in comparison.runs}) > 1:
        out.print("their settings and files are the same")
    print_sentences(f"note: {note}" for note in comparison.notes)


def print_height_sensitivity(sensitivity: HeightSensitivity) -> None:
    """Print the ranks of the best sites with changed heights of buildings, and which of them change."""
    label = sensitivity.label

    def rank_cell(number: int) -> Callable[[RankedAgain], str]:
        def cell(site: RankedAgain) -> str:
            score = site.scores[number]
            return "-" if score is None else f"{site.ranks[number]}  {label.value(score)}"

        return cell

    columns: list[Column[RankedAgain]] = [Column("site", lambda site: site.name, align="left")]
    for number, height_run in enumerate(sensitivity.runs.runs):
        columns.append(Column(height_run.label, rank_cell(number)))
    out = console(_FILE_WIDTH, soft_wrap=False)
    out.print(make_table(columns, sensitivity.sites, width=out.width, title=f"rank, and {label.label}"))
    out.print()
    print_sentences(sensitivity.conclusion())


def print_no_assumed_height(height_runs: HeightRuns) -> None:
    """Print that the ranking depends on no assumed height."""
    print_sentences(
        [f"No height is assumed: all {height_runs.buildings:,} buildings have one from the map or by hand."]
    )


def _result_tables(comparison: Comparison, top: int | None, width: int) -> Iterator[Table]:
    """Yield tables of the poles or sites, with as many runs side by side as fit; the first run is in each."""
    first, *others = range(len(comparison.runs))
    start = 0
    while start < len(others):
        count = len(others) - start
        table = _result_table(comparison, [first, *others[start:]], top, width)
        while count > 1 and _unwrapped_width(table) > width:
            count -= 1
            table = _result_table(comparison, [first, *others[start : start + count]], top, width)
        yield table
        start += count


def _unwrapped_width(table: Table) -> int:
    """Return the width of a table, if nothing is wrapped."""
    widths = []
    for column in table.columns:
        cells = [str(column.header), *(str(cell) for cell in column.cells)]
        widths.append(max(len(cell) for cell in cells))
    return sum(widths) + _COLUMN_GAP * len(widths)


def _result_table(comparison: Comparison, runs: Sequence[int], top: int | None, width: int) -> Table:
    if comparison.by == "pole":
        return make_table(_pole_columns(comparison, runs, width), comparison.poles[:top], width=width)
    return _site_table(comparison, [comparison.runs[run] for run in runs], comparison.sites[:top], width)


# ---- by pole


def _pole_columns(comparison: Comparison, runs: Sequence[int], width: int) -> list[Column[ComparedPole]]:
    """Return the best mount of each pole in some runs, and the differences from the first run."""
    columns: list[Column[ComparedPole]] = [Column("pole", lambda pole: pole.name, "left", wrap=True)]
    has_same_mounts = width < NARROW and all(_is_same_mount(pole) for pole in comparison.poles)
    for run in runs:
        columns += _mount_columns(comparison, run, width, with_mount=run == 0 or not has_same_mounts)
        if run > 0 and any(pole.differences[run] is not None for pole in comparison.poles):
            title = f"{comparison.runs[run].label} - {comparison.runs[0].label}"
            columns.append(Column(title, partial(_format_gap, run)))
    return columns


def _is_same_mount(pole: ComparedPole) -> bool:
    """Whether the best mounts of a pole have the same height, tilt and roll in all runs."""
    poses = {None if mount is None else (mount.z_m, mount.pitch_deg, mount.roll_deg) for mount in pole.mounts}
    return len(poses) == 1


def _mount_columns(
    comparison: Comparison, run: int, width: int, *, with_mount: bool = True
) -> list[Column[ComparedPole]]:
    """Return the columns of one run, without those that are the same at all its sites."""
    compared = comparison.runs[run]
    sites = compared.ranking.sites
    names = [(pole.mounts[run], pole.name) for pole in comparison.poles]
    columns: list[Column[ComparedPole]] = []

    def column(title: str, text: Callable[[RankedSite], str], align: Literal["left", "right"] = "right") -> None:
        def cell(pole: ComparedPole) -> str:
            mount = pole.mounts[run]
            return "-" if mount is None else text(mount)

        columns.append(Column(f"{compared.label} {title}", cell, align, wrap=align == "left"))

    is_pitched = any(site.pitch_deg for site in sites)
    if width < NARROW:
        if with_mount:
            column("mount", partial(_describe_mount, is_pitched), "left")
    elif any(mount is not None and mount.site != name for mount, name in names):
        column("best site", lambda site: site.site, "left")
    if len(compared.sensors) > 1:
        column("sensor", lambda site: site.sensor, "left")
    if width >= NARROW:
        column("z m", lambda site: f"{site.z_m:.4g}")
        if any(site.yaw_deg for site in sites):
            column("yaw", lambda site: f"{site.yaw_deg:.0f}")
        if is_pitched:
            column("pitch", lambda site: f"{site.pitch_deg:z.0f}")
    column(compared.ranking.by.head, format_score)
    return columns


def _describe_mount(with_pitch: bool, site: RankedSite) -> str:
    """Return height, pitch and roll, e.g. "3 m, -10°, upside down"."""
    parts = [f"{site.z_m:.4g} m", f"{site.pitch_deg:z.0f}°" if with_pitch else "", describe_roll(site.roll_deg)]
    return ", ".join(part for part in parts if part)


def format_score(site: RankedSite) -> str:
    """Return the score that ranks with its standard error, relative for scores that are no shares.

    A share of vehicles found has none here: its error is mostly that of the level, which all sites share; the errors of
    differences are in a column of their own.
    """
    if site.by.name == DEFAULT_SCORE:
        return site.by.value(site.score)
    if site.by.is_share:
        return site.by.with_error(site.score, math.nan if site.score_se is None else site.score_se)
    error = site.by.error(site.score, site.score_se)
    if error == "-":
        return site.by.value(site.score)
    return f"{site.by.value(site.score)} ± {error.removeprefix('±')}"


def _format_gap(run: int, pole: ComparedPole) -> str:
    difference, mount = pole.differences[run], pole.mounts[run]
    if difference is None or mount is None:
        return "-"
    return format_difference(difference, mount)


def _print_pole_notes(out: Console, comparison: Comparison) -> None:
    """Explain the table of poles, and say at how many poles another run is better."""
    first = comparison.runs[0]
    compared = [run for run in range(1, len(comparison.runs)) if _gaps(comparison, run)]
    sentences = []
    for run in compared:
        gaps = _gaps(comparison, run)
        better = [gap.is_clear for gap in gaps if gap.value > 0]
        worse = [gap.is_clear for gap in gaps if gap.value < 0]
        label = comparison.runs[run].label
        text = f"{label} is better than {first.label} at {len(better)} of {len(gaps)} poles (clearly at {sum(better)})"
        sentences.append(f"{text}, worse at {len(worse)} (clearly at {sum(worse)}).")
    if compared and comparison.sensors is None:
        sentences.append(explain_differences(first.label, first.ranking.best[0]))
    print_sentences(sentences)
    out.print()


def _gaps(comparison: Comparison, run: int) -> list[ScoreDifference]:
    differences = [pole.differences[run] for pole in comparison.poles]
    return [difference for difference in differences if difference is not None]


# ---- sensors


def _print_sensors(out: Console, comparison: Comparison, sensors: SensorComparison) -> None:
    """Print the best mount of each sensor, what it costs, and how far the comparison can be trusted."""
    by = sensors.baseline.site.by
    columns: list[Column[SensorResult]] = []
    if len(sensors.results) > len(sensors.sensors):
        columns.append(Column("run", lambda result: result.mount.run, "left"))
    columns += [
        Column("sensor", lambda result: result.mount.sensor, "left", wrap=True),
        Column("best site", lambda result: result.mount.site.site, "left", wrap=True),
        Column("z m", lambda result: f"{result.mount.site.z_m:.4g}", min_width=NARROW),
    ]
    if sensors.has_yaw_or_pitch:
        columns.append(Column("yaw", lambda result: f"{result.mount.site.yaw_deg:.0f}", min_width=NARROW))
        columns.append(Column("pitch", lambda result: f"{result.mount.site.pitch_deg:z.0f}", min_width=NARROW))
    columns.append(Column(by.head, lambda result: format_score(result.mount.site)))
    if all(result.mount.site.noticed is not None for result in sensors.results):
        columns.append(Column(SCORE_LABELS[NOTICED].head, lambda result: result.mount.site.noticed_text))
    columns.append(Column(f"difference\nfrom {sensors.baseline_name}", lambda result: result.gain_text))
    if any(result.mount.cost is not None for result in sensors.results):
        columns.append(Column("cost", lambda result: result.cost_text))
    out.print(make_table(columns, sensors.results, width=out.width, title="the best mount of each sensor"))
    print_sentences([explain_sensor_differences(sensors)])
    if preference := noticed_preference(sensors):
        print_sentences([preference])
    if sensors.unpriced:
        option = costs_option(sensors.sensors if not sensors.has_costs else sensors.unpriced)
        out.print(f"With costs: {option}, or [costs] in scenario.toml", soft_wrap=True)  # to be copied
    is_modelled = all(run.has_losses for run in comparison.runs)
    if note := range_note(sensors.sensors, is_modelled=is_modelled):
        print_sentences([note])
    print_sentences([describe_trust(sensors)])
    if order := describe_order(sensors):
        print_sentences([order])
    out.print()


# ---- by site


def _run_columns(run: ComparedRun, width: int) -> list[Column[str]]:
    """Return the columns of one run, whose rows are names of sites."""
    label = SCORE_LABELS[run.rank_by]

    def cell_text(text: Callable[[RankedSite], object], site_name: str) -> str:
        site = run.sites.get(site_name)
        if site is None:
            return "-"
        return str(text(site))

    score = Column(f"{run.label} {label.head}", partial(cell_text, lambda site: label.value(site.score)))
    error = Column(f"{run.label} error", partial(cell_text, lambda site: label.error(site.score, site.score_se)))
    egvs = Column(f"{run.label} bit", partial(cell_text, lambda site: f"{site.egvs:.1f}"))
    share = Column(f"{run.label} of limit", partial(cell_text, lambda site: percent_or_dash(share_of_limit(site))))
    rank = Column(f"{run.label} rank", partial(cell_text, lambda site: site.rank))

    columns = [score, error, egvs, rank]
    if run.rank_by == "egvs":
        columns = [egvs, error, share, rank]
    if width >= NARROW:
        return columns
    if len(run.label) == 1:
        return [column for column in columns if column is not error]
    return columns[-2:]


def _site_table(comparison: Comparison, runs: Sequence[ComparedRun], names: Sequence[str], width: int) -> Table:
    """Return the scores of sites in several runs."""
    sites = {name: next(run.sites[name] for run in comparison.runs if name in run.sites) for name in names}
    columns = [Column[str]("site", str, "left", wrap=True)]
    for title, key in (("x m", "x_m"), ("y m", "y_m"), ("z m", "z_m")):
        columns.append(Column(title, partial(_format_value, sites, key, ".2f"), min_width=NARROW))
    if any(site.longitude_deg is not None for site in sites.values()):
        for title, key in (("longitude", "longitude_deg"), ("latitude", "latitude_deg")):
            columns.append(Column(title, partial(_format_value, sites, key, ".6f"), min_width=NARROW))
    for run in runs:
        columns += _run_columns(run, width)
    return make_table(columns, names, width=width)


def _format_value(sites: dict[str, RankedSite], key: str, spec: str, name: str) -> str:
    return format_or_dash(getattr(sites[name], key), spec)


# ---- agreement and settings


def _agreement_table(comparison: Comparison) -> Table:
    columns: list[Column[RankAgreement]] = [
        Column("runs", lambda pair: f"{pair.a}, {pair.b}", "left"),
        Column(f"common {comparison.by}s", lambda pair: str(pair.shared), wrap=True),
    ]
    if any(pair.shared >= _MIN_RANKED for pair in comparison.agreements):
        columns.append(Column("tau", lambda pair: _format_correlation(pair, pair.tau)))
        columns.append(Column("rho", lambda pair: _format_correlation(pair, pair.rho)))
    columns += [
        Column("best", _format_best_sites, "left", wrap=True),
        Column("regret of the first run's best", lambda pair: percent_or_dash(pair.regret_a, 2), wrap=True),
    ]
    first = comparison.runs[0].label
    with_first = [pair for pair in comparison.agreements if pair.a == first]
    if len(comparison.runs) <= _ALL_PAIRS_RUNS:
        return make_table(columns, comparison.agreements)
    return make_table(columns, with_first, caption=f"only pairs with {first}; compare fewer runs for the others")


def _format_correlation(pair: RankAgreement, value: float | None) -> str:
    return format_or_dash(value if pair.shared >= _MIN_RANKED else None, ".2f")


def _format_best_sites(pair: RankAgreement) -> str:
    if not pair.shared:
        return "-"
    if pair.best_a == pair.best_b:
        return "the same: " + _format_names(pair.best_a)
    return f"{_format_names(pair.best_a)} / {_format_names(pair.best_b)}"


def _format_names(sites: tuple[str, ...]) -> str:
    return list_first(sites, 2)


def _difference_table(comparison: Comparison) -> Table:
    columns: list[Column[Difference]] = [Column("what differs", lambda row: row.what, "left")]
    for number, run in enumerate(comparison.runs):
        columns.append(Column(run.label, partial(_format_setting, number), "left"))
    return make_table(columns, comparison.differences)


def _print_differences(out: Console, comparison: Comparison) -> None:
    """Print what differs as a table; if it is wider than the terminal, in a sentence for each setting."""
    table = _difference_table(comparison)
    if _unwrapped_width(table) <= out.width:
        out.print(table)
        return
    out.print("what differs")
    sentences = []
    for difference in comparison.differences:
        values = [f"{run.label} {_format_setting(number, difference)}" for number, run in enumerate(comparison.runs)]
        sentences.append(f"{difference.what}: {', '.join(values)}")
    print_sentences(sentences)


def _format_setting(run: int, difference: Difference) -> str:
    value = difference.values[run]
    if state := effect_state(difference.what, value):
        return state
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False)
