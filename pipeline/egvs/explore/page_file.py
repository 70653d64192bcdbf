"""The 3D view of a run as one HTML file that needs no server and no network.

viser records the messages that draw the scene (:meth:`viser.ViserServer.get_scene_serializer`) and puts them, with its
viewer, into one page. This module draws the sites, a plan, layers on the road and a minute of traffic, and adds a panel
with ranking, legends and credits. The same run gives the same file on the same versions of the libraries.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from egvs._version import __version__
from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.core.grid import Vec3
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import format_percent
from egvs.drawing.colours import solid_colour
from egvs.explore import controls, drawing, map_symbols
from egvs.explore.access import AccessGuard
from egvs.explore.recorded_traffic import TrafficClip, TrafficRecorder
from egvs.explore.server import start_server, stop_server
from egvs.explore.session import MovingPlan, Playback, PoseScore, Session
from egvs.explore.settings import Settings
from egvs.explore.view_state import LAYERS, View
from egvs.report.plan_section import plan_headline
from egvs.report.ranking_text import headline
from egvs.report.sensor_text import detection_level, plan_level
from egvs.results.levels import read_levels
from egvs.results.map_credits import read_map_credits
from egvs.results.plans import SensorPlan
from egvs.results.ranking import Ranking, site_titles
from egvs.scoring.targets import SEEN_WELL_POINTS
from egvs.sensors.sites import has_relief

MAX_RANKED = 10
"""Number of sites in the panel's ranking."""

_SITE_LAYERS = ("blindspots", "seen", "missed", "traffic")
_PLAN_LAYERS = ("overlap_car",)
_NO_LAYER = "none"
_AMBIENT_LIGHT, _LIGHT_FROM_ABOVE = 0.75 * math.pi, 0.25 * math.pi
"""Brightness of the lights. A level surface, which both reach, has its own colour: a matt surface sends out 1/pi of the
light that it receives."""
_TEMPLATES = Path(__file__).parent / "templates"
_TITLE = "<title>Viser</title>"


@dataclass(frozen=True)
class PageFile:
    """A written page.

    Attributes
    ----------
    path
        The file.
    size_bytes
        Its size.
    sensors
        Names of the sites whose returns are drawn.
    duration_s
        Length of the recorded traffic.
    returns, returns_drawn
        Number of returns on road users, and how many of them are drawn.
    """

    path: Path
    size_bytes: int
    sensors: tuple[str, ...]
    duration_s: float
    returns: int
    returns_drawn: int


@dataclass(frozen=True)
class _Layer:
    """A layer on the road: its name, its title on the page, its node in the scene, and its legend."""

    name: str
    title: str
    node: str
    legend: Markup


def check_page_file(path: Path) -> None:
    """Check the name of a page, before long computations.

    Raises
    ------
    InputError
        If the name does not end in .html, or the file cannot be written.
    """
    if path.suffix.lower() != ".html":
        raise InputError("--to", f"expected a file name ending in .html, got {str(path)!r}", "Use --to page.html.")
    files.check_writable(path)


def write_page_file(session: Session, path: Path, progress: ProgressCallback = no_progress) -> PageFile:
    """Write the 3D view of a run as one file.

    Parameters
    ----------
    session
        The run.
    path
        The file; its folder is created, and an existing file is replaced.
    progress
        Called as the returns are simulated.

    Raises
    ------
    InputError
        If the name does not end in .html, or the file cannot be written.
    """
    check_page_file(path)
    playback, plan = Playback(session), session.plan
    ratings = [session.ranked[0]]
    if plan is not None:
        ratings = [session.rate(site.name, site.pose, site.sensor) for site in plan.sites.values()]
    clip = TrafficClip.of(playback, [rating.site for rating in ratings], progress)
    guard = AccessGuard(lambda _: {})  # the server is only used to record: nobody has its key
    server = start_server(guard)
    try:
        html, panel = _record(server, session, playback, plan, ratings[0], clip)
    finally:
        stop_server(server)
    files.ensure_writable_folder(path)
    files.write_text(path, _with_panel(html, session, panel))
    returns = sum(map(len, clip.returns_m))
    drawn = sum(len(points[:: clip.returns_step]) for points in clip.returns_m)
    names = tuple(rating.site.name for rating in ratings)
    return PageFile(path, path.stat().st_size, names, clip.duration_s, returns, drawn)


