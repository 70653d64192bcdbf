"""Scene, overlays and gizmo as arrays.

What the page shows of a scene, as arrays for a graphics card: float32 round a zero of its own, so that a scene far
from the world's zero does not tremble.

Lengths in metres. ``zero_m`` of every function is the point of the world frame that becomes (0, 0, 0).

What stands still on the page: the static world, lanes, the region, candidate sites, and the sensors of a plan.

Angles of a mount as the quaternion that a gizmo has, and back.

R_world_sensor = Rz(yaw) Ry(-pitch) Rx(roll), as :func:`egvs.sensors.sensor.rotation_world_sensor` builds it; a
quaternion is
(w, x, y, z) of length 1. Positions are whole millimetres and angles whole hundredths of a degree: nobody drags finer.

The vehicles of a recorded frame as one mesh: the bodies that point clouds are made with.

What may be laid over the scene: traffic, what a sensor sees and misses of it, its scan, recorded vehicles.

Each layer draws itself in place of the one before, and says in a legend (HTML) what its colours mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.grid import Roi, Vec3
from egvs.explore.session import MovingPlan, Playback, PoseScore, Session
from egvs.explore.view_state import View
from egvs.report import colours
from egvs.sensors.sites import Pose, Site
from egvs.traffic.network import LANE_WIDTH_M
from egvs.validation.cloud_simulation import MeshPart
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World

Points = NDArray[np.float32]
"""(n, 3) float32, metres."""

_ABOVE_ROAD_M = 0.03
"""So high above a lane's middle line its surface is drawn, and so high above that the TPOG."""

ABOVE_LANES_M = 2.0 * _ABOVE_ROAD_M
"""So high lies what is laid over the road."""

_SCALE_STEPS, _MIN_OPACITY = 255, 0.4

MAX_TRIANGLES = 150_000
"""A world of more is drawn coarser, so that a browser without a graphics card can turn it; beams meet all of it."""

_FINEST_M = 0.25


@dataclass(frozen=True)
class Mesh:
    """Triangles: ``points`` (n, 3) float32, ``faces`` (m, 3) int32."""

    points: Points
    faces: NDArray[np.int32]


def drawing_origin(roi: Roi) -> Vec3:
    """The point that the page is drawn round: the middle of the region's floor, in whole metres."""
    (x, y, z), (width, length, _) = roi.origin_m, roi.size_m
    return float(round(x + width / 2.0)), float(round(y + length / 2.0)), float(round(z))


def solid_meshes(world: World, zero_m: Vec3, most: int = MAX_TRIANGLES) -> dict[str, Mesh]:
    """The static world, a mesh for each kind of solid; drawn coarser where it has more than ``most`` triangles."""
    kinds = np.array([kind for _, kind in world.solids])[world.solid_of_face] if len(world.faces) else np.empty(0, str)
    around = (world.vertices_m - zero_m).astype(np.float32)
    found = {}
    for kind in np.unique(kinds).tolist():
        used, faces = np.unique(world.faces[kinds == kind], return_inverse=True)
        found[kind] = Mesh(around[used], faces.reshape(-1, 3).astype(np.int32))
    cell_m = _FINEST_M
    while sum(len(mesh.faces) for mesh in found.values()) > most:
        found = {kind: _coarser(mesh, cell_m) for kind, mesh in found.items()}
        cell_m *= 2.0
    return found


