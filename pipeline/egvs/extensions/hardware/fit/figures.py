"""Figures of a fitted sensor: fitted against measured values, and the chosen ground plane."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.extensions.hardware.fit import empty_scan, return_rates
from egvs.extensions.hardware.fit.empty_scan import TRAFFIC, UNKNOWN
from egvs.extensions.hardware.fit.fit import SensorFit
from egvs.extensions.hardware.fit.sweep_layout import axis_distances_m, nearest_ring
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.statistics.intervals import Estimate
from egvs.world.mesh import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_POINTS = 60_000
_VIEW_M = 80.0
_STEEP = 0.3
"""Walls: triangles whose normal rises by less."""
_BLUE, _ORANGE, _GREEN, _GREY, _RED = "#1f77b4", "#e07b00", "#2a9d4a", "#b5b5b5", "#d62728"


def _figure(width: float, height: float, columns: int, rows: int = 1) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def draw_angles(fit: SensorFit) -> Figure:
    """Measured against fitted directions: residuals of elevation and azimuth, and the offsets of the channels."""
    figure, ((left, middle, right),) = _figure(15.0, 4.6, 3)
    angles = fit.angles
    points, channel, column = _measured_points(fit)
    radius_m = axis_distances_m(points)
    raw_deg = np.degrees(np.arctan2(points[:, 2], radius_m)) - angles.elevation_deg[channel]
    fitted_deg = np.degrees(
        np.arctan2(points[:, 2] - angles.offset_m[channel], radius_m) - np.radians(angles.elevation_deg[channel])
    )
    left.plot(radius_m, raw_deg, ",", color=_GREY)
    left.plot(radius_m, fitted_deg, ",", color=_BLUE)
    left.plot([], [], "s", color=_GREY, label="without offset")
    left.plot([], [], "s", color=_BLUE, label="with the channel's vertical offset")
    left.set(xscale="log", xlabel="horizontal distance (m)", ylabel="measured - fitted elevation (degrees)")
    low, high = np.percentile(raw_deg, [0.5, 99.5])
    margin = 0.3 * (high - low) + 0.005
    left.set(ylim=(min(low, 0.0) - margin, max(high, 0.0) + margin), title="Elevation of the returns")
    left.legend(loc="best")

    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    residual_deg = azimuth_deg - angles.azimuth_deg()[channel, column]
    residual_deg = np.mod(residual_deg + 180.0, 360.0) - 180.0
    middle.plot(azimuth_deg, residual_deg, ",", color=_BLUE)
    half = 0.55 * angles.grid_step_deg
    middle.set(xlabel="azimuth (degrees)", ylabel="measured - fitted azimuth (degrees)", ylim=(-half, half))
    middle.set_title(f"Azimuth of the returns ({angles.azimuths} steps of {angles.grid_step_deg:.4g} degrees)")

    order = angles.ascending
    right.errorbar(
        angles.elevation_deg[order], 1000 * angles.offset_m[order], 1000 * 1.96 * angles.offset_se_m[order],
        fmt="o", color=_BLUE, markersize=3, label="channel, 95 % interval",
    )  # fmt: skip
    line = np.linspace(angles.elevation_deg.min(), angles.elevation_deg.max(), 50)
    label = f"optics {1000 * angles.axis_distance_m:.1f} mm from the axis"
    right.plot(line, -1000 * angles.axis_distance_m * np.tan(np.radians(line)), color=_ORANGE, label=label)
    right.set(xlabel="fitted elevation (degrees)", ylabel="vertical offset (mm)", title="Channels")
    right.legend(loc="best")
    return figure


def _measured_points(fit: SensorFit) -> tuple[FloatArray, Any, Any]:
    """Return measured points of the first sweep that is not coarse, with channel and column of their pulse."""
    number = next(index for index, sweep in enumerate(fit.sweeps) if not sweep.is_coarse)
    points = fit.sweeps[number].points_m
    points = points[np.isfinite(points[:, 0])]
    points = points[:: max(1, len(points) // _MAX_POINTS)]
    angles = fit.angles
    order = angles.ascending
    radius_m = axis_distances_m(points)
    tangent = np.tan(np.radians(angles.elevation_deg))[order]
    ring, _ = nearest_ring(radius_m, points[:, 2], tangent, angles.offset_m[order])
    channel = order[ring]
    turned = np.degrees(np.arctan2(points[:, 1], points[:, 0])) - angles.azimuth_offset_deg[channel]
    turned = np.mod(turned - angles.first_azimuth_deg, 360.0)
    column = np.round(turned / angles.grid_step_deg).astype(np.int64) % angles.azimuths
    return points, channel, column


def draw_ranges(fit: SensorFit) -> Figure:
    """Range noise by range and by channel, and the return rates on smooth surfaces."""
    figure, ((left, middle, right),) = _figure(15.0, 4.6, 3)
    sample = slice(None, None, max(1, len(fit.residuals.range_m) // _MAX_POINTS))
    # The residual's standard deviation is sqrt(3/2) times that of a range.
    scatter_mm = 1000 * np.abs(fit.residuals.residual_m[sample]) / np.sqrt(1.5)
    left.plot(fit.residuals.range_m[sample], scatter_mm, ",", color=_GREY)
    _bars(left, [(b.from_m, b.to_m, b.sigma_m) for b in fit.noise], 1000.0, _BLUE, "all surfaces")
    _bars(left, [(b.from_m, b.to_m, b.sigma_m) for b in fit.noise_on_road], 1000.0, _ORANGE, "road")
    left.plot([], [], "s", color=_GREY, label="a return and its neighbours")
    left.set(xscale="log", yscale="log", ylim=(0.5, None), xlabel="range (m)", ylabel="standard deviation (mm)")
    left.set_title("Range noise (upper bound beyond 25 m:\nit includes the roughness of surfaces)")
    left.legend(loc="upper left")

    order = fit.angles.ascending
    known = [c for c in order if fit.noise_by_channel[c] is not None]
    estimates = [fit.noise_by_channel[c] for c in known]
    middle.errorbar(
        fit.angles.elevation_deg[known],
        [1000 * e.value for e in estimates if e],
        [[1000 * (e.value - e.low) for e in estimates if e], [1000 * (e.high - e.value) for e in estimates if e]],
        fmt="o", color=_BLUE, markersize=3,
    )  # fmt: skip
    if fit.sigma_m is not None:
        label = f"all channels: {1000 * fit.sigma_m.value:.1f} mm"
        middle.axhline(1000 * fit.sigma_m.value, color=_ORANGE, label=label)
        middle.legend(loc="best")
    middle.set(xlabel="elevation of the channel (degrees)", ylabel="standard deviation (mm)", ylim=(0, None))
    middle.set_title("Range noise by channel, 5 to 25 m (95 % intervals)")

    colours = ["#08306b", "#2171b5", "#6baed6", "#fdae6b", "#e6550d", "#a63603"]
    for index, (low, high) in enumerate(
        zip(return_rates.INCIDENCE_EDGES_DEG[:-1], return_rates.INCIDENCE_EDGES_DEG[1:], strict=True)
    ):
        rates = [(b.from_m, b.to_m, b.rate) for b in fit.return_rates if b.from_deg == low]
        _bars(right, rates, 100.0, colours[index], f"{low:g} to {high:g} degrees")
    right.set(xlabel="range (m)", ylabel="returns of 100 pulses", title="Returns from smooth surfaces, by incidence")
    if fit.return_rates:
        right.legend(loc="lower left")
    return figure


def describe_fitted_roll(roll_deg: float, digits: int = 2) -> str:
    """Return a roll as sites count it: from upside down, with these words before, for a sensor that is.

    >>> describe_fitted_roll(1.5), describe_fitted_roll(-178.5)
    ('roll 1.50', 'upside down, roll 1.50 from there')
    """
    pose = Pose(0.0, 0.0, 0.0, roll_deg=roll_deg)
    roll = f"roll {pose.side_tilt_deg:z.{digits}f}"
    return f"upside down, {roll} from there" if pose.is_inverted else roll


def draw_ground(fit: SensorFit) -> Figure:
    """The chosen ground plane from above and from the side, and the share of returns from the road."""
    figure, axes = _figure(15.0, 9.6, 2, 2)
    (above, side), (rates, across) = axes
    number = next(index for index, sweep in enumerate(fit.sweeps) if not sweep.is_coarse)
    points = fit.sweeps[number].points_m
    points = points[np.isfinite(points[:, 0])]
    points = points[np.hypot(points[:, 0], points[:, 1]) < 1.2 * _VIEW_M]
    heights_m = [plane.distance_m(points) for plane in fit.planes]
    chosen = next(index for index, plane in enumerate(fit.planes) if plane is fit.plane)
    others = np.zeros(len(points), dtype=bool)
    for index, height_m in enumerate(heights_m):
        others |= (np.abs(height_m) <= 0.2) & (index != chosen)
    on_plane = np.abs(heights_m[chosen]) <= 0.2
    parts = (
        (~on_plane & ~others, _GREY, "other returns"),
        (others & ~on_plane, _BLUE, "other planes"),
        (on_plane, _GREEN, f"chosen plane, {fit.plane.height_m:.2f} m below the sensor"),
    )
    for axis, x, y in ((above, 0, 1), (side, 0, 2), (across, 1, 2)):
        for members, colour, label in parts:
            axis.plot(points[members, x], points[members, y], ",", color=colour)
            axis.plot([], [], "s", color=colour, label=label)
        axis.plot(0, 0, "^", color=_RED, label="sensor")
    above.set(xlabel="x (m)", ylabel="y (m)", xlim=(-_VIEW_M, _VIEW_M), ylim=(-_VIEW_M, _VIEW_M), aspect="equal")
    is_inverted = fit.plane.is_inverted
    if is_inverted:  # its y and z axes are drawn as in the world, the road below
        above.set_ylim(_VIEW_M, -_VIEW_M)
    above.set_title(f"From above, in the frame of the sensor{', which is upside down' if is_inverted else ''}")
    above.legend(loc="upper left", fontsize=8, bbox_to_anchor=(1.02, 1.0))
    deepest = min(-1.3 * max(plane.height_m for plane in fit.planes), -2.0)
    for axis, name, slope in ((side, "x", 0), (across, "y", 1)):
        line = np.array([-_VIEW_M, _VIEW_M])
        normal = fit.plane.normal
        axis.plot(line, -(fit.plane.height_m + normal[slope] * line) / normal[2], color="black", linewidth=0.8)
        limits_m = (-deepest, -2.0) if is_inverted else (deepest, 2.0)
        left_m = _VIEW_M if is_inverted and slope else -_VIEW_M
        axis.set(xlabel=f"{name} (m)", ylabel="z (m)", xlim=(left_m, -left_m), ylim=limits_m)
    side.set_title(
        f"From the side: {describe_fitted_roll(fit.plane.roll_deg)}, pitch {fit.plane.pitch_deg:.2f} degrees"
    )
    across.set_title("Along the sensor's x axis")
    _bars(rates, [(b.from_m, b.to_m, b.rate) for b in fit.road_rates], 100.0, _GREEN, "from the road alone")
    _bars(rates, [(b.from_m, b.to_m, b.rate) for b in fit.rates_towards_road], 100.0, _GREY, "from vehicles as well")
    rates.set(xlabel="range to the plane (m)", ylabel="returns of 100 pulses", ylim=(0, 102))
    rates.set_title("Returns of pulses towards the road (95 % intervals)")
    if fit.road_rates:
        rates.set_xlim(0, 150)
        rates.legend(loc="best")
    return figure


def draw_empty_scan(fit: SensorFit) -> Figure | None:
    """The empty scan, and the returns in front of it, from above; None without an empty scan."""
    if fit.empty_scan is None:
        return None
    figure, ((left, right),) = _figure(15.0, 7.6, 2)
    background = empty_scan.points_of(fit.empty_scan.range_m, fit.angles)
    background = background[np.isfinite(fit.empty_scan.range_m)]
    height_m = fit.plane.distance_m(background)
    scatter = left.scatter(
        background[:, 0], background[:, 1], c=height_m, s=0.3, cmap="viridis", vmin=-4.0, vmax=8.0, linewidths=0
    )
    figure.colorbar(scatter, ax=left, label="height above the chosen plane (m)", shrink=0.8)
    left.set_title(f"Empty scan: {len(background):,} of {fit.empty_scan.range_m.size:,} pulses")
    right.plot(background[:, 0], background[:, 1], ",", color=_GREY)
    for label, colour in ((UNKNOWN, _BLUE), (TRAFFIC, _RED)):
        for number, grid in enumerate(fit.grids):
            members = np.isfinite(grid.range_m) & (fit.empty_scan.labels[number] == label)
            points = empty_scan.points_of(grid.range_m, fit.angles)[members]
            right.plot(points[:, 0], points[:, 1], ",", color=colour)
    counts = fit.empty_scan.counts
    right.plot([], [], "s", color=_RED, label=f"in front of the background ({counts[TRAFFIC]:,} returns)")
    right.plot([], [], "s", color=_BLUE, label=f"no background known ({counts[UNKNOWN]:,} returns)")
    right.set_title(f"Returns of all {len(fit.grids)} sweeps")
    right.legend(loc="upper left", fontsize=8)
    for axis in (left, right):
        axis.set(xlabel="x (m)", ylabel="y (m)", xlim=(-_VIEW_M, _VIEW_M), ylim=(-_VIEW_M, _VIEW_M), aspect="equal")
    return figure


def draw_map(fit: SensorFit) -> Figure | None:
    """The sweep on the static world from above, and how well it fits at each yaw; None without a pose in the world."""
    if fit.map_pose is None:
        return None
    from matplotlib.collections import LineCollection

    figure, ((plan, curve),) = _figure(15.0, 7.6, 2)
    map_pose = fit.map_pose
    best, pose = map_pose.best, map_pose.best.pose
    rotation = rotation_world_sensor(pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
    points = map_pose.points_m @ rotation.T + np.array(pose.position_m)
    for members, colour, label in (
        (~best.on_surface, _ORANGE, "returns elsewhere (vehicles, trees, errors of the map)"),
        (best.on_surface, _BLUE, "returns on the static world"),
    ):
        plan.plot(points[members, 0], points[members, 1], ",", color=colour)
        plan.plot([], [], "s", color=colour, label=f"{label}: {format_percent(float(np.mean(members)), 0)}")
    plan.add_collection(LineCollection(list(_wall_lines(map_pose.world)), colors="black", linewidths=0.8))
    plan.plot([], [], color="black", linewidth=0.8, label="walls of the static world")
    ahead = np.radians(pose.yaw_deg)
    tip = (pose.x_m + 12.0 * np.cos(ahead), pose.y_m + 12.0 * np.sin(ahead))
    plan.annotate("", tip, (pose.x_m, pose.y_m), arrowprops={"color": _RED, "width": 1.5, "headwidth": 8})
    plan.plot(pose.x_m, pose.y_m, "o", color=_RED, label="fitted position, and the sensor's x axis")
    plan.plot(map_pose.start.x_m, map_pose.start.y_m, "x", color=_RED, label="given position")
    limits = [(centre - _VIEW_M, centre + _VIEW_M) for centre in (pose.x_m, pose.y_m)]
    plan.set(xlabel="x (m)", ylabel="y (m)", xlim=limits[0], ylim=limits[1], aspect="equal")
    yaw_se_deg = best.standard_errors["yaw_deg"]
    plan.set_title(f"From above: yaw {pose.yaw_deg:.2f} +- {yaw_se_deg:.2g} degrees")
    plan.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2, fontsize=8, frameon=False)

    curve.plot(map_pose.search.yaws_deg, map_pose.search.costs_m, color=_GREY, label="tried, at the given position")
    curve.axvline(pose.yaw_deg % 360.0, color=_RED, label="best fit")
    for yaw_deg in map_pose.ambiguous_yaws_deg:
        curve.axvline(yaw_deg % 360.0, color=_ORANGE, linestyle="--")
    if map_pose.ambiguous_yaws_deg:
        curve.plot([], [], color=_ORANGE, linestyle="--", label="fits as well")
    curve.set(xlabel="yaw (degrees)", ylabel="mean distance from surfaces, at most 2 m (m)", xlim=(0, 360))
    curve.set_ylim(bottom=0.0)
    curve.set_title("How well the sweep fits at each yaw")
    curve.legend(loc="best", fontsize=8)
    return figure


def _wall_lines(world: World) -> FloatArray:
    """Return the longest side in plan of each steep triangle, (n, 2, 2)."""
    corners = world.triangles_m
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    steep = corners[np.abs(normals[:, 2]) < _STEEP * np.linalg.norm(normals, axis=1)][:, :, :2]
    sides = np.stack([steep, np.roll(steep, -1, axis=1)], axis=2)
    longest = np.linalg.norm(sides[:, :, 1] - sides[:, :, 0], axis=2).argmax(axis=1)
    lines: FloatArray = sides[np.arange(len(sides)), longest]
    return lines


def _bars(axis: Any, bins: Sequence[tuple[float, float, Estimate]], scale: float, colour: str, label: str) -> None:
    """Draw estimates as horizontal lines over their ranges, with bands for the 95 % intervals."""
    for index, (start, end, estimate) in enumerate(bins):
        start = max(start, 1.0)
        axis.fill_between([start, end], scale * estimate.low, scale * estimate.high, color=colour, alpha=0.25, lw=0)
        name = label if index == 0 else None
        axis.plot([start, end], [scale * estimate.value] * 2, color=colour, linewidth=2, label=name)


FIGURES: dict[str, Callable[[SensorFit], Figure | None]] = {
    "angles.png": draw_angles,
    "ranges.png": draw_ranges,
    "ground.png": draw_ground,
    "empty_scan.png": draw_empty_scan,
    "map.png": draw_map,
}
"""The function that draws each file."""
