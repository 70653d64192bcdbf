"""The page in a real browser loads without errors, and a drag ends with the score of the final pose.

One browser and one page serve all tests of this module, because loading takes seconds with software rendering.
"""

from __future__ import annotations

import asyncio
import functools
import http.server
import math
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.explore.page import GIZMO_M, Page
from egvs.explore.settings import open_session
from egvs.explore.view_state import SAVED_SITES, Camera
from egvs.sensors.sites import Pose
from tests.chromium import SOFTWARE_GRAPHICS, needs_chromium, open_chromium
from tests.conftest import write_mini

viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

from tests.explore.serving import serving  # noqa: E402

READY_MS, READY_S = 60_000, 60

CONNECT = """([address, protocol]) => new Promise(done => {
    const its = new WebSocket(address, protocol);
    its.onopen = () => done('open');
    its.onerror = () => done('refused');
})"""

pytestmark = [
    needs_chromium,
    pytest.mark.system,
    pytest.mark.slow,
]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A served page over the small scenario."""
    folder = tmp_path_factory.mktemp("browser")
    made = Page(open_session(write_mini(folder / "mini"), (), folder / "run"), folder / "scratch")
    made.set_camera(Camera((30.0, -34.0, 18.0), (30.0, -10.0, 3.0)))  # at the sensor that is dragged
    with serving(made) as served:
        yield served


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium with software rendering."""
    with open_chromium(SOFTWARE_GRAPHICS) as opened:
        yield opened.new_context(viewport={"width": 800, "height": 500}, device_scale_factor=0.5)


def look(browser: Any, address: str, errors: list[str]) -> Any:
    """Open an address; errors are added to ``errors``."""
    tab = browser.new_page()
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.goto(address)
    tab.get_by_text("rank 1 of 2").wait_for(timeout=READY_MS)
    return tab


@pytest.fixture(scope="module")
def errors() -> list[str]:
    """Errors in the tab."""
    return []


@pytest.fixture(scope="module")
def tab(browser: Any, page: Page, errors: list[str]) -> Any:
    """A tab with the page."""
    return look(browser, page.address, errors)


def looks_at_it(page: Page) -> None:
    """Wait until the browser reports the requested camera; it starts with another one."""
    (client,) = page.server.get_clients().values()
    there = threading.Event()

    def check(camera: Any) -> None:
        if np.allclose(camera.position, page.server.initial_camera.position, atol=1e-3):
            there.set()

    client.camera.on_update(check)
    check(client.camera)
    assert there.wait(READY_S)


def on_screen(page: Page, tab: Any, at_m: np.ndarray) -> tuple[float, float]:
    """Return the pixel of a point of the page's frame, with the camera that the browser reports."""
    (client,) = page.server.get_clients().values()
    w, x, y, z = client.camera.wxyz
    columns = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ]
    right, down, ahead = np.array(columns) @ (at_m - client.camera.position)
    box = tab.locator("canvas").first.bounding_box()
    focal = box["height"] / 2.0 / math.tan(client.camera.fov / 2.0)
    return (
        box["x"] + box["width"] / 2.0 + focal * right / ahead,
        box["y"] + box["height"] / 2.0 + focal * down / ahead,
    )


def test_drag_ends_with_score_of_final_pose(tab: Any, page: Page, errors: list[str]) -> None:
    looks_at_it(page)
    start = page.rating.site
    at_m = np.subtract(start.pose.position_m, page.zero_m)
    x, y = on_screen(page, tab, at_m + np.array([0.0, 0.0, 0.85 * GIZMO_M]))
    ended = threading.Event()

    @page.gizmo.on_update
    def _(event: Any) -> None:
        if event.phase == "end":
            ended.set()

    tab.mouse.move(x, y)
    tab.mouse.down()
    for step in range(1, 5):
        tab.mouse.move(x, y - 10 * step)
    tab.mouse.up()
    assert ended.wait(READY_S)
    assert page.wait_until_idle(READY_S)
    moved = page.rating.site.pose
    assert (moved.x_m, moved.y_m, moved.angles_deg) == (start.pose.x_m, start.pose.y_m, start.pose.angles_deg)
    assert moved.z_m > start.pose.z_m + 0.2
    assert page.rating == page.session.rate(start.name, moved)
    tab.get_by_text(f"{page.rating.scores['egvs']:,.1f}").first.wait_for(timeout=READY_MS)
    assert (page.gizmo.position + page.zero_m).tolist() == list(moved.position_m)
    assert errors == []


