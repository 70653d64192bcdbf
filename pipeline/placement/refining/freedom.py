"""How far a sensor of a plan may move: its pole along its line, in a circle or in a polygon; its height and its angles.

What may change is a point of a box from 0 to 1, one axis a number that may change; yaw that may be any comes round and
has no ends. Positions are whole millimetres and angles whole hundredths of a degree: nobody mounts better than that.
World frame.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.errors import InputError
from pipeline.placement.solving.sight import Floats
from pipeline.scenario.models import Scenario, SiteLine
from pipeline.scenario.placement import RefineModel
from pipeline.sensing.sites import Pose, Site
from pipeline.sensing.sites import of as sites_of

if TYPE_CHECKING:
    from shapely import LineString
    from shapely.geometry.base import BaseGeometry

_ALONG = "along_m"
_ON_LINE_M = 1e-6
_LENGTH_DIGITS, _ANGLE_DIGITS = 3, 2
_RIM_M = 10.0**-_LENGTH_DIGITS
"""A pole stays so far within its circle, so that rounding leaves it there."""


@dataclass(frozen=True)
class Axis:
    """A number that may change.

    Attributes
    ----------
    name
        A field of :class:`pipeline.sensing.sites.Pose`, or the way along a pole's line.
    low, high
        What it may be.
    comes_round
        Whether it has no ends.
    """

    name: str
    low: float
    high: float
    comes_round: bool = False

    def value(self, share: float) -> float:
        """What it is at a share of the way from ``low`` to ``high``, rounded."""
        value = self.low + share * (self.high - self.low)
        if self.comes_round:
            return round(math.remainder(value, 360.0), _ANGLE_DIGITS) + 0.0
        rounded = round(value, _ANGLE_DIGITS if self.name.endswith("_deg") else _LENGTH_DIGITS)
        return min(max(rounded, self.low), self.high) + 0.0

    def share(self, value: float) -> float:
        """The inverse; the nearer end where it is beyond."""
        share = (value - self.low) / (self.high - self.low)
        return share % 1.0 if self.comes_round else min(max(share, 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class Freedom:
    """What one sensor may do.

    Attributes
    ----------
    pose
        That of its candidate.
    axes
        What may change; the rest stays as in ``pose``.
    line
        That its pole may move along.
    radius_m
        How far from its candidate's place its pole may be.
    area
        In which its pole must be.
    """

    pose: Pose
    axes: tuple[Axis, ...]
    line: LineString | None = None
    radius_m: float = math.inf
    area: BaseGeometry | None = None

    @property
    def moves_pole(self) -> bool:
        """Whether it may leave its place in plan."""
        return any(axis.name in (_ALONG, "x_m", "y_m") for axis in self.axes)

    @property
    def ends(self) -> tuple[list[float | None], list[float | None]]:
        """Of each axis of the box, None where it has none."""
        lowest = [None if axis.comes_round else 0.0 for axis in self.axes]
        return lowest, [None if low is None else 1.0 for low in lowest]

    def point(self, pose: Pose) -> Floats:
        """The point of the box that is nearest to a pose, (axes,) float64."""
        values = asdict(pose)
        if self.line is not None:
            import shapely

            values[_ALONG] = shapely.line_locate_point(self.line, shapely.Point(pose.x_m, pose.y_m))
        return np.array([axis.share(values[axis.name]) for axis in self.axes])

    def pose_at(self, point: Floats) -> Pose | None:
        """The pose at a point of the box; None outside of the area."""
        values = {axis.name: axis.value(float(share)) for axis, share in zip(self.axes, point, strict=True)}
        if self.line is not None:
            spot = self.line.interpolate(values.pop(_ALONG))
            values |= {"x_m": round(spot.x, _LENGTH_DIGITS), "y_m": round(spot.y, _LENGTH_DIGITS)}
        if math.isfinite(self.radius_m):
            values |= self._in_circle(values["x_m"], values["y_m"])
        if self.area is not None:
            import shapely

            if not shapely.intersects_xy(self.area, values["x_m"], values["y_m"]):
                return None
        return Pose(**{**asdict(self.pose), **values})

    def _in_circle(self, x_m: float, y_m: float) -> dict[str, float]:
        """The place itself, or the one at the rim in its direction."""
        from_x, from_y = x_m - self.pose.x_m, y_m - self.pose.y_m
        most, far = max(self.radius_m - _RIM_M, 0.0), math.hypot(from_x, from_y)
        if far > most:
            x_m, y_m = self.pose.x_m + from_x / far * most, self.pose.y_m + from_y / far * most
        return {"x_m": round(x_m, _LENGTH_DIGITS), "y_m": round(y_m, _LENGTH_DIGITS)}


def check(scenario: Scenario, wanted: RefineModel) -> None:
    """InputError for a polygon that no candidate stands in."""
    import shapely

    poses = [site.pose for site in sites_of(scenario)]
    x_m, y_m = [pose.x_m for pose in poses], [pose.y_m for pose in poses]
    for number, corners in enumerate(wanted.within_m):
        if not shapely.intersects_xy(shapely.Polygon(corners), x_m, y_m).any():
            place = f"{scenario.file}: placement.refine.within_m: polygon {number}"
            raise InputError(place, "no candidate stands in it", "a polygon round one, in the world frame")


def freedoms(
    scenario: Scenario, wanted: RefineModel, candidates: Sequence[Site], plan: Sequence[Site], stay: Sequence[bool]
) -> tuple[Freedom | None, ...]:
    """What each sensor of a plan may do; None for one that stays: one that is told to, or with a measured scan.

    A pole that several sensors of the plan hang at keeps its place.

    Parameters
    ----------
    candidates
        All of them: their heights are those that a sensor may have where nothing else is said.

    Raises
    ------
    InputError
        Where no sensor of the plan may do anything.
    """
    heights_m = wanted.heights_m or _ends([site.pose.z_m for site in candidates])
    shared = {pole for pole, used in Counter(site.pole for site in plan).items() if used > 1}
    found = tuple(
        None if stays or site.points is not None else _freedom(scenario, wanted, heights_m, site, site.pole in shared)
        for site, stays in zip(plan, stay, strict=True)
    )
    if not any(one is not None and one.axes for one in found):
        place = f"{scenario.file}: placement.refine"
        right = "a range of heights or angles, or sensors that are neither forced nor measured"
        raise InputError(place, "no sensor of the plan may move at all", right)
    return tuple(one if one is not None and one.axes else None for one in found)


def _freedom(
    scenario: Scenario, wanted: RefineModel, heights_m: tuple[float, float], site: Site, is_shared: bool
) -> Freedom:
    own = site.pose
    ranges = {
        "z_m": heights_m,
        "yaw_deg": wanted.yaw_deg or (-180.0, 180.0),
        "pitch_deg": wanted.pitch_deg,
        "roll_deg": wanted.roll_deg or (own.roll_deg, own.roll_deg),
    }
    mount = tuple(
        Axis(name, low, high, comes_round=name == "yaw_deg" and wanted.yaw_deg is None)
        for name, (low, high) in ranges.items()
        if low < high
    )
    if is_shared:
        return Freedom(own, mount)
    if (area := _area_of(wanted, own)) is not None:
        west, south, east, north = area.bounds
        return Freedom(own, (Axis("x_m", west, east), Axis("y_m", south, north), *mount), area=area)
    if (rule := _line_of(scenario.sites.along, own)) is not None:
        line, at_m, spacing_m = rule
        reach_m = spacing_m / 2.0 if wanted.radius_m is None else wanted.radius_m
        way = Axis(_ALONG, max(at_m - reach_m, 0.0), min(at_m + reach_m, line.length))
        return Freedom(own, (way, *mount), line=line) if way.low < way.high else Freedom(own, mount)
    if radius_m := wanted.radius_m or 0.0:
        spots = (Axis(name, at_m - radius_m, at_m + radius_m) for name, at_m in (("x_m", own.x_m), ("y_m", own.y_m)))
        return Freedom(own, (*spots, *mount), radius_m=radius_m)
    return Freedom(own, mount)


def _ends(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)


def _area_of(wanted: RefineModel, pose: Pose) -> BaseGeometry | None:
    """The first polygon that a pole stands in."""
    import shapely

    polygons = (shapely.Polygon(corners) for corners in wanted.within_m)
    return next((area for area in polygons if shapely.intersects_xy(area, pose.x_m, pose.y_m)), None)


def _line_of(rules: Sequence[SiteLine], pose: Pose) -> tuple[LineString, float, float] | None:
    """The line that a rule put a pole on, how far along it stands, and the spacing."""
    import shapely

    for rule in rules:
        line = shapely.LineString(rule.line_m)
        along_m = np.arange(math.floor(line.length / rule.spacing_m + _ON_LINE_M) + 1) * rule.spacing_m
        spots = shapely.get_coordinates(shapely.line_interpolate_point(line, along_m))
        away_m = np.hypot(*(spots - (pose.x_m, pose.y_m)).T)
        if away_m.min() <= _ON_LINE_M:
            return line, float(along_m[np.argmin(away_m)]), rule.spacing_m
    return None