def _coarser(mesh: Mesh, cell_m: float) -> Mesh:
    """Corners in one cell of a grid become one, in their middle; triangles that have no area then are left out, and
    the second of two alike."""
    cells = np.floor(mesh.points / np.float32(cell_m)).astype(np.int64)
    _, of, sizes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    middle = np.column_stack([np.bincount(of.ravel(), mesh.points[:, axis]) / sizes for axis in range(3)])
    faces = of.ravel()[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh(middle.astype(np.float32), faces[np.sort(first)].astype(np.int32))


def lane_mesh(carriageway: Carriageway, zero_m: Vec3) -> Mesh:
    """The lanes as strips of their width along their middle lines."""
    points, faces, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int32)], 0
    for lane in carriageway.lanes:
        strip = _lane_strip(lane.shape_m, LANE_WIDTH_M if lane.width_m is None else lane.width_m)
        left = np.arange(len(strip) // 2 - 1) * 2
        quads = np.column_stack([left, left + 1, left + 2, left + 2, left + 1, left + 3]).reshape(-1, 3)
        points.append(strip)
        faces.append((quads + count).astype(np.int32))
        count += len(strip)
    lifted = np.concatenate(points) - zero_m + (0.0, 0.0, _ABOVE_ROAD_M)
    return Mesh(lifted.astype(np.float32), np.concatenate(faces))


def _lane_strip(line: NDArray[np.float64], width_m: float) -> NDArray[np.float64]:
    """Left and right of each point of a line (n, 3) in turn, (2 n, 3)."""
    along = np.gradient(line[:, :2], axis=0)
    along /= np.maximum(np.hypot(*along.T), np.finfo(np.float64).tiny)[:, None]
    aside = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(line))]) * (width_m / 2.0)
    return np.stack([line + aside, line - aside], axis=1).reshape(-1, 3)


def region_edges(roi: Roi, zero_m: Vec3) -> NDArray[np.float32]:
    """The 12 edges of the region of interest, (12, 2, 3)."""
    unit = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=np.float64)
    corners = np.asarray(roi.origin_m) + unit * roi.size_m - zero_m
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if int(np.abs(unit[a] - unit[b]).sum()) == 1]
    return corners[pairs].astype(np.float32)


def column_points(
    tpog: Tpog, values: NDArray[np.float64], zero_m: Vec3, peak: float | None = None
) -> tuple[Points, NDArray[np.uint8]]:
    """Values of voxels (nx, ny, nz) added up along z, as points over the middle of each column that has some, and
    their colours (n, 3) on a scale up to ``peak``, or to the largest."""
    grid, total = tpog.grid, values.sum(axis=2)
    ix, iy = np.nonzero(total > 0.0)
    middle = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * grid.voxel_m
    points = middle + grid.origin_m - zero_m + (0.0, 0.0, ABOVE_LANES_M)
    return points.astype(np.float32), colour_scale(total[ix, iy], 0.0, peak)


def difference_points(
    tpog: Tpog,
    this: NDArray[np.float64],
    other: NDArray[np.float64],
    zero_m: Vec3,
    colours: tuple[Sequence[int], Sequence[int], Sequence[int]],
) -> tuple[Points, NDArray[np.uint8]]:
    """Two fields of voxels (nx, ny, nz) added up along z, where one of them is more: points as of
    :func:`column_points`, and
    colours from the third of ``colours``, where both are alike, to the first or second, where one is most more; the
    least difference has a good part of its colour, else few large ones would hide all others."""
    grid, more = tpog.grid, this.sum(axis=2) - other.sum(axis=2)
    ix, iy = np.nonzero((this.sum(axis=2) > 0.0) | (other.sum(axis=2) > 0.0))
    middle = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * grid.voxel_m
    points = middle + grid.origin_m - zero_m + (0.0, 0.0, ABOVE_LANES_M)
    share = np.abs(more[ix, iy]) / max(float(np.abs(more).max(initial=0.0)), np.finfo(np.float64).tiny)
    share[share > 0.0] = _MIN_OPACITY + (1.0 - _MIN_OPACITY) * share[share > 0.0]
    ends = np.where((more[ix, iy] >= 0.0)[:, None], colours[0], colours[1])
    mixed = np.asarray(colours[2]) + share[:, None] * (ends - np.asarray(colours[2]))
    return points.astype(np.float32), np.rint(mixed).astype(np.uint8)


def colour_scale(
    values: NDArray[np.float64] | Sequence[float], low: float | None = None, high: float | None = None
) -> NDArray[np.uint8]:
    """Colours (n, 3) of values, from the lowest (or ``low``) to the highest of them (or ``high``); as in the report, on
    light."""
    known = np.asarray(values, dtype=np.float64)
    low = float(np.min(known, initial=np.inf)) if low is None else low
    span = (float(np.max(known, initial=-np.inf)) if high is None else high) - low
    share = (known - low) / span if span > 0.0 else np.ones(len(known))
    at = np.rint(np.nan_to_num(share) * _SCALE_STEPS).astype(np.int64)
    table = [
        tuple(colours.interpolate_colour(step, _SCALE_STEPS, colours.ON_LIGHT)) for step in range(_SCALE_STEPS + 1)
    ]
    return np.array(table, dtype=np.uint8)[at]


