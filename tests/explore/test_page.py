"""The page: served to this machine alone, shows what `Session` says, and ends when it is told to."""

from __future__ import annotations

import gc
import math
import socket
import threading
import urllib.error
import urllib.request
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.explore import controls, drawing
from egvs.explore.page import HOST, Page
from egvs.explore.session import Playback, Session
from egvs.explore.settings import SessionFactory, Settings, open_session
from egvs.explore.view_state import LAYERS
from egvs.sensors.sites import Pose
from tests.conftest import write_mini

viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

import websockets  # noqa: E402 - comes with viser
from websockets.sync.client import connect  # noqa: E402

from tests.explore.serving import serving  # noqa: E402


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Over the small scenario."""
    folder = tmp_path_factory.mktemp("page")
    return open_session(write_mini(folder / "mini"), (), folder / "run")


def with_key(served: Page) -> Any:
    """What opens the page as a browser does: it keeps the cookie."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    assert opener.open(served.address).status == 200
    return opener


@pytest.fixture
def page(session: Session, tmp_path: Path) -> Iterator[Page]:
    """Served."""
    with serving(Page(session, tmp_path / "scratch")) as served:
        yield served


def settled(page: Page, name: str, pose: Pose, sensor: str = "small") -> None:
    """Wait until a pose is shown."""
    page.ask(site=replace(page.session.candidates[name].site, pose=pose, sensor=sensor))
    assert page.rest(30)


def test_it_serves_this_machine_alone(page: Page) -> None:
    assert page.address.startswith("http://127.0.0.1:")
    assert b"viser" in with_key(page).open(page._origin).read()
    assert page._server.get_host() == HOST
    assert page._server.request_share_url() is None


