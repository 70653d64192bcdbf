"""The page: served to this machine alone, shows what `Session` says, and ends when it is told to."""

from __future__ import annotations

import math
import shutil
import socket
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pipeline
from pipeline.core.errors import InputError
from pipeline.explore.opening import open_session
from pipeline.explore.session import Session
from pipeline.sensing.sites import Pose
from tests.conftest import write_mini

viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

from pipeline.explore.layers import LAYERS  # noqa: E402 - needs viser
from pipeline.explore.page import GIZMO_M, HOST, Page  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
in_a_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium")
GRAPHICS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
READY_MS = 30_000


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Over the small scenario."""
    folder = tmp_path_factory.mktemp("page")
    return open_session(write_mini(folder / "mini"), (), folder / "run")


@pytest.fixture
def page(session: Session) -> Iterator[Page]:
    """Served, with its loop in a thread."""
    served = Page(session)
    loop = threading.Thread(target=served.run)
    loop.start()
    try:
        yield served
    finally:
        served.end()
        loop.join()
        served.stop()


def settled(page: Page, name: str, pose: Pose, sensor: str = "small") -> None:
    """Wait until a pose is shown."""
    page.want(replace(page.session.candidates[name].site, pose=pose, sensor=sensor))
    assert page.rest(30)


def test_it_serves_this_machine_alone(page: Page) -> None:
    assert page.address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == 200
    assert page._server.get_host() == HOST
    assert page._server.request_share_url() is None


def test_what_rests_is_what_was_wanted_last(page: Page, session: Session) -> None:
    poses = [Pose(10 + i / 8, 12, 3 + i / 16, 3.0 * i) for i in range(40)]
    for pose in poses[:-1]:
        page.want(replace(session.candidates["pole_a"].site, pose=pose))
    settled(page, "pole_a", poses[-1])
    expected = session.rate("pole_a", poses[-1])
    assert page.rating == expected
    assert f"## {expected.scores['egvs']:,.1f}" in page._told.content


def test_controls_and_gizmo_follow(page: Page) -> None:
    pose = Pose(10.5, 12.25, 4.125, 33.0, -7.5, 2.0)
    settled(page, "pole_a", pose)
    assert {name: number.value for name, number in page._numbers.items()} == pose.__dict__
    assert page._site.value.endswith("pole_a: 993.0")
    assert (page._gizmo.position + page.zero_m).tolist() == [10.5, 12.25, 4.125]
    assert page._label.text == f"pole_a  rank {page.rating.rank}"


def test_where_none_can_stand_no_score_is_left(page: Page) -> None:
    settled(page, "pole_a", Pose(16, 6, 3))
    assert page._told.content.startswith("## no score")
    assert "stands inside house" in page._told.content
    assert page._label.text == "pole_a: cannot stand"


def test_another_sensor_is_that_of_the_catalogue(page: Page, session: Session) -> None:
    pose = session.candidates["pole_a"].site.pose
    settled(page, "pole_a", pose, "VLP-16")
    assert page._sensor.value == "VLP-16"
    assert page.rating.scores["egvs"] > session.candidates["pole_a"].scores["egvs"]


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_show_what_their_names_say(page: Page, session: Session, layer: str) -> None:
    pose = Pose(11, 12, 3)
    page._layer.value = layer
    settled(page, "pole_a", pose)
    drawn = page._server.scene.get_handle_by_name("/layer")
    hits = session.hits(page.rating.site)
    total = session.entropy_bit.sum()
    expected = {
        "none": 0,
        "traffic (TPOG)": (session.tpog.counts.sum(axis=2) > 0).sum(),
        "entropy seen": (session.entropy_bit * (hits > 0)).any(axis=2).sum(),
        "entropy missed": (session.entropy_bit * (hits == 0)).any(axis=2).sum(),
        "empty scan": len(session.returns_m(page.rating.site)),
        "beams of a ring": len(session.beams_m(page.rating.site, 0)),
    }
    assert (0 if drawn is None else len(drawn.points)) == expected[layer]
    assert math.isclose((session.entropy_bit * (hits > 0)).sum() / total, page.rating.scores["entropy_seen"])


def test_a_plan_moves_with_its_sensors(mini: Path, tmp_path: Path) -> None:
    placed = pipeline.place(pipeline.load(mini, ["placement.count=1"]), tmp_path / "run")
    served = Page(open_session(mini, (), tmp_path / "run"))
    try:
        site = served.rating.site
        assert f"**plan** pole\\_b: together {placed.joint:,.1f}; best for one more: pole\\_a" in served._told.content
        there = replace(site, pose=replace(site.pose, z_m=4.5))
        served._show(served.session.rate(there.name, there.pose))
        assert served.plan is not None
        assert served.plan.sites["pole_b"] == there
        assert served.plan.joint == served.rating.scores["egvs"]  # of one sensor, the joint score is the score
        other = served.session.candidates["pole_a"].site
        served._show(served.session.rate(other.name, other.pose))
        assert served.plan.sites["pole_b"] == there
    finally:
        served.stop()


def test_a_port_that_is_taken_is_refused(session: Session) -> None:
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--port: {port} is taken; another one, or 0 for any that is free"):
            Page(session, port)


def test_nothing_is_served_after_the_end(session: Session) -> None:
    served = Page(session)
    address = served.address
    served.end()
    served.run()
    served.stop()
    with pytest.raises(OSError):
        urllib.request.urlopen(address)


# ---- in a browser


@pytest.fixture
def browser() -> Iterator[Any]:
    """Chromium, with software rendering."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS)
        yield opened
        opened.close()


