"""The page of a session: the scene in three dimensions, the candidates, and a gizmo that moves one of them.

All browsers that look at it share one state. Whatever moves a sensor (gizmo, numbers, a click) only says which pose is
wanted; :meth:`Page.run` scores the last one that was wanted, in the thread that called it, and shows that. So the
number that rests is that of the pose that rests, however fast somebody drags.
"""

from __future__ import annotations

import io
import threading
from contextlib import redirect_stdout
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import trimesh
import viser
from matplotlib import image

from pipeline.core.errors import InputError
from pipeline.explore import layers, shapes, turning, wording
from pipeline.explore.session import Rating, Session
from pipeline.sensing.sensors import CATALOGUE
from pipeline.sensing.sites import Pose, Site

HOST = "127.0.0.1"
"""Nobody else's machine can reach it."""

_COLOURS = {"building": (205, 208, 216), "ground": (225, 222, 214), "tree_crown": (150, 190, 165)}
_OTHER_SOLID, _LANE, _ROI = (150, 154, 166), (112, 118, 130), (232, 89, 12)
_SITE_RADIUS_M, GIZMO_M = 0.9, 6.0
_LABELS = {
    "x_m": "x m",
    "y_m": "y m",
    "z_m": "z m",
    "yaw_deg": "yaw deg",
    "pitch_deg": "tilt deg",
    "roll_deg": "roll deg",
}
_LENGTH_STEP, _ANGLE_STEP = 0.001, 0.01


class _Server(viser.ViserServer):
    """A server that stays on this machine: whoever opens the page cannot have it published."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing is shared."""
        return None