def _record(
    server: viser.ViserServer, session: Session, playback: Playback, plan: MovingPlan | None, rating: PoseScore,
    clip: TrafficClip,
) -> tuple[str, dict[str, Any]]:  # fmt: skip
    """Draw the scene, and return viser's page and the values of the panel."""
    scene, roi = server.scene, session.scene.roi
    zero_m = drawing.drawing_origin(roi)
    world = drawing.SceneMeshes.draw(scene, session, zero_m)
    _light_for_true_colours(scene)
    drawing.draw_sites(scene, session, zero_m, None)
    drawing.draw_plan(scene, plan, "", zero_m, None)
    labelled = [rating.site]
    if plan is None:
        _draw_label(scene, f"{rating.site.name}: rank {rating.rank}", rating, zero_m)
    else:
        labelled = [*plan.sites.values()]
        if plan.best_next is not None:
            labelled.append(session.candidates[plan.best_next[0]].site)
    sites = [candidate.site for candidate in session.ranked]
    map_symbols.draw_pole_names(scene, sites, {site.pole or site.name for site in labelled}, zero_m)
    map_symbols.draw_north_and_scale(scene, roi, session.scene.world, zero_m)
    layers = _draw_layers(scene, session, playback, plan, rating, zero_m)
    camera = drawing.first_camera(roi)
    server.initial_camera.position = np.subtract(camera.from_m, zero_m)
    server.initial_camera.look_at = np.subtract(camera.at_m, zero_m)
    recorder = TrafficRecorder(scene, playback, clip, zero_m)
    recording = server.get_scene_serializer()
    recorder.record(recording)
    ranked = session.ranked
    panel = {
        "title": session.scenario.name,
        "description": session.scenario.description,
        "score": controls.plain_name(session.rank_by),
        "ranking": [
            (one.rank, one.site.name, controls.format_score(session.rank_by, one.scores[session.rank_by]))
            for one in ranked[:MAX_RANKED]
        ],
        "sites": len(ranked),
        "headline": _headline(session),
        "plan": None if plan is None else _plan_values(plan),
        "sensor": rating.site.name,
        "layers": layers,
        "duration_s": clip.duration_s,
        "traffic_legend": Markup(_traffic_legend(clip, session)),
        "triangles": controls.describe_drawn_triangles(world.drawn, world.triangles),
        "credits": read_map_credits(session.scenario),
        "version": __version__,
        "viser_version": viser.__version__,
        "script_values": Markup(_script_values(world, layers)),
    }
    return recording.as_html(), panel


