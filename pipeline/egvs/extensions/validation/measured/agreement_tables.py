"""What ``egvs validate --labels`` prints about lists of labels, and its page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from egvs.cli.console import Column, print_sentences, print_table
from egvs.core.wording import number_of
from egvs.extensions.validation.measured.figures import Panel, Series, range_figure
from egvs.extensions.validation.measured.label_agreement import NEARER_M, AgreementRow, JudgedList, ScoreRow
from egvs.extensions.validation.measured.list_poses import NEAR_M
from egvs.extensions.validation.measured.pages import MeasuredPage, PageTable, write_pages
from egvs.extensions.validation.measured.ratios import Ratio
from egvs.extensions.validation.measured.tables import share_text, without_nan
from egvs.results.labels import join_names
from egvs.scenario.model import Scenario
from egvs.scoring.noticed import FARTHEST_M

_FILE_WIDTH = 150


def range_text(row: AgreementRow) -> str:
    """Return the ranges of a row."""
    is_total = row.low == 0.0 and row.high == FARTHEST_M
    return f"to {row.high:g} m" if is_total else f"{row.low:g}-{row.high:g} m"


def points_text(row: AgreementRow) -> str:
    """Return the points of a row."""
    return f"{row.low:g} and more" if math.isinf(row.high) else f"{row.low:g}-{row.high:g}"


def difference_text(ratio: Ratio | None) -> str:
    """Return a difference of shares with two standard errors, in points."""
    if ratio is None or math.isnan(ratio.value):
        return "-"
    value = f"{100 * ratio.value:+.0f}"
    return value if math.isnan(ratio.se) else f"{value} ± {200 * ratio.se:.0f}"


def columns(judged: JudgedList, *, by_points: bool = False) -> list[Column[AgreementRow]]:
    """Return the columns of the table by range, or by points."""
    has = "found" if judged.is_detections else "labelled"
    first: Column[AgreementRow] = Column("range", range_text, "left")
    if by_points:
        first = Column("simulated points", points_text, "left")
    listed: list[Column[AgreementRow]] = [
        Column("of", lambda row: row.group, "left"),
        first,
        Column("boxes", lambda row: f"{row.boxes:,}"),
        Column("objects", lambda row: f"{row.objects:,}"),
        Column(f"{has} within {NEAR_M:g} m", lambda row: share_text(row.found)),
        Column(f"within {NEARER_M:g} m", lambda row: share_text(row.found_nearer)),
        Column("by chance", lambda row: share_text(row.by_chance)),
    ]
    if judged.sensor is not None:
        listed += [
            Column("people", lambda row: share_text(row.people)),
            Column(f"people - {has}", lambda row: difference_text(row.difference)),
            Column("detectors", lambda row: share_text(row.detectors)),
        ]
    return listed


SCORE_COLUMNS: list[Column[ScoreRow]] = [
    Column("score from", lambda row: f"{row.score:g}" if row.score else "all"),
    Column("detections", lambda row: f"{row.detections:,}"),
    Column(f"cars found within {NEAR_M:g} m", lambda row: share_text(row.found)),
    Column(f"within {NEARER_M:g} m", lambda row: share_text(row.found_nearer)),
    Column("detections of nothing, per sweep", lambda row: f"{row.alone:.1f}"),
]


def title(judged: JudgedList) -> str:
    """Return what a table is about."""
    what = "detections" if judged.is_detections else "labels"
    return f"Of what {join_names(judged.others)} has, what do the {what} {judged.name} have? (± 2 se)"


def sentences(judged: JudgedList) -> Iterator[str]:
    """Yield what the tables mean, and what was assumed."""
    cars = next((row for row in judged.rows if row.group == "cars" and row.high == FARTHEST_M), None)
    sensor = "" if judged.sensor is None else f", by {judged.sensor}"
    yield f"{judged.name}{sensor}: {number_of(judged.sweeps, 'pair')} of sweeps."
    if cars is not None:
        has = "finds" if judged.is_detections else "has"
        text = f"It {has} {share_text(cars.found)} of the cars within {FARTHEST_M:g} m"
        if not math.isnan(cars.by_chance.value):
            text += f" ({share_text(cars.by_chance)} by chance)"
        if cars.people is not None and cars.difference is not None:
            text += f"; people should notice {share_text(cars.people)}: {difference_text(cars.difference)} points"
        yield f"{text}."
    if judged.losses is not None:
        yield (
            f"Points are simulated on boxes, with losses: rated range {judged.losses.rated_range_m:g} m at "
            f"{judged.losses.rated_reflectivity:g}, reflectivity of cars {judged.losses.target_reflectivity():g}."
        )
    yield from judged.notes


def print_agreement(results: Sequence[JudgedList]) -> None:
    """Print tables and sentences of each judged list."""
    for number, judged in enumerate(results):
        print_sentences([*([""] if number else []), title(judged)])
        if judged.rows:
            print_table(columns(judged), judged.rows, file_width=_FILE_WIDTH)
        if judged.point_rows:
            print_sentences(["", f"The same by simulated points, to {FARTHEST_M:g} m (± 2 se)"])
            print_table(columns(judged, by_points=True), judged.point_rows, file_width=_FILE_WIDTH)
        if judged.score_rows:
            print_sentences(["", "By the score of detections (± 2 se)"])
            print_table(SCORE_COLUMNS, judged.score_rows, file_width=_FILE_WIDTH)
        print_sentences(["", *sentences(judged)])


def write_agreement(results: Sequence[JudgedList], folder: Path, scenario: Scenario | None = None) -> list[Path]:
    """Write the results as JSON, and the page; return the files.

    Errors and ``scenario`` as of :func:`egvs.extensions.validation.measured.pages.write_pages`.
    """
    values = [asdict(judged) | {"notes": list(sentences(judged))} for judged in results]
    over = join_names([judged.name for judged in results])
    return write_pages([to_page(judged) for judged in results], without_nan(values), over, folder, scenario)


def to_page(judged: JudgedList) -> MeasuredPage:
    """Return the part of the page on one judged list."""
    tables = []
    if judged.rows:
        tables.append(PageTable.of("By range (± 2 se)", columns(judged), judged.rows))
    if judged.point_rows:
        heading = f"By simulated points, to {FARTHEST_M:g} m (± 2 se)"
        tables.append(PageTable.of(heading, columns(judged, by_points=True), judged.point_rows))
    if judged.score_rows:
        tables.append(PageTable.of("By the score of detections (± 2 se)", SCORE_COLUMNS, judged.score_rows))
    first, *others = sentences(judged)
    return MeasuredPage(
        heading=title(judged).removesuffix(" (± 2 se)"),
        lede=" ".join([first, *others[:1]]),
        figure=_figure(judged),
        caption="Share of the boxes of the other list by range, with two standard errors where there are enough blocks "
        "of time.",
        tables=tuple(tables),
        sentences=tuple(others[1:]),
    )


def _figure(judged: JudgedList) -> str:
    panels = []
    has = "found" if judged.is_detections else "labelled"
    for group in ("cars", "larger vehicles"):
        rows = [row for row in judged.rows if row.group == group and (row.low, row.high) != (0.0, FARTHEST_M)]
        if not rows:
            continue
        series = [Series(f"{has} within {NEAR_M:g} m", {_ends(row): row.found for row in rows})]
        if judged.is_detections:
            series.append(Series(f"{has} within {NEARER_M:g} m", {_ends(row): row.found_nearer for row in rows}))
        if judged.sensor is not None:
            series.append(Series("people should notice", {_ends(row): row.people for row in rows if row.people}))
            series.append(Series("models expect", {_ends(row): row.detectors for row in rows if row.detectors}))
        panels.append(Panel(group, tuple(_ends(row) for row in rows), tuple(series), in_percent=True))
    return (
        range_figure(panels, f"Share of cars and larger vehicles {has}, by range, beside what should be.")
        if panels
        else ""
    )


def _ends(row: AgreementRow) -> str:
    return f"{row.low:g}-{row.high:g}"