Colour = tuple[int, int, int]

_LIGHT_COLOURS: dict[str, Colour] = {
    "building": (205, 208, 216), "ground": (225, 222, 214), "tree_crown": (150, 190, 165), "lanes": (112, 118, 130),
    "other": (150, 154, 166),
}  # fmt: skip
_DARK_COLOURS: dict[str, Colour] = {
    "building": (66, 70, 82), "ground": (34, 36, 42), "tree_crown": (52, 88, 66), "lanes": (52, 56, 66),
    "other": (92, 96, 108),
}  # fmt: skip
_ROI_COLOUR = (232, 89, 12)
_SITE_RADIUS_M, _PLAN_RADIUS_M = 0.9, 1.3
_PLAN_COLOUR, _NEXT_SITE_COLOUR = (214, 40, 120), (120, 60, 200)


@dataclass(frozen=True)
class SceneMeshes:
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
    def draw(cls, scene: viser.SceneApi, session: Session, zero_m: Vec3) -> SceneMeshes:
        """Draw it, by day."""
        scene.configure_default_lights(cast_shadow=False)  # a graphics card in software has no time for it
        shown = solid_meshes(session.scene.world, zero_m)
        count = sum(len(mesh.faces) for mesh in shown.values())
        if session.carriageway is not None:
            shown["lanes"] = lane_mesh(session.carriageway, zero_m)
        scene.add_line_segments("/roi", region_edges(session.scene.roi, zero_m), _ROI_COLOUR, thickness=0.15)
        meshes = {
            kind: scene.add_mesh_simple(f"/world/{kind}", mesh.points, mesh.faces,
            color=_solid_colour(kind, _LIGHT_COLOURS),
                                        flat_shading=kind != "lanes", side="double", cast_shadow=False)
            for kind, mesh in shown.items()
        }  # fmt: skip
        return cls(meshes, count, len(session.scene.world.faces))

    def colour(self, is_dark: bool) -> None:
        """By day, or in the dark."""
        for kind, mesh in self.meshes.items():
            mesh.color = _solid_colour(kind, _DARK_COLOURS if is_dark else _LIGHT_COLOURS)


def _solid_colour(kind: str, colours: dict[str, Colour]) -> Colour:
    return colours.get(kind, colours["other"])


def draw_sites(scene: viser.SceneApi, session: Session, zero_m: Vec3, choose: Callable[[Site], None]) -> None:
    """The candidates as balls, the darker the better; a click on one chooses it."""
    sites = [rating.site for rating in session.ranked]
    colours = colour_scale([rating.scores[session.rank_by] for rating in session.ranked])
    _draw_balls(scene, "/sites", sites, colours, _SITE_RADIUS_M, zero_m, choose)


def draw_plan(
    scene: viser.SceneApi, plan: MovingPlan | None, chosen: str, zero_m: Vec3, choose: Callable[[Site], None]
) -> None:
    """The sensors of a plan where they are now, and the pole that would be best for one more; labelled, but for the one
    that is chosen."""
    scene.remove_by_name("/plan")
    if plan is None:
        return
    sites, colours, said = (
        list(plan.sites.values()),
        [_PLAN_COLOUR] * len(plan.sites),
        ["in the plan"] * len(plan.sites),
    )
    if plan.best_next is not None:
        sites.append(plan.poses.placement_problem.sites[plan.poses.placement_problem.names.index(plan.best_next[0])])
        colours.append(_NEXT_SITE_COLOUR)
        said.append("best for one more")
    scene.add_frame("/plan", show_axes=False)
    _draw_balls(scene, "/plan/balls", sites, np.array(colours, dtype=np.uint8), _PLAN_RADIUS_M, zero_m, choose)
    for number, (site, its) in enumerate(zip(sites, said, strict=True)):
        if site.name == chosen:  # it has a label of its own
            continue
        at_m = np.subtract(site.pose.position_m, zero_m)
        at_m[2] += 1.5 * _PLAN_RADIUS_M
        scene.add_label(f"/plan/label{number}", f"{site.name}: {its}", position=at_m, anchor="bottom-center",
                        font_screen_scale=0.8)  # fmt: skip


