"""The figure of an accuracy study: expected loss against seconds.

Filled markers are settings that approximate the scenario's scores, hollow ones those that measure something else.
Bars are standard errors. Kinds of settings differ in shape and in colour (Okabe and Ito's palette), so the figure is
readable in grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core import files
from egvs.core.grid import FloatArray
from egvs.results.studies import SCENARIO, SettingResult, Tolerance

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

    def __init__(self, axes: Any, points: FloatArray) -> None:
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
_LEAST_TOP_POINTS = 0.5
"""Upper end of the axis of losses if all losses are small, in percentage points."""
_LABELLED_SHARE = 0.08
"""Settings off the front have a label if their loss is at least this share of the axis."""


def write_figure(settings: Sequence[SettingResult], tolerance: Tolerance, title: str, path: Path) -> None:
    """Write the figure as a PNG; see :func:`draw_figure`."""
    with files.atomic_write(path) as partial:
        draw_figure(settings, tolerance, title).savefig(partial, dpi=150, format="png", metadata={"Software": None})


def draw_figure(settings: Sequence[SettingResult], tolerance: Tolerance, title: str) -> Figure:
    """Draw the figure.

    Parameters
    ----------
    settings
        Priced settings.
    tolerance
        What the recommended setting meets.
    title
        Name of the scenario.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set(
        xscale="log",
        xlabel="processor seconds of a run",
        ylabel="expected loss by the choice of the pole\n(percentage points of vehicles found)",
    )
    axes.set_title(f"What a right decision costs: {title}", fontsize=12)
    _scale_axes(axes, settings, tolerance)
    if tolerance.score is None:
        axes.axhline(tolerance.loss_points, color="0.4", linewidth=1, linestyle="--")
        axes.annotate(
            f"tolerance: {tolerance.loss_points:g}", (0.01, tolerance.loss_points), xycoords=("axes fraction", "data"),
            xytext=(0, 3), textcoords="offset points", fontsize=8, color="0.25",
        )  # fmt: skip
        # the settings that no other beats in both time and loss
        front = sorted((setting for setting in settings if setting.front), key=lambda setting: setting.seconds)
        axes.step(*_coordinates(front), where="post", color="0.55", linewidth=1.2, zorder=1)
    _draw_settings(axes, settings)
    # below the panel, because a setting may be in any corner inside
    below: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.11), "ncols": 5}
    axes.legend(fontsize=8, title="setting that varies (hollow: it measures something else)", title_fontsize=8,
                frameon=False, **below)  # fmt: skip
    figure.draw_without_rendering()  # lays out the panel; labels need its size
    _label_settings(axes, settings)
    return figure


def _scale_axes(axes: Any, settings: Sequence[SettingResult], tolerance: Tolerance) -> None:
    """Show all seconds as 1, 2, 5, 10, and losses from 0."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    seconds = [setting.seconds for setting in settings]
    axes.set_xlim(min(seconds) / 1.25, max(seconds) * 1.25)
    largest = max(setting.loss_points + setting.loss_se_points for setting in settings)
    top = max(_LEAST_TOP_POINTS, 1.08 * largest)
    if tolerance.score is None:
        top = max(top, 1.3 * tolerance.loss_points)
    axes.set_ylim(-0.06 * top, top)
    axes.grid(True, which="major", color="0.9", linewidth=0.7)
    axes.tick_params(labelsize=8)


def _draw_settings(axes: Any, settings: Sequence[SettingResult]) -> None:
    """Draw one marker per setting with its standard error, and a circle around the recommended one."""
    knobs = dict.fromkeys(setting.knob for setting in settings if setting.kind != SCENARIO)
    styles = zip(knobs, zip(cycle(_COLOURS), cycle(_SHAPES)), strict=False)
    for knob, (colour, shape) in styles:
        label: str | None = knob
        for setting in settings:
            if setting.knob != knob or setting.kind == SCENARIO:
                continue
            _draw_error_bar(axes, setting, colour)
            face = colour if setting.approximates else "white"
            axes.scatter(
                [setting.seconds], [setting.loss_points], marker=shape, s=46, facecolors=face, edgecolors=colour,
                linewidths=1.3, zorder=3, label=label,
            )  # fmt: skip
            label = None
    for setting in settings:
        if setting.kind == SCENARIO:
            _draw_error_bar(axes, setting, "black")
            star = {"s": 210, "marker": "*", "facecolors": "#F0E442", "edgecolors": "black", "linewidths": 1.0}
            axes.scatter([setting.seconds], [setting.loss_points], label="the scenario's own setting", zorder=5, **star)
        if setting.recommended:
            circle = {"s": 260, "facecolors": "none", "edgecolors": "black", "linewidths": 1.6}
            axes.scatter([setting.seconds], [setting.loss_points], zorder=4, **circle)


def _draw_error_bar(axes: Any, setting: SettingResult, colour: str) -> None:
    low = max(0.0, setting.loss_points - setting.loss_se_points)
    high = setting.loss_points + setting.loss_se_points
    axes.plot([setting.seconds] * 2, [low, high], color=colour, linewidth=0.9, alpha=0.6, zorder=2)


def _coordinates(settings: Sequence[SettingResult]) -> tuple[list[float], list[float]]:
    return [setting.seconds for setting in settings], [setting.loss_points for setting in settings]


def _label_settings(axes: Any, settings: Sequence[SettingResult]) -> None:
    """Label the recommended setting, then the front, then others where there is room."""
    labels = LabelPlacement(axes, np.column_stack(_coordinates(settings)))
    least = _LABELLED_SHARE * axes.get_ylim()[1]

    def order(setting: SettingResult) -> tuple[bool, bool, float]:
        return not setting.recommended, not setting.front, -setting.loss_points

    for setting in sorted(settings, key=order):
        if setting.recommended:
            name = setting.label
            labels.add(f"recommended: {name}", setting.seconds, setting.loss_points, 8.5)
        elif setting.kind != SCENARIO and (setting.front or setting.loss_points > least):
            labels.add(setting.setting, setting.seconds, setting.loss_points)
