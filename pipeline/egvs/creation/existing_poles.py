"""Poles that exist, as candidates: street lamps, masts of traffic signals and utility poles of a map.

Maps are imprecise here. A lamp that the map has on the carriageway stands beside it, at the nearest kerb. A signal is
often a point on the road at the stop line: its mast is at the kerb of the lane that ends there. Both are moved, and
their positions are assumed; all others stay as mapped.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from shapely.geometry import LineString, Point, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points

from egvs.core.grid import XY
from egvs.creation import junctions
from egvs.creation.junctions import JunctionRegion, KerbsidePole, StreetJunction, Streets
from egvs.creation.map_parts import MappedPole, MappedSolid
from egvs.traffic.network import CAR

MOST_MOVED_M = 15.0
"""A pole that would have to be moved farther is left out."""

APART_M = 1.0
"""Of several poles that are nearer to each other, one is a candidate."""

_STOP_LINE_M = 10.0
"""A signal at a stop line is so near to a lane that ends at the junction."""

_SOLID_BUILDINGS = ("building", "roof")


@dataclass(frozen=True)
class ExistingPoles:
    """Candidates among the poles of a map.

    Attributes
    ----------
    poles
        Counter-clockwise around the junction.
    left_out
        Number of other poles near the junction, by reason.
    """

    poles: tuple[KerbsidePole, ...]
    left_out: Counter[str] = field(default_factory=Counter)

    @property
    def as_mapped(self) -> list[str]:
        """Names of the poles that were not moved."""
        return [pole.name for pole in self.poles if not pole.moved_m]

    @property
    def notes(self) -> list[str]:
        """What to know about the poles."""
        notes = []
        if moved := [pole for pole in self.poles if pole.moved_m]:
            names = ", ".join(f"{pole.name} ({pole.moved_m:.1f} m)" for pole in moved)
            notes.append(
                f"Mapped on the carriageway and moved to its kerb, so that their positions are assumed: {names}."
                " Check them on site, correct sites.csv, and add them to sites.existing_poles."
            )
        if self.left_out:
            reasons = ", ".join(f"{number} {reason}" for reason, number in sorted(self.left_out.items()))
            notes.append(f"Poles of the map that are no candidates: {reasons}.")
        return notes


def find_existing_poles(
    mapped: Sequence[MappedPole],
    streets: Streets,
    junction: StreetJunction,
    roi: JunctionRegion,
    solids: Sequence[MappedSolid],
) -> ExistingPoles:
    """Choose the poles in and beside the region of interest.

    Parameters
    ----------
    mapped
        Poles of the map.
    streets, junction
        The carriageway and the junction.
    roi
        The region of interest; poles are inside it or up to ``junctions.BEYOND_ROI_M`` outside.
    solids
        Static objects: no candidate is inside a building.
    """
    window = box(*roi.area.buffer(junctions.BEYOND_ROI_M, join_style="mitre").bounds)
    carriageway = junctions.carriageway_near(streets, window)
    kerb = junctions.kerb_line(carriageway)
    buildings = [solid.area for solid in solids if solid.kind in _SOLID_BUILDINGS and not solid.base_m]
    chosen: list[tuple[MappedPole, XY, float]] = []
    left_out = Counter[str]()
    for pole in sorted(mapped, key=lambda each: (each.kind, each.name)):
        if not window.covers(Point(pole.at_m)):
            continue
        at_m = _position(pole, streets, junction, carriageway, kerb)
        if at_m is None:
            left_out["on the junction, or far from any kerb"] += 1
        elif any(building.covers(Point(at_m)) for building in buildings):
            left_out["inside a building"] += 1
        elif any(math.dist(at_m, other_m) < APART_M for _, other_m, _ in chosen):
            left_out[f"less than {APART_M:g} m from another one"] += 1
        else:
            chosen.append((pole, at_m, math.dist(at_m, pole.at_m)))

    center = junction.area.centroid
    chosen.sort(key=lambda each: (math.atan2(center.y - each[1][1], center.x - each[1][0]), each[1]))
    totals, numbers = Counter(pole.kind for pole, _, _ in chosen), Counter[str]()
    poles = []
    for pole, (x_m, y_m), moved_m in chosen:
        numbers[pole.kind] += 1
        name = f"{pole.kind}{numbers[pole.kind]:0{len(str(totals[pole.kind]))}d}"
        poles.append(KerbsidePole(x_m, y_m, name, round(moved_m, 1), pole.name))
    return ExistingPoles(tuple(poles), left_out)


def _position(
    pole: MappedPole, streets: Streets, junction: StreetJunction, carriageway: BaseGeometry, kerb: BaseGeometry
) -> XY | None:
    """Return where a pole stands, rounded to 1 cm; None where that is not known."""
    point: Point | None = Point(pole.at_m)
    if carriageway.intersects(point):
        if pole.kind == "signal":
            point = _on_kerb_lane(point, streets, junction)
        if point is not None:
            _, beside = nearest_points(point, kerb)
            point = beside if beside.distance(Point(pole.at_m)) <= MOST_MOVED_M else None
    return None if point is None else (round(point.x, 2), round(point.y, 2))


def _on_kerb_lane(point: Point, streets: Streets, junction: StreetJunction) -> Point | None:
    """Return the nearest point of the kerb lane of the road whose stop line a signal is at; None on the junction."""
    if junction.area.covers(point):
        return None
    nearest: tuple[float, LineString] | None = None
    for edge in streets.network.edges:
        if edge.to_node not in junction.nodes or edge.from_node in junction.nodes:
            continue
        lanes = [LineString(lane.shape_m[:, :2]) for lane in edge.lanes if lane.permission.admits(CAR)]
        if not lanes:
            continue
        distance_m = min(lane.distance(point) for lane in lanes)
        if distance_m <= _STOP_LINE_M and (nearest is None or distance_m < nearest[0]):
            nearest = distance_m, lanes[0]  # SUMO counts lanes from the kerb
    if nearest is None:
        return None
    return Point(nearest[1].interpolate(nearest[1].project(point)))