def _draw_balls(
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


_LENGTH_DIGITS, _ANGLE_DIGITS = 3, 2
_MAX_SIN_PITCH = 1.0 - 1e-9
"""Sine of the pitch above which yaw and roll turn about the same axis; roll is 0 there."""

Quaternion = tuple[float, float, float, float]


def quaternion(pose: Pose) -> Quaternion:
    """How a mount is turned, (w, x, y, z)."""
    yaw, pitch, roll = (math.radians(angle) / 2.0 for angle in (pose.yaw_deg, -pose.pitch_deg, pose.roll_deg))
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(half), math.sin(half)) for half in (yaw, pitch, roll))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def angles_deg(wxyz: Sequence[float]) -> tuple[float, float, float]:
    """(yaw, pitch, roll) of a quaternion, of any length above 0."""
    length = math.hypot(*wxyz)
    w, x, y, z = (value / length for value in wxyz)
    sine = max(-1.0, min(1.0, 2.0 * (x * z - w * y)))  # of the pitch, nose up
    if abs(sine) > _MAX_SIN_PITCH:
        yaw = math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))
        return math.degrees(yaw), math.copysign(90.0, sine), 0.0
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return math.degrees(yaw), math.degrees(math.asin(sine)), math.degrees(roll)


def moved_pose(pose: Pose, position_m: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """A pose after a drag, rounded; what was not dragged stays to the last digit."""
    values = dict(zip(("x_m", "y_m", "z_m"), position_m, strict=True))
    values |= dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles_deg(wxyz), strict=True))
    return Pose(**{name: _keep_if_unchanged(name, before, values[name]) for name, before in asdict(pose).items()})


def _keep_if_unchanged(name: str, before: float, after: float) -> float:
    is_angle = name.endswith("_deg")
    digits = _ANGLE_DIGITS if is_angle else _LENGTH_DIGITS
    away = math.remainder(after - before, 360.0) if is_angle else after - before
    return before if abs(away) <= 0.5 * 10.0**-digits else round(float(after), digits) + 0.0


Floats = NDArray[np.float64]


def vehicle_mesh(
    frame: TrafficFrame,
    kinds: Sequence[str],
    parts: Mapping[str, tuple[MeshPart, ...]],
    which: NDArray[np.bool_],
    zero_m: Vec3,
) -> Mesh:
    """Some vehicles of a frame.

    Parameters
    ----------
    kinds, parts
        The body of each box, and the parts of each body.
    which
        Of the boxes, (n,).
    zero_m
        The point of the world that becomes (0, 0, 0).
    """
    found = [
        _fit_to_box(
            np.concatenate([part.triangles for part in parts[kinds[i]]]), frame.boxes[i], float(frame.pitch_rad[i])
        )
        for i in np.flatnonzero(which).tolist()
    ]
    corners = np.concatenate(found) - zero_m if found else np.empty((0, 3, 3))
    return Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3))


def _fit_to_box(triangles: Floats, box: Floats, pitch_rad: float) -> Floats:
    """Triangles (m, 3, 3) of the unit box round zero in a box of :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`."""
    (cy, cp), (sy, sp) = np.cos((box[6], pitch_rad)), np.sin((box[6], pitch_rad))
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    placed: Floats = (triangles * box[3:6]) @ (yaw @ pitch).T + box[:3]
    return placed


LAYER_NAME = "/layer"
"""Of what is laid over it, in the scene; what is more than points or lines lies below it."""

