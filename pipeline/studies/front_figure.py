"""Draws what accuracy costs in time: the figure of an accuracy study, with the front of settings that no other beats.

Two panels: on the left the settings that approximate the scenario's number, seconds against error, with the front of
those that no other beats in both; on the right those that measure something else, by how far their ranking agrees with
the scenario's, with the regret and the seconds beside. Kinds of settings differ in shape as well as in colour (Okabe
and Ito's palette); nothing depends on colour alone, and the figure is readable in grey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core import files

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")
_SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h")
_LEAST_ERROR = 1e-4
"""Smallest error that is drawn; an error of 0 is drawn there."""


@dataclass(frozen=True)
class PlottedSetting:
    """One setting. ``knob`` is what it turns; ``kind`` is "scenario", "reference", "approximates" or "measures"."""

    name: str
    kind: str
    knob: str
    seconds: float
    error: float
    tau: float
    regret: float
    front: bool
    recommended: bool
    default: bool


def draw_figure(settings: Sequence[PlottedSetting], tolerance: float, title: str, path: Path) -> None:
    """Write the figure as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    measures = sorted((s for s in settings if s.kind == "measures"), key=lambda s: (s.tau, -s.regret, -s.seconds))
    figure = Figure(figsize=(13.0, max(5.6, 1.6 + 0.24 * len(measures))), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    approximations = [s for s in settings if s.kind in ("approximates", "scenario")]
    _draw_approximations(left, approximations, tolerance)
    _draw_measures(right, measures)
    figure.suptitle(f"What accuracy costs in time: {title}", fontsize=12)
    figure.draw_without_rendering()  # places the panels, so that names can be placed in them
    _name_settings(left, approximations)
    with files.aside(path) as partial:
        figure.savefig(partial, dpi=150, format="png", metadata={"Software": None})


def _styles(settings: Sequence[PlottedSetting]) -> dict[str, tuple[str, str]]:
    named = dict.fromkeys(s.knob for s in settings if s.kind != "scenario")
    return {knob: (_COLOURS[i % len(_COLOURS)], _SHAPES[i % len(_SHAPES)]) for i, knob in enumerate(named)}


def _draw_approximations(axes: Any, settings: Sequence[PlottedSetting], tolerance: float) -> None:
    """Seconds against error, with the front."""
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="seconds, all stages",
        ylabel="error of the scores (or its standard error), %",
    )
    axes.set_title("Settings that approximate the same number", fontsize=10)
    _write_ticks_plainly(axes)
    axes.axhline(100 * tolerance, color="0.4", linewidth=1, linestyle="--")
    axes.annotate(
        f"asked for: {100 * tolerance:g} %", (0.01, 100 * tolerance), xycoords=("axes fraction", "data"), xytext=(0, 3),
        textcoords="offset points", fontsize=8, color="0.25",
    )  # fmt: skip
    front = sorted((s for s in settings if s.front), key=lambda s: s.seconds)
    axes.step(
        [s.seconds for s in front],
        [_error_percent(s) for s in front],
        where="post",
        color="0.35",
        linewidth=1.2,
        zorder=1,
    )
    _scatter(axes, settings)
    for s in settings:
        if s.recommended:
            axes.scatter(
                [s.seconds], [_error_percent(s)], s=230, facecolors="none", edgecolors="black", linewidths=1.6, zorder=4
            )
    axes.margins(x=0.08, y=0.12)
    axes.legend(fontsize=8, loc="upper right", framealpha=0.9, title="knob", title_fontsize=8)


def _write_ticks_plainly(axes: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _scatter(axes: Any, settings: Sequence[PlottedSetting]) -> None:
    for knob, (colour, shape) in _styles(settings).items():
        of_knob = [s for s in settings if s.knob == knob and s.kind != "scenario"]
        x, y = [s.seconds for s in of_knob], [_error_percent(s) for s in of_knob]
        axes.scatter(
            x, y, s=46, marker=shape, facecolors=colour, edgecolors="black", linewidths=0.6, label=knob, zorder=3
        )
    own = [s for s in settings if s.kind == "scenario"]
    axes.scatter(
        [s.seconds for s in own], [_error_percent(s) for s in own], s=210, marker="*", facecolors="#F0E442",
        edgecolors="black", linewidths=1.0, label="the scenario's own setting", zorder=5,
    )  # fmt: skip
    axes.grid(True, which="major", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)


def _draw_measures(axes: Any, settings: Sequence[PlottedSetting]) -> None:
    """One line a setting: the agreement of its ranking, its regret and its seconds."""
    axes.set_title("Settings that measure something else", fontsize=10)
    if not settings:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "none was tried", ha="center", color="0.4", transform=axes.transAxes)
        return
    axes.set(xlabel="Kendall's tau with the scenario's ranking (1: the same)")
    styles = _styles(settings)
    for line, s in enumerate(settings):
        colour, shape = styles[s.knob]
        axes.scatter(
            [s.tau], [line], s=46, marker=shape, facecolors=colour, edgecolors="black", linewidths=0.6, zorder=3
        )
        regret = "same best site" if s.regret == 0 else f"regret {s.regret:.2%}"
        axes.annotate(
            f"{regret}, {s.seconds:.2g} s", (1.02, line), xycoords=("axes fraction", "data"), va="center", fontsize=8,
            annotation_clip=False,
        )  # fmt: skip
    axes.set_yticks(range(len(settings)), [s.name for s in settings], fontsize=8)
    axes.grid(True, axis="both", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)
    axes.set_xlim(right=1.03)


def _error_percent(setting: PlottedSetting) -> float:
    return 100 * max(setting.error, _LEAST_ERROR)


def _name_settings(axes: Any, settings: Sequence[PlottedSetting]) -> None:
    """Name the recommended setting, the program's default and the front, each where it covers no other name and no
    marker."""
    renderer = axes.figure.canvas.get_renderer()
    taken = [axes.get_legend().get_window_extent(renderer)]
    markers = axes.transData.transform([(s.seconds, _error_percent(s)) for s in settings])
    named = [s for s in settings if (s.front or s.recommended or s.default) and s.kind != "scenario"]
    for s in sorted(named, key=lambda s: (not s.recommended, not s.default, s.seconds)):
        text = "recommended: " * s.recommended + "the program's default: " * s.default + s.name
        for align, x, y in (("left", 6, -11), ("right", -8, -11), ("left", 6, 6), ("right", -8, 6)):
            name = axes.annotate(
                text, (s.seconds, _error_percent(s)), xytext=(x, y), textcoords="offset points", fontsize=7.5,
                ha=align, zorder=2,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
            )  # fmt: skip
            box = name.get_window_extent(renderer)
            hides = any(box.overlaps(other) for other in taken) or any(box.contains(*marker) for marker in markers)
            if not hides and axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1):
                taken.append(box)
                break
            name.remove()