def look(browser: Any, page: Page) -> tuple[Any, list[str]]:
    """A browser's view of the page, and the errors that it will have."""
    tab = browser.new_page(viewport={"width": 1200, "height": 800})
    errors: list[str] = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.goto(page.address)
    tab.get_by_text("rank 1 of 2").wait_for(timeout=READY_MS)
    return tab, errors


@in_a_browser
@pytest.mark.system
@pytest.mark.slow
def test_two_browsers_see_the_score_of_a_pose_that_one_types(browser: Any, page: Page, session: Session) -> None:
    (first, wrong), (second, other_wrong) = look(browser, page), look(browser, page)
    field = first.get_by_label("z m")
    field.fill("4.5")
    field.press("Enter")
    best = session.ranked[0].site
    pose = Pose(best.pose.x_m, best.pose.y_m, 4.5)
    expected = f"{session.rate(best.name, pose).scores['egvs']:,.1f}"
    for tab in (first, second):
        tab.get_by_text(expected).first.wait_for(timeout=READY_MS)
    first.reload()
    first.get_by_text(expected).first.wait_for(timeout=READY_MS)
    assert page.rating.site.pose == pose
    assert (wrong, other_wrong) == ([], [])


def on_screen(page: Page, tab: Any, at_m: np.ndarray) -> tuple[float, float]:
    """Where a point of the page's frame is drawn, in pixels, by the camera that the browser tells of."""
    (client,) = page._server.get_clients().values()
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


@in_a_browser
@pytest.mark.system
@pytest.mark.slow
def test_a_drag_ends_with_the_score_of_where_it_ends(browser: Any, page: Page, session: Session) -> None:
    tab, wrong = look(browser, page)
    start = page.rating.site
    at_m = np.subtract(start.pose.position_m, page.zero_m)
    x, y = on_screen(page, tab, at_m + np.array([0.0, 0.0, 0.85 * GIZMO_M]))
    ended = threading.Event()

    @page._gizmo.on_update
    def _(event: Any) -> None:
        if event.phase == "end":
            ended.set()

    tab.mouse.move(x, y)
    tab.mouse.down()
    for step in range(1, 9):
        tab.mouse.move(x, y - 6 * step)
    tab.mouse.up()
    assert ended.wait(30)
    assert page.rest(30)
    moved = page.rating.site.pose
    assert (moved.x_m, moved.y_m, moved.angles_deg) == (start.pose.x_m, start.pose.y_m, start.pose.angles_deg)
    assert moved.z_m > start.pose.z_m + 0.2
    assert page.rating == session.rate(start.name, moved)
    tab.get_by_text(f"{page.rating.scores['egvs']:,.1f}").first.wait_for(timeout=READY_MS)
    assert (page._gizmo.position + page.zero_m).tolist() == list(moved.position_m)
    assert wrong == []