_RETURN_M, _BEAM_M = 0.12, 0.04
_SCAN_COLOUR, _STATIC_COLOUR, _VISIBLE_COLOUR, _HIDDEN_COLOUR = (
    (200, 30, 80),
    (150, 150, 150),
    (0, 90, 181),
    (220, 95, 0),
)
_THIS_COLOUR, _OTHER_COLOUR, _BOTH_COLOUR = (0, 90, 181), (220, 95, 0), (222, 222, 222)
_LEGEND_STEPS = 8

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class LayerContext:
    """What a layer is drawn of.

    Attributes
    ----------
    rating, view
        The sensor as it is now, and what else is asked for.
    other
        The site that differences are taken to; None where there is no other.
    zero_m
        The point of the world that is the page's zero.
    """

    scene: viser.SceneApi
    session: Session
    playback: Playback
    rating: PoseScore
    view: View
    other: PoseScore | None
    zero_m: Vec3

    def points(self, points: Points, colours: Bytes, size_m: float) -> None:
        """Draw points (n, 3) with their colours; nothing where there are none."""
        if len(points):
            self.scene.add_point_cloud(
                LAYER_NAME, points, colours, point_size=size_m, precision="float32", point_shading="flat"
            )


def draw_layer(context: LayerContext) -> str:
    """Lay a layer over a scene in place of what was there, nothing where the sensor cannot stand; its legend."""
    context.scene.remove_by_name(LAYER_NAME)
    draws = _DRAW_FUNCTIONS.get(context.view.layer)
    if draws is None or (not context.rating.is_feasible and context.view.layer not in ("traffic", "replay")):
        return ""
    return draws(context)


def _draw_traffic(context: LayerContext) -> str:
    tpog = context.session.tpog
    points, colours = column_points(tpog, tpog.p, context.zero_m)
    context.points(points, colours, tpog.grid.voxel_m)
    return _scale_legend("share of time occupied, added up along z", 0.0, float(tpog.p.sum(axis=2).max(initial=0.0)))


def _draw_entropy(context: LayerContext) -> str:
    session, is_seen = context.session, context.view.layer == "seen"
    crossed = session.hits(context.rating.site) > 0.0
    peak = float(session.entropy_bit.sum(axis=2).max(initial=0.0))
    part = np.where(crossed == is_seen, session.entropy_bit, 0.0)
    points, colours = column_points(session.tpog, part, context.zero_m, peak)
    context.points(points, colours, session.tpog.grid.voxel_m)
    what = "where beams pass" if is_seen else "where no beam passes"
    return _scale_legend(f"bits of entropy {what}, added up along z", 0.0, peak)


def _draw_blindspots(context: LayerContext) -> str:
    found = context.session.blindspots(context.rating.site)
    ix, iy = np.nonzero(~np.isnan(found.share_missed))
    middle = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * found.cell_m
    corner_m = np.array([*found.origin_m, ABOVE_LANES_M])
    points = middle + corner_m - context.zero_m
    context.points(points.astype(np.float32), colour_scale(found.share_missed[ix, iy], 0.0, 1.0), found.cell_m)
    worst = [f"{place.words}: {place.share:.0%} seen" for place in found.worst]
    whole = f"all vehicles: {found.overall.share:.1%} seen" if found.overall is not None else "no vehicle was recorded"
    legend = _scale_legend(f"vehicles with fewer than {found.points:g} points", 0.0, 1.0, "{:.0%}")
    return legend + _text_legend([f"<b>{_escape_html(whole)}</b>", *map(_escape_html, worst)])


def _draw_difference(context: LayerContext) -> str:
    if context.other is None or not context.other.is_feasible:
        return _text_legend(["there is no other site"])
    session, entropy = context.session, context.session.entropy_bit
    this, other = (session.hits(rating.site) > 0.0 for rating in (context.rating, context.other))
    only_this, only_other = (np.where(one & ~two, entropy, 0.0) for one, two in ((this, other), (other, this)))
    points, colours = difference_points(
        session.tpog, only_this, only_other, context.zero_m, (_THIS_COLOUR, _OTHER_COLOUR, _BOTH_COLOUR)
    )
    context.points(points, colours, session.tpog.grid.voxel_m)
    names = context.rating.site.name, context.other.site.name
    bits = float(only_this.sum()), float(only_other.sum())
    rows = zip((_THIS_COLOUR, _OTHER_COLOUR), names, bits, strict=True)
    return _swatch_legend([(colour, f"{name} alone sees {bit:,.1f} bit") for colour, name, bit in rows])


