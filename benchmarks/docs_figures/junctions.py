"""Pictures from the runs of sessions, and errors with and without several seeds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from benchmarks.docs_figures.printed import ROOT, run_command
from egvs.artefacts.readers import read_scores
from egvs.drawing.svg_figures import standalone_svg
from egvs.extensions.hardware import write_sheets

SEEDS = 5
KEYS = ("traffic.frames=1000", "traffic.frame_period_s=1", "roi.voxel_m=0.5", "score.rank_by=expected_detections")
COLOURS = ("#3b528b", "#d1701a")

STORY_FIGURES = {
    "download.svg": ("run/report.html", "Map of 108"),
    "zones.svg": ("run/report.html", "Map of 9 zones"),
    "approaches.svg": ("run/report.html", "Approaches of"),
    "signal_plan.svg": ("fixed_plan/report.html", "Stage diagram"),
}
"""File -> page, and how the label of the figure begins."""

ACCEPTANCE = (
    ("Expected", "Expected"),
    ("Measured", "Measured"),
    ("", "Colour scale"),
    ("Difference: a pole stops the beams in red; returns in yellow are nearer than expected", "Differences"),
)
"""Title and beginning of the label of each figure of the range images."""

STORY_FILES = (*STORY_FIGURES, "acceptance.svg", "story-sheet.png")


def page_figure(page: Path, label: str) -> str:
    """Return the figure of a page whose accessible label begins with ``label``."""
    text = page.read_text(encoding="utf-8")
    figures = (match[0] for match in re.finditer(r"<svg.*?</svg>", text, re.DOTALL))
    return next(figure for figure in figures if f'aria-label="{label}' in figure)


PLAN_FILES = ("nishishinjuku.svg", "points-overlap.svg", "export-dxf.png")

SITE_PLAN_M = (165.0, 245.0), (222.0, 275.0)
"""Part of the site plan that is drawn: from and to x and y."""


def draw_plan(folder: Path, images: Path) -> None:
    """Draw the map of sites, the overlap of points for people in the report of nishishinjuku, and its site plan."""
    run = folder / "runs" / "nishishinjuku"
    for name, label in (
        ("nishishinjuku.svg", "Map of 13"),
        ("points-overlap.svg", "From above: number of sensors of the plan that see a pedestrian"),
    ):
        drawn = standalone_svg(page_figure(run / "report.html", label))
        (images / name).write_text(drawn, encoding="utf-8")
    run_command("egvs export runs/nishishinjuku --to dxf", folder)
    _draw_site_plan(run / "export" / "nishishinjuku.dxf", images / "export-dxf.png")


def _draw_site_plan(drawing: Path, path: Path) -> None:
    from ezdxf.addons.drawing.config import BackgroundPolicy, Configuration
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.matplotlib import MatplotlibBackend
    from ezdxf.addons.drawing.properties import RenderContext
    from ezdxf.filemanagement import readfile
    from matplotlib.figure import Figure

    document = readfile(drawing)
    figure = Figure(dpi=110)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    config = Configuration(background_policy=BackgroundPolicy.WHITE)
    Frontend(RenderContext(document), MatplotlibBackend(axes), config=config).draw_layout(document.modelspace())
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=SITE_PLAN_M[0], ylim=SITE_PLAN_M[1])
    figure.set_size_inches(9.0, 9.0 * np.ptp(SITE_PLAN_M[1]) / np.ptp(SITE_PLAN_M[0]))
    figure.savefig(path, metadata={"Software": None})


def draw_story(folder: Path, images: Path) -> None:
    """Draw figures of the reports, the sheet, and the range images of a scan with a pole in front of the sensor."""
    import cairosvg

    for name, (page, label) in STORY_FIGURES.items():
        (images / name).write_text(standalone_svg(page_figure(folder / page, label)), encoding="utf-8")
    (accepted,) = (folder / "run" / "acceptance").glob("*.html")
    parts = [(title, page_figure(accepted, label)) for title, label in ACCEPTANCE]
    (images / "acceptance.svg").write_text(standalone_svg(_stacked(parts)), encoding="utf-8")
    ((_, sheet),) = write_sheets(folder / "run", kind="svg", out=folder / "sheet")
    cairosvg.svg2png(
        url=str(sheet), write_to=str(images / "story-sheet.png"), output_width=720, background_color="#fff"
    )


def _stacked(figures: list[tuple[str, str]]) -> str:
    """Return titles and figures of a page as one figure, below one another."""
    parts, width, top = [], 0.0, 0.0
    for title, figure in figures:
        size = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', figure)
        assert size is not None
        if title:
            parts.append(f'<text x="8" y="{top + 16:g}" font-size="14">{title}</text>')
            top += 24.0
        parts.append(figure.replace("<svg", f'<svg y="{top:g}" width="{size[1]}" height="{size[2]}"', 1))
        width, top = max(width, float(size[1])), top + float(size[2])
    return f'<svg class="plan" viewBox="0 0 {width:g} {top:g}" role="img">{"".join(parts)}</svg>'


def draw_seeds(folder: Path, images: Path) -> None:
    """Draw the scores of all sites, in the order of the first run, with one standard error to each side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    scenario = ROOT / "scenarios" / "roundabout"
    runs: list[dict[str, dict[str, Any]]] = []
    for number, settings in enumerate(((), (f"traffic.seeds={SEEDS}", "tpog.blocks=10"))):
        out = folder / f"seeds{number}"
        egvs.run(egvs.load(scenario, [*KEYS, *settings]), out)
        runs.append({row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()})
    sites = sorted(runs[0], key=lambda site: -runs[0][site]["expected_detections"])
    labels = ("one simulation of 1,000 s: errors from its blocks", f"{SEEDS} simulations of 200 s: errors between them")

    drawing, axes = plt.subplots(figsize=(6.4, 0.42 * len(sites) + 1.3), dpi=110)
    for rows, label, colour, shift in zip(runs, labels, COLOURS, (-0.14, 0.14), strict=True):
        found = 100 * np.array([rows[site]["expected_detections"] for site in sites])
        errors = 100 * np.array([rows[site]["expected_detections_se"] for site in sites])
        at = np.arange(len(sites)) + shift
        axes.errorbar(found, at, xerr=errors, fmt="o", markersize=4, capsize=3, color=colour, label=label)
    axes.set_yticks(range(len(sites)), sites)
    axes.invert_yaxis()
    axes.set_xlabel("vehicles found, % (± one standard error)")
    axes.grid(axis="x", color="#ddd")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    drawing.legend(*axes.get_legend_handles_labels(), loc="upper center", ncols=1, frameon=False, fontsize=9)
    drawing.tight_layout(rect=(0, 0, 1, 1 - 0.5 / drawing.get_figheight()))
    drawing.savefig(images / "seeds.png", metadata={"Software": None})
    plt.close(drawing)