def test_who_has_no_key_gets_neither_page_nor_connection(page: Page) -> None:
    for request in ("/", "/index.html", "/?key=guessed"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(page._origin + request)
    port, protocol = page._server.get_port(), [websockets.Subprotocol(f"viser-v{viser.__version__}")]
    cookie = {"Cookie": f"egvs_explore_{port}={page.guard.key}"}
    for headers, origin in (({}, page._origin), (cookie, "http://evil.example"), (cookie, None)):
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            connect(f"ws://{HOST}:{port}", additional_headers=headers, origin=origin, subprotocols=protocol)
    with connect(
        f"ws://{HOST}:{port}", additional_headers=cookie, origin=page._origin, subprotocols=protocol
    ) as connection:
        assert connection.recv(10)


def test_a_world_that_is_drawn_coarser_says_so(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said, add = [], viser.GuiApi.add_markdown
    monkeypatch.setattr(viser.GuiApi, "add_markdown", lambda gui, text: (said.append(text), add(gui, text))[1])
    for most in (drawing.MAX_TRIANGLES, 6):
        monkeypatch.setattr(drawing.solid_meshes, "__defaults__", (most,))
        with serving(Page(session, tmp_path / str(most))):
            pass
    (told,) = [text for text in said if "triangles" in text]
    assert told.endswith(f" of {len(session.scene.world.faces)} triangles are drawn; beams meet all of them.")


def test_what_rests_is_what_was_wanted_last(page: Page, session: Session) -> None:
    poses = [Pose(10 + i / 8, 12, 3 + i / 16, 3.0 * i) for i in range(40)]
    for pose in poses[:-1]:
        page.ask(site=replace(session.candidates["pole_a"].site, pose=pose))
    settled(page, "pole_a", poses[-1])
    expected = session.rate("pole_a", poses[-1])
    assert page.rating == expected
    assert f"## {expected.scores['egvs']:,.1f}" in page.controls.status.content


def test_controls_and_gizmo_follow(page: Page) -> None:
    pose = Pose(10.5, 12.25, 4.125, 33.0, -7.5, 2.0)
    settled(page, "pole_a", pose)
    assert {name: number.value for name, number in page.controls.numbers.items()} == pose.__dict__
    assert page.controls._site.value.endswith("pole_a: 993.0")
    assert (page._gizmo.position + page.zero_m).tolist() == [10.5, 12.25, 4.125]
    assert page._label.text == f"pole_a  rank {page.rating.rank}"


def test_in_the_dark_the_world_is_dark(page: Page) -> None:
    by_day = {kind: mesh.color for kind, mesh in page._world.meshes.items()}
    page.ask(is_dark=True)
    assert page.rest(30)
    assert page.controls._dark.value
    assert all(sum(mesh.color) < sum(by_day[kind]) for kind, mesh in page._world.meshes.items())
    page.ask(is_dark=False)
    assert page.rest(30)
    assert {kind: mesh.color for kind, mesh in page._world.meshes.items()} == by_day


def test_where_none_can_stand_no_score_is_left(page: Page) -> None:
    settled(page, "pole_a", Pose(16, 6, 3))
    assert page.controls.status.content.startswith("## no score")
    assert "is inside house" in page.controls.status.content
    assert page._label.text == "pole_a: cannot stand"


@pytest.mark.slow
def test_another_sensor_is_that_of_the_catalogue(page: Page, session: Session) -> None:
    pose = session.candidates["pole_a"].site.pose
    settled(page, "pole_a", pose, "VLP-16")
    assert page.controls.sensor.value == "VLP-16"
    assert page.rating.scores["egvs"] > session.candidates["pole_a"].scores["egvs"]


@pytest.mark.slow
@pytest.mark.parametrize("layer", LAYERS)
def test_layers_show_what_their_names_say(page: Page, session: Session, layer: str) -> None:
    page.ask(layer=layer, ring=0, frame=7)
    settled(page, "pole_a", Pose(11, 12, 3))
    drawn, site = page._server.scene.get_handle_by_name("/layer"), page.rating.site
    hits, entropy = session.hits(site), session.entropy_bit
    other = session.hits(session.candidates["pole_b"].site)
    expected = {
        "none": 0,
        "traffic": (session.tpog.counts.sum(axis=2) > 0).sum(),
        "seen": (entropy * (hits > 0)).any(axis=2).sum(),
        "missed": (entropy * (hits == 0)).any(axis=2).sum(),
        "blindspots": (~np.isnan(session.blindspots(site).share_missed)).sum(),
        "difference": (entropy * ((hits > 0) != (other > 0))).any(axis=2).sum(),
        "scan": len(session.returns_m(site)),
        "ring": len(session.beams_m(site, 0)),
        "replay": len(Playback(session).moment(site, 7).returns_m),
    }
    assert (0 if drawn is None else len(drawn.points)) == expected[layer]
    assert (page.controls._legend.content != "") == (layer != "none")
    assert math.isclose((entropy * (hits > 0)).sum() / entropy.sum(), page.rating.scores["entropy_seen"])
    if layer == "difference":
        alone = (entropy * ((hits > 0) & (other == 0))).sum(), (entropy * ((hits == 0) & (other > 0))).sum()
        for name, bit in zip(("pole_a", "pole_b"), alone, strict=True):
            assert f"{name} alone sees {bit:,.1f} bit" in page.controls._legend.content
    if layer == "blindspots":
        assert f"{session.blindspots(site).overall.share:.1%} seen" in page.controls._legend.content


@pytest.mark.slow
def test_recorded_traffic_plays(page: Page) -> None:
    page.controls.plays.value = True
    page.ask(layer="replay", frame=39)
    deadline = threading.Event()
    watched = page.controls.frame
    watched.on_update(lambda event: deadline.set() if event.target.value in (1, 2) else None)
    assert deadline.wait(30)  # after the last frame comes the first
    bodies = [page._server.scene.get_handle_by_name(f"/layer/{name}") for name in ("seen", "missed")]
    assert any(body is not None for body in bodies)


@pytest.mark.slow
def test_settings_are_those_of_a_run_with_them(page: Page, session: Session, tmp_path: Path) -> None:
    pose = Pose(10.5, 12.25, 4.125, 33.0, -7.5, 2.0)
    settled(page, "pole_a", pose)
    with_them = Settings(2.0, "points_on_target", frozenset({"moving_occlusion"}))
    page.ask(settings=with_them)
    assert page.rest(60)
    expected = SessionFactory(session, tmp_path / "other").session(with_them)
    assert page.session is not session
    assert page.rating == expected.rate("pole_a", pose)
    assert {name: its.scores for name, its in page.session.candidates.items()} == {
        name: its.scores for name, its in expected.candidates.items()
    }
    assert (page.controls.gamma.value, page.controls.score.value) == (2.0, "points_on_target")
    assert page.controls.effects["moving_occlusion"].value
    assert controls.ranking_table(expected.ranked, "points_on_target") == page.controls._ranking.content
    page.ask(settings=replace(with_them, gamma=-1.0))
    assert page.rest(60)
    assert "input should be greater than or equal to 0" in page.controls.status.content
    assert page.view.settings == with_them
    page.ask(settings=Settings.of(session.scenario))
    assert page.rest(60)
    assert page.session is session
    assert page.rating == session.rate("pole_a", pose)


@pytest.mark.slow
def test_what_is_asked_while_a_setting_is_made_is_not_lost(page: Page, session: Session) -> None:
    pose = Pose(10.5, 12.25, 4.0)
    page.ask(settings=Settings(2.0, "egvs", frozenset()))
    page.ask(site=replace(session.candidates["pole_a"].site, pose=pose))
    page.ask(layer="missed")
    assert page.rest(60)
    assert (page.view.settings.gamma, page.view.site.pose, page.view.layer) == (2.0, pose, "missed")
    assert page.session.scenario.gamma == 2.0


@pytest.mark.slow
def test_nothing_is_held_of_poses_sensors_and_sessions_that_were(page: Page, session: Session) -> None:
    """What a page holds on to is bounded: one mount a scanner, one engine a session, messages of what is shown."""
    buffer = page._server._websock_server._broadcast_buffer

    def held() -> tuple[int, int, int, int]:
        engines = session._engines.values()
        mounts = sum(len(engine.scanner._directions) for engine in engines)
        return len(engines), mounts, len(buffer.message_from_id), len(buffer.id_from_redundancy_key)

    def walk() -> None:
        for step in range(12):
            page.ask(layer=sorted(LAYERS)[step % len(LAYERS)])
            settled(page, "pole_a", Pose(10 + step / 8, 12, 3, 3.0 * step), ("VLP-16", "small")[step % 2])
        for gamma in (1.0, 2.0, None):
            page.ask(settings=Settings(gamma, "egvs", frozenset()))
            assert page.rest(60)

    walk()
    sessions = weakref.WeakSet([page._variants.session(Settings(3.0, "egvs", frozenset()))])
    first = held()
    walk()
    gc.collect()
    assert held() == first
    assert first[1] == 1
    assert not sessions
    again = session.rate("pole_a", page.view.site.pose, "small")
    assert page.rating == again


def test_a_link_shows_what_it_says(page: Page, session: Session) -> None:
    opener = with_key(page)
    link = f"{page.address}&site=pole_a&pose=10.5,12,4,0,0,0&layer=seen&camera=20,-30,40,20,0,2.5"
    assert opener.open(link).url == f"{page._origin}/?initialCameraPosition=0,-30,40&initialCameraLookAt=0,0,2.5"
    assert page.rest(30)
    assert (page.view.site.pose, page.view.layer) == (Pose(10.5, 12, 4), "seen")
    assert opener.open(f"{page.address}&site=nobody").url == f"{page._origin}/"
    assert page.rest(30)
    assert "nobody" in page.controls.status.content
    assert page.view.site.pose == Pose(10.5, 12, 4)


def test_who_is_gone_holds_nothing_any_more(page: Page) -> None:
    class Gone:
        client_id = 7

    page._dragging = 7
    settled(page, "pole_a", Pose(10.5, 12, 4))
    assert (page._gizmo.position + page.zero_m).tolist() == [30.5, -12, 3]  # somebody's hand has it
    page._lost(Gone())  # type: ignore[arg-type]
    assert page.rest(30)
    assert (page._gizmo.position + page.zero_m).tolist() == [10.5, 12, 4]


@pytest.mark.slow
def test_a_plan_moves_with_its_sensors(mini: Path, tmp_path: Path) -> None:
    placed = egvs.place(egvs.load(mini, ["placement.count=1"]), tmp_path / "run")
    served = Page(open_session(mini, (), tmp_path / "run"), tmp_path / "scratch")
    try:
        site = served.rating.site
        assert (
            f"**plan** pole\\_b: together {placed.joint:,.1f}; best for one more: pole\\_a"
            in served.controls.status.content
        )
        assert served._server.scene.get_handle_by_name("/plan/label0") is None  # it is chosen
        assert served._server.scene.get_handle_by_name("/plan/label1").text == "pole_a: best for one more"
        there = replace(site, pose=replace(site.pose, z_m=4.5))
        served._show(replace(served.view, site=there))
        assert served.plan is not None
        assert served.plan.sites["pole_b"] == there
        assert served.plan.joint == served.rating.scores["egvs"]  # of one sensor, the joint score is the score
        balls = served._server.scene.get_handle_by_name("/plan/balls")
        assert (balls.batched_positions[0] + served.zero_m).tolist() == [*there.pose.position_m]
        other = served.session.candidates["pole_a"].site
        served._show(replace(served.view, site=other))
        assert served._server.scene.get_handle_by_name("/plan/label0").text == "pole_b: in the plan"
        assert served._server.scene.get_handle_by_name("/plan/label1") is None
        assert served.plan.sites["pole_b"] == there
        assert served.present(served.session.candidates["pole_b"].site) == there
        served._show(replace(served.view, settings=Settings(1.0, "egvs", frozenset())))
        assert served.plan.sites["pole_b"] == there
        assert served.plan.joint == served.session.rate("pole_b", there.pose).scores["egvs"]
    finally:
        served.stop()


def test_a_port_that_is_taken_is_refused(session: Session, tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--port: {port} is taken; another one, or 0 for any that is free"):
            Page(session, tmp_path, port)


def test_nothing_is_served_after_the_end(session: Session, tmp_path: Path) -> None:
    served = Page(session, tmp_path)
    address = served.address
    served.end()
    served.run()
    served.stop()
    with pytest.raises(OSError):
        urllib.request.urlopen(address)
