"""The figure of an accuracy study: error against seconds, with the Pareto front.

The left panel shows the settings that approximate the scenario's scores, with the front of those that no other setting
beats in both time and error. The right panel shows the settings that measure something else: how far their rankings
agree with the scenario's, their regret, and their seconds. Kinds of settings differ in shape and in colour (Okabe and
Ito's palette), so the figure is readable in grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
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
"""Alignment of a label, and its offset from the point to the right and up, in printer's points."""


class LabelPlacement:
    """Writes labels beside the points of a panel, where they cover no other label and no marker.

    Parameters
    ----------
    axes
        The panel, after ``figure.draw_without_rendering()``.
    points
        Markers in data coordinates, (n, 2).
    """

    def __init__(self, axes: Any, points: NDArray[np.float64]) -> None:
        self._axes, self._renderer = axes, axes.figure.canvas.get_renderer()
        self._occupied = [text.get_window_extent(self._renderer) for text in axes.texts]
        self._markers = axes.transData.transform(points)

    def add(self, text: str, x: float, y: float, size: float = 7.5) -> bool:
        """Write a label if there is room for it.

        Parameters
        ----------
        text
            The label.
        x, y
            Its point in data coordinates.
        size
            Font size.

        Returns
        -------
        bool
            Whether there was room.
        """
        for align, right, up in _LABEL_OFFSETS:
            label = self._axes.annotate(
                text, (x, y), xytext=(right, up), textcoords="offset points", fontsize=size, ha=align, zorder=2,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
            )  # fmt: skip
            box = label.get_window_extent(self._renderer)
            covers_text = any(box.overlaps(other) for other in self._occupied)
            covers_marker = any(box.contains(*marker) for marker in self._markers)
            is_inside = self._axes.bbox.containsx(box.x0) and self._axes.bbox.containsx(box.x1)
            if is_inside and not covers_text and not covers_marker:
                self._occupied.append(box)
                return True
            label.remove()
        return False


_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")
_SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h")
_MARKER = {"s": 46, "edgecolors": "black", "linewidths": 0.6, "zorder": 3}
_MIN_ERROR = 1e-4
"""Smaller errors are drawn here, because the axis is logarithmic."""


def write_figure(settings: Sequence[SettingResult], tolerance: float, title: str, path: Path) -> None:
    """Write the figure as a PNG; see :func:`draw_figure`."""
    with files.atomic_write(path) as partial:
        draw_figure(settings, tolerance, title).savefig(partial, dpi=150, format="png", metadata={"Software": None})


