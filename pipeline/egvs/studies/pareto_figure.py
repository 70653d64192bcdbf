"""Error against seconds; labels that do not overlap.

Writes names beside the points of a figure, where they cover no other name and no marker.

Draws what accuracy costs in time: the figure of an accuracy study, with the front of settings that no other beats.

Two panels: on the left the settings that approximate the scenario's number, seconds against error, with the front of
those that no other beats in both; on the right those that measure something else, by how far their ranking agrees with
the scenario's, with the regret and the seconds beside. Kinds of settings differ in shape as well as in colour (Okabe
and Ito's palette); nothing depends on colour alone, and the figure is readable in grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.core import files
from egvs.studies.score_errors import SettingResult
from egvs.studies.study_settings import APPROXIMATES, MEASURES, SCENARIO

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_LABEL_OFFSETS = (("left", 6, -11), ("right", -8, -11), ("left", 6, 6), ("right", -8, 6))


class LabelPlacement:
    """The names in one panel, after ``figure.draw_without_rendering()``.

    Parameters
    ----------
    axes
        The panel.
    points
        Its markers in the panel's data, (n, 2).
    """

    def __init__(self, axes: Any, points: NDArray[np.float64]) -> None:
        self._axes, self._renderer = axes, axes.figure.canvas.get_renderer()
        self._taken = [text.get_window_extent(self._renderer) for text in axes.texts]
        self._markers = axes.transData.transform(points)

    def add(self, text: str, x: float, y: float, size: float = 7.5) -> bool:
        """Write one name where there is room round its point; whether there was."""
        for align, right, up in _LABEL_OFFSETS:
            name = self._axes.annotate(
                text, (x, y), xytext=(right, up), textcoords="offset points", fontsize=size, ha=align, zorder=2,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
            )  # fmt: skip
            box = name.get_window_extent(self._renderer)
            hides = any(box.overlaps(other) for other in self._taken)
            hides = hides or any(box.contains(*marker) for marker in self._markers)
            if not hides and self._axes.bbox.containsx(box.x0) and self._axes.bbox.containsx(box.x1):
                self._taken.append(box)
                return True
            name.remove()
        return False


_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")
_SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h")
_MARKER = {"s": 46, "edgecolors": "black", "linewidths": 0.6, "zorder": 3}
_MIN_ERROR = 1e-4
"""Smallest error that is drawn; an error of 0 is drawn there."""


def draw_figure(settings: Sequence[SettingResult], tolerance: float, title: str, path: Path) -> None:
    """Write the figure as a PNG."""
    with files.atomic_write(path) as partial:
        make_figure(settings, tolerance, title).savefig(partial, dpi=150, format="png", metadata={"Software": None})


def make_figure(settings: Sequence[SettingResult], tolerance: float, title: str) -> Figure:
    """The figure, laid out; its first panel holds the settings that approximate, its second the others."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    measures = sorted((s for s in settings if s.kind == MEASURES), key=lambda s: (s.tau, -s.regret, -s.seconds))
    figure = Figure(figsize=(13.0, max(5.6, 1.6 + 0.24 * len(measures))), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    approximations = [s for s in settings if s.kind in (APPROXIMATES, SCENARIO)]
    _draw_approximations(left, approximations, tolerance)
    _draw_measures(right, measures)
    figure.suptitle(f"What accuracy costs in time: {title}", fontsize=12)
    figure.draw_without_rendering()  # places the panels, so that names can be placed in them
    _name_settings(left, approximations)
    return figure


def _styles(settings: Sequence[SettingResult]) -> dict[str, tuple[str, str]]:
    named = dict.fromkeys(s.knob for s in settings if s.kind != SCENARIO)
    return {knob: (_COLOURS[i % len(_COLOURS)], _SHAPES[i % len(_SHAPES)]) for i, knob in enumerate(named)}


def _draw_approximations(axes: Any, settings: Sequence[SettingResult], tolerance: float) -> None:
    """Seconds against error, with the front."""
    error = "error of the scores (or its standard error), %"
    axes.set(xscale="log", yscale="log", xlabel="seconds, all stages", ylabel=error)
    axes.set_title("Settings that approximate the same number", fontsize=10)
    _write_ticks_plainly(axes)
    axes.axhline(100 * tolerance, color="0.4", linewidth=1, linestyle="--")
    axes.annotate(
        f"asked for: {100 * tolerance:g} %", (0.01, 100 * tolerance), xycoords=("axes fraction", "data"), xytext=(0, 3),
        textcoords="offset points", fontsize=8, color="0.25",
    )  # fmt: skip
    front = sorted((s for s in settings if s.front), key=lambda s: s.seconds)
    axes.step(*_positions(front), where="post", color="0.35", linewidth=1.2, zorder=1)
    _scatter(axes, settings)
    if recommended := [s for s in settings if s.recommended]:
        axes.scatter(*_positions(recommended), s=230, facecolors="none", edgecolors="black", linewidths=1.6, zorder=4)
    axes.margins(x=0.08, y=0.12)
    # below the panel: inside, there is no corner that a setting may not lie in
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.1), "ncols": 4}
    axes.legend(fontsize=8, title="knob", title_fontsize=8, frameon=False, **below)


def _write_ticks_plainly(axes: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _scatter(axes: Any, settings: Sequence[SettingResult]) -> None:
    for knob, (colour, shape) in _styles(settings).items():
        of_knob = _positions([s for s in settings if s.knob == knob and s.kind != SCENARIO])
        axes.scatter(*of_knob, marker=shape, facecolors=colour, label=knob, **_MARKER)
    own = _positions([s for s in settings if s.kind == SCENARIO])
    name = "the scenario's own setting"
    axes.scatter(
        *own, s=210, marker="*", facecolors="#F0E442", edgecolors="black", linewidths=1.0, label=name, zorder=5
    )
    axes.grid(True, which="major", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)


def _draw_measures(axes: Any, settings: Sequence[SettingResult]) -> None:
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
        axes.scatter([s.tau], [line], marker=shape, facecolors=colour, **_MARKER)
        regret = "same best site" if s.regret == 0 else f"regret {s.regret:.2%}"
        axes.annotate(
            f"{regret}, {s.seconds:.2g} s", (1.02, line), xycoords=("axes fraction", "data"), va="center", fontsize=8,
            annotation_clip=False,
        )  # fmt: skip
    axes.set_yticks(range(len(settings)), [s.setting for s in settings], fontsize=8)
    axes.grid(True, axis="both", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)
    axes.set_xlim(right=1.03)


def _positions(settings: Sequence[SettingResult]) -> tuple[list[float], list[float]]:
    """Where settings stand: seconds, and the error that they are judged by, per cent."""
    return [s.seconds for s in settings], [100 * max(s.judged, _MIN_ERROR) for s in settings]


def _name_settings(axes: Any, settings: Sequence[SettingResult]) -> None:
    """Name the recommended setting, the default and the front, each where it covers no other name and no marker."""
    names = LabelPlacement(axes, np.column_stack(_positions(settings)))
    named = [s for s in settings if (s.front or s.recommended or s.default) and s.kind != SCENARIO]
    for s in sorted(named, key=lambda s: (not s.recommended, not s.default, s.seconds)):
        (seconds,), (error,) = _positions([s])
        names.add("recommended: " * s.recommended + "the program's default: " * s.default + s.setting, seconds, error)
