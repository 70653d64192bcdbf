"""Draws what validation found: each site's score against what a detector finds there, and how well every score does.

One column a detector. Above, as the source paper's figure: EGVS as the scenario has it against the detector's measure,
a point a site with its standard error. Below: Spearman's rho of every score with that measure, with intervals of 95 %;
of scores with parameters, all that were tried. Readable in grey.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core import files
from pipeline.scenario.models import Scenario
from pipeline.studies.placed_names import PlacedNames
from pipeline.validation.agreement import Agreement, ScoreName, Validation, main_measure
from pipeline.validation.detection import ALL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARTEFACT = "validation.png"

_PER_CENT = 100.0
_DOT, _OWN = "#0072B2", "#D55E00"


def draw(path: Path, scenario: Scenario, done: Validation) -> None:
    """Write the figure as a PNG."""
    with files.aside(path) as partial:
        make(scenario, done).savefig(partial, dpi=150, format="png", metadata={"Software": None})


def make(scenario: Scenario, done: Validation) -> Figure:
    """The figure, laid out."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    detectors = list(dict.fromkeys(row.detector for row in done.detections))
    scores = len({str(its.score) for its in done.agreements})
    below = 1.2 + 0.17 * scores
    figure = Figure(figsize=(1.5 + 5.2 * len(detectors), 4.4 + below), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(detectors), height_ratios=(4.0, below), squeeze=False)
    figure.suptitle(f"Does the score foretell detection? {scenario.name}", fontsize=12)
    placed = [_scatter(panels[0, i], scenario, done, name) for i, name in enumerate(detectors)]
    for i, name in enumerate(detectors):
        _ranked(panels[1, i], done, name, own=done.own_score(scenario), named=i == 0)
    figure.draw_without_rendering()  # places the panels, so that names can be placed in them
    for i, (x, y, sites) in enumerate(placed):
        names = PlacedNames(panels[0, i], np.column_stack([x, y]))
        for site, at_x, at_y in zip(sites, x, y, strict=True):
            names.place(site, at_x, at_y)
    return figure


def _scatter(
    axes: Any, scenario: Scenario, done: Validation, detector: str
) -> tuple[list[float], list[float], list[str]]:
    """EGVS against what is detected; where the points are, and whose they are."""
    measure, own = main_measure(detector), done.own_score(scenario)
    rows = [row for row in done.detections if row.detector == detector and row.objects_of == ALL]
    score = {
        row.site: row.value
        for row in done.surrogates.rows
        if (row.score, row.parameters_json) == (own.score, own.parameters)
    }
    known = [row for row in rows if math.isfinite(row.measures[measure].value)]
    x = [score[row.site] / 1e3 for row in known]
    y = [_PER_CENT * row.measures[measure].value for row in known]
    half = [1.96 * _PER_CENT * row.measures[measure].se for row in known]
    axes.errorbar(x, y, yerr=np.nan_to_num(half), fmt="none", ecolor="0.7", elinewidth=1.0, zorder=1)
    axes.scatter(x, y, s=34, facecolors=_DOT, edgecolors="black", linewidths=0.6, zorder=3)
    axes.set(xlabel="EGVS, thousand bits", ylabel=_WORDS[measure])
    agreement = done.agreement(own, detector, measure)
    axes.set_title(f"{detector}: {_told(agreement)}", fontsize=10)
    axes.grid(True, color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)
    axes.margins(0.12)
    return x, y, [row.site for row in known]


def _told(agreement: Agreement) -> str:
    spearman = agreement.by_kind["spearman"]
    if not math.isfinite(spearman.value):
        return "no rank correlation"
    low, high = spearman.interval.low, spearman.interval.high
    between = f" ({low:.2f} to {high:.2f})" if math.isfinite(low) else ""
    return f"Spearman's rho {spearman.value:.2f}{between}, {spearman.sites} sites"


def _ranked(axes: Any, done: Validation, detector: str, own: ScoreName, *, named: bool) -> None:
    """Every score's rho, in the order of the scores."""
    measure = main_measure(detector)
    mine = [its for its in done.agreements if (its.detector, its.measure) == (detector, measure)]
    for line, its in enumerate(mine):
        spearman, colour = its.by_kind["spearman"], _OWN if its.score == own else _DOT
        if math.isfinite(spearman.interval.low):
            axes.plot(
                [spearman.interval.low, spearman.interval.high], [line, line], color="0.65", linewidth=1.4, zorder=1
            )
        shape = "D" if its.score == own else "o"
        axes.scatter(
            [spearman.value],
            [line],
            s=26,
            marker=shape,
            facecolors=colour,
            edgecolors="black",
            linewidths=0.5,
            zorder=3,
        )
    axes.set_yticks(range(len(mine)), [str(its.score) for its in mine] if named else [""] * len(mine), fontsize=6.5)
    axes.set_ylim(len(mine) - 0.5, -0.5)
    axes.set_xlim(-1.05, 1.05)
    axes.axvline(0.0, color="0.5", linewidth=0.8)
    axes.set_xlabel(f"Spearman's rho with {_WORDS[measure]}", fontsize=8)
    axes.grid(True, axis="both", color="0.92", linewidth=0.6)
    axes.tick_params(labelsize=7)


_WORDS = {
    "ap_combined_r40_iou70": "AP, from above + in space, R40, IoU 0.7, %",
    "seen_20": "vehicles with 20 points or more, %",
}
