"""What ``egvs validate --against`` prints, and its page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from egvs.cli.console import Column, format_or_dash, print_sentences, print_table
from egvs.clouds.simulation import REFLECTIVITY
from egvs.core import files
from egvs.core.wording import number_of
from egvs.extensions.validation.measured.comparison import Comparison, LevelRow, PointsRow
from egvs.extensions.validation.measured.detection import NEARBY_M, DetectionRow
from egvs.extensions.validation.measured.figures import Panel, Series, range_figure
from egvs.extensions.validation.measured.pages import MeasuredPage, PageTable, write_pages
from egvs.extensions.validation.measured.ratios import Ratio
from egvs.extensions.validation.measured.repetition import Repetition, RepetitionRow
from egvs.scenario.model import Scenario
from egvs.sensors.sensor_table import format_sensor_table, sensor_keys

SENSOR_FILE = "sensor.toml"

LOSSES = {
    "none": "without losses",
    "sensor": "with the sensor's losses",
    "fitted": "with the fitted losses",
    "measured": "with the measured points",
}

_FILE_WIDTH = 150


def ratio_text(ratio: Ratio) -> str:
    """Return a ratio with two standard errors: "2.93 ± 0.94"."""
    if math.isnan(ratio.value):
        return "-"
    return f"{ratio.value:.2f}" if math.isnan(ratio.se) else f"{ratio.value:.2f} ± {2 * ratio.se:.2f}"


def share_text(ratio: Ratio | None) -> str:
    """Return a share with two standard errors, in per cent."""
    if ratio is None or math.isnan(ratio.value):
        return "-"
    share = f"{100 * ratio.value:.0f}"
    return f"{share} %" if math.isnan(ratio.se) else f"{share} ± {200 * ratio.se:.0f} %"


def range_text(row: PointsRow | LevelRow | DetectionRow) -> str:
    """Return the ranges of a row."""
    return "all" if row.from_m is None else f"{row.from_m}-{row.to_m} m"


POINT_COLUMNS: list[Column[PointsRow]] = [
    Column("class", lambda row: row.label, "left"),
    Column("range", range_text, "left"),
    Column("boxes", lambda row: f"{row.boxes:,}"),
    Column("objects", lambda row: f"{row.objects:,}"),
    Column("measured points", lambda row: f"{row.measured:,}"),
    Column("simulated", lambda row: f"{row.simulated:,.0f}"),
    Column("with losses", lambda row: f"{row.expected:,.0f}"),
    Column("simulated / measured", lambda row: ratio_text(row.without_losses)),
    Column("with losses / measured", lambda row: ratio_text(row.with_losses)),
]


def level_columns(comparison: Comparison) -> list[Column[tuple[str, LevelRow]]]:
    """Return the columns of the table of levels; its rows are pairs of whose level it is, and a row."""
    columns: list[Column[tuple[str, LevelRow]]] = [
        Column("of", lambda row: row[1].group, "left"),
        Column("range", lambda row: range_text(row[1]), "left"),
        Column("boxes", lambda row: f"{row[1].boxes:,}"),
        Column("level", lambda row: row[0], "left"),
    ]
    for key in comparison.levels[0].people if comparison.levels else ():
        columns.append(Column(LOSSES[key], lambda row, key=key: share_text(_level(row, key))))  # type: ignore[misc]
    return columns


DETECTORS, PEOPLE = "detectors (models)", "people (noticed)"


def _level(row: tuple[str, LevelRow], key: str) -> Ratio | None:
    return (row[1].detectors if row[0] == DETECTORS else row[1].people).get(key)


def level_rows(comparison: Comparison) -> list[tuple[str, LevelRow]]:
    """Return the rows of the table of levels."""
    rows = []
    for level in comparison.levels:
        if level.detectors:
            rows.append((DETECTORS, level))
        rows.append((PEOPLE, level))
    return rows


DETECTION_COLUMNS: list[Column[DetectionRow]] = [
    Column("detector", lambda row: row.detector, "left"),
    Column("of", lambda row: row.group, "left"),
    Column("range", range_text, "left"),
    Column("boxes", lambda row: f"{row.boxes:,}"),
    Column("expected", lambda row: share_text(row.expected)),
    Column("simulated", lambda row: share_text(row.simulated)),
    Column("measured", lambda row: share_text(row.measured)),
    Column(f"simulated, {NEARBY_M:g} m", lambda row: share_text(row.simulated_nearby)),
    Column(f"measured, {NEARBY_M:g} m", lambda row: share_text(row.measured_nearby)),
    Column("AUC", lambda row: "-" if math.isnan(row.auc) else f"{row.auc:.2f}"),
    Column("expected to found, in quarters", lambda row: bins_text(row), "left", min_width=170),
]


def bins_text(row: DetectionRow) -> str:
    """Return expected and found shares in four bins: ".20 to .27, .74 to .55, ..."."""
    return ", ".join(f"{expected:.2f} to {found:.2f}" for expected, found in row.bins) or "-"


def sentences(comparison: Comparison) -> Iterator[str]:
    """Yield what the tables mean, and what was assumed."""
    points, site = comparison.points, comparison.site
    sweeps = number_of(len(comparison.sweeps), "sweep")
    yield f"{site.sensor.name}: {len(points):,} labelled boxes in {sweeps}, beside the simulation of the same boxes."
    cars = points.of_class("car")
    on_box, measured = points.on_box[cars].sum(), int(points.measured[cars].sum())
    if measured:
        yield (
            f"Scores count points on boxes, not on bodies: with losses, {on_box / measured:.2f} times the measured "
            f"ones on cars, and {points.expected[cars].sum() / measured:.2f} times on bodies."
        )
    if comparison.convention is not None:
        name, held = comparison.convention
        counts = ", ".join(f"{other} {count:,}" for other, count in held.items())
        yield f"Headings are taken as {name}, which the labels do not state: points in boxes by convention: {counts}."
    yield from comparison.notes
    if comparison.fit is not None:
        fit = comparison.fit
        low_m, high_m = fit.limit_interval_m
        text = (
            f"Losses fitted to {number_of(fit.vehicles, 'box', 'boxes')} of {number_of(fit.objects, 'car')}: half of "
            f"the returns from cars are lost at {fit.limit_m:.1f} m ({low_m:.1f} to {high_m:.1f}, 2 se)"
        )
        if fit.softness_se:
            low, high = fit.softness_interval
            yield f"{text}, softness {fit.softness:.1f} ({low:.1f} to {high:.1f})."
        else:
            yield f"{text}, with a softness of {fit.softness:.1f}, which these cars do not show."


def fitted_table(comparison: Comparison) -> str:
    """Return the lines of ``[sensors.NAME]`` with the fitted losses; empty without a fit."""
    fit, sensor, model = comparison.fit, comparison.site.sensor, comparison.model
    if fit is None or model is None:
        return ""
    keys = sensor_keys(sensor) | {
        "rated_range_m": round(fit.rated_range_m, 1),
        "rated_reflectivity": model.rated_reflectivity,
        "softness": round(fit.softness, 2),
        "dropout": fit.dropout,
    }
    if comparison.site.pose.is_inverted:
        keys["mount"] = "inverted"
    lines = [
        f"# Losses fitted to {number_of(fit.vehicles, 'labelled box', 'labelled boxes')} of "
        f"{number_of(fit.objects, 'car')}, at a reflectivity of cars of {model.target_reflectivity():g}."
    ]
    if sensor.table is not None:
        lines.append(f"# Add the key beams or pattern of {sensor.name}.")
    return "\n".join(lines) + "\n" + format_sensor_table(f"{sensor.name} fitted", keys)


def print_repetition(repetition: Repetition) -> None:
    """Print which returns repeat, and the rated range that the ground shows."""
    columns: list[Column[RepetitionRow]] = [
        Column("range", lambda row: f"{row.from_m}-{row.to_m} m", "left"),
        Column("static returns", lambda row: f"{row.returns:,}"),
        Column("repeat", lambda row: f"{100 * row.share:.1f} %"),
        Column("rated range by the ground, m", lambda row: format_or_dash(row.rated_range_m, ".0f")),
    ]
    print_sentences([f"Returns that come again in the next of {len(repetition.sweeps):,} sweeps"])
    print_table(columns, repetition.rows, file_width=_FILE_WIDTH)
    print_sentences(["", *repetition_sentences(repetition)])


def repetition_sentences(repetition: Repetition) -> Iterator[str]:
    """Yield what the repetition of returns says."""
    yield from repetition.site.assumptions[:1]
    sensor, fit = repetition.site.sensor, repetition.fit
    if fit is None:
        yield "The rated range is not fitted: too few returns are from the ground, or they show no limit."
    else:
        low_m, high_m = fit.interval_m
        yield (
            f"By {fit.returns:,} returns from the ground, half of the returns from a target of "
            f"{sensor.rated_reflectivity:g} are lost at {fit.rated_range_m:.0f} m ({low_m:.0f} to {high_m:.0f}, 2 se), "
            f"if the ground reflects {REFLECTIVITY['ground']:g}; the data sheet: "
            f"{format_or_dash(sensor.rated_range_m, '.0f')} m."
        )
    yield "This is the sensor's part. What vehicles reflect does not follow from it: that needs labels."


def print_comparison(comparison: Comparison) -> None:
    """Print both tables, the fitted sensor, and sentences."""
    print_sentences(["Points on vehicles (± 2 se)"])
    print_table(POINT_COLUMNS, comparison.rows, file_width=_FILE_WIDTH)
    print_sentences(["", "Level: what should be found of them (± 2 se)"])
    print_table(level_columns(comparison), level_rows(comparison), file_width=_FILE_WIDTH)
    if comparison.detections:
        print_sentences(["", "Detectors, sweep by sweep (boxes that overlap by more than 0.7; ± 2 se)"])
        print_table(DETECTION_COLUMNS, comparison.detections, file_width=_FILE_WIDTH)
    print_sentences(["", *sentences(comparison)])
    if table := fitted_table(comparison):
        print_sentences(["", table.rstrip()])


def write_comparison(comparison: Comparison, folder: Path, scenario: Scenario | None = None) -> list[Path]:
    """Write the results as JSON, the page, and the fitted sensor if there is one; return the files.

    Errors and ``scenario`` as of :func:`egvs.extensions.validation.measured.pages.write_pages`.
    """
    written = write_pages([to_page(comparison)], to_json(comparison), comparison.site.sensor.name, folder, scenario)
    if table := fitted_table(comparison):
        written.append(folder / SENSOR_FILE)
        files.write_text(written[-1], table)
    return written


def to_json(comparison: Comparison) -> dict[str, Any]:
    """Return the results as JSON values; unknown numbers are null."""
    points, fit = comparison.points, comparison.fit
    boxes = zip(
        points.sweep.tolist(), points.names, points.classes, points.range_m.tolist(), points.measured.tolist(),
        points.simulated.tolist(), points.expected.tolist(), points.on_box.tolist(), strict=True,
    )  # fmt: skip
    keys = ("sweep", "object", "class", "range_m", "measured", "simulated", "with_losses", "on_box")
    values: dict[str, Any] = {
        "sensor": comparison.site.sensor.name,
        "pose": asdict(comparison.site.pose),
        "sweeps": list(comparison.sweeps),
        "points": [asdict(row) for row in comparison.rows],
        "levels": [asdict(row) for row in comparison.levels],
        "detections": [asdict(row) for row in comparison.detections],
        "losses": None if comparison.model is None else asdict(comparison.model),
        "fitted_losses": None if fit is None else asdict(fit) | {"limit_interval_m": list(fit.limit_interval_m)},
        "headings": None if comparison.convention is None else comparison.convention[0],
        "notes": list(sentences(comparison)),
        "boxes": [dict(zip(keys, box, strict=True)) for box in boxes],
    }
    cleaned: dict[str, Any] = without_nan(values)
    return cleaned


def without_nan(value: Any) -> Any:
    """Return JSON values with null for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_page(comparison: Comparison) -> MeasuredPage:
    """Return the page."""
    levels = level_columns(comparison)
    tables = [
        PageTable.of("Points on vehicles (± 2 se)", POINT_COLUMNS, comparison.rows),
        PageTable.of("What should be found of them (± 2 se)", levels, level_rows(comparison)),
    ]
    if comparison.detections:
        title = "What detectors find, sweep by sweep (boxes that overlap by more than 0.7; ± 2 se)"
        tables.append(PageTable.of(title, DETECTION_COLUMNS, comparison.detections))
    lede, *others = sentences(comparison)
    return MeasuredPage(
        heading="Simulated and measured points, and what should be found",
        lede=lede,
        figure=_figure(comparison),
        caption="Cars by range, with two standard errors where there are enough of them. Left: simulated points over "
        "measured ones. Right: what people and models of detectors should find with the losses of the sensor, and "
        "what detectors find in the measured sweeps.",
        tables=tuple(tables),
        sentences=tuple(others),
        sensor=fitted_table(comparison),
    )


