"""The explorer's page: the scene in 3D, the candidates, and a gizmo that moves a sensor.

All browsers share one state. What users do (gizmo, numbers, clicks, links) only requests a view;
:meth:`Page.run` shows the latest requested view, in the thread that called it. So however fast somebody drags, the
last number is that of the last pose. A request with an invalid value is rejected with a message, and the page goes on.
"""

from __future__ import annotations

import errno
import gc
import io
import math
import re
import shlex
import socket
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
from PIL import Image

from egvs.core.errors import EgvsError, InputError
from egvs.core.grid import Vec3
from egvs.core.resource_usage import release_memory
from egvs.explore import controls, drawing, map_symbols, settings
from egvs.explore.access import KEY_PARAMETER, AccessGuard
from egvs.explore.controls import Controls, PanelContent, show_modal
from egvs.explore.recorded_traffic import FRAME_S, frames_per_step
from egvs.explore.server import HOST, start_server, stop_server
from egvs.explore.session import MovingPlan, Playback, Session
from egvs.explore.settings import SessionFactory
from egvs.explore.view_state import (
    SAVED_SITES,
    Camera,
    View,
    check_view,
    decode_view,
    encode_view,
    save_pose,
    unused_file_name,
)
from egvs.sensors.sites import Pose, Site

GIZMO_M = 6.0
FREE_MEMORY_EVERY = 32
"""Moves after which unused memory is returned to the system."""

RESOLUTION = "fixedDpr"
"""viser's parameter for drawn pixels per CSS pixel; a browser that draws without a GPU is fast enough with 0.5."""

_RESOLUTION_VALUE = re.compile(r"[0-4](\.\d{1,3})?")
_ADD_SENSOR, _RESET_PLAN = "add", "reset"
_WHERE = "the page"
"""Used in messages about invalid values."""


