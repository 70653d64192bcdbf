"""Pictures of the explorer and of the page of one file over nishishinjuku, in a headless browser.

Needs Chromium and playwright. Software rendering takes a minute or two.
"""

from __future__ import annotations

import io
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.docs_figures.printed import ROOT
from egvs.explore.page import Page
from egvs.explore.page_file import write_page_file
from egvs.explore.settings import open_session
from egvs.explore.view_state import Camera
from egvs.sensors.sites import Pose

SCENARIO = ROOT / "scenarios" / "nishishinjuku"
GRAPHICS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
HIDE_NOTIFICATIONS = ".mantine-Notifications-root { display: none }"
"""Style: viser warns of software rendering."""
WIDTH, HEIGHT = 1200, 720
ABOVE = Camera((203.0, 188.0, 48.0), (197.0, 237.0, 0.0))
NEAR = Camera((216.0, 212.0, 24.0), (191.0, 240.0, 0.0))
MOVED: dict[str, Any] = {"from": "c03", "pose": Pose(196.6, 251.7, 2.0, 0.0, 1.0)}

PICTURES: dict[str, tuple[Camera, dict[str, Any]]] = {
    "explore": (ABOVE, {"layer": "missed", **MOVED}),
    "explore-1-opened": (ABOVE, {"layer": "traffic"}),
    "explore-2-moved": (ABOVE, {"layer": "seen", **MOVED}),
    "explore-3-lanes": (ABOVE, {"layer": "blindspots", **MOVED}),
    "explore-4-difference": (ABOVE, {"layer": "difference", **MOVED, "beside": "c05"}),
    "explore-5-traffic": (NEAR, {"layer": "replay", **MOVED, "frame": 300}),
}
"""File name, camera, and view; ``pose`` is that of the candidate ``from`` after it was moved."""

PAGE_FILE_PICTURES = {"view": "light", "view-dark": "dark"}
"""File name, and colour scheme of the browser."""
PAGE_WIDTH, PAGE_HEIGHT, LEFT, BOTTOM = 1100, 690, 190, 50
"""Size of the browser's window, and what is cut off: an empty part of the scene, and the controls of the playback."""
COLOUR_STEP = 4
"""Colours are rounded to multiples of this, which halves the size of the file."""


FILES = tuple(f"{name}.png" for name in [*PAGE_FILE_PICTURES, *PICTURES])


def draw(run: Path, scratch: Path, images: Path) -> None:
    """Draw the page of one file without a plan, and the explorer with one.

    Parameters
    ----------
    run
        A run folder with a plan.
    scratch
        An empty folder.
    images
        Where pictures are written.
    """
    without_plan = scratch / "run"
    shutil.copytree(run, without_plan, ignore=shutil.ignore_patterns("placement.parquet", "curve.parquet"))
    page = write_page_file(open_session(SCENARIO, (), without_plan), scratch / "page.html").path
    _draw_page_file(page, list(PAGE_FILE_PICTURES), images)
    with _tab(scratch, run) as (running, tab):
        for name, (camera, view) in PICTURES.items():
            _draw(running, tab, camera, view, images / f"{name}.png")


def _draw_page_file(page: Path, names: list[str], out: Path) -> None:
    with browser() as opened:
        for name in names:
            tab = opened.new_page(
                viewport={"width": PAGE_WIDTH, "height": PAGE_HEIGHT}, color_scheme=PAGE_FILE_PICTURES[name]
            )
            tab.set_default_timeout(300_000)
            tab.goto(page.resolve().as_uri(), wait_until="commit")
            tab.wait_for_function("window.__viserSceneTree?.getState()['/traffic/returns'] !== undefined")
            tab.add_style_tag(content=HIDE_NOTIFICATIONS)
            tab.wait_for_timeout(30_000)  # drawn in software
            picture = Image.open(io.BytesIO(tab.screenshot()))
            _save(picture.crop((LEFT, 0, PAGE_WIDTH, PAGE_HEIGHT - BOTTOM)), out / f"{name}.png")
            tab.close()


def _save(picture: Image.Image, path: Path) -> None:
    shown = np.asarray(picture.convert("RGB")).astype(int)
    rounded = np.minimum((shown + COLOUR_STEP // 2) // COLOUR_STEP * COLOUR_STEP, 255)
    Image.fromarray(rounded.astype(np.uint8)).save(path, optimize=True)


@contextmanager
def browser() -> Iterator[Any]:
    """Open Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        opened = playwright.chromium.launch(executable_path=chromium, args=GRAPHICS)
        yield opened
        opened.close()


@contextmanager
def _tab(scratch: Path, run: Path) -> Iterator[tuple[Page, Any]]:
    """Return the page, and a browser tab that shows it."""
    page = Page(open_session(SCENARIO, (), run), scratch / "page")
    loop = threading.Thread(target=page.run)
    loop.start()
    try:
        with browser() as opened:
            tab = opened.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            tab.goto(page.address)
            tab.get_by_text("rank 1 of").wait_for(timeout=120_000)
            tab.wait_for_timeout(30_000)
            tab.add_style_tag(content=HIDE_NOTIFICATIONS)
            yield page, tab
    finally:
        page.end()
        loop.join()
        page.stop()


def _draw(page: Page, tab: Any, camera: Camera, view: dict[str, Any], path: Path) -> None:
    best = page.session.ranked[0].site
    site = page.session.candidates[view.get("from", best.name)].site
    pose = view.get("pose", site.pose)
    changes = {key: value for key, value in view.items() if key not in ("from", "pose")}
    blank = {"layer": "none", "beside": "", "frame": 0, "is_dark": False}
    page.request(site=replace(site, pose=pose), **{**blank, **changes})
    assert page.wait_until_idle(120)
    (client,) = page.server.get_clients().values()
    client.camera.position = np.subtract(camera.from_m, page.zero_m)
    client.camera.look_at = np.subtract(camera.at_m, page.zero_m)
    tab.wait_for_timeout(15_000)  # drawn in software
    _save(Image.open(io.BytesIO(tab.screenshot(timeout=120_000))), path)
