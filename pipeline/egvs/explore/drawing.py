"""Draw the explorer's page: the scene, candidates and plans, layers over the scene, and the pose of the gizmo.

Arrays for the browser are float32 relative to ``zero_m``, a point near the region, so that scenes far from the origin
of the world frame do not jitter. Lengths are in metres.

Mount angles and quaternions: R_world_sensor = Rz(yaw) Ry(-pitch) Rx(roll), as
:func:`egvs.sensors.sensor.rotation_world_sensor` builds it; a quaternion is (w, x, y, z) of length 1. Dragged positions
are rounded to millimetres, and angles to hundredths of a degree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations, product

import numpy as np
import trimesh
import viser
from numpy.typing import ArrayLike, NDArray

from egvs.artefacts.tpog import Tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import MeshPart
from egvs.core.grid import BoolArray, FloatArray, Grid, Roi, Vec3
from egvs.core.wording import format_percent, number_of
from egvs.drawing import colours
from egvs.drawing.colours import Colour
from egvs.explore.road_meshes import LANE_HEIGHT_M, Mesh, junction_mesh, lane_mesh, marking_mesh
from egvs.explore.session import MovingPlan, Playback, PoseScore, Session
from egvs.explore.view_state import Camera, View
from egvs.scoring.points_map import CLASS_LABELS, OVERLAP_POINTS, PointsMap, overlap_map
from egvs.scoring.targets import SEEN_WELL_POINTS
from egvs.sensors.sites import Pose, Site
from egvs.world.mesh import World

Points = NDArray[np.float32]
"""(n, 3) float32, metres."""
Bytes = NDArray[np.uint8]
Quaternion = tuple[float, float, float, float]
"""w, x, y, z."""

_ROI_COLOUR = (232, 89, 12)
_SITE_RADIUS_M, _PLAN_RADIUS_M = 0.9, 1.3
_PLAN_COLOUR, _NEXT_SITE_COLOUR = (214, 40, 120), (120, 60, 200)

LAYER_HEIGHT_M = 3.0 * LANE_HEIGHT_M
_GROUND_MARGIN_M = 50.0
"""Height of a drawn layer above the road and its markings."""

_SCALE_STEPS, _MIN_OPACITY = 255, 0.4

_FLAT_KINDS = ("lanes", "junctions", "markings")

MAX_TRIANGLES = 150_000
"""Larger worlds are simplified for drawing, so that browsers without a graphics card can rotate them."""

_FINEST_M = 0.25


def drawing_origin(roi: Roi) -> Vec3:
    """Return the origin of the drawing in the world frame: the middle of the region's floor, in whole metres."""
    (x, y, z), (width, length, _) = roi.origin_m, roi.size_m
    return float(round(x + width / 2.0)), float(round(y + length / 2.0)), float(round(z))


def first_camera(roi: Roi) -> Camera:
    """Return a camera south of the region and above it, which looks at its middle."""
    x, y, z = drawing_origin(roi)
    size_m = max(roi.size_m)
    return Camera((x, y - 0.4 * size_m, z + 0.6 * size_m), (x, y, z))


def solid_meshes(world: World, zero_m: Vec3, max_triangles: int = MAX_TRIANGLES) -> dict[str, Mesh]:
    """Return the meshes of the static world by kind of solid.

    Parameters
    ----------
    world
        The static world.
    zero_m
        Origin of the drawing.
    max_triangles
        The meshes are simplified until they have no more triangles.
    """
    if not len(world.faces):
        return {}
    kinds = np.array([kind for _, kind in world.solids])[world.solid_of_face]
    points = (world.vertices_m - zero_m).astype(np.float32)
    meshes = {}
    for kind in np.unique(kinds).tolist():
        used, faces = np.unique(world.faces[kinds == kind], return_inverse=True)
        meshes[kind] = Mesh(points[used], faces.reshape(-1, 3).astype(np.int32))
    cell_m = _FINEST_M
    while sum(len(mesh.faces) for mesh in meshes.values()) > max_triangles:
        meshes = {kind: _simplify(mesh, cell_m) for kind, mesh in meshes.items()}
        cell_m *= 2.0
    return meshes


