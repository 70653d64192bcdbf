"""How does one see what accuracy costs?

Two panels that share the axis of seconds: on the left the settings that approximate the scenario's number, by their error, with the
front of those that no other beats in both; on the right those that measure something else, by how far their ranking agrees with the
scenario's. Knobs are told apart by shape as well as by colour (Okabe and Ito's palette), and nothing depends on colour alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline import tables

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


def draw(points: Sequence[Point], tolerance: float, title: str, path: Path) -> None:
    """Write the figure as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharex=True)
    _approximations(left, [p for p in points if p.kind in ("approximates", "scenario")], tolerance)
    _others(right, [p for p in points if p.kind in ("measures", "scenario")])
    figure.suptitle(f"What accuracy costs in time: {title}", fontsize=12)
    with tables.aside(path) as partial:
        figure.savefig(partial, dpi=160, format="png", metadata={"Software": None})


def _styles(points: Sequence[Point]) -> dict[str, tuple[str, str]]:
    named = dict.fromkeys(p.knob for p in points if p.kind != "scenario")
    return {knob: (_COLOURS[i % len(_COLOURS)], _SHAPES[i % len(_SHAPES)]) for i, knob in enumerate(named)}


def _approximations(axes: Any, points: Sequence[Point], tolerance: float) -> None:
    """Seconds against error, with the front."""
    axes.set(xscale="log", yscale="log", xlabel="seconds, all stages", ylabel="error of the scores, %")
    axes.set_title("Settings that approximate the same number", fontsize=10)
    axes.axhline(100 * tolerance, color="0.4", linewidth=1, linestyle="--")
    axes.annotate(
        f"asked for: {100 * tolerance:g} %", (0.99, 100 * tolerance), xycoords=("axes fraction", "data"), xytext=(0, 3),
        textcoords="offset points", ha="right", fontsize=8, color="0.25",
    )  # fmt: skip
    front = sorted((p for p in points if p.front), key=lambda p: p.seconds)
    axes.step([p.seconds for p in front], [_percent(p) for p in front], where="post", color="0.35", linewidth=1.2, zorder=1)
    _scatter(axes, points, _percent)
    for p in front:
        if not p.recommended and p.kind != "scenario":
            _name(axes, p, _percent(p), p.name, (4, 4))
    for p in points:
        if p.recommended:
            axes.scatter([p.seconds], [_percent(p)], s=230, facecolors="none", edgecolors="black", linewidths=1.6, zorder=4)
            _name(axes, p, _percent(p), f"recommended: {p.name}", (-8, -16), "right")
    axes.legend(fontsize=8, loc="lower left", framealpha=0.9)


def _others(axes: Any, points: Sequence[Point]) -> None:
    """Seconds against the agreement of the ranking, the regret beside each point where there is any."""
    axes.set(xscale="log", xlabel="seconds, all stages", ylabel="Kendall's tau with the scenario's ranking")
    axes.set_title("Settings that measure something else (same traffic)", fontsize=10)
    _scatter(axes, points, lambda p: p.tau)
    for number, p in enumerate(sorted(points, key=lambda p: (p.tau, p.seconds))):
        if p.kind != "scenario":
            lost = f" (loses {p.regret:.1%})" if p.regret > 0.0005 else ""
            _name(axes, p, p.tau, p.name + lost, (6, 4) if number % 2 else (6, -9))
    axes.legend(fontsize=8, loc="lower right", framealpha=0.9)
    axes.margins(x=0.2, y=0.12)


def _scatter(axes: Any, points: Sequence[Point], height: Any) -> None:
    for knob, (colour, shape) in _styles(points).items():
        mine = [p for p in points if p.knob == knob and p.kind != "scenario"]
        x, y = [p.seconds for p in mine], [height(p) for p in mine]
        axes.scatter(x, y, s=46, marker=shape, facecolors=colour, edgecolors="black", linewidths=0.6, label=knob, zorder=3)
    own = [p for p in points if p.kind == "scenario"]
    axes.scatter(
        [p.seconds for p in own], [height(p) for p in own], s=210, marker="*", facecolors="#F0E442", edgecolors="black",
        linewidths=1.0, label="the scenario's own setting", zorder=5,
    )  # fmt: skip
    axes.grid(True, which="major", color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)


def _percent(point: Point) -> float:
    return 100 * max(point.error, _LEAST)


def _name(axes: Any, point: Point, height: float, text: str, offset: tuple[int, int], align: str = "left") -> None:
    axes.annotate(text, (point.seconds, height), xytext=offset, textcoords="offset points", fontsize=7, ha=align, zorder=6)
