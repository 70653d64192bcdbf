"""The page serves only this machine, shows the scores of `Session`, and stops on request."""

from __future__ import annotations

import asyncio
import gc
import math
import socket
import threading
import urllib.error
import urllib.request
import weakref
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.explore import controls, drawing
from egvs.explore.page import Page
from egvs.explore.server import HOST
from egvs.explore.session import Playback, Session
from egvs.explore.settings import SessionFactory, Settings, open_session
from egvs.explore.view_state import LAYERS
from egvs.sensors.sites import Pose
from tests.conftest import write_mini

viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

import msgspec  # noqa: E402 - comes with viser
import websockets  # noqa: E402 - comes with viser
from websockets.sync.client import connect  # noqa: E402

from tests.explore.serving import serving  # noqa: E402


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session over the small scenario."""
    folder = tmp_path_factory.mktemp("page")
    return open_session(write_mini(folder / "mini"), (), folder / "run")


def with_key(served: Page) -> Any:
    """Open the page as a browser does, with its cookie."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    assert opener.open(served.address).status == 200
    return opener


@pytest.fixture
def page(session: Session, tmp_path: Path) -> Iterator[Page]:
    """A served page."""
    with serving(Page(session, tmp_path / "scratch")) as served:
        yield served


def move_and_wait(page: Page, name: str, pose: Pose, sensor: str = "small") -> None:
    """Wait until a pose is shown."""
    page.request(site=replace(page.session.candidates[name].site, pose=pose, sensor=sensor))
    assert page.wait_until_idle(30)


@pytest.mark.slow
def test_serves_only_this_machine(page: Page) -> None:
    assert page.address.startswith("http://127.0.0.1:")
    assert b"viser" in with_key(page).open(page.origin).read()
    assert page.server.get_host() == HOST
    assert page.server.request_share_url() is None