def _draw_scan(context: LayerContext) -> str:
    points = (context.session.returns_m(context.rating.site) - context.zero_m).astype(np.float32)
    context.points(points, np.full(points.shape, _SCAN_COLOUR, dtype=np.uint8), _RETURN_M)
    return _swatch_legend([(_SCAN_COLOUR, f"{len(points):,} returns of beams that can meet the region")])


def _draw_ring(context: LayerContext) -> str:
    lines = (context.session.beams_m(context.rating.site, context.view.ring) - context.zero_m).astype(np.float32)
    if len(lines):
        context.scene.add_line_segments(LAYER_NAME, lines, _SCAN_COLOUR, thickness=_BEAM_M)
    return _swatch_legend([(_SCAN_COLOUR, f"{len(lines):,} beams of the ring that can meet the region")])


def _draw_replay(context: LayerContext) -> str:
    played = context.playback
    moment = played.moment(context.rating.site, context.view.frame)
    of_vehicles = moment.owner >= 0
    colours = np.where(of_vehicles[:, None], _SCAN_COLOUR, _STATIC_COLOUR).astype(np.uint8)
    context.points((moment.returns_m - context.zero_m).astype(np.float32), colours, _RETURN_M)
    if not len(moment.returns_m):
        context.scene.add_frame(LAYER_NAME, show_axes=False)  # vehicles lie below it
    seen = moment.is_visible
    for name, which, colour in (("seen", seen, _VISIBLE_COLOUR), ("missed", ~seen, _HIDDEN_COLOUR)):
        if which.any():
            body = vehicle_mesh(moment.frame, played.kinds(moment.frame), played.parts, which, context.zero_m)
            context.scene.add_mesh_simple(
                f"{LAYER_NAME}/{name}", body.points, body.faces, color=colour, flat_shading=True, cast_shadow=False
            )
    said = [
        (_VISIBLE_COLOUR, f"{int(seen.sum())} with 20 returns or more"),
        (_HIDDEN_COLOUR, f"{int((~seen).sum())} with fewer"),
    ]
    return _swatch_legend([*said, (_SCAN_COLOUR, f"{int(of_vehicles.sum()):,} returns of vehicles")])


_DRAW_FUNCTIONS: dict[str, Callable[[LayerContext], str]] = {
    "traffic": _draw_traffic,
    "seen": _draw_entropy,
    "missed": _draw_entropy,
    "blindspots": _draw_blindspots,
    "difference": _draw_difference,
    "scan": _draw_scan,
    "ring": _draw_ring,
    "replay": _draw_replay,
}


def _scale_legend(what: str, low: float, high: float, form: str = "{:.3g}") -> str:
    """A bar of colours with its ends."""
    stops = colour_scale(np.linspace(0.0, 1.0, _LEGEND_STEPS))
    bar = f"linear-gradient(to right, {', '.join(map(_css_colour, stops.tolist()))})"
    ends = f"<span>{form.format(low)}</span><span>{form.format(high)}</span>"
    flex = "display:flex;justify-content:space-between"
    return _legend_box(f'{what}<div style="height:0.7em;background:{bar}"></div><div style="{flex}">{ends}</div>')


def _swatch_legend(rows: Sequence[tuple[Sequence[int], str]]) -> str:
    square = "display:inline-block;width:0.8em;height:0.8em;margin-right:0.5em"
    return _text_legend(
        [
            f'<span style="{square};background:{_css_colour(colour)}"></span>{_escape_html(said)}'
            for colour, said in rows
        ]
    )


def _text_legend(rows: Sequence[str]) -> str:
    return _legend_box("".join(f"<div>{row}</div>" for row in rows))


def _legend_box(content: str) -> str:
    return f'<div style="margin:0.3em 0.8em;font-size:0.85em;line-height:1.5">{content}</div>'


def _css_colour(colour: Sequence[int]) -> str:
    return f"rgb({', '.join(str(int(value)) for value in colour)})"


def _escape_html(text: str) -> str:
    """A text that HTML shows as it is."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