def _figure(comparison: Comparison) -> str:
    """Return the figure of cars by range; empty without cars at two ranges."""
    cars = [row for row in comparison.rows if row.label == "car" and row.from_m is not None]
    levels = [row for row in comparison.levels if row.group == "cars" and row.from_m is not None]
    detections = [row for row in comparison.detections if row.group == "cars" and row.from_m is not None]
    if not cars or not levels:
        return ""
    losses = "none" if comparison.model is None else "sensor"
    points = [
        Series("without losses", {_ends(row): row.without_losses for row in cars}),
        Series("with losses", {_ends(row): row.with_losses for row in cars}),
    ]
    shares = [
        Series("people should notice", {_ends(row): row.people[losses] for row in levels}),
        Series("models expect", {_ends(row): row.detectors[losses] for row in levels}),
    ]
    for name in dict.fromkeys(row.detector for row in detections):
        of_detector = [row for row in detections if row.detector == name]
        shares.append(
            Series(f"{name}, within {NEARBY_M:g} m", {_ends(row): row.measured_nearby for row in of_detector})
        )
        shares.append(Series(f"{name}, fitting box", {_ends(row): row.measured for row in of_detector}))
    categories = tuple(_ends(row) for row in cars)
    panels = [
        Panel(
            "simulated / measured points", categories, tuple(points[:1] if losses == "none" else points), reference=1.0
        ),
        Panel("share of the cars", categories, tuple(shares), in_percent=True),
    ]
    return range_figure(panels, "Simulated over measured points on cars by range, and shares of cars found by range.")


def _ends(row: PointsRow | LevelRow | DetectionRow) -> str:
    return f"{row.from_m}-{row.to_m}"
