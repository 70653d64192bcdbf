"""The page of a session: the scene in three dimensions, the candidates, and a gizmo that moves one of them.

All browsers that look at it share one state. Whatever they do (gizmo, numbers, a click, a link) only says what is
wanted; :meth:`Page.run` shows the last that was wanted, in the thread that called it. So the number that rests is that
of the pose that rests, however fast somebody drags.
"""

from __future__ import annotations

import errno
import gc
import io
import shlex
import socket
import threading
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
from matplotlib import image

from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.runtime import release_memory
from egvs.explore import controls, drawing, settings
from egvs.explore.access import KEY_PARAMETER, AccessGuard
from egvs.explore.controls import Controls, show_modal
from egvs.explore.session import MovingPlan, Playback, Session
from egvs.explore.settings import SessionFactory
from egvs.explore.view_state import SAVED_SITES, Camera, View, decode_view, encode_view, save_pose, unused_file_name
from egvs.sensors.sites import Site

HOST = "127.0.0.1"
"""Nobody else's machine can reach it."""

GIZMO_M = 6.0
FRAME_S = 0.25
"""So long a frame stays while recorded traffic plays; longer where the machine needs it."""

FREE_MEMORY_EVERY = 32
"""After so many moves memory that is kept for later is given back: it grows as arrays of many sizes come and go."""

_SHUTDOWN_S = 5.0


def check_port_free(port: int) -> None:
    """InputError where no page can be served on a port: told before long work is done for it."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            found = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise InputError("--port", f"{port} {found}", "another one, or 0 for any that is free") from None


class _Server(viser.ViserServer):
    """A server that stays on this machine: whoever opens the page cannot have it published."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing is shared."""
        return None


