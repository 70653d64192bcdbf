"""What ``egvs validate --against`` prints, and its page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from egvs.cli.console import Column, print_sentences, print_table
from egvs.core import files
from egvs.core.wording import format_percent, number_of
from egvs.drawing import pages
from egvs.extensions.validation.measured.comparison import Comparison, LevelRow, PointsRow, Ratio
from egvs.sensors.return_model import ReturnModel

JSON_FILE, PAGE_FILE, SENSOR_FILE = "against.json", "against.html", "sensor.toml"
TEMPLATES = Path(__file__).parent.parent / "templates"

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


def range_text(row: PointsRow) -> str:
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


def sentences(comparison: Comparison) -> Iterator[str]:
    """Yield what the tables mean, and what was assumed."""
    points, site = comparison.points, comparison.site
    sweeps = number_of(len(comparison.sweeps), "sweep")
    yield f"{site.sensor.name}: {len(points):,} labelled boxes in {sweeps}, held against the simulation of the same boxes."
    cars = points.of_class("car")
    on_box, measured = points.on_box[cars].sum(), int(points.measured[cars].sum())
    if measured:
        yield (
            f"Scores count points on boxes, not on bodies: with losses {on_box / measured:.2f} times the measured ones "
            "on cars."
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


def sensor_table(comparison: Comparison) -> str:
    """Return the lines of ``[sensors.NAME]`` with the fitted losses; empty without a fit."""
    fit, sensor, model = comparison.fit, comparison.site.sensor, comparison.model
    if fit is None or model is None:
        return ""
    lines = [
        f"# Losses fitted to {fit.vehicles} labelled boxes of {fit.objects} cars; rated range at a reflectivity of cars",
        f"# of {model.target_reflectivity():g}. Beams and optics are those of {sensor.name}: copy its other keys from",
        f'# [sensors."{sensor.name}"] of the scenario, or of egvs sensors "{sensor.name}".',
        f'[sensors."{sensor.name} fitted"]',
        *_beam_lines(comparison),
        f"rated_range_m = {fit.rated_range_m:.1f}",
        f"rated_reflectivity = {model.rated_reflectivity:g}",
        f"softness = {fit.softness:g}",
        f"dropout = {fit.dropout:g}",
    ]
    return "\n".join(lines) + "\n"