def draw_figure(settings: Sequence[SettingResult], tolerance: float, title: str) -> Figure:
    """Draw the figure.

    Parameters
    ----------
    settings
        Compared settings.
    tolerance
        Tolerated error, relative.
    title
        Name of the scenario.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    approximations = [setting for setting in settings if setting.kind in (APPROXIMATES, SCENARIO)]
    measures = [setting for setting in settings if setting.kind == MEASURES]
    measures.sort(key=lambda setting: (setting.tau, -setting.regret, -setting.seconds))
    figure = Figure(figsize=(13.0, max(5.6, 1.6 + 0.24 * len(measures))), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_approximations(left, approximations, tolerance)
    _draw_measures(right, measures)
    figure.suptitle(f"What accuracy costs in time: {title}", fontsize=12)
    figure.draw_without_rendering()  # lays out the panels; labels need their size
    _label_settings(left, approximations)
    return figure


def _styles(settings: Sequence[SettingResult]) -> dict[str, tuple[str, str]]:
    """Return colour and shape by knob."""
    knobs = dict.fromkeys(setting.knob for setting in settings if setting.kind != SCENARIO)
    return dict(zip(knobs, zip(cycle(_COLOURS), cycle(_SHAPES)), strict=False))


def _draw_approximations(axes: Any, settings: Sequence[SettingResult], tolerance: float) -> None:
    """Draw seconds against error, with the front."""
    error = "error of the scores (or its standard error), %"
    axes.set(xscale="log", yscale="log", xlabel="seconds, all stages", ylabel=error)
    axes.set_title("Settings that approximate the same number", fontsize=10)
    _format_ticks(axes)
    axes.axhline(100 * tolerance, color="0.4", linewidth=1, linestyle="--")
    axes.annotate(
        f"tolerance: {100 * tolerance:g} %", (0.01, 100 * tolerance), xycoords=("axes fraction", "data"),
        xytext=(0, 3), textcoords="offset points", fontsize=8, color="0.25",
    )  # fmt: skip
    front = sorted((setting for setting in settings if setting.front), key=lambda setting: setting.seconds)
    axes.step(*_coordinates(front), where="post", color="0.35", linewidth=1.2, zorder=1)
    _scatter(axes, settings)
    recommended = [setting for setting in settings if setting.recommended]
    if recommended:
        circle = {"s": 230, "facecolors": "none", "edgecolors": "black", "linewidths": 1.6}
        axes.scatter(*_coordinates(recommended), zorder=4, **circle)
    axes.margins(x=0.08, y=0.12)
    # below the panel, because a setting may be in any corner inside
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.1), "ncols": 4}
    axes.legend(fontsize=8, title="setting that varies", title_fontsize=8, frameon=False, **below)


def _format_ticks(axes: Any) -> None:
    """Write 0.01 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _scatter(axes: Any, settings: Sequence[SettingResult]) -> None:
    for knob, (colour, shape) in _styles(settings).items():
        same_knob = [setting for setting in settings if setting.knob == knob and setting.kind != SCENARIO]
        axes.scatter(*_coordinates(same_knob), marker=shape, facecolors=colour, label=knob, **_MARKER)
    scenario = [setting for setting in settings if setting.kind == SCENARIO]
    star = {"s": 210, "marker": "*", "facecolors": "#F0E442", "edgecolors": "black", "linewidths": 1.0}
    axes.scatter(*_coordinates(scenario), label="the scenario's own setting", zorder=5, **star)
    axes.grid(True, which="major", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)


def _draw_measures(axes: Any, settings: Sequence[SettingResult]) -> None:
    """Draw one line per setting: the agreement of its ranking, its regret and its seconds."""
    axes.set_title("Settings that measure something else", fontsize=10)
    if not settings:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no such setting", ha="center", color="0.4", transform=axes.transAxes)
        return
    axes.set(xlabel="Kendall's tau with the scenario's ranking (1: the same)")
    styles = _styles(settings)
    for line, setting in enumerate(settings):
        colour, shape = styles[setting.knob]
        axes.scatter([setting.tau], [line], marker=shape, facecolors=colour, **_MARKER)
        regret = "same best site" if setting.regret == 0 else f"regret {setting.regret:.2%}"
        axes.annotate(
            f"{regret}, {setting.seconds:.2g} s", (1.02, line), xycoords=("axes fraction", "data"), va="center",
            fontsize=8, annotation_clip=False,
        )  # fmt: skip
    axes.set_yticks(range(len(settings)), [setting.setting for setting in settings], fontsize=8)
    axes.grid(True, axis="both", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)
    axes.set_xlim(right=1.03)


def _coordinates(settings: Sequence[SettingResult]) -> tuple[list[float], list[float]]:
    """Return seconds, and the errors that count in per cent."""
    errors = [100 * max(setting.judged, _MIN_ERROR) for setting in settings]
    return [setting.seconds for setting in settings], errors


def _label_settings(axes: Any, settings: Sequence[SettingResult]) -> None:
    """Label the recommended setting, then the default, then the front."""
    labels = LabelPlacement(axes, np.column_stack(_coordinates(settings)))
    for setting in sorted(
        settings, key=lambda setting: (not setting.recommended, not setting.default, setting.seconds)
    ):
        is_notable = setting.front or setting.recommended or setting.default
        if setting.kind == SCENARIO or not is_notable:
            continue
        text = setting.setting
        if setting.default:
            text = f"the program's default: {text}"
        if setting.recommended:
            text = f"recommended: {text}"
        (seconds,), (error,) = _coordinates([setting])
        labels.add(text, seconds, error)
