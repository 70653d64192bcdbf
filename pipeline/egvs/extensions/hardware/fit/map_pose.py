"""The pose of an installed sensor in the world of a scenario: yaw, and position to a centimetre, from its own sweeps.

The ground plane gives height, roll and pitch only. Here the static returns are registered to the static world of a
scenario (:mod:`egvs.extensions.hardware.registration`), from a position that is known to 2 m, at every yaw. The result
says how well it fits, and which other yaws fit as well: a site between equal walls has several.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.extensions.hardware.registration import (
    Registration,
    StaticSurfaces,
    YawSearch,
    parameter_name_and_unit,
    sample_points,
    search_yaw,
)
from egvs.sensors.ground_plane import GroundPlane
from egvs.sensors.sites import Pose
from egvs.statistics.blocks import clustered_mean_se
from egvs.world.mesh import World

MAX_HORIZONTAL_SHIFT_M = 5.0
"""A fit that is farther than this from the given position is not that of the sensor."""

MIN_ON_SURFACE = 0.3
"""Below this share of returns on the static world, a fit is not to be relied on."""

_MAX_POINTS = 60_000
_BLOCK_DEG = 10.0


@dataclass(frozen=True)
class MapPose:
    """A sensor's pose in the static world.

    Attributes
    ----------
    scenario
        Name of the scenario.
    world
        Its static world.
    points_m
        Returns in the sensor's frame that were registered, (n, 3).
    start
        Where the search began; its yaw is not used.
    search
        The best fit, and other yaws.
    residual_m, residual_se_m
        Mean distance of the returns on the static world from its surfaces, positive outside of solids, and its standard
        error, from sectors of 10 degrees of azimuth.
    """

    scenario: str
    world: World
    points_m: FloatArray
    start: Pose
    search: YawSearch
    residual_m: float
    residual_se_m: float

    @property
    def best(self) -> Registration:
        """The best fit."""
        return self.search.best

    @property
    def share_on_surface(self) -> float:
        """Share of the returns that lie on the static world."""
        return float(self.best.on_surface.mean())

    @property
    def shift_m(self) -> float:
        """Horizontal distance of the fitted position from the given one."""
        return float(np.hypot(self.best.pose.x_m - self.start.x_m, self.best.pose.y_m - self.start.y_m))

    @property
    def ambiguous_yaws_deg(self) -> tuple[float, ...]:
        """Other yaws within reach of the position that fit as well as the best one."""
        fits = (other.registration for other in self.search.equally_good)
        return tuple(fit.pose.yaw_deg for fit in fits if _shift_m(fit, self.start) <= MAX_HORIZONTAL_SHIFT_M)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons not to rely on the pose, as sentences."""
        messages = []
        if "yaw_deg" in self.best.not_fixed:
            messages.append("No surface of the static world fixes the yaw.")
        elif self.best.not_fixed:
            names = ", ".join(parameter_name_and_unit(name)[0] for name in self.best.not_fixed)
            messages.append(f"No surface of the static world fixes {names}, which kept the start value.")
        if self.ambiguous_yaws_deg:
            yaws = ", ".join(f"{yaw_deg:.1f}" for yaw_deg in self.ambiguous_yaws_deg)
            messages.append(f"Ambiguous: the sweep fits as well at a yaw of {yaws} degrees. Choose by the map figure.")
        if self.shift_m > MAX_HORIZONTAL_SHIFT_M:
            messages.append(f"The fit is {self.shift_m:.1f} m from --site: check the position.")
        if self.share_on_surface < MIN_ON_SURFACE:
            share = self.share_on_surface
            messages.append(
                f"Only {format_percent(share, 0)} of the returns lie on the static world: check it, and the position."
            )
        if not self.best.converged:
            messages.append("The registration did not converge.")
        return tuple(messages)


def fit_map_pose(
    points_m: FloatArray,
    plane: GroundPlane,
    world: World,
    site_m: tuple[float, ...],
    scenario: str = "scenario",
    where: str = "sweeps",
) -> MapPose:
    """Return the pose of a sensor in the static world.

    Parameters
    ----------
    points_m
        Static returns (or all) in the sensor's frame, (n, 3), finite.
    plane
        The ground plane: height, roll and pitch of the sensor.
    world
        The static world.
    site_m
        x and y of the sensor to 2 m, and z if the world has no ground there.
    scenario
        Name of the scenario.
    where
        The sweeps, for messages.

    Raises
    ------
    InputError
        If the world has no ground at the site and z is not given, or hardly any return lies on the static world.
    """
    x_m, y_m = site_m[:2]
    z_m = site_m[2] if len(site_m) > 2 else lowest_surface_m(world, x_m, y_m) + plane.height_m
    start = Pose(x_m, y_m, z_m, 0.0, plane.pitch_deg, plane.roll_deg)
    points_m = sample_points(points_m, _MAX_POINTS)
    search = search_yaw(points_m, StaticSurfaces(world, start.position_m), start, where=where)
    best = search.best
    distance_m = best.distance_m[best.on_surface]
    sector = np.floor(np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0])) / _BLOCK_DEG).astype(np.int64)
    _, block = np.unique(sector[best.on_surface], return_inverse=True)
    residual_m, residual_se_m = clustered_mean_se(distance_m, block)
    return MapPose(
        scenario=scenario,
        world=world,
        points_m=points_m,
        start=start,
        search=search,
        residual_m=residual_m,
        residual_se_m=residual_se_m,
    )


def lowest_surface_m(world: World, x_m: float, y_m: float) -> float:
    """Return the height of the ground at a location, world frame; of all surfaces, the lowest, if none is a ground.

    Raises
    ------
    InputError
        If there is no surface.
    """
    is_ground = np.array([kind == "ground" for _, kind in world.solids], dtype=np.bool_)[world.solid_of_face]
    for faces in (is_ground, np.ones(len(world.faces), dtype=np.bool_)):
        heights = _heights_m(world.triangles_m[faces], x_m, y_m)
        if len(heights):
            return float(heights.min())
    problem = f"the static world has no ground at x = {x_m:g}, y = {y_m:g}"
    raise InputError("--site", problem, "Give the height of the sensor too: --site X,Y,Z.")


def _heights_m(triangles_m: FloatArray, x_m: float, y_m: float) -> FloatArray:
    """Return the heights of the triangles (n, 3, 3) above or below a location, without upright ones."""
    sides = triangles_m[:, 1:] - triangles_m[:, :1]
    area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    a, ab, ac = triangles_m[area != 0, 0], sides[area != 0, 0], sides[area != 0, 1]
    dx, dy = x_m - a[:, 0], y_m - a[:, 1]
    u = (dx * ac[:, 1] - dy * ac[:, 0]) / area[area != 0]
    v = (ab[:, 0] * dy - ab[:, 1] * dx) / area[area != 0]
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    heights: FloatArray = (a[:, 2] + u * ab[:, 2] + v * ac[:, 2])[inside]
    return heights


def _shift_m(fit: Registration, start: Pose) -> float:
    return float(np.hypot(fit.pose.x_m - start.x_m, fit.pose.y_m - start.y_m))
