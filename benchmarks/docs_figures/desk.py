"""Pictures of the desk, in a headless browser: from a made-up map to a plan for two sensors."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.docs_figures.explorer import browser
from benchmarks.docs_figures.printed import ROOT

MAP = ROOT / "tests" / "creation" / "data" / "small.osm"
FILES = ("desk-1-junction.png", "desk-2-poles.png", "desk-3-traffic.png", "desk-4-ranking.png", "desk-5-plan.png")
WIDTH, HEIGHT = 1100, 720
_JOB_MS = 600_000


def draw(folder: Path, images: Path) -> None:
    """Go through the page as a planner would, and take a picture of each step.

    Parameters
    ----------
    folder
        An empty folder.
    images
        Where pictures are written.
    """
    command = [sys.executable, "-m", "egvs", "desk", str(folder), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, browser() as chromium:
        assert server.stdout is not None
        tab = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        tab.goto(server.stdout.readline().split()[0])
        for file, step in zip(FILES, (_junction, _poles, _traffic, _ranking, _plan), strict=True):
            step(tab)
            tab.wait_for_timeout(1000)
            picture = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
            picture.quantize(256, dither=Image.Dither.NONE).save(images / file, optimize=True)
        server.terminate()


def _junction(tab: Any) -> None:
    tab.set_input_files("#map-file", MAP)
    tab.get_by_role("heading", name="Which junction?").wait_for(timeout=_JOB_MS)


def _poles(tab: Any) -> None:
    tab.get_by_role("button", name="Make the scenario").click()
    tab.get_by_role("button", name="signal1").click(timeout=_JOB_MS)


def _traffic(tab: Any) -> None:
    tab.get_by_role("button", name="Next: Traffic").click()
    field = tab.locator(".approach input").first
    field.fill("300")
    field.press("Enter")


def _ranking(tab: Any) -> None:
    tab.get_by_role("button", name="Next: Run").click()
    tab.get_by_role("button", name="Start the run").click()
    tab.get_by_role("heading", name="Ranking").wait_for(timeout=_JOB_MS)


def _plan(tab: Any) -> None:
    tab.get_by_role("button", name="Next: Decide").click()
    tab.get_by_role("button", name="Find the best 2 poles").click()
    tab.get_by_role("heading", name="2 sensors").wait_for(timeout=_JOB_MS)