class Page:
    """A page over a session, served until :meth:`stop`.

    Parameters
    ----------
    scratch
        A folder for runs with other settings, which goes with the page.
    port
        On this machine; 0 for any that is free.
    opened_with
        The words of the command that opens it again; for links.

    Raises
    ------
    InputError
        When the port is taken.
    """

    def __init__(self, session: Session, scratch: Path, port: int = 0, opened_with: Sequence[str] = ()) -> None:
        self.session = self._mix = session
        self._initial_session, self._variants, self._opened_with = (
            session,
            SessionFactory(session, scratch),
            tuple(opened_with),
        )
        self.zero_m = drawing.drawing_origin(session.scene.roi)
        self.view = self._opened = View.of(session)
        site = self.view.site
        self.rating = session.rate(site.name, site.pose)  # compiles what is needed before anybody waits
        self.plan, self._playback = session.plan, Playback(session)
        self._changed = threading.Condition()
        self._latest, self._has_request = self.view, False
        self._ended = self._is_busy = False
        self._dragging: int | None = None
        self._notice, self._draw_count = "", 0
        self.guard = AccessGuard(self._followed)
        with redirect_stdout(io.StringIO()), self.guard.before_a_server():  # it greets in its own words
            self._server = _Server(host=HOST, port=port, label="egvs explore", verbose=False)
        if not self.guard.is_active:
            self.stop()
            raise RunError("viser serves pages in another way than egvs explore knows how to guard")
        if port and self._server.get_port() != port:  # it has looked for another one
            self.stop()
            raise InputError("--port", f"{port} is taken", "another one, or 0 for any that is free")
        self._draw()
        self._show(self.view)
        release_memory()  # what the run that came before has left

    @property
    def address(self) -> str:
        """What a browser opens: with the key, without which nobody gets in."""
        return f"{self._origin}/?{KEY_PARAMETER}={self.guard.key}"

    @property
    def _origin(self) -> str:
        return f"http://{HOST}:{self._server.get_port()}"

    def ask(self, **changes: Any) -> None:
        """Want something else of the view (its fields by name); the rest of what was wanted last stays."""
        with self._changed:
            self._latest, self._has_request = replace(self._latest, **changes), True
            self._changed.notify_all()

    def run(self) -> None:
        """Show what is wanted, until :meth:`end` or an interrupt."""
        while True:
            with self._changed:
                is_asked = self._changed.wait_for(lambda: self._has_request or self._ended, self._patience_s())
                if self._ended:
                    return
                if not is_asked:
                    self._latest = replace(self._latest, frame=(self._latest.frame + 1) % self._playback.frames)
                wanted, self._has_request, self._is_busy = self._latest, False, True
            self._show(wanted)
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()

    def rest(self, timeout_s: float) -> bool:
        """Wait until all that was wanted is shown; whether that came in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._has_request and not self._is_busy, timeout_s)

    def end(self) -> None:
        """Let :meth:`run` return."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Serve no more."""
        with redirect_stdout(io.StringIO()):  # it says good-bye in its own words, at the end of its thread
            self._server.stop()
            if (thread := self._server._websock_server._server_thread) is not None:
                thread.join(_SHUTDOWN_S)

    def present(self, candidate: Site) -> Site:
        """Where a candidate's sensor is in the plan now; the candidate itself where it is in none."""
        return candidate if self.plan is None else self.plan.sites.get(candidate.name, candidate)

    def look_from(self, camera: Camera) -> None:
        """Where a browser that opens the page looks from."""
        self._server.initial_camera.position = np.subtract(camera.from_m, self.zero_m)
        self._server.initial_camera.look_at = np.subtract(camera.at_m, self.zero_m)

    def open_at(self, text: str, where: str) -> None:
        """Begin with the view that a link's text asks for; InputError where it asks for what is not there."""
        view, camera = decode_view(text, self._initial_session, self._opened, where)
        self.ask(**vars(view))
        if camera is not None:
            self.look_from(camera)

    def _patience_s(self) -> float | None:
        """How long nothing has to happen until the next recorded frame is shown; None: for ever."""
        return FRAME_S if self.view.layer == "replay" and self.controls.plays.value else None

    # ---- what is drawn once

    def _draw(self) -> None:
        scene, session = self._server.scene, self.session
        self._world = drawing.SceneMeshes.draw(scene, session, self.zero_m)
        drawing.draw_sites(scene, session, self.zero_m, self._choose)
        drawing.draw_plan(scene, self.plan, self.view.site.name, self.zero_m, self._choose)
        self._gizmo = scene.add_transform_controls("/sensor", scale=GIZMO_M, depth_test=False)
        self._label = scene.add_label("/sensor/label", "", anchor="top-center")
        self._gizmo.on_update(self._dragged)
        self._server.on_client_disconnect(self._lost)
        reach_m = max(session.scene.roi.size_m)
        x, y, z = self.zero_m
        self.look_from(Camera((x, y - 0.4 * reach_m, z + 0.6 * reach_m), self.zero_m))
        buttons = {"Keep this pose": self._keep, "Link to this view": self._link, "Picture (PNG)": self._picture}
        effects, frames = settings.offered_effects(session), self._playback.frames
        note = controls.describe_drawn_triangles(self._world.drawn, self._world.triangles)
        self.controls = Controls(self._server.gui, session, self.view, self, effects, frames, buttons, note)

    # ---- what somebody does

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        """A coroutine, so that drags come in their order."""
        self._dragging = None if event.phase == "end" else event.client_id
        own = self.view.site
        position_m = np.asarray(event.target.position, dtype=np.float64) + self.zero_m
        self.ask(site=replace(own, pose=drawing.moved_pose(own.pose, position_m.tolist(), event.target.wxyz.tolist())))

    def _lost(self, client: viser.ClientHandle) -> None:
        """Who is gone holds nothing any more."""
        if self._dragging == client.client_id:
            self._dragging = None
            self.ask()

    def _choose(self, site: Site) -> None:
        self.ask(site=self.present(self.session.candidates[site.name].site))

    def _followed(self, query: dict[str, str]) -> dict[str, str]:
        """Somebody opens a link; where its browser is to look from."""
        if not query:
            return {}
        try:
            view, camera = decode_view(query, self._initial_session, self._opened, "the link")
        except InputError as error:
            self._notice = str(error)
            self.ask()
            return {}
        self.ask(**vars(view))
        if camera is None:
            return {}
        places = {"initialCameraPosition": camera.from_m, "initialCameraLookAt": camera.at_m}
        return {key: ",".join(f"{x:.6g}" for x in np.subtract(at, self.zero_m)) for key, at in places.items()}

    def _keep(self, client: viser.ClientHandle, name: str = SAVED_SITES) -> None:
        path = self.session.scenario.folder / name
        try:
            if not self.rating.is_feasible:
                raise InputError(f"site {self.rating.site.name}", "no sensor can stand there", "a free place")
            kept = save_pose(path, self.rating.site, self.session.candidates)
        except InputError as error:
            other = unused_file_name(path.parent)
            answers = {f"Keep in {other}": lambda: self._keep(client, other)} if self.rating.is_feasible else {}
            show_modal(
                client, "Not kept", [controls.escape_markdown(str(error))], {**answers, "Keep nothing": lambda: None}
            )
        except OSError as error:
            show_modal(client, "Not kept", [controls.escape_markdown(str(error))], {"Close": lambda: None})
        else:
            client.add_notification(f"kept as {kept}", f"in {path}")

    def _link(self, client: viser.ClientHandle) -> None:
        from_m, at_m = (np.add(at, self.zero_m) for at in (client.camera.position, client.camera.look_at))
        camera = Camera(tuple(from_m.tolist()), tuple(at_m.tolist()))
        text = encode_view(self.view, self._opened, camera)
        command = shlex.join((*(self._opened_with or ("egvs", "explore", "RUN")), "--view", text))
        texts = ["While this page is served, on this machine:", f"```\n{self.address}&{text}\n```",
                 "At any time:", f"```\n{command}\n```"]  # fmt: skip
        show_modal(client, "Link to this view", texts, {"Close": lambda: None})

    def _picture(self, client: viser.ClientHandle) -> None:
        file = io.BytesIO()
        drawn = client.get_render(client.camera.image_height, client.camera.image_width, transport_format="png")
        image.imsave(file, drawn, format="png")
        client.send_file_download(f"{self.session.scenario.name}.png", file.getvalue(), save_immediately=True)

    # ---- what changes

    def _show(self, view: View) -> None:
        """Show what is wanted, and bring controls and gizmo to it."""
        session_before, plan_before, before = self.session, self.plan, self.view
        view = self._apply_settings(view)
        site, is_new, rests = view.site, self.session is not session_before, self._dragging is None
        is_another = is_new or site.sensor != self.rating.site.sensor
        if is_new or site != self.rating.site:
            self.rating = self.session.rate(site.name, site.pose, site.sensor)
        self.view, rating = view, self.rating
        if rests and rating.is_feasible and self.plan is not None and self.plan.sites.get(site.name, site) != site:
            self.plan = self.plan.moved(site, self.session.beams(site))
        with self._server.atomic():
            if is_new:
                drawing.draw_sites(self._server.scene, self.session, self.zero_m, self._choose)
            if self.plan is not plan_before or site.name != before.site.name:
                drawing.draw_plan(self._server.scene, self.plan, site.name, self.zero_m, self._choose)
            if view.is_dark != before.is_dark:
                self._world.colour(view.is_dark)
            self._label.text = (
                f"{site.name}  rank {rating.rank}" if rating.is_feasible else f"{site.name}: cannot stand"
            )
            legend = None
            if rests:  # else it would be pulled out of a hand
                self._gizmo.position = np.subtract(site.pose.position_m, self.zero_m)
                self._gizmo.wxyz = np.array(drawing.quaternion(site.pose))
                legend = drawing.draw_layer(self._layer_context())
            self.controls.show(self.session, view, rating, self._status_text(rests), legend)
        self._draw_count += 1
        if is_another:
            gc.collect()  # what was made for the session or the sensor before
        if is_another or self._draw_count % FREE_MEMORY_EVERY == 0:
            release_memory()

    def _apply_settings(self, view: View) -> View:
        """Bring the session to the settings and the period of a view; settings that are refused stay as they are."""
        mix = self._mix
        if view.settings != self.view.settings:
            self.controls.status.content = controls.WORKING_TITLE
            try:
                mix = self._variants.session(view.settings)
            except (EgvsError, OSError) as error:
                self._notice = str(error)
                with self._changed:
                    self._latest = replace(self._latest, settings=self.view.settings)
                view = replace(view, settings=self.view.settings)
        if mix is not self._mix:
            self.plan = _with_moved_sensors(self.plan, mix)
        if mix is not self._mix or view.period != self.session.period:
            self.session.forget()  # it may be wanted again, but not now
            self._mix, self.session = mix, mix.in_period(view.period) if view.period else mix
            self._playback = Playback(self.session)
        return view

    def _layer_context(self) -> drawing.LayerContext:
        beside = self.view.beside or next(
            (its.site.name for its in self.session.ranked if its.site.name != self.view.site.name), ""
        )
        other = self.session.candidates.get(beside)
        if other is not None and (site := self.present(other.site)) != other.site:
            other = self.session.rate(beside, site.pose, site.sensor)
        return drawing.LayerContext(
            self._server.scene, self.session, self._playback, self.rating, self.view, other, self.zero_m
        )

    def _status_text(self, rests: bool) -> str:
        """What is said of the sensor, and of the plan; what went wrong comes first, once."""
        notice, self._notice = self._notice, ""
        name = self.view.site.name
        said = controls.describe_score(
            self.rating, self.session.rank_by, self.session.candidates[name], len(self.session.candidates)
        )
        of_plan = (
            controls.describe_plan(self.plan) if rests and self.plan is not None and self.rating.is_feasible else ""
        )
        return (controls.format_notice(notice) if notice else "") + said + of_plan


def _with_moved_sensors(before: MovingPlan | None, session: Session) -> MovingPlan | None:
    """A session's plan, with its sensors where somebody has moved them."""
    plan = session.plan
    if plan is None or before is None:
        return plan
    for name, site in before.sites.items():
        if plan.sites.get(name, site) != site:
            plan = plan.moved(site, session.beams(site))
    return plan
