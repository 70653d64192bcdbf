"""Draw the calibration of models: how often vehicles were found against the predicted probability."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.core import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "detectability.png"

_COLOURS = {"cluster": "#0072B2", "pointpillars": "#D55E00"}
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
    above.set_title("each junction predicted by the model of the others", fontsize=9)
    above.legend(fontsize=7, loc="upper left")
    for axes in (above, below):
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7)
    return figure