def test_refuses_page_and_connection_without_key(page: Page) -> None:
    for request in ("/", "/index.html", "/?key=guessed"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(page.origin + request)
    port, protocol = page.server.get_port(), [websockets.Subprotocol(f"viser-v{viser.__version__}")]
    cookie = {"Cookie": f"egvs_explore_{port}={page.guard.key}"}
    for headers, origin in (({}, page.origin), (cookie, "http://evil.example"), (cookie, None)):
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            connect(f"ws://{HOST}:{port}", additional_headers=headers, origin=origin, subprotocols=protocol)
    with connect(
        f"ws://{HOST}:{port}", additional_headers=cookie, origin=page.origin, subprotocols=protocol
    ) as connection:
        assert connection.recv(10)


GARBAGE = [
    b"\x00\xff" * 50 + b"\r\n\r\n",
    b"GET / HTTP/9.9\r\n\r\n",
    b"GET /\xff HTTP/1.1\r\nHost: \xff\r\n\r\n",
    b"GE",
]
MESSAGES = [
    "text",
    b"\xc1",
    b"\x80",
    msgspec.msgpack.encode({"type": "no such message"}),
    msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": [5], "updates": 7}),
    msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage", "name": {}, "wxyz": None, "position": 1}),
]


@pytest.mark.slow  # waits for answers to each message
def test_malformed_requests_and_messages_print_no_traceback(
    page: Page, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    port, protocol = page.server.get_port(), [websockets.Subprotocol(f"viser-v{viser.__version__}")]
    for garbage in GARBAGE:
        with socket.create_connection((HOST, port)) as connection:
            connection.sendall(garbage)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(4096):
                pass
    cookie = {"Cookie": f"egvs_explore_{port}={page.guard.key}"}
    for message in MESSAGES:
        with (
            connect(
                f"ws://{HOST}:{port}", additional_headers=cookie, origin=page.origin, subprotocols=protocol
            ) as client,
            suppress(TimeoutError, websockets.exceptions.ConnectionClosed),
        ):
            client.send(message)
            while True:
                client.recv(timeout=0.3)
    gc.collect()
    printed = "".join(capfd.readouterr())
    assert b"viser" in with_key(page).open(page.origin).read()
    assert "Traceback" not in caplog.text + printed


def test_panel_notes_simplified_drawing(session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texts, add = [], viser.GuiApi.add_markdown
    monkeypatch.setattr(viser.GuiApi, "add_markdown", lambda gui, text: (texts.append(text), add(gui, text))[1])
    for most in (drawing.MAX_TRIANGLES, 6):
        monkeypatch.setattr(drawing.solid_meshes, "__defaults__", (most,))
        with serving(Page(session, tmp_path / str(most))):
            pass
    (note,) = [text for text in texts if "triangles" in text]
    assert note.endswith(f" of {len(session.scene.world.faces)} triangles; scores use all of them.")


def test_shows_the_last_requested_pose(page: Page, session: Session) -> None:
    poses = [Pose(10 + i / 8, 12, 3 + i / 16, 3.0 * i) for i in range(40)]
    for pose in poses[:-1]:
        page.request(site=replace(session.candidates["pole_a"].site, pose=pose))
    move_and_wait(page, "pole_a", poses[-1])
    expected = session.rate("pole_a", poses[-1])
    assert page.rating == expected
    assert f"## {expected.scores['egvs']:,.1f}" in page.controls.status.content


def test_controls_and_gizmo_show_the_pose(page: Page) -> None:
    pose = Pose(10.5, 12.25, 4.125, 33.0, -7.5, 2.0)
    move_and_wait(page, "pole_a", pose)
    assert {name: number.value for name, number in page.controls.numbers.items()} == pose.__dict__
    assert page.controls.site.value.endswith("pole_a: 993.0 bit")
    assert (page.gizmo.position + page.zero_m).tolist() == [10.5, 12.25, 4.125]
    assert page.label.text == f"pole_a  rank {page.rating.rank}"


def test_dark_page_has_dark_world(page: Page) -> None:
    by_day = {kind: mesh.color for kind, mesh in page.world.meshes.items()}
    page.request(is_dark=True)
    assert page.wait_until_idle(30)
    assert page.controls.dark.value
    assert all(sum(mesh.color) < sum(by_day[kind]) for kind, mesh in page.world.meshes.items())
    page.request(is_dark=False)
    assert page.wait_until_idle(30)
    assert {kind: mesh.color for kind, mesh in page.world.meshes.items()} == by_day


@pytest.mark.slow
def test_impossible_pose_has_no_score(page: Page) -> None:
    move_and_wait(page, "pole_a", Pose(16, 6, 3))
    assert page.controls.status.content.startswith("## no score")
    assert "is inside house" in page.controls.status.content
    assert page.label.text == "pole_a: no sensor can be mounted here"


@pytest.mark.slow
def test_sensor_of_the_catalogue_can_be_selected(page: Page, session: Session) -> None:
    pose = session.candidates["pole_a"].site.pose
    move_and_wait(page, "pole_a", pose, "VLP-16")
    assert page.controls.sensor.value == "VLP-16"
    assert page.rating.scores["egvs"] > session.candidates["pole_a"].scores["egvs"]


@pytest.mark.slow
@pytest.mark.parametrize("layer", LAYERS)
def test_layers_draw_their_data(page: Page, session: Session, layer: str) -> None:
    page.request(layer=layer, ring=0, frame=7)
    move_and_wait(page, "pole_a", Pose(11, 12, 3))
    drawn, site = page.server.scene.get_handle_by_name("/layer"), page.rating.site
    hits, entropy = session.hits(site), session.entropy_bit
    other = session.hits(session.candidates["pole_b"].site)
    playback = Playback(session)
    expected = {
        "none": 0,
        "traffic": (session.tpog.counts.sum(axis=2) > 0).sum(),
        "seen": (entropy * (hits > 0)).any(axis=2).sum(),
        "missed": (entropy * (hits == 0)).any(axis=2).sum(),
        "blindspots": (~np.isnan(session.blindspots(site).share_missed)).sum(),
        "points_car": 0,  # without a road network there is no surface
        "points_pedestrian": 0,
        "overlap_car": 0,
        "overlap_pedestrian": 0,
        "difference": (entropy * ((hits > 0) != (other > 0))).any(axis=2).sum(),
        "scan": len(session.returns_m(site)),
        "ring": len(session.beams_m(site, 0)),
        "replay": len(playback.simulate(site, playback.frame(7)).returns_m),
    }
    assert (0 if drawn is None else len(drawn.points)) == expected[layer]
    assert (page.controls.legend.content != "") == (layer != "none")
    assert math.isclose((entropy * (hits > 0)).sum() / entropy.sum(), page.rating.scores["entropy_seen"])
    if layer == "difference":
        alone = (entropy * ((hits > 0) & (other == 0))).sum(), (entropy * ((hits == 0) & (other > 0))).sum()
        for name, bit in zip(("pole_a", "pole_b"), alone, strict=True):
            assert f"seen only by {name}: {bit:,.1f} bits" in page.controls.legend.content
    if layer == "replay":
        last_s = (playback.frames - 1) * playback.period_s
        assert f"{7 * playback.period_s:,.1f} s of {last_s:,.1f} s" in page.controls.legend.content
    if layer == "blindspots":
        assert f"{100 * session.blindspots(site).overall.share:.1f} % found" in page.controls.legend.content


@pytest.mark.slow
def test_recorded_traffic_plays(page: Page) -> None:
    page.controls.plays.value = True
    page.request(layer="replay", frame=39)
    deadline = threading.Event()
    watched = page.controls.frame
    watched.on_update(lambda event: deadline.set() if event.target.value in (1, 2) else None)
    assert deadline.wait(30)  # after the last frame comes the first
    bodies = [page.server.scene.get_handle_by_name(f"/layer/{name}") for name in ("seen", "missed")]
    assert any(body is not None for body in bodies)


@pytest.mark.slow
def test_settings_give_the_scores_of_a_run(page: Page, session: Session, tmp_path: Path) -> None:
    pose = Pose(10.5, 12.25, 4.125, 33.0, -7.5, 2.0)
    move_and_wait(page, "pole_a", pose)
    with_them = Settings(2.0, "points_on_target", frozenset({"moving_occlusion"}))
    page.request(settings=with_them)
    assert page.wait_until_idle(60)
    expected = SessionFactory(session, tmp_path / "other").session(with_them)
    assert page.session is not session
    assert page.rating == expected.rate("pole_a", pose)
    assert {name: candidate.scores for name, candidate in page.session.candidates.items()} == {
        name: candidate.scores for name, candidate in expected.candidates.items()
    }
    assert (page.controls.gamma.value, page.controls.score.value) == (2.0, "points_on_target")
    assert page.controls.effects["moving_occlusion"].value
    assert controls.ranking_table(expected.ranked, "points_on_target") == page.controls.ranking.content
    page.request(settings=replace(with_them, gamma=-1.0))
    assert page.wait_until_idle(60)
    assert "expected a value greater than or equal to 0" in page.controls.status.content
    assert page.view.settings == with_them
    page.request(settings=Settings.from_scenario(session.scenario))
    assert page.wait_until_idle(60)
    assert page.session is session
    assert page.rating == session.rate("pole_a", pose)


@pytest.mark.slow
def test_requests_during_a_run_are_not_lost(page: Page, session: Session) -> None:
    pose = Pose(10.5, 12.25, 4.0)
    page.request(settings=Settings(2.0, "egvs", frozenset()))
    page.request(site=replace(session.candidates["pole_a"].site, pose=pose))
    page.request(layer="missed")
    assert page.wait_until_idle(60)
    assert (page.view.settings.gamma, page.view.site.pose, page.view.layer) == (2.0, pose, "missed")
    assert page.session.scenario.gamma == 2.0


@pytest.mark.slow
def test_memory_for_earlier_poses_sensors_and_sessions_is_freed(page: Page, session: Session) -> None:
    """What a page keeps is bounded: one mount per scanner, one engine per session, messages of what is shown."""
    buffer = page.server._websock_server._broadcast_buffer  # viser has no public access to it

    def count_cached() -> tuple[int, int, int, int]:
        engines = session.engines.values()
        mounts = sum(len(engine.scanner._directions) for engine in engines)
        return len(engines), mounts, len(buffer.message_from_id), len(buffer.id_from_redundancy_key)

    def visit_everything() -> None:
        for step in range(12):
            page.request(layer=sorted(LAYERS)[step % len(LAYERS)])
            move_and_wait(page, "pole_a", Pose(10 + step / 8, 12, 3, 3.0 * step), ("VLP-16", "small")[step % 2])
        for gamma in (1.0, 2.0, None):
            page.request(settings=Settings(gamma, "egvs", frozenset()))
            assert page.wait_until_idle(60)

    page.request(settings=Settings(3.0, "egvs", frozenset()))
    assert page.wait_until_idle(60)
    earlier_sessions = weakref.WeakSet([page.session])
    visit_everything()
    first = count_cached()
    visit_everything()
    gc.collect()
    assert count_cached() == first
    assert first[1] == 1
    assert not earlier_sessions
    assert page.rating == session.rate("pole_a", page.view.site.pose, "small")


def test_page_opens_with_traffic_names_of_poles_north_and_scale(page: Page) -> None:
    page.request(site=page.session.candidates["pole_b"].site)
    assert page.wait_until_idle(30)
    assert page.controls.layer.value == LAYERS["traffic"]
    assert page.server.scene.get_handle_by_name("/layer") is not None
    scene = page.server.scene
    assert scene.get_handle_by_name("/map/north/label").text == "N"
    assert scene.get_handle_by_name("/map/scale/label").text == "5 m"
    names = [scene.get_handle_by_name(f"/poles/{number}") for number in (0, 1)]
    assert [label and label.text for label in names] == [None, "pole_a"]  # the gizmo names the selected one
    page.request(site=page.session.candidates["pole_a"].site)
    assert page.wait_until_idle(30)
    names = [scene.get_handle_by_name(f"/poles/{number}") for number in (0, 1)]
    assert [label and label.text for label in names] == ["pole_b", None]


def test_height_slider_moves_the_sensor(page: Page) -> None:
    page.request(site=page.session.candidates["pole_a"].site)
    assert page.wait_until_idle(30)
    slider = page.controls.height
    slider._impl.value = 4.5  # as viser does when a browser sends it
    for update in slider._impl.update_cb:
        update(viser.GuiEvent(object(), 0, slider))
    assert page.wait_until_idle(30)
    assert page.rating.site.pose == Pose(10.0, 12.0, 4.5)
    assert page.controls.numbers["z_m"].value == 4.5
    move_and_wait(page, "pole_a", Pose(10.0, 12.0, 40.0))
    assert slider.value == slider.max


def test_second_sensor_is_added_by_one_click(page: Page) -> None:
    moved = replace(page.session.candidates["pole_a"].site, pose=Pose(10.5, 12.25, 4.0))
    page.request(site=moved)
    page.add_sensor()
    assert page.wait_until_idle(60)
    assert page.plan is not None
    assert list(page.plan.sites) == ["pole_a", "pole_b"]
    assert page.plan.sites["pole_a"] == moved
    assert page.plan.joint > page.rating.scores["egvs"]
    assert "**plan** pole\\_a, pole\\_b: EGVS" in page.controls.status.content
    assert page.server.scene.get_handle_by_name("/plan/label1").text == "pole_b: in the plan"
    page.add_sensor()
    assert page.wait_until_idle(60)
    assert "All candidates are in the plan" in page.controls.status.content
    page.reset_plan()
    assert page.wait_until_idle(60)
    assert page.plan is None
    assert "**plan**" not in page.controls.status.content


def test_impossible_sensor_starts_no_plan(page: Page) -> None:
    move_and_wait(page, "pole_a", Pose(16, 6, 3))
    page.add_sensor()
    assert page.wait_until_idle(60)
    assert page.plan is None
    assert "cannot be mounted" in page.controls.status.content


def test_opened_link_shows_its_view(page: Page, session: Session) -> None:
    opener = with_key(page)
    link = f"{page.address}&site=pole_a&pose=10.5,12,4,0,0,0&layer=seen&camera=20,-30,40,20,0,2.5"
    assert opener.open(link).url == f"{page.origin}/?initialCameraPosition=0,-30,40&initialCameraLookAt=0,0,2.5"
    assert page.wait_until_idle(30)
    assert (page.view.site.pose, page.view.layer) == (Pose(10.5, 12, 4), "seen")
    assert opener.open(f"{page.address}&fixedDpr=0.5").url == f"{page.origin}/?fixedDpr=0.5"
    assert opener.open(f"{page.address}&fixedDpr=0.5&site=nobody").url == f"{page.origin}/?fixedDpr=0.5"
    assert page.wait_until_idle(30)
    assert "nobody" in page.controls.status.content
    assert page.view.site.pose == Pose(10.5, 12, 4)
    assert opener.open(f"{page.address}&fixedDpr=x").url == f"{page.origin}/"
    assert page.wait_until_idle(30)
    assert "fixedDpr" in page.controls.status.content


BAD_VALUES = [
    ("z_m", math.inf, "z_m: expected a number from -1e+08 to 1e+08, got inf"),
    ("yaw_deg", math.nan, "yaw_deg: expected a number from -1e+08 to 1e+08, got nan"),
    ("sensor", "nothing", "unknown sensor 'nothing'"),
    ("layer", "sky", "layer: expected one of none, traffic, "),
    ("period", "noon", "period: expected no value, got 'noon'"),
    ("compared_site", "nobody", "beside: expected one of pole_a, pole_b, got 'nobody'"),
    ("score", "best", "score.rank_by: expected "),
    ("gamma", math.nan, "score.gamma: expected "),
]


@pytest.mark.parametrize(("name", "value", "message"), BAD_VALUES)
def test_bad_value_of_a_browser_is_rejected(page: Page, name: str, value: object, message: str) -> None:
    panel = page.controls
    control = panel.numbers.get(name) or getattr(panel, name)
    rating, view, before = page.rating, page.view, control.value
    control._impl.value = value  # as viser does when a browser sends it
    for update in control._impl.update_cb:
        update(viser.GuiEvent(object(), 0, control))
    assert page.wait_until_idle(30)
    assert message in panel.status.content.replace("\\", "")
    assert (page.rating, page.view, control.value) == (rating, view, before)
    move_and_wait(page, "pole_a", Pose(11, 12, 3))
    assert page.rating == page.session.rate("pole_a", Pose(11, 12, 3))


@pytest.mark.parametrize(
    ("position", "wxyz"), [((math.inf, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), ((0.0, 0.0, 3.0), (0.0,) * 4)]
)
def test_impossible_drag_is_rejected(page: Page, position: tuple[float, ...], wxyz: tuple[float, ...]) -> None:
    where = page.gizmo.position.tolist()
    page.gizmo._impl.position, page.gizmo._impl.wxyz = np.array(position), np.array(wxyz)
    asyncio.run(page._on_gizmo(viser.TransformControlsEvent(None, 7, page.gizmo, "update")))
    assert page.wait_until_idle(30)
    assert "the page: sensor: expected a position and an angle" in page.controls.status.content.replace("\\", "")
    assert page.gizmo.position.tolist() == where


def test_page_goes_on_after_a_layer_that_fails(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> str:
        raise InputError("trajectories.parquet", "no such file")

    monkeypatch.setitem(drawing._DRAW_FUNCTIONS, "replay", fail)
    page.request(layer="replay")
    assert page.wait_until_idle(30)
    assert "no such file" in page.controls.status.content
    assert (page.view.layer, page.controls.layer.value) == ("none", LAYERS["none"])
    move_and_wait(page, "pole_a", Pose(11, 12, 3))
    assert page.rating == page.session.rate("pole_a", Pose(11, 12, 3))


def test_gizmo_follows_when_dragging_browser_disconnects(page: Page) -> None:
    page.request(site=page.session.candidates["pole_a"].site)
    assert page.wait_until_idle(30)
    page.drag(7, Pose(10.5, 12, 4), is_finished=False)
    assert page.wait_until_idle(30)
    assert page.rating.site.pose == Pose(10.5, 12, 4)
    assert (page.gizmo.position + page.zero_m).tolist() == [10, 12, 3]  # it must not move under the mouse
    page.disconnect(8)
    assert page.wait_until_idle(30)
    assert (page.gizmo.position + page.zero_m).tolist() == [10, 12, 3]
    page.disconnect(7)
    assert page.wait_until_idle(30)
    assert (page.gizmo.position + page.zero_m).tolist() == [10.5, 12, 4]


def test_gizmo_follows_at_the_end_of_a_drag(page: Page) -> None:
    page.drag(7, Pose(30.5, -12, 4), is_finished=False)
    page.drag(7, Pose(30.5, -12, 5), is_finished=True)
    assert page.wait_until_idle(30)
    assert (page.gizmo.position + page.zero_m).tolist() == [30.5, -12, 5]


@pytest.mark.slow
def test_plan_follows_its_sensors(mini: Path, tmp_path: Path) -> None:
    placed = egvs.place(egvs.load(mini, ["placement.count=1"]), tmp_path / "run")
    with serving(Page(open_session(mini, (), tmp_path / "run"), tmp_path / "scratch")) as served:
        scene = served.server.scene
        site = served.rating.site
        text = f"**plan** pole\\_b: EGVS {placed.joint:,.1f} bit together; best next: pole\\_a"
        assert text in served.controls.status.content
        assert scene.get_handle_by_name("/plan/label0") is None  # the gizmo has a label
        assert scene.get_handle_by_name("/plan/label1").text == "pole_a: best next"
        moved = replace(site, pose=replace(site.pose, z_m=4.5))
        served.request(site=moved)
        assert served.wait_until_idle(60)
        assert served.plan is not None
        assert served.plan.sites["pole_b"] == moved
        assert served.plan.joint == served.rating.scores["egvs"]  # with one sensor, the joint score is its score
        balls = scene.get_handle_by_name("/plan/balls")
        assert (balls.batched_positions[0] + served.zero_m).tolist() == [*moved.pose.position_m]
        served.request(site=served.session.candidates["pole_a"].site)
        assert served.wait_until_idle(60)
        assert scene.get_handle_by_name("/plan/label0").text == "pole_b: in the plan"
        assert scene.get_handle_by_name("/plan/label1") is None
        assert served.plan.sites["pole_b"] == moved
        assert served.current_site(served.session.candidates["pole_b"].site) == moved
        served.request(settings=Settings(1.0, "egvs", frozenset()))
        assert served.wait_until_idle(60)
        assert served.plan.sites["pole_b"] == moved
        assert served.plan.joint == served.session.rate("pole_b", moved.pose).scores["egvs"]


def test_rejects_port_in_use(session: Session, tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--port: port {port} is in use"):
            Page(session, tmp_path, port)


def test_nothing_is_served_after_the_end(session: Session, tmp_path: Path) -> None:
    served = Page(session, tmp_path)
    address = served.address
    served.end()
    served.run()
    served.stop()
    with pytest.raises(OSError):
        urllib.request.urlopen(address)
