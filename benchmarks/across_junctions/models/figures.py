"""Draw the calibration of models: how often vehicles were found against the predicted probability."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curves = Mapping[str, Sequence[Mapping[str, float]]]
"""By junction, the bins of :func:`benchmarks.across_junctions.models.fitting.curve`."""

OTHERS = "each junction predicted by the model of the others"

_COLOURS = {"cluster": "#0072B2", "pointpillars": "#D55E00", "pointpillars_sensor": "#009E73"}
_OTHER = "#777777"


def draw(path: Path, source: Path) -> None:
    """Write the calibration of every detector of a file of models as PNG."""
    with files.atomic_write(path) as partial:
        figure = calibration(json.loads(source.read_text(encoding="utf-8")))
        figure.savefig(partial, dpi=130, format="png", metadata={"Software": None})


def calibration(models: dict[str, Any]) -> Figure:
    """Draw the share that was found by probability, and below it how many vehicles have about that probability."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
    above.plot([0.0, 1.0], [0.0, 1.0], color="0.5", linewidth=0.9, label="as predicted")
    each = models["detectors"]
    for number, (name, model) in enumerate(each.items()):
        curve = model["elsewhere"]["calibration"]
        chance, colour = [part["chance"] for part in curve], _COLOURS.get(name, _OTHER)
        count = sum(part["vehicle_frames"] for part in curve)
        label = f"{name}, {count:,} vehicle-frames"
        above.plot(chance, [part["found"] for part in curve], color=colour, marker="o", ms=4, lw=1.2, label=label)
        width = 0.08 / len(each)
        left = [(int(10.0 * at) + 0.5) / 10.0 + (number + 0.5 - len(each) / 2) * width for at in chance]
        below.bar(left, [part["vehicle_frames"] / count for part in curve], width, color=colour)
    above.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), ylabel="share that was found")
    below.set(xlabel="predicted probability", ylabel="share of them")
    above.set_title(OTHERS, fontsize=9)
    above.legend(fontsize=7, loc="upper left")
    for axes in (above, below):
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7)
    return figure


def draw_reliability(path: Path, detector: str, curves: Curves, model: str = OTHERS) -> None:
    """Write the reliability diagrams of a detector as PNG, one for each junction."""
    figure = reliability_diagrams(detector, curves, model)
    with files.atomic_write(path) as partial:
        figure.savefig(partial, dpi=130, format="png", metadata={"Software": None})


def reliability_diagrams(detector: str, curves: Curves, model: str = OTHERS) -> Figure:
    """Draw the share that was found by predicted probability, for each junction.

    The area of a marker is the number of vehicle-frames; bars are 95 % intervals of a share of independent
    vehicle-frames, so they are too short: frames of one queue are not independent. The title has the difference between
    the predicted and the actual share of all vehicles.

    Parameters
    ----------
    model
        Which model predicted, for the heading.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(len(curves), 3)
    rows = -(-len(curves) // columns)
    figure = Figure(figsize=(2.9 * columns, 3.1 * rows + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{detector}\n{model}", fontsize=9)
    each_axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (name, parts) in zip(each_axes, curves.items(), strict=False):
        chance, found, count = (
            np.array([part[key] for part in parts]) for key in ("chance", "found", "vehicle_frames")
        )
        axes.plot([0.0, 1.0], [0.0, 1.0], color="0.5", linewidth=0.9)
        half = 1.96 * np.sqrt(found * (1.0 - found) / count)
        colour = _COLOURS.get(detector, _OTHER)
        axes.errorbar(chance, found, yerr=half, color=colour, linewidth=1.0)
        axes.scatter(chance, found, s=4.0 + 90.0 * count / count.max(), color=colour, alpha=0.7)
        off = 100.0 * float(((chance - found) * count).sum() / count.sum())
        axes.set_title(f"{name}: {off:+.1f} points predicted", fontsize=8)
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7)
    for axes in each_axes[len(curves) :]:
        axes.set_axis_off()
    figure.supxlabel("predicted probability", fontsize=9)
    figure.supylabel("share that was found", fontsize=9)
    return figure