def _simplify(mesh: Mesh, cell_m: float) -> Mesh:
    """Merge the corners in each cell of a grid to their mean; drop triangles without area, and duplicates."""
    cells = np.floor(mesh.points / np.float32(cell_m)).astype(np.int64)
    _, cell_of_point, sizes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell_of_point = cell_of_point.ravel()
    means = np.column_stack([np.bincount(cell_of_point, mesh.points[:, axis]) / sizes for axis in range(3)])
    faces = cell_of_point[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh(means.astype(np.float32), faces[np.sort(first)].astype(np.int32))


def roi_box_lines(roi: Roi, zero_m: Vec3) -> Points:
    """Return the 12 edges of the region of interest, (12, 2, 3)."""
    unit = np.array(list(product((0.0, 1.0), repeat=3)))
    corners = np.asarray(roi.origin_m) + unit * roi.size_m - zero_m
    pairs = [(a, b) for a, b in combinations(range(8), 2) if np.abs(unit[a] - unit[b]).sum() == 1.0]
    return corners[pairs].astype(np.float32)


def column_points(tpog: Tpog, values: FloatArray, zero_m: Vec3, peak: float | None = None) -> tuple[Points, Bytes]:
    """Sum values along z, and return a point for each column with values.

    Parameters
    ----------
    tpog
        Its grid is used.
    values
        Values of voxels, (nx, ny, nz).
    zero_m
        Origin of the drawing.
    peak
        Upper end of the colour scale; the largest sum by default.

    Returns
    -------
    points
        Middles of the columns, (n, 3).
    colours
        RGB, (n, 3).
    """
    total = values.sum(axis=2)
    ix, iy = np.nonzero(total > 0.0)
    return _column_middles(tpog.grid, ix, iy, zero_m), colour_scale(total[ix, iy], 0.0, peak)


def difference_points(
    tpog: Tpog, this: FloatArray, other: FloatArray, zero_m: Vec3, colours: tuple[Colour, Colour, Colour]
) -> tuple[Points, Bytes]:
    """Sum two fields along z, and return a point for each column with values, coloured by their difference.

    Parameters
    ----------
    tpog
        Its grid is used.
    this, other
        Values of voxels, (nx, ny, nz).
    zero_m
        Origin of the drawing.
    colours
        For columns where ``this`` or ``other`` is larger, and where both are equal. Small differences have at least
        40 % of their colour, so that a few large ones do not hide them.

    Returns
    -------
    points
        Middles of the columns, (n, 3).
    colours
        RGB, (n, 3).
    """
    sum_this, sum_other = this.sum(axis=2), other.sum(axis=2)
    ix, iy = np.nonzero((sum_this > 0.0) | (sum_other > 0.0))
    difference = sum_this - sum_other
    largest = max(float(np.abs(difference).max(initial=0.0)), np.finfo(np.float64).tiny)
    share = np.abs(difference[ix, iy]) / largest
    share[share > 0.0] = _MIN_OPACITY + (1.0 - _MIN_OPACITY) * share[share > 0.0]
    this_colour, other_colour, equal_colour = colours
    full = np.where((difference[ix, iy] >= 0.0)[:, None], this_colour, other_colour)
    mixed = np.asarray(equal_colour) + share[:, None] * (full - np.asarray(equal_colour))
    return _column_middles(tpog.grid, ix, iy, zero_m), np.rint(mixed).astype(np.uint8)


def _column_middles(grid: Grid, ix: NDArray[np.intp], iy: NDArray[np.intp], zero_m: Vec3) -> Points:
    middles = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * grid.voxel_m
    return (middles + grid.origin_m - zero_m + (0.0, 0.0, LAYER_HEIGHT_M)).astype(np.float32)


def lift_to_ground(points: Points, world: World, zero_m: Vec3) -> Points:
    """Return points (n, 3) of a layer on the ground, where it is not flat.

    Heights are linear between the vertices of the ground (Delaunay triangulation). Without a ground around them, points
    stay where they are.
    """
    is_ground = np.array([solid == ("ground", "ground") for solid in world.solids], dtype=np.bool_)
    ground_m = world.vertices_m[np.unique(world.faces[is_ground[world.solid_of_face]])] - zero_m
    if not len(points) or not len(ground_m) or not np.ptp(ground_m[:, 2]):
        return points
    from scipy.interpolate import LinearNDInterpolator

    low_m, high_m = points[:, :2].min(axis=0) - _GROUND_MARGIN_M, points[:, :2].max(axis=0) + _GROUND_MARGIN_M
    near_m = ground_m[((ground_m[:, :2] >= low_m) & (ground_m[:, :2] <= high_m)).all(axis=1)]
    if len(near_m) < 3:
        return points
    heights_m = LinearNDInterpolator(near_m[:, :2], near_m[:, 2])(points[:, :2]) + LAYER_HEIGHT_M
    lifted = points.copy()
    lifted[:, 2] = np.where(np.isnan(heights_m), points[:, 2], heights_m)
    return lifted


def colour_scale(values: FloatArray | Sequence[float], low: float | None = None, high: float | None = None) -> Bytes:
    """Return the colours of values, (n, 3), on the scale of the report's light theme.

    Parameters
    ----------
    values
        Values, (n,).
    low, high
        Ends of the scale; the lowest and highest value by default.
    """
    numbers = np.asarray(values, dtype=np.float64)
    if low is None:
        low = float(np.min(numbers, initial=np.inf))
    if high is None:
        high = float(np.max(numbers, initial=-np.inf))
    span = high - low
    share = np.ones(len(numbers))
    if span > 0.0:
        share = (numbers - low) / span
    steps = np.rint(np.nan_to_num(share) * _SCALE_STEPS).astype(np.int64)
    table = [
        tuple(colours.interpolate_colour(step, _SCALE_STEPS, colours.ON_LIGHT)) for step in range(_SCALE_STEPS + 1)
    ]
    return np.array(table, dtype=np.uint8)[steps]


@dataclass(frozen=True)
class SceneMeshes:
    """The drawn static world and lanes.

    Attributes
    ----------
    meshes
        By kind.
    drawn, triangles
        Number of triangles of the static world that are drawn, and in all.
    """

    meshes: dict[str, viser.MeshHandle]
    drawn: int
    triangles: int

    @classmethod
    def draw(cls, scene: viser.SceneApi, session: Session, zero_m: Vec3) -> SceneMeshes:
        """Draw the static world, lanes and the region of interest in light colours."""
        scene.configure_default_lights(cast_shadow=False)  # too slow without a graphics card
        meshes = solid_meshes(session.scene.world, zero_m)
        drawn = sum(len(mesh.faces) for mesh in meshes.values())
        roads = session.work.inputs
        if roads.carriageway is not None:
            meshes["junctions"] = junction_mesh(roads.carriageway, zero_m)
            meshes["lanes"] = lane_mesh(roads.carriageway, zero_m)
        if roads.network is not None:
            meshes["markings"] = marking_mesh(roads.network, zero_m)
        scene.add_line_segments("/roi", roi_box_lines(session.scene.roi, zero_m), _ROI_COLOUR, thickness=0.15)
        handles = {}
        for kind, mesh in meshes.items():
            if not len(mesh.faces):
                continue
            handles[kind] = scene.add_mesh_simple(
                f"/world/{kind}", mesh.points, mesh.faces, color=colours.solid_colour(kind),
                flat_shading=kind not in _FLAT_KINDS, side="double", cast_shadow=False,
            )  # fmt: skip
        return cls(handles, drawn, len(session.scene.world.faces))

    def set_dark(self, is_dark: bool) -> None:
        """Use dark or light colours."""
        for kind, mesh in self.meshes.items():
            mesh.color = colours.solid_colour(kind, is_dark=is_dark)


OnClick = Callable[[Site], None]
"""Called with the site that is clicked."""


def draw_sites(scene: viser.SceneApi, session: Session, zero_m: Vec3, on_click: OnClick | None) -> None:
    """Draw the candidates as balls, the best ones darkest; without ``on_click`` they cannot be clicked."""
    sites = [candidate.site for candidate in session.ranked]
    ball_colours = colour_scale([candidate.scores[session.rank_by] for candidate in session.ranked])
    _draw_balls(scene, "/sites", sites, ball_colours, _SITE_RADIUS_M, zero_m, on_click)


def draw_plan(
    scene: viser.SceneApi, plan: MovingPlan | None, selected: str, zero_m: Vec3, on_click: OnClick | None
) -> None:
    """Draw the sensors of a plan and the best additional candidate, with labels.

    Parameters
    ----------
    scene
        The page's scene.
    plan
        The plan; None to draw nothing.
    selected
        A site that has no label here, because the gizmo has one.
    zero_m
        Origin of the drawing.
    on_click
        Called with the site that is clicked; None for balls that cannot be clicked.
    """
    scene.remove_by_name("/plan")
    if plan is None:
        return
    sites = list(plan.sites.values())
    labels = ["in the plan"] * len(sites)
    ball_colours = [_PLAN_COLOUR] * len(sites)
    if plan.best_next is not None:
        problem = plan.poses.placement_problem
        sites.append(problem.sites[problem.names.index(plan.best_next[0])])
        labels.append("best next")
        ball_colours.append(_NEXT_SITE_COLOUR)
    scene.add_frame("/plan", show_axes=False)
    plan_colours = np.array(ball_colours, dtype=np.uint8)
    _draw_balls(scene, "/plan/balls", sites, plan_colours, _PLAN_RADIUS_M, zero_m, on_click)
    for number, (site, label) in enumerate(zip(sites, labels, strict=True)):
        if site.name == selected:
            continue
        position_m = np.subtract(site.pose.position_m, zero_m)
        position_m[2] += 1.5 * _PLAN_RADIUS_M
        scene.add_label(
            f"/plan/label{number}", f"{site.name}: {label}", position=position_m, anchor="bottom-center",
            font_screen_scale=0.8,
        )  # fmt: skip


def linear_colours(colours: ArrayLike) -> Bytes:
    """Return sRGB colours (0 to 255) as linear ones, rounded; viser's viewer takes the colours of instances as linear.

    The transfer function is that of IEC 61966-2-1.

    >>> linear_colours(np.array([[0, 10, 188], [90, 181, 255]])).tolist()
    [[0, 1, 128], [26, 118, 255]]
    """
    values = np.asarray(colours, dtype=np.float64) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * linear).astype(np.uint8)


