"""The written page opens from disk without network, draws the scene, and shows the chosen layer."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.accessibility import violations
from tests.conftest import write_mini

pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

from egvs.explore.drawing import HIDDEN_COLOUR, VISIBLE_COLOUR, colour_scale, linear_colours
from egvs.explore.page_file import write_page_file
from egvs.explore.settings import open_session
from tests.chromium import SOFTWARE_GRAPHICS, needs_chromium, open_chromium
from tests.explore.test_page_in_browser import READY_MS

pytestmark = [
    needs_chromium,
    pytest.mark.system,
    pytest.mark.slow,
]

VISIBLE = """() => Object.entries(window.__viserSceneTree.getState())
    .filter(([name, node]) => /^\\/layers\\/[a-z]+$/.test(name) && node.effectiveVisibility).map(([name]) => name)"""


MIN_PIXELS, MAX_COLOUR_DIFFERENCE = 10, 8
"""A roof has this many pixels at least, and each channel differs from the legend by this much at most."""
VEHICLE_COLOURS = np.array([VISIBLE_COLOUR, HIDDEN_COLOUR])
WORST_SITE_COLOUR = colour_scale([0.0, 1.0])[0]


def count_pixels(picture: np.ndarray, colours: np.ndarray) -> int:
    """Return the number of pixels of a picture (rows, columns, 3) that have one of the colours (n, 3)."""
    differences = np.abs(picture[:, :, None, :].astype(int) - colours).max(axis=3)
    return int((differences.min(axis=2) <= MAX_COLOUR_DIFFERENCE).sum())


def count_shades(picture: np.ndarray, colour: np.ndarray) -> int:
    """Return the number of pixels of a picture (rows, columns, 3) with a colour (3,) at half of its light or more."""
    light, full = linear_colours(picture) / 255, linear_colours(colour) / 255
    shade = light @ full / (full @ full)
    differences = np.abs(light - shade[:, :, None] * full).max(axis=2)
    return int(((shade >= 0.5) & (differences <= 0.02)).sum())


def test_opens_from_disk_without_network(tmp_path: Path) -> None:
    page = write_page_file(open_session(write_mini(tmp_path / "mini"), (), tmp_path / "run"), tmp_path / "page.html")
    errors: list[str] = []
    requests: list[str] = []
    with open_chromium(SOFTWARE_GRAPHICS) as browser:
        context = browser.new_context(
            viewport={"width": 800, "height": 500}, device_scale_factor=0.5, offline=True, color_scheme="dark"
        )
        tab: Any = context.new_page()
        tab.set_default_timeout(READY_MS)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(page.path.as_uri(), wait_until="commit")
        tab.wait_for_function("window.__viserSceneTree?.getState()['/traffic/returns'] !== undefined")
        tab.wait_for_function(f"({VISIBLE})().join() === '/layers/blindspots'")
        assert tab.locator("#egvs").get_attribute("data-theme") == "dark"
        assert tab.locator("main, [role=main]").count() == tab.locator("h1").count() == 1
        assert violations(tab) == []
        tab.get_by_label("entropy seen").check()
        tab.wait_for_function(f"({VISIBLE})().join() === '/layers/seen'")
        tab.get_by_label("none").check()
        tab.wait_for_function(f"({VISIBLE})().join() === ''")
        tab.add_style_tag(content="#egvs, .mantine-Notifications-root { display: none }")
        for _ in range(40):  # traffic plays
            tab.wait_for_timeout(500)
            picture = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
            if count_pixels(picture, VEHICLE_COLOURS) >= MIN_PIXELS:
                break
    assert count_pixels(picture, VEHICLE_COLOURS) >= MIN_PIXELS, "no vehicle has a colour of the legend"
    assert count_shades(picture, WORST_SITE_COLOUR) >= MIN_PIXELS, "the ball of the worst site has another colour"
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert errors == []
    assert {url.split(":")[0] for url in requests} <= {"file", "blob", "data"}