def _light_for_true_colours(scene: viser.SceneApi) -> None:
    """Light the scene so that bodies have the colours of the legend; the page's script turns off tone mapping.

    viser's own lights and surroundings are brighter than a surface can show, so tone mapping makes colours paler.
    """
    scene.configure_default_lights(enabled=False, cast_shadow=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/ambient", intensity=_AMBIENT_LIGHT)
    scene.add_light_directional(
        "/lights/above", intensity=_LIGHT_FROM_ABOVE, position=(0.0, 0.0, 1.0), cast_shadow=False
    )


def _draw_label(scene: viser.SceneApi, text: str, rating: PoseScore, zero_m: Vec3) -> None:
    position_m = np.subtract(rating.site.pose.position_m, zero_m)
    position_m[2] += map_symbols.ABOVE_BALL_M
    scene.add_label("/best", text, position=position_m, anchor="bottom-center", font_screen_scale=0.8)


def _draw_layers(
    scene: viser.SceneApi, session: Session, playback: Playback, plan: MovingPlan | None, rating: PoseScore,
    zero_m: Vec3,
) -> list[_Layer]:  # fmt: skip
    """Draw each layer under its own node; the page shows one of them."""
    names = (*_SITE_LAYERS, *(_PLAN_LAYERS if plan is not None else ()))
    scene.add_frame("/layers", show_axes=False)
    layers = []
    for name in names:
        node = f"/layers/{name}"
        scene.add_frame(node, show_axes=False, visible=name == names[0])
        view = View(rating.site, Settings.from_scenario(session.scenario), layer=name)
        context = drawing.LayerContext(
            scene, session, playback, rating, view, None, zero_m, plan, node=f"{node}/points"
        )
        legend = drawing.draw_layer(context)
        title = LAYERS[name]
        if name in _SITE_LAYERS and name != "traffic":
            title = f"{title}: {rating.site.name}"
        layers.append(_Layer(name, title, node, Markup(legend)))
    return [*layers, _Layer(_NO_LAYER, LAYERS[_NO_LAYER], "", Markup())]


def _headline(session: Session) -> str:
    """Return the answer as the report gives it, with the error of the level: the plan, or the best site without one."""
    work = session.work
    ranking = Ranking.read(work.folder.scores)
    best = ranking.sites[0]
    groups, relief = read_levels(work.folder.levels, best.site), has_relief(work.scenario)
    planned = SensorPlan.read(work.folder) if session.plan is not None else None
    if planned is not None and planned.sensors:
        titles = site_titles(planned.sensors, has_relief=relief, is_moved=planned.refinement is not None)
        found = plan_level(work.scenario, [sensor.sensor for sensor in planned.sensors], groups)
        return plan_headline(planned, titles, found)
    found = detection_level(work.scenario, work.scenario.score.ranking_detectors, best.sensor, groups)
    return headline(ranking, True, found, site_titles(ranking.sites, has_relief=relief))


def _plan_values(plan: MovingPlan) -> dict[str, Any]:
    score = plan.poses.placement_problem.score
    values: dict[str, Any] = {
        "sites": list(plan.sites),
        "score": controls.plain_name(score),
        "joint": controls.format_score(score, plan.joint),
        "next": None,
        "forbids_more": plan.forbids_more,
    }
    if plan.best_next is not None:
        name, gain = plan.best_next
        values["next"] = name, controls.format_score(score, gain)
    return values


def _traffic_legend(clip: TrafficClip, session: Session) -> str:
    """Return the legend of the recorded traffic (HTML)."""
    if not clip.has_returns:
        return drawing.text_legend(["without returns: the empty scan was measured, so no sweep can be simulated"])
    share = clip.share_visible(session.scene.roi)
    found = "no vehicles in the region" if share is None else f"{format_percent(share)} of the vehicles in the region"
    returns = "returns on road users"
    if clip.returns_step > 1:
        returns += f", 1 in {clip.returns_step} drawn"
    return drawing.swatch_legend(
        [
            (drawing.VISIBLE_COLOUR, f"hit: {SEEN_WELL_POINTS:g} or more points ({found})"),
            (drawing.HIDDEN_COLOUR, f"missed: fewer than {SEEN_WELL_POINTS:g} points"),
            (drawing.SCAN_COLOUR, returns),
        ]
    )


def _script_values(world: drawing.SceneMeshes, layers: list[_Layer]) -> str:
    """Return what the page's script needs as JSON: nodes of layers, and colours of meshes on a dark page."""
    values = {
        "layers": [layer.node for layer in layers if layer.node],
        "dark": {f"/world/{kind}": solid_colour(kind, is_dark=True) for kind in world.meshes},
    }
    return json.dumps(values, sort_keys=True).replace("<", "\\u003c")


def _with_panel(html: str, session: Session, panel: dict[str, Any]) -> str:
    """Add the panel and its script to viser's page."""
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    head, title, rest = html.partition(_TITLE)
    page, end, after = rest.rpartition("</body>")
    if not title or not end:
        raise RunError("this version of viser writes another page, so the panel cannot be added")
    name = Markup.escape(session.scenario.name)
    script = environment.get_template("page_file.js.j2").render(panel)
    aside = environment.get_template("page_file.html.j2").render(panel)
    return f"{head}<title>{name} - egvs</title><script>{script}</script>{page}{aside}{end}{after}"