def _draw_balls(
    scene: viser.SceneApi,
    name: str,
    sites: Sequence[Site],
    colours: Bytes,
    radius_m: float,
    zero_m: Vec3,
    on_click: OnClick | None,
) -> None:
    """Draw a ball for each site, in its colour, (n, 3)."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius_m)
    handle = scene.add_batched_meshes_simple(
        name, np.asarray(ball.vertices, dtype=np.float32), np.asarray(ball.faces, dtype=np.int32),
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(sites), 1)),
        batched_positions=np.array([site.pose.position_m for site in sites]) - zero_m,
        batched_colors=linear_colours(colours), lod="off",
    )  # fmt: skip
    if on_click is None:
        return

    @handle.on_click
    def _(event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
        if event.instance_index is not None:
            on_click(sites[event.instance_index])


_LENGTH_DIGITS, _ANGLE_DIGITS = 3, 2
_MAX_SIN_PITCH = 1.0 - 1e-9
"""Beyond this sine of the pitch, yaw and roll rotate about the same axis; roll is then 0."""


def pose_quaternion(pose: Pose) -> Quaternion:
    """Return the orientation of a mount."""
    yaw, pitch, roll = (math.radians(angle) / 2.0 for angle in (pose.yaw_deg, -pose.pitch_deg, pose.roll_deg))
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(half), math.sin(half)) for half in (yaw, pitch, roll))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def quaternion_to_yaw_pitch_roll_deg(wxyz: Sequence[float]) -> Vec3:
    """Return yaw, pitch and roll of a quaternion of any length above 0."""
    length = math.hypot(*wxyz)
    w, x, y, z = (value / length for value in wxyz)
    sin_pitch = max(-1.0, min(1.0, 2.0 * (x * z - w * y)))  # nose up
    if abs(sin_pitch) > _MAX_SIN_PITCH:
        yaw = math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))
        return math.degrees(yaw), math.copysign(90.0, sin_pitch), 0.0
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return math.degrees(yaw), math.degrees(math.asin(sin_pitch)), math.degrees(roll)


def dragged_pose(pose: Pose, position_m: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """Return a pose after a drag; values that changed are rounded, the others stay exactly the same.

    Parameters
    ----------
    pose
        The pose before.
    position_m, wxyz
        Position and orientation of the gizmo.
    """
    after = (*position_m, *quaternion_to_yaw_pitch_roll_deg(wxyz))
    values = {}
    for (name, before), value in zip(asdict(pose).items(), after, strict=True):
        change, digits = value - before, _LENGTH_DIGITS
        if name.endswith("_deg"):
            change, digits = math.remainder(value - before, 360.0), _ANGLE_DIGITS
        is_unchanged = abs(change) <= 0.5 * 10.0**-digits
        values[name] = before if is_unchanged else round(float(value), digits) + 0.0
    return Pose(**values)


def vehicle_mesh(
    frame: TrafficFrame,
    kinds: Sequence[str],
    parts: Mapping[str, tuple[MeshPart, ...]],
    selected: BoolArray,
    zero_m: Vec3,
) -> Mesh:
    """Return some vehicles of a recorded frame as one mesh.

    Parameters
    ----------
    frame
        The frame.
    kinds, parts
        Body of each box, and parts of each body.
    selected
        Which boxes are drawn, (n,).
    zero_m
        Origin of the drawing.
    """
    corners = [np.empty((0, 3, 3))]
    for index in np.flatnonzero(selected).tolist():
        triangles = np.concatenate([part.triangles for part in parts[kinds[index]]])
        corners.append(_fit_to_box(triangles, frame.boxes[index], float(frame.pitch_rad[index])) - zero_m)
    points = np.concatenate(corners).reshape(-1, 3).astype(np.float32)
    return Mesh(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3))


def _fit_to_box(triangles: FloatArray, box: FloatArray, pitch_rad: float) -> FloatArray:
    """Scale triangles (m, 3, 3) of the unit box to a box of :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`."""
    (cy, cp), (sy, sp) = np.cos((box[6], pitch_rad)), np.sin((box[6], pitch_rad))
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    placed: FloatArray = (triangles * box[3:6]) @ (yaw @ pitch).T + box[:3]
    return placed


LAYER_NAME = "/layer"
"""Name of the layer in the page's scene; vehicles are its children."""

RETURN_M, _BEAM_M = 0.12, 0.04
SCAN_COLOUR, _STATIC_COLOUR = (200, 30, 80), (150, 150, 150)
VISIBLE_COLOUR, HIDDEN_COLOUR = (0, 90, 181), (220, 95, 0)
_THIS_COLOUR, _OTHER_COLOUR, _EQUAL_COLOUR = (0, 90, 181), (220, 95, 0), (222, 222, 222)
_LEGEND_STEPS = 8
_NO_NETWORK = "the traffic does not come from one road network"


@dataclass(frozen=True)
class LayerContext:
    """What a layer depends on.

    Attributes
    ----------
    scene
        The page's scene.
    session, playback
        The session and its recorded traffic.
    rating, view
        The sensor in its current pose, and what the page shows.
    other
        The site that the layer ``difference`` compares with; None if there is no other site.
    zero_m
        Origin of the drawing.
    plan
        The plan; None if there is none.
    node
        Name of the layer in the scene.
    """

    scene: viser.SceneApi
    session: Session
    playback: Playback
    rating: PoseScore
    view: View
    other: PoseScore | None
    zero_m: Vec3
    plan: MovingPlan | None = None
    node: str = LAYER_NAME

    def draw_points(self, points: Points, point_colours: Bytes, size_m: float) -> None:
        """Draw points (n, 3) with their colours (n, 3)."""
        if len(points):
            self.scene.add_point_cloud(
                self.node, points, point_colours, point_size=size_m, precision="float32", point_shading="flat"
            )

    def draw_columns(self, points: Points, point_colours: Bytes, size_m: float) -> None:
        """Draw points (n, 3) that stand for columns, on the ground."""
        self.draw_points(lift_to_ground(points, self.session.scene.world, self.zero_m), point_colours, size_m)


def draw_layer(context: LayerContext) -> str:
    """Replace the layer, and return its legend (HTML).

    Most layers are empty if no sensor can be mounted at the current pose.
    """
    context.scene.remove_by_name(context.node)
    layer = context.view.layer
    needs_sensor = layer not in ("traffic", "replay", "overlap_car", "overlap_pedestrian")
    if layer not in _DRAW_FUNCTIONS or (needs_sensor and not context.rating.is_feasible):
        return ""
    return _DRAW_FUNCTIONS[layer](context)


def _draw_traffic(context: LayerContext) -> str:
    tpog = context.session.tpog
    points, point_colours = column_points(tpog, tpog.p, context.zero_m)
    context.draw_columns(points, point_colours, tpog.grid.voxel_m)
    peak = float(tpog.p.sum(axis=2).max(initial=0.0))
    return _scale_legend("share of time for which voxels are occupied by vehicles, summed over height", peak)


def _draw_entropy(context: LayerContext) -> str:
    session = context.session
    draws_seen = context.view.layer == "seen"
    is_crossed = session.hits(context.rating.site) > 0.0
    entropy = np.where(is_crossed == draws_seen, session.entropy_bit, 0.0)
    peak = float(session.entropy_bit.sum(axis=2).max(initial=0.0))
    points, point_colours = column_points(session.tpog, entropy, context.zero_m, peak)
    context.draw_columns(points, point_colours, session.tpog.grid.voxel_m)
    where = "that beams cross" if draws_seen else "that no beam crosses"
    return _scale_legend(f"entropy (bits) of voxels {where}, summed over height", peak)


def _draw_blindspots(context: LayerContext) -> str:
    spots = context.session.blindspots(context.rating.site)
    ix, iy = np.nonzero(~np.isnan(spots.share_missed))
    middles = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * spots.cell_m
    points = middles + np.array([*spots.origin_m, LAYER_HEIGHT_M]) - context.zero_m
    point_colours = colour_scale(spots.share_missed[ix, iy], 0.0, 1.0)
    context.draw_columns(points.astype(np.float32), point_colours, spots.cell_m)
    overall = "no vehicles were recorded"
    if spots.overall is not None:
        overall = f"all vehicles: {format_percent(spots.overall.share)} found"
    rows = [f"<b>{_escape_html(overall)}</b>"]
    rows += [_escape_html(f"{location.words}: {format_percent(location.share, 0)} found") for location in spots.worst]
    return _scale_legend("share of vehicles not found", 1.0, partial(format_percent, digits=0)) + text_legend(rows)


def _draw_points(context: LayerContext) -> str:
    target = context.view.layer.removeprefix("points_")
    points = context.session.points_map(context.rating.site, target)
    if points is None:
        return text_legend([_NO_NETWORK])
    shares = [
        f"{format_percent(points.share_with(limit))} of the surface with {limit:g} points or more" for limit in (1, 20)
    ]
    return _draw_classes(context, points, points.classes, CLASS_LABELS, f"points on a {target}") + text_legend(shares)


def _draw_overlap(context: LayerContext) -> str:
    target = context.view.layer.removeprefix("overlap_")
    if context.plan is None:
        return text_legend(["there is no plan"])
    maps = [context.session.points_map(site, target) for site in context.plan.poses.sites]
    known = [points for points in maps if points is not None]
    if not known:
        return text_legend([_NO_NETWORK])
    overlap = overlap_map(known)
    labels = [str(count) for count in range(len(known) + 1)]
    title = f"sensors of the plan with {OVERLAP_POINTS:g} points or more on a {target}"
    return _draw_classes(context, overlap, overlap.values, labels, title)


def _draw_classes(
    context: LayerContext, points: PointsMap, classes: FloatArray, labels: Sequence[str], title: str
) -> str:
    """Draw the class of each square metre of a map, and return the legend."""
    ix, iy = np.nonzero(points.on_surface)
    middles = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * points.cell_m
    at_m = middles + np.array([*points.origin_m, LAYER_HEIGHT_M]) - context.zero_m
    highest = len(labels) - 1
    context.draw_columns(at_m.astype(np.float32), colour_scale(classes[ix, iy], 0.0, highest), points.cell_m)
    swatches = colour_scale(np.arange(len(labels), dtype=np.float64), 0.0, highest).tolist()
    rows = [((red, green, blue), label) for (red, green, blue), label in zip(swatches, labels, strict=True)]
    return text_legend([f"<b>{title}</b>"]) + swatch_legend(rows)


def _draw_difference(context: LayerContext) -> str:
    if context.other is None or not context.other.is_feasible:
        return text_legend(["there is no other site to compare with"])
    session, entropy = context.session, context.session.entropy_bit
    this = session.hits(context.rating.site) > 0.0
    other = session.hits(context.other.site) > 0.0
    only_this, only_other = np.where(this & ~other, entropy, 0.0), np.where(other & ~this, entropy, 0.0)
    palette = (_THIS_COLOUR, _OTHER_COLOUR, _EQUAL_COLOUR)
    points, point_colours = difference_points(session.tpog, only_this, only_other, context.zero_m, palette)
    context.draw_columns(points, point_colours, session.tpog.grid.voxel_m)
    return swatch_legend(
        [
            (_THIS_COLOUR, f"seen only by {context.rating.site.name}: {float(only_this.sum()):,.1f} bits"),
            (_OTHER_COLOUR, f"seen only by {context.other.site.name}: {float(only_other.sum()):,.1f} bits"),
        ]
    )


def _draw_scan(context: LayerContext) -> str:
    points = (context.session.returns_m(context.rating.site) - context.zero_m).astype(np.float32)
    context.draw_points(points, np.full(points.shape, SCAN_COLOUR, dtype=np.uint8), RETURN_M)
    return swatch_legend([(SCAN_COLOUR, f"{len(points):,} returns from beams directed at the region")])


def _draw_ring(context: LayerContext) -> str:
    lines = (context.session.beams_m(context.rating.site, context.view.ring) - context.zero_m).astype(np.float32)
    if len(lines):
        context.scene.add_line_segments(context.node, lines, SCAN_COLOUR, thickness=_BEAM_M)
    return swatch_legend([(SCAN_COLOUR, f"{len(lines):,} beams of this ring towards the region")])


def _draw_replay(context: LayerContext) -> str:
    playback = context.playback
    played = playback.simulate(context.rating.site, playback.frame(context.view.frame))
    on_vehicle = played.owner >= 0
    point_colours = np.where(on_vehicle[:, None], SCAN_COLOUR, _STATIC_COLOUR).astype(np.uint8)
    context.draw_points((played.returns_m - context.zero_m).astype(np.float32), point_colours, RETURN_M)
    if not len(played.returns_m):
        context.scene.add_frame(context.node, show_axes=False)  # parent of the vehicles
    visible, kinds = played.is_visible, playback.kinds(played.frame)
    for name, selected, colour in (("seen", visible, VISIBLE_COLOUR), ("missed", ~visible, HIDDEN_COLOUR)):
        if selected.any():
            mesh = vehicle_mesh(played.frame, kinds, playback.parts, selected, context.zero_m)
            context.scene.add_mesh_simple(
                f"{context.node}/{name}", mesh.points, mesh.faces, color=colour, flat_shading=True, cast_shadow=False
            )
    time_s, last_s = (playback.period_s * number for number in (played.frame.number, playback.frames - 1))
    swatches = [
        (VISIBLE_COLOUR, f"{_count_road_users(played.frame, visible)} with {SEEN_WELL_POINTS:g} or more points"),
        (HIDDEN_COLOUR, f"{_count_road_users(played.frame, ~visible)} with fewer"),
        (SCAN_COLOUR, f"{int(on_vehicle.sum()):,} points on them"),
    ]
    return text_legend([f"<b>{time_s:,.1f} s of {last_s:,.1f} s</b>"]) + swatch_legend(swatches)


def _count_road_users(frame: TrafficFrame, selected: BoolArray) -> str:
    """Return how many of some boxes are vehicles, and how many are people on foot or on bicycles."""
    is_vehicle = frame.are_vehicles()
    vehicles, people = int((selected & is_vehicle).sum()), int((selected & ~is_vehicle).sum())
    listed = number_of(vehicles, "vehicle")
    return f"{listed}, {number_of(people, 'person', 'people')}" if people else listed


_DRAW_FUNCTIONS: dict[str, Callable[[LayerContext], str]] = {
    "traffic": _draw_traffic,
    "seen": _draw_entropy,
    "missed": _draw_entropy,
    "blindspots": _draw_blindspots,
    "points_car": _draw_points,
    "points_pedestrian": _draw_points,
    "overlap_car": _draw_overlap,
    "overlap_pedestrian": _draw_overlap,
    "difference": _draw_difference,
    "scan": _draw_scan,
    "ring": _draw_ring,
    "replay": _draw_replay,
}


def _scale_legend(title: str, high: float, format_number: Callable[[float], str] = "{:.3g}".format) -> str:
    """Return a colour bar with its ends."""
    stops = ", ".join(map(_css_colour, colour_scale(np.linspace(0.0, 1.0, _LEGEND_STEPS)).tolist()))
    bar = f'<div style="height:0.7em;background:linear-gradient(to right, {stops})"></div>'
    ends = f"<span>{format_number(0.0)}</span><span>{format_number(high)}</span>"
    return _legend_box(f'{title}{bar}<div style="display:flex;justify-content:space-between">{ends}</div>')


def swatch_legend(rows: Sequence[tuple[Colour, str]]) -> str:
    """Return coloured squares with texts."""
    square = "display:inline-block;width:0.8em;height:0.8em;margin-right:0.5em"
    lines = []
    for colour, text in rows:
        lines.append(f'<span style="{square};background:{_css_colour(colour)}"></span>{_escape_html(text)}')
    return text_legend(lines)


def text_legend(rows: Sequence[str]) -> str:
    return _legend_box("".join(f"<div>{row}</div>" for row in rows))


def _legend_box(content: str) -> str:
    return f'<div style="margin:0.3em 0.8em;font-size:0.85em;line-height:1.5">{content}</div>'


def _css_colour(colour: Sequence[int]) -> str:
    return f"rgb({', '.join(str(int(value)) for value in colour)})"


def _escape_html(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