def check_port_free(port: int) -> None:
    """Raise an InputError if a port cannot be used; called before long computations."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _port_taken(port) from None
            raise InputError("--port", f"port {port} cannot be used ({error.strerror})", _PORT_HINT) from None


_PORT_HINT = "Use another port, or 0 for any free one."


def _port_taken(port: int) -> InputError:
    return InputError("--port", f"port {port} is in use", _PORT_HINT)


class Page:
    """A page over a session, served until :meth:`stop`.

    Parameters
    ----------
    session
        The session without changes.
    scratch
        A temporary folder for runs with other settings.
    port
        Port on this machine; 0 for any free one.
    command
        Words of the command that opens the session, for links.

    Attributes
    ----------
    session, view, plan, rating
        What the page shows: session with its settings, view, plan, and scores of the selected sensor.
    controls, server, gizmo, label, world
        The panel, the server, and parts of the scene.
    guard
        Restricts access.
    zero_m
        Origin of the drawing in the world frame.

    Raises
    ------
    InputError
        If the port is in use.
    """

    def __init__(self, session: Session, scratch: Path, port: int = 0, command: Sequence[str] = ()) -> None:
        self.session = self._all_periods = self._initial_session = session
        self._variants, self._command = SessionFactory(session, scratch), tuple(command)
        self.zero_m = drawing.drawing_origin(session.scene.roi)
        self.view = self._initial_view = View.from_session(session)
        site = self.view.site
        self.rating = session.rate(site.name, site.pose)  # compiles everything before the first request
        self.plan, self._playback = session.plan, Playback(session)
        self._changed = threading.Condition()
        self._requested, self._has_request = self.view, False
        self._is_stopped = self._is_busy = False
        self._dragging_client: int | None = None
        self._notice, self._draw_count = "", 0
        self._plan_request: str | None = None
        self.guard = AccessGuard(self._open_query)
        self.server = start_server(self.guard, port)
        if port and self.server.get_port() != port:  # viser uses another port instead
            self.stop()
            raise _port_taken(port)
        self._draw_scene()
        self._show(self.view)
        release_memory()  # of the run before

    @property
    def address(self) -> str:
        """The address to open, with the key."""
        return f"{self.origin}/?{KEY_PARAMETER}={self.guard.key}"

    @property
    def origin(self) -> str:
        """The address without path and key."""
        return f"http://{HOST}:{self.server.get_port()}"

    def request(self, **changes: Any) -> None:
        """Request changes of the view (fields by name), in addition to those that were requested before.

        Changes to an invalid view are rejected: the page shows the reason.
        """
        with self._changed:
            view = replace(self._requested, **changes)
            try:
                check_view(view, self._initial_session, _WHERE)
            except InputError as error:
                self._notice = str(error)
            else:
                self._requested = view
            self._has_request = True
            self._changed.notify_all()

    def add_sensor(self) -> None:
        """Request the best additional sensor; without a plan, it starts with the selected sensor."""
        self._request_plan(_ADD_SENSOR)

    def reset_plan(self) -> None:
        """Request the plan of the run folder; no plan if there is none."""
        self._request_plan(_RESET_PLAN)

    def _request_plan(self, action: str) -> None:
        with self._changed:
            self._plan_request = action
            self._has_request = True
            self._changed.notify_all()

    def run(self) -> None:
        """Show requested views until :meth:`end` or an interrupt."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._has_request or self._is_stopped, self._playback_timeout_s())
                if self._is_stopped:
                    return
                if not self._has_request:
                    next_frame = (
                        self._requested.frame + frames_per_step(self._playback.period_s)
                    ) % self._playback.frames
                    self._requested = replace(self._requested, frame=next_frame)
                view, self._has_request, self._is_busy = self._requested, False, True
            self._show_or_reject(view)
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()

    def wait_until_idle(self, timeout_s: float) -> bool:
        """Wait until all requests are shown; False after a timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._has_request and not self._is_busy, timeout_s)

    def end(self) -> None:
        """Let :meth:`run` return."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Stop serving."""
        stop_server(self.server)

    def current_site(self, candidate: Site) -> Site:
        """Return where a candidate's sensor is in the plan now; the candidate itself if the plan does not use it."""
        return candidate if self.plan is None else self.plan.sites.get(candidate.name, candidate)

    def set_camera(self, camera: Camera) -> None:
        """Set the camera of browsers that open the page."""
        self.server.initial_camera.position = np.subtract(camera.from_m, self.zero_m)
        self.server.initial_camera.look_at = np.subtract(camera.at_m, self.zero_m)

    def open_link(self, link: str, where: str) -> None:
        """Request the view of a link.

        Parameters
        ----------
        link
            Its text.
        where
            Used in messages.

        Raises
        ------
        InputError
            If the link is not valid.
        """
        view, camera = decode_view(link, self._initial_session, self._initial_view, where)
        self.request(**vars(view))
        if camera is not None:
            self.set_camera(camera)

    def drag(self, client_id: int | None, pose: Pose, *, is_finished: bool) -> None:
        """Move the sensor to a pose; layers and gizmo are updated when the drag is finished.

        Parameters
        ----------
        client_id
            The browser.
        pose
            Current pose of the gizmo.
        is_finished
            Whether the gizmo was released.
        """
        self._dragging_client = None if is_finished else client_id
        self.request(site=replace(self.view.site, pose=pose))

    def disconnect(self, client_id: int) -> None:
        """Finish the drag of a browser that has disconnected."""
        if self._dragging_client == client_id:
            self._dragging_client = None
            self.request()

    def _playback_timeout_s(self) -> float | None:
        """Return the time until the next recorded frame; None if traffic is not played."""
        if self.view.layer == "replay" and self.controls.plays.value:
            return FRAME_S
        return None

    def _draw_scene(self) -> None:
        """Draw what does not change, and add the panel."""
        scene, session = self.server.scene, self.session
        self.world = drawing.SceneMeshes.draw(scene, session, self.zero_m)
        drawing.draw_sites(scene, session, self.zero_m, self._select)
        drawing.draw_plan(scene, self.plan, self.view.site.name, self.zero_m, self._select)
        self._draw_pole_names(self.view.site)
        map_symbols.draw_north_and_scale(scene, session.scene.roi, session.scene.world, self.zero_m)
        self.gizmo = scene.add_transform_controls("/sensor", scale=GIZMO_M, depth_test=False)
        self.label = scene.add_label("/sensor/label", "", anchor="top-center")
        self.gizmo.on_update(self._on_gizmo)
        self.server.on_client_disconnect(lambda client: self.disconnect(client.client_id))
        self.set_camera(drawing.first_camera(session.scene.roi))
        content = PanelContent(
            effects=settings.offered_effects(session),
            frames=self._playback.frames,
            buttons={
                "Save this pose": self._save_pose,
                "Link to this view": self._show_link,
                "Download picture (PNG)": self._send_picture,
            },
            note=controls.describe_drawn_triangles(self.world.drawn, self.world.triangles),
        )
        self.controls = Controls(self.server.gui, session, self.view, self, content)

    # ---- what users do

    async def _on_gizmo(self, event: viser.TransformControlsEvent) -> None:
        """Handle a drag; a coroutine, so that viser keeps the order of events."""
        values = [*event.target.position, *event.target.wxyz]
        if not all(map(math.isfinite, values)) or not any(event.target.wxyz):
            self._notice = str(InputError(f"{_WHERE}: sensor", f"expected a position and an angle, got {values}"))
            self._dragging_client = None
            self.request()
            return
        position_m = np.asarray(event.target.position, dtype=np.float64) + self.zero_m
        pose = drawing.dragged_pose(self.view.site.pose, position_m.tolist(), event.target.wxyz.tolist())
        self.drag(event.client_id, pose, is_finished=event.phase == "end")

    def _select(self, site: Site) -> None:
        self.request(site=self.current_site(self.session.candidates[site.name].site))

    def _open_query(self, query: dict[str, str]) -> dict[str, str]:
        """Request the view of an opened link, and return the query that sets the browser's camera and resolution."""
        passed = {}
        if _RESOLUTION_VALUE.fullmatch(query.get(RESOLUTION, "")):
            passed[RESOLUTION] = query.pop(RESOLUTION)
        if not query:
            return passed
        try:
            view, camera = decode_view(query, self._initial_session, self._initial_view, "the link")
        except InputError as error:
            self._notice = str(error)
            self.request()
            return passed
        self.request(**vars(view))
        if camera is None:
            return passed
        return passed | {
            "initialCameraPosition": self._camera_text(camera.from_m),
            "initialCameraLookAt": self._camera_text(camera.at_m),
        }

    def _camera_text(self, point_m: Vec3) -> str:
        return ",".join(f"{value:.6g}" for value in np.subtract(point_m, self.zero_m))

    def _save_pose(self, client: viser.ClientHandle, file: str = SAVED_SITES) -> None:
        path = self.session.scenario.folder / file
        site = self.rating.site
        if not self.rating.is_feasible:
            error = InputError(
                f"site {site.name}",
                "the sensor cannot be mounted at its current position",
                "Move it to a free location.",
            )
            show_modal(client, "Not saved", [controls.escape_markdown(str(error))], {"Close": _do_nothing})
            return
        try:
            name = save_pose(path, site, self.session.candidates)
        except InputError as error:  # somebody else's file
            other = unused_file_name(path.parent)
            answers = {f"Save to {other}": lambda: self._save_pose(client, other), "Cancel": _do_nothing}
            show_modal(client, "Not saved", [controls.escape_markdown(str(error))], answers)
        except OSError as error:
            show_modal(client, "Not saved", [controls.escape_markdown(str(error))], {"Close": _do_nothing})
        else:
            client.add_notification(f"saved as {name}", f"in {path}")

    def _show_link(self, client: viser.ClientHandle) -> None:
        from_m, at_m = (np.add(point, self.zero_m) for point in (client.camera.position, client.camera.look_at))
        camera = Camera(tuple(from_m.tolist()), tuple(at_m.tolist()))
        link = encode_view(self.view, self._initial_view, camera)
        command = shlex.join((*(self._command or ("egvs", "explore", "RUN")), "--view", link))
        texts = [
            "This link works on this machine while the page is open:",
            f"```\n{self.address}&{link}\n```",
            "To open the view later, run:",
            f"```\n{command}\n```",
        ]
        show_modal(client, "Link to this view", texts, {"Close": _do_nothing})

    def _send_picture(self, client: viser.ClientHandle) -> None:
        file = io.BytesIO()
        picture = client.get_render(client.camera.image_height, client.camera.image_width, transport_format="png")
        Image.fromarray(picture).save(file, format="png")
        client.send_file_download(f"{self.session.scenario.name}.png", file.getvalue(), save_immediately=True)

    # ---- showing a view

    def _show_or_reject(self, view: View) -> None:
        """Show a view; if that fails, show the one before and the reason, without a layer, which may have failed."""
        before = self.session, self._all_periods, self.plan, self._playback, self.rating, self.view
        try:
            self._show(view)
        except (EgvsError, OSError) as error:
            self._notice = str(error)
            self.session, self._all_periods, self.plan, self._playback, self.rating, self.view = before
            without_layer = replace(self.view, layer="none")
            with self._changed:
                self._requested = without_layer
            self._show(without_layer)

    def _show(self, view: View) -> None:
        """Compute the scores of a view, and update scene and panel."""
        session_before, plan_before, view_before = self.session, self.plan, self.view
        view = self._apply_settings(view)
        site = view.site
        is_new_session = self.session is not session_before
        is_new_sensor = is_new_session or site.sensor != self.rating.site.sensor
        if is_new_session or site != self.rating.site:
            self.rating = self.session.rate(site.name, site.pose, site.sensor)
        self.view = view
        is_dragging = self._dragging_client is not None
        is_plan_changed = self.plan is not None and self.plan.sites.get(site.name, site) != site
        if self.plan is not None and is_plan_changed and self.rating.is_feasible and not is_dragging:
            self.plan = self.plan.with_moved(site, self.session.beams(site))

        self._change_plan(site)

        scene = self.server.scene
        with self.server.atomic():
            if is_new_session:
                drawing.draw_sites(scene, self.session, self.zero_m, self._select)
            if self.plan is not plan_before or site.name != view_before.site.name:
                drawing.draw_plan(scene, self.plan, site.name, self.zero_m, self._select)
                self._draw_pole_names(site)
            if view.is_dark != view_before.is_dark:
                self.world.set_dark(view.is_dark)
            self.label.text = f"{site.name}: no sensor can be mounted here"
            if self.rating.is_feasible:
                self.label.text = f"{site.name}  rank {self.rating.rank}"
            legend = None
            if not is_dragging:  # the gizmo must not move under the mouse
                self.gizmo.position = np.subtract(site.pose.position_m, self.zero_m)
                self.gizmo.wxyz = np.array(drawing.pose_quaternion(site.pose))
                legend = drawing.draw_layer(self._layer_context())
            self.controls.show(self.session, view, self._status_text(is_dragging), legend)

        self._draw_count += 1
        if is_new_sensor:
            gc.collect()  # frees the previous session or sensor
        if is_new_sensor or self._draw_count % FREE_MEMORY_EVERY == 0:
            release_memory()

    def _change_plan(self, site: Site) -> None:
        """Add a sensor to the plan, or reset it, if that was requested."""
        with self._changed:
            action, self._plan_request = self._plan_request, None
        if action == _RESET_PLAN:
            self.plan = self.session.plan
        if action != _ADD_SENSOR:
            return
        if not self.rating.is_feasible:
            self._notice = "The sensor cannot be mounted at its current position. Move it to a free location first."
            return
        self.controls.status.content = controls.WORKING_TITLE
        plan = self.plan
        if plan is None:
            plan = MovingPlan.of_candidates(self.session.work, [site.name])
            if plan.sites[site.name] != site:
                plan = plan.with_moved(site, self.session.beams(site))
        if plan.best_next is None:
            self._notice = "All candidates are in the plan."
            if plan.forbids_more:
                self._notice = f"{plan.forbids_more} allows no further sensor."
        else:
            plan = plan.with_added(plan.best_next[0])
        self.plan = plan

    def _draw_pole_names(self, site: Site) -> None:
        """Write the names of poles that have no other label: the selected sensor and those of the plan have one."""
        labelled = [site]
        if self.plan is not None:
            labelled += self.plan.sites.values()
            if self.plan.best_next is not None:
                labelled.append(self.session.candidates[self.plan.best_next[0]].site)
        ranked = [candidate.site for candidate in self.session.ranked]
        map_symbols.draw_pole_names(
            self.server.scene, ranked, {one.pole or one.name for one in labelled}, self.zero_m
        )  # fmt: skip

    def _apply_settings(self, view: View) -> View:
        """Change session and period to those of a view; return the view, without settings that are not valid."""
        session = self._all_periods
        if view.settings != self.view.settings:
            self.controls.status.content = controls.WORKING_TITLE
            try:
                session = self._variants.session(view.settings)
            except (EgvsError, OSError) as error:
                self._notice = str(error)
                with self._changed:
                    self._requested = replace(self._requested, settings=self.view.settings)
                view = replace(view, settings=self.view.settings)
        is_new = session is not self._all_periods
        if is_new:
            self.plan = _with_moved_sensors(self.plan, session)
        if is_new or view.period != self.session.period:
            self.session.clear_caches()
            self.session = self._all_periods = session
            if view.period:
                self.session = session.in_period(view.period)
            self._playback = Playback(self.session)
        return view

    def _layer_context(self) -> drawing.LayerContext:
        name = self.view.beside
        if not name:
            others = [one.site.name for one in self.session.ranked if one.site.name != self.view.site.name]
            name = others[0] if others else ""
        other = self.session.candidates.get(name)
        if other is not None:
            site = self.current_site(other.site)
            if site != other.site:
                other = self.session.rate(name, site.pose, site.sensor)
        return drawing.LayerContext(
            self.server.scene, self.session, self._playback, self.rating, self.view, other, self.zero_m, self.plan
        )

    def _status_text(self, is_dragging: bool) -> str:
        """Return the text about the sensor and the plan, after the last error, which is shown once."""
        text = ""
        if self._notice:
            text = f"**{controls.escape_markdown(self._notice)}**\n\n"
            self._notice = ""
        candidates = self.session.candidates
        candidate = candidates[self.view.site.name]
        text += controls.describe_score(self.rating, self.session.rank_by, candidate, len(candidates))
        if not is_dragging and self.plan is not None and self.rating.is_feasible:
            text += controls.describe_plan(self.plan)
        return text


def _do_nothing() -> None:
    """Close a window without further action."""


def _with_moved_sensors(before: MovingPlan | None, session: Session) -> MovingPlan | None:
    """Return the plan of a session with its sensors where users have moved them."""
    if before is None:
        return session.plan
    plan = session.plan
    if plan is None or list(plan.sites) != list(before.sites):
        plan = MovingPlan.of_candidates(session.work, list(before.sites))
    for name, site in before.sites.items():
        if plan.sites.get(name, site) != site:
            plan = plan.with_moved(site, session.beams(site))
    return plan
