"""How does one see what accuracy costs?

Two panels: on the left the settings that approximate the scenario's number, seconds against error, with the front of
those that no other beats in both; on the right those that measure something else, by how far their ranking agrees with
the scenario's, with the regret and the seconds beside. Knobs are told apart by shape as well as by colour (Okabe and
Ito's palette); nothing depends on colour alone, and the figure is readable in grey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core import files

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")
_SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h")
_LEAST = 1e-4
"""Smallest error that is drawn; an error of 0 is drawn there."""


@dataclass(frozen=True)
class Point:
    """One setting. ``kind`` is "scenario", "reference", "approximates" or "measures"."""

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


def draw(points: Sequence[Point], tolerance: float, title: str, path: Path) -> None:
    """Write the figure as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    others = sorted((p for p in points if p.kind == "measures"), key=lambda p: (p.tau, -p.regret, -p.seconds))
    figure = Figure(figsize=(13.0, max(5.6, 1.6 + 0.24 * len(others))), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    same = [p for p in points if p.kind in ("approximates", "scenario")]
    _approximations(left, same, tolerance)
    _others(right, others)
    figure.suptitle(f"What accuracy costs in time: {title}", fontsize=12)
    figure.draw_without_rendering()  # places the panels, so that names can be placed in them
    _names(left, same)
    with files.aside(path) as partial:
        figure.savefig(partial, dpi=150, format="png", metadata={"Software": None})


def _styles(points: Sequence[Point]) -> dict[str, tuple[str, str]]:
    named = dict.fromkeys(p.knob for p in points if p.kind != "scenario")
    return {knob: (_COLOURS[i % len(_COLOURS)], _SHAPES[i % len(_SHAPES)]) for i, knob in enumerate(named)}


def _approximations(axes: Any, points: Sequence[Point], tolerance: float) -> None:
    """Seconds against error, with the front."""
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="seconds, all stages",
        ylabel="error of the scores (or its standard error), %",
    )
    axes.set_title("Settings that approximate the same number", fontsize=10)
    _plain_ticks(axes)
    axes.axhline(100 * tolerance, color="0.4", linewidth=1, linestyle="--")
    axes.annotate(
        f"asked for: {100 * tolerance:g} %", (0.01, 100 * tolerance), xycoords=("axes fraction", "data"), xytext=(0, 3),
        textcoords="offset points", fontsize=8, color="0.25",
    )  # fmt: skip
    front = sorted((p for p in points if p.front), key=lambda p: p.seconds)
    axes.step(
        [p.seconds for p in front], [_percent(p) for p in front], where="post", color="0.35", linewidth=1.2, zorder=1
    )
    _scatter(axes, points)
    for p in points:
        if p.recommended:
            axes.scatter(
                [p.seconds], [_percent(p)], s=230, facecolors="none", edgecolors="black", linewidths=1.6, zorder=4
            )
    axes.margins(x=0.08, y=0.12)
    axes.legend(fontsize=8, loc="upper right", framealpha=0.9, title="knob", title_fontsize=8)


def _plain_ticks(axes: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _scatter(axes: Any, points: Sequence[Point]) -> None:
    for knob, (colour, shape) in _styles(points).items():
        mine = [p for p in points if p.knob == knob and p.kind != "scenario"]
        x, y = [p.seconds for p in mine], [_percent(p) for p in mine]
        axes.scatter(
            x, y, s=46, marker=shape, facecolors=colour, edgecolors="black", linewidths=0.6, label=knob, zorder=3
        )
    own = [p for p in points if p.kind == "scenario"]
    axes.scatter(
        [p.seconds for p in own], [_percent(p) for p in own], s=210, marker="*", facecolors="#F0E442", edgecolors="black",
        linewidths=1.0, label="the scenario's own setting", zorder=5,
    )  # fmt: skip
    axes.grid(True, which="major", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)


def _others(axes: Any, points: Sequence[Point]) -> None:
    """One line a setting: the agreement of its ranking, its regret and its seconds."""
    axes.set_title("Settings that measure something else", fontsize=10)
    if not points:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "none was tried", ha="center", color="0.4", transform=axes.transAxes)
        return
    axes.set(xlabel="Kendall's tau with the scenario's ranking (1: the same)")
    styles = _styles(points)
    for line, p in enumerate(points):
        colour, shape = styles[p.knob]
        axes.scatter(
            [p.tau], [line], s=46, marker=shape, facecolors=colour, edgecolors="black", linewidths=0.6, zorder=3
        )
        regret = "same best site" if p.regret == 0 else f"regret {p.regret:.2%}"
        axes.annotate(
            f"{regret}, {p.seconds:.2g} s", (1.02, line), xycoords=("axes fraction", "data"), va="center", fontsize=8,
            annotation_clip=False,
        )  # fmt: skip
    axes.set_yticks(range(len(points)), [p.name for p in points], fontsize=8)
    axes.grid(True, axis="both", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)
    axes.set_xlim(right=1.03)


def _percent(point: Point) -> float:
    return 100 * max(point.error, _LEAST)


def _names(axes: Any, points: Sequence[Point]) -> None:
    """Name the recommended setting, the program's default and the front, each where it covers no other name and no
    point."""
    renderer = axes.figure.canvas.get_renderer()
    taken = [axes.get_legend().get_window_extent(renderer)]
    spots = axes.transData.transform([(p.seconds, _percent(p)) for p in points])
    named = [p for p in points if (p.front or p.recommended or p.default) and p.kind != "scenario"]
    for p in sorted(named, key=lambda p: (not p.recommended, not p.default, p.seconds)):
        text = "recommended: " * p.recommended + "the program's default: " * p.default + p.name
        for align, x, y in (("left", 6, -11), ("right", -8, -11), ("left", 6, 6), ("right", -8, 6)):
            name = axes.annotate(
                text, (p.seconds, _percent(p)), xytext=(x, y), textcoords="offset points", fontsize=7.5, ha=align, zorder=2,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
            )  # fmt: skip
            box = name.get_window_extent(renderer)
            free = not any(box.overlaps(other) for other in taken) and not any(box.contains(*spot) for spot in spots)
            if free and axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1):
                taken.append(box)
                break
            name.remove()