class Page:
    """A page over a session, served until :meth:`stop`.

    Parameters
    ----------
    port
        On this machine; 0 for any that is free.

    Raises
    ------
    InputError
        When the port is taken.
    """

    def __init__(self, session: Session, port: int = 0) -> None:
        self.session = session
        self.zero_m = shapes.zero_of(session.scene.roi)
        best = session.ranked[0]
        self.rating = session.rate(best.site.name, best.site.pose)  # compiles what is needed before anybody waits
        self.plan = session.plan
        self._changed = threading.Condition()
        self._wanted: Site | None = None
        self._ended = self._is_dragged = self._is_busy = False
        with redirect_stdout(io.StringIO()):  # it greets in its own words
            self._server = _Server(host=HOST, port=port, label="egvs explore", verbose=False)
        if port and self._server.get_port() != port:
            self.stop()
            raise InputError("--port", f"{port} is taken", "another one, or 0 for any that is free")
        self._draw_scene()
        self._draw_controls()
        self._show(self.rating)

    @property
    def address(self) -> str:
        """What a browser opens."""
        return f"http://{HOST}:{self._server.get_port()}"

    def want(self, site: Site) -> None:
        """Ask for a candidate in another pose, or with another sensor; what was asked for before and not yet scored is
        let go."""
        with self._changed:
            self._wanted = site
            self._changed.notify_all()

    def run(self) -> None:
        """Score what is wanted, until :meth:`end` or an interrupt."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted is not None or self._ended)
                if self._ended:
                    return
                wanted, self._wanted = self._wanted, None
                self._is_busy = True
            if wanted is not None:
                self._show(self.session.rate(wanted.name, wanted.pose, wanted.sensor))
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()

    def rest(self, timeout_s: float) -> bool:
        """Wait until all that was wanted is shown; whether that came in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self._wanted is None and not self._is_busy, timeout_s)

    def end(self) -> None:
        """Let :meth:`run` return."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Serve no more."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    # ---- what is drawn once

    def _draw_scene(self) -> None:
        scene, session = self._server.scene, self.session
        scene.configure_default_lights(cast_shadow=False)  # a graphics card in software has no time for it
        for kind, mesh in shapes.solids(session.scene.world, self.zero_m).items():
            colour = _COLOURS.get(kind, _OTHER_SOLID)
            scene.add_mesh_simple(f"/world/{kind}", mesh.points, mesh.faces, color=colour, flat_shading=True,
                                  side="double", cast_shadow=False)  # fmt: skip
        if session.carriageway is not None:
            road = shapes.lanes(session.carriageway, self.zero_m)
            self._lanes = scene.add_mesh_simple("/lanes", road.points, road.faces, color=_LANE, side="double",
                                                cast_shadow=False)  # fmt: skip
        scene.add_line_segments("/roi", shapes.edges(session.scene.roi, self.zero_m), _ROI, thickness=0.15)
        self._draw_sites()
        self._gizmo = scene.add_transform_controls("/sensor", scale=GIZMO_M, depth_test=False)
        self._label = scene.add_label("/sensor/label", "")
        self._gizmo.on_update(self._dragged)
        self._server.on_client_disconnect(self._lost)
        reach_m = max(session.scene.roi.size_m)
        self._server.initial_camera.position = (0.0, -0.45 * reach_m, 0.85 * reach_m)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)

    def _draw_sites(self) -> None:
        ranked = self.session.ranked
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_SITE_RADIUS_M)
        places = np.array([rating.site.pose.position_m for rating in ranked]) - self.zero_m
        balls = self._server.scene.add_batched_meshes_simple(
            "/sites", np.asarray(ball.vertices, dtype=np.float32), np.asarray(ball.faces, dtype=np.int32),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(ranked), 1)), batched_positions=places,
            batched_colors=shapes.scale([rating.scores[self.session.rank_by] for rating in ranked]), lod="off",
        )  # fmt: skip

        @balls.on_click
        def _(event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
            if event.instance_index is not None:
                self.want(self._present(ranked[event.instance_index].site))

    def _draw_controls(self) -> None:
        gui, session = self._server.gui, self.session
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._choices = {wording.choice(its, session.rank_by): its.site for its in session.ranked}
        self._of_site = {site.name: choice for choice, site in self._choices.items()}
        self._site = gui.add_dropdown("site", tuple(self._choices), hint="Candidates, the best first.")
        self._site.on_update(self._chosen)
        self._told = gui.add_markdown("")
        with gui.add_folder("pose"):
            self._numbers = {
                name: gui.add_number(label, 0.0, step=_ANGLE_STEP if name.endswith("_deg") else _LENGTH_STEP)
                for name, label in _LABELS.items()
            }
            known = dict.fromkeys((*session.scene.used_sensors, *session.scenario.sensors, *CATALOGUE))
            self._sensor = gui.add_dropdown("sensor", tuple(known))
        for number in self._numbers.values():
            number.on_update(self._typed)
        self._sensor.on_update(self._typed)
        gui.add_button("Back to the candidate").on_click(lambda _: self._back())
        gui.add_button("Keep this pose").on_click(self._keep)
        gui.add_button("Picture (PNG)").on_click(self._picture)
        with gui.add_folder("show"):
            self._layer = gui.add_dropdown("layer", layers.LAYERS, hint="What lies on the road, added up along z.")
            self._ring = gui.add_number("ring", 0, min=0, step=1, hint="Whose beams the last layer shows.")
            for control in (self._layer, self._ring):
                control.on_update(lambda _: self.want(self.rating.site))
            dark = gui.add_checkbox("dark", False)
            dark.on_update(
                lambda _: gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark.value)
            )
        with gui.add_folder("ranking", expand_by_default=False):
            gui.add_markdown(wording.ranking(session.ranked, session.rank_by))

    # ---- what somebody does

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        """A coroutine, so that drags come in their order."""
        self._is_dragged = event.phase != "end"
        own = self.rating.site
        position_m = np.asarray(event.target.position, dtype=np.float64) + self.zero_m
        self.want(replace(own, pose=turning.moved(own.pose, position_m.tolist(), event.target.wxyz.tolist())))

    def _lost(self, _client: viser.ClientHandle) -> None:
        """Who is gone holds nothing any more."""
        self._is_dragged = False
        self.want(self.rating.site)

    def _chosen(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client is not None:
            self.want(self._present(self._choices[event.target.value]))

    def _typed(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            values = {name: float(number.value) for name, number in self._numbers.items()}
            self.want(replace(self.rating.site, pose=Pose(**values), sensor=self._sensor.value))

    def _present(self, candidate: Site) -> Site:
        """Where a candidate's sensor is in the plan now; the candidate itself where it is in none."""
        return candidate if self.plan is None else self.plan.sites.get(candidate.name, candidate)

    def _back(self) -> None:
        site = self.session.candidates[self.rating.site.name].site
        self.want(site)

    def _keep(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        try:
            path, name = self.session.keep(self.rating)
            title, text = f"kept as {name}", f"in {path}"
        except (InputError, OSError) as error:
            title, text = "not kept", str(error)
        if event.client is not None:
            event.client.add_notification(title, text)

    def _picture(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        if event.client is not None:
            camera, file = event.client.camera, io.BytesIO()
            drawn = event.client.get_render(camera.image_height, camera.image_width, transport_format="png")
            image.imsave(file, drawn, format="png")
            event.client.send_file_download(f"{self.session.scenario.name}.png", file.getvalue())

    # ---- what changes

    def _show(self, rating: Rating) -> None:
        """Show what a sensor is worth, and bring controls and gizmo to where it is."""
        self.rating, site = rating, rating.site
        candidate = self.session.candidates[site.name]
        with self._server.atomic():
            told = wording.in_words(rating, self.session.rank_by, candidate, len(self.session.candidates))
            self._told.content = told + ("" if self._is_dragged else self._plan_in_words(rating))
            _set(self._sensor, site.sensor)
            _set(self._site, self._of_site[site.name])
            for name, value in asdict(site.pose).items():
                _set(self._numbers[name], value)
            self._label.text = f"{site.name}  rank {rating.rank}" if rating.stands else f"{site.name}: cannot stand"
            if not self._is_dragged:  # else it would be pulled out of a hand
                self._gizmo.position = np.subtract(site.pose.position_m, self.zero_m)
                self._gizmo.wxyz = np.array(turning.quaternion(site.pose))
                layer, ring = self._layer.value, int(self._ring.value)
                layers.draw(self._server.scene, self.session, rating, layer, ring, self.zero_m)

    def _plan_in_words(self, rating: Rating) -> str:
        """The plan with this sensor as it is now, where it belongs to it; nothing where there is no plan."""
        if self.plan is None or not rating.stands:
            return ""
        if rating.site.name in self.plan.sites and rating.site != self.plan.sites[rating.site.name]:
            self.plan = self.plan.moved(rating.site, self.session.beams(rating.site))
        return wording.plan(self.plan)


def _set(control: Any, value: str | float) -> None:
    """Show another value; viser's types have it that nobody may."""
    control.value = value
