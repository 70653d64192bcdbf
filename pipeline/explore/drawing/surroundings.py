"""What stands still on the page: the static world, lanes, the region, candidate sites, and the sensors of a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
import viser

from pipeline.core.grid import Vec3
from pipeline.explore.drawing import shapes
from pipeline.explore.plan import MovingPlan
from pipeline.explore.session import Session
from pipeline.sensing.sites import Site

Colour = tuple[int, int, int]

_BY_DAY: dict[str, Colour] = {
    "building": (205, 208, 216), "ground": (225, 222, 214), "tree_crown": (150, 190, 165), "lanes": (112, 118, 130),
    "other": (150, 154, 166),
}  # fmt: skip
_DARK: dict[str, Colour] = {
    "building": (66, 70, 82), "ground": (34, 36, 42), "tree_crown": (52, 88, 66), "lanes": (52, 56, 66),
    "other": (92, 96, 108),
}  # fmt: skip
_ROI = (232, 89, 12)
_SITE_RADIUS_M, _PLAN_RADIUS_M = 0.9, 1.3
_OF_PLAN, _NEXT = (214, 40, 120), (120, 60, 200)


@dataclass(frozen=True)
class World:
    """Solids, lanes and the region of interest, as they were drawn.

    Attributes
    ----------
    meshes
        By kind.
    drawn, triangles
        How many triangles are drawn of the static world, and how many it has.
    """

    meshes: dict[str, viser.MeshHandle]
    drawn: int
    triangles: int

    @classmethod
    def draw(cls, scene: viser.SceneApi, session: Session, zero_m: Vec3) -> World:
        """Draw it, by day."""
        scene.configure_default_lights(cast_shadow=False)  # a graphics card in software has no time for it
        shown = shapes.solids(session.scene.world, zero_m)
        count = sum(len(mesh.faces) for mesh in shown.values())
        if session.carriageway is not None:
            shown["lanes"] = shapes.lanes(session.carriageway, zero_m)
        scene.add_line_segments("/roi", shapes.edges(session.scene.roi, zero_m), _ROI, thickness=0.15)
        meshes = {
            kind: scene.add_mesh_simple(f"/world/{kind}", mesh.points, mesh.faces, color=_colour(kind, _BY_DAY),
                                        flat_shading=kind != "lanes", side="double", cast_shadow=False)
            for kind, mesh in shown.items()
        }  # fmt: skip
        return cls(meshes, count, len(session.scene.world.faces))

    def colour(self, is_dark: bool) -> None:
        """By day, or in the dark."""
        for kind, mesh in self.meshes.items():
            mesh.color = _colour(kind, _DARK if is_dark else _BY_DAY)


def _colour(kind: str, colours: dict[str, Colour]) -> Colour:
    return colours.get(kind, colours["other"])


def draw_sites(scene: viser.SceneApi, session: Session, zero_m: Vec3, choose: Callable[[Site], None]) -> None:
    """The candidates as balls, the darker the better; a click on one chooses it."""
    sites = [rating.site for rating in session.ranked]
    colours = shapes.scale([rating.scores[session.rank_by] for rating in session.ranked])
    _balls(scene, "/sites", sites, colours, _SITE_RADIUS_M, zero_m, choose)


def draw_plan(
    scene: viser.SceneApi, plan: MovingPlan | None, chosen: str, zero_m: Vec3, choose: Callable[[Site], None]
) -> None:
    """The sensors of a plan where they are now, and the pole that would be best for one more; labelled, but for the one
    that is chosen."""
    scene.remove_by_name("/plan")
    if plan is None:
        return
    sites, colours, said = list(plan.sites.values()), [_OF_PLAN] * len(plan.sites), ["in the plan"] * len(plan.sites)
    if plan.best_next is not None:
        sites.append(plan.poses.asked.sites[plan.poses.asked.names.index(plan.best_next[0])])
        colours.append(_NEXT)
        said.append("best for one more")
    scene.add_frame("/plan", show_axes=False)
    _balls(scene, "/plan/balls", sites, np.array(colours, dtype=np.uint8), _PLAN_RADIUS_M, zero_m, choose)
    for number, (site, its) in enumerate(zip(sites, said, strict=True)):
        if site.name == chosen:  # it has a label of its own
            continue
        at_m = np.subtract(site.pose.position_m, zero_m)
        at_m[2] += 1.5 * _PLAN_RADIUS_M
        scene.add_label(f"/plan/label{number}", f"{site.name}: {its}", position=at_m, anchor="bottom-center",
                        font_screen_scale=0.8)  # fmt: skip


def _balls(
    scene: viser.SceneApi,
    name: str,
    sites: list[Site],
    colours: np.ndarray[tuple[int, ...], np.dtype[np.uint8]],
    radius_m: float,
    zero_m: Vec3,
    choose: Callable[[Site], None],
) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius_m)
    places = np.array([site.pose.position_m for site in sites]) - zero_m
    balls = scene.add_batched_meshes_simple(
        name, np.asarray(ball.vertices, dtype=np.float32), np.asarray(ball.faces, dtype=np.int32),
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(sites), 1)), batched_positions=places,
        batched_colors=colours, lod="off",
    )  # fmt: skip

    @balls.on_click
    def _(event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
        if event.instance_index is not None:
            choose(sites[event.instance_index])
