"""Draw the pictures of the explorer for docs and README: the page over nishishinjuku, in a headless browser.

    python -m benchmarks.explorer_pictures [--only explore-3-lanes] [--out docs/images]

Needs Chromium and playwright. Software rendering takes a minute or two.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from egvs.explore.page import Page
from egvs.explore.settings import open_session
from egvs.explore.view_state import Camera
from egvs.sensors.sites import Pose

SCENARIO = Path("scenarios/nishishinjuku")
GRAPHICS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDTH, HEIGHT = 1200, 720
ABOVE = Camera((203.0, 188.0, 48.0), (197.0, 237.0, 0.0))
NEAR = Camera((216.0, 212.0, 24.0), (191.0, 240.0, 0.0))
MOVED = Pose(196.6, 251.7, 2.0, 0.0, 1.0)

PICTURES: dict[str, tuple[Camera, dict[str, Any]]] = {
    "explore": (ABOVE, {"layer": "missed", "pose": MOVED}),
    "explore-dark": (ABOVE, {"layer": "missed", "pose": MOVED, "is_dark": True}),
    "explore-1-opened": (ABOVE, {"layer": "traffic"}),
    "explore-2-moved": (ABOVE, {"layer": "seen", "pose": MOVED}),
    "explore-3-lanes": (ABOVE, {"layer": "blindspots", "pose": MOVED}),
    "explore-4-difference": (ABOVE, {"layer": "difference", "pose": MOVED, "beside": "c05"}),
    "explore-5-traffic": (NEAR, {"layer": "replay", "pose": MOVED, "frame": 300}),
}
"""File name, camera, and view."""


def main() -> None:
    """Draw all pictures, or some."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=list(PICTURES), default=list(PICTURES))
    parser.add_argument("--run", type=Path, help="a run folder with a plan; a new run by default")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        run = options.run or Path(scratch) / "run"
        if not (run / "placement.parquet").is_file():
            egvs.place(egvs.load(SCENARIO, ["placement.count=2"]), run)
        with _tab(Path(scratch), run) as (page, tab):
            for name, (camera, view) in PICTURES.items():
                if name in options.only:
                    _draw(page, tab, camera, view, options.out / f"{name}.png")


@contextmanager
def _tab(scratch: Path, run: Path) -> Iterator[tuple[Page, Any]]:
    """Return the page, and a browser tab that shows it."""
    from playwright.sync_api import sync_playwright

    page = Page(open_session(SCENARIO, (), run), scratch / "page")
    loop = threading.Thread(target=page.run)
    loop.start()
    try:
        with sync_playwright() as playwright:
            chromium = shutil.which("chromium") or shutil.which("chromium-browser")
            browser = playwright.chromium.launch(executable_path=chromium, args=GRAPHICS)
            tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            tab.goto(page.address)
            tab.get_by_text("rank 1 of").wait_for(timeout=120_000)
            tab.wait_for_timeout(30_000)
            tab.add_style_tag(content=".mantine-Notifications-root { display: none }")  # it warns of software rendering
            yield page, tab
            browser.close()
    finally:
        page.end()
        loop.join()
        page.stop()


def _draw(page: Page, tab: Any, camera: Camera, view: dict[str, Any], path: Path) -> None:
    site = page.session.ranked[0].site
    pose = view.get("pose", site.pose)
    changes = {key: value for key, value in view.items() if key != "pose"}
    blank = {"layer": "none", "beside": "", "frame": 0, "is_dark": False}
    page.request(site=replace(site, pose=pose), **{**blank, **changes})
    assert page.wait_until_idle(120)
    (client,) = page.server.get_clients().values()
    client.camera.position = np.subtract(camera.from_m, page.zero_m)
    client.camera.look_at = np.subtract(camera.at_m, page.zero_m)
    tab.wait_for_timeout(15_000)  # drawn in software
    tab.screenshot(path=path, timeout=120_000)
    print(path)


if __name__ == "__main__":
    main()
