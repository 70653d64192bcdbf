"""What ``egvs validate --labels`` prints about lists of labels, and its page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from egvs.cli.console import Column, print_sentences, print_table
from egvs.core.wording import number_of
from egvs.extensions.validation.measured.figures import Panel, Series, range_figure
from egvs.extensions.validation.measured.label_agreement import NEARER_M, AgreementRow, ComparedList, ScoreRow
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


def columns(tested: ComparedList, *, by_points: bool = False) -> list[Column[AgreementRow]]:
    """Return the columns of the table by range, or by points."""
    has = "found" if tested.is_detections else "labelled"
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
    if tested.sensor is not None:
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


def title(tested: ComparedList) -> str:
    """Return what a table is about."""
    what = "detections" if tested.is_detections else "labels"
    return f"Of what {join_names(tested.others)} has, what do the {what} {tested.name} have? (± 2 se)"


def sentences(tested: ComparedList) -> Iterator[str]:
    """Yield what the tables mean, and what was assumed."""
    cars = next((row for row in tested.rows if row.group == "cars" and row.high == FARTHEST_M), None)
    sensor = "" if tested.sensor is None else f", by {tested.sensor}"
    yield f"{tested.name}{sensor}: {number_of(tested.sweeps, 'pair')} of sweeps."
    if cars is not None:
        has = "finds" if tested.is_detections else "has"
        text = f"It {has} {share_text(cars.found)} of the cars within {FARTHEST_M:g} m"
        if not math.isnan(cars.by_chance.value):
            text += f" ({share_text(cars.by_chance)} by chance)"
        if cars.people is not None and cars.difference is not None:
            text += f"; people should notice {share_text(cars.people)}: {difference_text(cars.difference)} points"
        yield f"{text}."
    if tested.losses is not None:
        yield (
            f"Points are simulated on boxes, with losses: rated range {tested.losses.rated_range_m:g} m at "
            f"{tested.losses.rated_reflectivity:g}, reflectivity of cars {tested.losses.target_reflectivity():g}."
        )
    yield from tested.notes


def print_agreement(results: Sequence[ComparedList]) -> None:
    """Print tables and sentences of each tested list."""
    for number, tested in enumerate(results):
        print_sentences([*([""] if number else []), title(tested)])
        if tested.rows:
            print_table(columns(tested), tested.rows, file_width=_FILE_WIDTH)
        if tested.point_rows:
            print_sentences(["", f"The same by simulated points, to {FARTHEST_M:g} m (± 2 se)"])
            print_table(columns(tested, by_points=True), tested.point_rows, file_width=_FILE_WIDTH)
        if tested.score_rows:
            print_sentences(["", "By the score of detections (± 2 se)"])
            print_table(SCORE_COLUMNS, tested.score_rows, file_width=_FILE_WIDTH)
        print_sentences(["", *sentences(tested)])


def write_agreement(results: Sequence[ComparedList], folder: Path, scenario: Scenario | None = None) -> list[Path]:
    """Write the results as JSON, and the page; return the files.

    Errors and ``scenario`` as of :func:`egvs.extensions.validation.measured.pages.write_pages`.
    """
    values = [asdict(tested) | {"notes": list(sentences(tested))} for tested in results]
    over = join_names([tested.name for tested in results])
    return write_pages([to_page(tested) for tested in results], without_nan(values), over, folder, scenario)


def to_page(tested: ComparedList) -> MeasuredPage:
    """Return the part of the page on one tested list."""
    tables = []
    if tested.rows:
        tables.append(PageTable.of("By range (± 2 se)", columns(tested), tested.rows))
    if tested.point_rows:
        heading = f"By simulated points, to {FARTHEST_M:g} m (± 2 se)"
        tables.append(PageTable.of(heading, columns(tested, by_points=True), tested.point_rows))
    if tested.score_rows:
        tables.append(PageTable.of("By the score of detections (± 2 se)", SCORE_COLUMNS, tested.score_rows))
    first, *others = sentences(tested)
    return MeasuredPage(
        heading=title(tested).removesuffix(" (± 2 se)"),
        lede=" ".join([first, *others[:1]]),
        figure=_figure(tested),
        caption="Share of the boxes of the other list by range, with two standard errors where there are enough blocks "
        "of time.",
        tables=tuple(tables),
        sentences=tuple(others[1:]),
    )


def _figure(tested: ComparedList) -> str:
    panels = []
    has = "found" if tested.is_detections else "labelled"
    for group in ("cars", "larger vehicles"):
        rows = [row for row in tested.rows if row.group == group and (row.low, row.high) != (0.0, FARTHEST_M)]
        if not rows:
            continue
        series = [Series(f"{has} within {NEAR_M:g} m", {_ends(row): row.found for row in rows})]
        if tested.is_detections:
            series.append(Series(f"{has} within {NEARER_M:g} m", {_ends(row): row.found_nearer for row in rows}))
        if tested.sensor is not None:
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