def test_other_browsers_and_reload_show_the_same(browser: Any, tab: Any, page: Page, errors: list[str]) -> None:
    field = tab.get_by_label("z (m)")
    field.fill("4.5")
    field.press("Enter")
    best = page.session.ranked[0].site
    pose = Pose(best.pose.x_m, best.pose.y_m, 4.5)
    expected = f"{page.session.rate(best.name, pose).scores['egvs']:,.1f}"
    tab.get_by_text(expected).first.wait_for(timeout=READY_MS)
    other = look(browser, page.address, errors)
    other.get_by_text(expected).first.wait_for(timeout=READY_MS)
    other.close()
    tab.reload()
    tab.get_by_text(expected).first.wait_for(timeout=READY_MS)
    assert page.rating.site.pose == pose
    assert errors == []


def test_reconnected_browser_shows_changes(tab: Any, page: Page) -> None:
    server = page.server._websock_server
    (lost,) = server._live_connections
    back = threading.Event()
    page.server.on_client_connect(lambda client: back.set() if client.client_id != lost else None)
    closing = server._live_connections[lost].close()
    asyncio.run_coroutine_threadsafe(closing, page.server.get_event_loop()).result(READY_S)
    site = page.session.candidates["pole_a"].site
    page.request(site=site)
    assert back.wait(READY_S)
    score = page.session.rate(site.name, site.pose).scores["egvs"]
    tab.get_by_role("heading", name=f"{score:,.1f}").wait_for(timeout=READY_MS)


def move_to_pole_a(page: Page) -> None:
    """Choose a site, whatever the tests before have done, and wait for its score."""
    page.request(site=page.session.candidates["pole_a"].site)
    assert page.wait_until_idle(READY_S)


def test_users_file_is_not_overwritten_when_saving_a_pose(tab: Any, page: Page) -> None:
    move_to_pole_a(page)
    folder = page.session.scenario.folder
    (folder / SAVED_SITES).write_text("mine")
    tab.get_by_role("button", name="Save this pose").click()
    tab.get_by_text("was not written by egvs explore").wait_for(timeout=READY_MS)
    tab.get_by_role("button", name="Save to kept_sites-2.csv").click()
    tab.get_by_text("saved as pole_a-1").wait_for(timeout=READY_MS)
    assert (folder / SAVED_SITES).read_text() == "mine"
    assert (folder / "kept_sites-2.csv").read_text().splitlines()[1].startswith("pole_a-1,10.0,12.0,3.0")


def test_link_and_picture_show_the_current_view(browser: Any, tab: Any, page: Page, errors: list[str]) -> None:
    move_to_pole_a(page)
    tab.get_by_role("button", name="Link to this view").click()
    link = tab.get_by_text(re.compile("^http://")).first.inner_text(timeout=READY_MS).strip()
    tab.get_by_role("button", name="Close").last.click()
    (client,) = page.server.get_clients().values()
    before = client.camera.position, page.view
    with tab.expect_download(timeout=READY_MS) as download:
        tab.get_by_role("button", name="Download picture (PNG)").click()
    assert download.value.suggested_filename == "mini.png"
    assert Path(download.value.path()).read_bytes().startswith(b"\x89PNG")
    page.request(site=page.session.candidates["pole_b"].site, layer="traffic")
    assert page.wait_until_idle(READY_S)
    tab.goto(link)
    tab.get_by_role("heading", name=f"{page.session.candidates['pole_a'].scores['egvs']:,.1f}").wait_for(
        timeout=READY_MS
    )
    assert page.view == before[1]
    (client,) = page.server.get_clients().values()
    assert np.allclose(client.camera.position, before[0], rtol=1e-4)
    assert "key=" not in tab.url
    assert errors == []


def test_page_of_other_origin_cannot_connect(browser: Any, tab: Any, page: Page, tmp_path: Path) -> None:
    (tmp_path / "evil.html").write_text("<p>evil</p>")
    handler = functools.partial(_Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as evil:
        serving = threading.Thread(target=evil.serve_forever)
        serving.start()
        try:
            other = browser.new_page()
            other.goto(f"http://127.0.0.1:{evil.server_address[1]}/evil.html")
            connected = other.evaluate(CONNECT, [page.origin.replace("http", "ws"), f"viser-v{viser.__version__}"])
            fetched = other.evaluate("address => fetch(address).then(() => 'read', () => 'refused')", page.origin)
        finally:
            evil.shutdown()
            serving.join()
    other.close()
    assert (connected, fetched) == ("refused", "refused")


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        """Print nothing."""
