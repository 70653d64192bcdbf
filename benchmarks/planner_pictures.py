"""Draw two pictures of the how-to pages for planners: a downloaded junction, and errors with and without several seeds.

    python -m benchmarks.planner_pictures [--only download seeds] [--out docs/images]

``download``: the map of docs/story.md, from a local server that answers as recorded, with its region and poles.
``seeds``: the sites of the scenario roundabout, with errors from blocks of one simulation and with errors from five
simulations of a fifth of the length.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from tests.creation.overpass_server import overpass_server, recorded_answer, send

import egvs
from benchmarks.pictures import IMAGES, ROOT, figure
from egvs.artefacts.readers import read_scores

NEW = ("new", "crossing", "--at", "52.0,10.0", "--download", "--vehicles-per-hour", "530")
RUN = ("run", "crossing", "--set", "traffic.frames=300", "--out", "run")
SEEDS = 5
KEYS = ("traffic.frames=1000", "traffic.frame_period_s=1", "roi.voxel_m=0.5", "score.rank_by=expected_detections")
COLOURS = ("#3b528b", "#d1701a")


def draw_download(path: Path, folder: Path) -> None:
    """Fetch the map of the tests from a local server, run its scenario, and draw the map of the report."""
    with overpass_server(send(recorded_answer())) as server:
        environment = {**os.environ, "EGVS_OVERPASS_URL": server.url, "XDG_CACHE_HOME": str(folder / "cache")}
        for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
            environment.pop(name, None)
        for command in (NEW, RUN):
            subprocess.run([sys.executable, "-m", "egvs", *command], cwd=folder, env=environment, check=True)
    page = (folder / "run" / "report.html").read_text(encoding="utf-8")
    path.write_text(figure(page, "Map of"), encoding="utf-8")


def draw_seeds(path: Path, folder: Path) -> None:
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
        for site, share, error in zip(sites, found, errors, strict=True):
            print(f"{site}: {share:.1f} ± {error:.1f} % ({label})")
    axes.set_yticks(range(len(sites)), sites)
    axes.invert_yaxis()
    axes.set_xlabel("vehicles found, % (± one standard error)")
    axes.grid(axis="x", color="#ddd")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    drawing.legend(*axes.get_legend_handles_labels(), loc="upper center", ncols=1, frameon=False, fontsize=9)
    drawing.tight_layout(rect=(0, 0, 1, 1 - 0.5 / drawing.get_figheight()))
    drawing.savefig(path, metadata={"Software": None})
    plt.close(drawing)


PICTURES = {"download": ("download.svg", draw_download), "seeds": ("seeds.png", draw_seeds)}


def main() -> None:
    """Draw the pictures, or one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(PICTURES), default=list(PICTURES))
    parser.add_argument("--out", type=Path, default=IMAGES)
    options = parser.parse_args()
    for name in options.only:
        file, draw = PICTURES[name]
        with tempfile.TemporaryDirectory() as folder:
            draw(options.out / file, Path(folder))
        print(options.out / file)


if __name__ == "__main__":
    main()
