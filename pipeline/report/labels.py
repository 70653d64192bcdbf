"""Places of sites on a map: sites that share one, and where the names go, so that they hide little.

Steps: group sites by place; for each place that is to be named try eight sides at four distances; take the first spot
that covers nothing, or else the one that covers least.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from pipeline.report.plan import Box, MapSite, Plan

Place = list[MapSite]
"""Sites that stand above one another, the best first."""

_LONGEST = 18
"""Letters of a name; longer ones are cut."""
_CROWDED = 40
"""With more places than this, a map has no room for numbers and names."""
_SIDES = ((1, 0), (0, -1), (0, 1), (-1, 0), (0.71, -0.71), (-0.71, -0.71), (0.71, 0.71), (-0.71, 0.71))
"""East, north, south, west, then the diagonals."""


def places_of(sites: Sequence[MapSite]) -> list[Place]:
    """Sites that share a place, the best first; places by their best."""
    places: dict[tuple[float, float], Place] = {}
    for site in sorted(sites, key=lambda s: s.rank):
        places.setdefault((site.x_m, site.y_m), []).append(site)
    return list(places.values())


def is_crowded(sites: Sequence[MapSite]) -> bool:
    """Whether the sites stand at too many places for numbers and names."""
    return len(places_of(sites)) > _CROWDED


def has_shared_places(sites: Sequence[MapSite]) -> bool:
    """Whether some sites share a place."""
    return len(places_of(sites)) < len(sites)


def name_labels(plan: Plan, places: Sequence[Place], named: Sequence[Place], radius: float) -> list[str]:
    """Names of the ``named`` places, further out with a line; ``radius`` is that of a place's innermost ring."""
    taken = [_square(plan.x(p[0].x_m), plan.y(p[0].y_m), _reach(p, radius) + 1) for p in places]
    drawn = []
    for place in named:
        x, y = plan.x(place[0].x_m), plan.y(place[0].y_m)
        text, near = _name(place), _reach(place, radius) + 4.0
        wide = 7.2 * len(text)
        options = [
            (d, _beside(x, y, d, wide, side)) for d in (near, near + 12, near + 26, near + 42) for side in _SIDES
        ]
        inside = [o for o in options if _within(o[1], plan)] or options
        away, box = min(inside, key=lambda o: sum(_overlap(o[1], t) for t in taken))
        taken.append(box)
        if away > near:
            drawn.append(
                f'<path class="lead" d="M{x:.1f} {y:.1f}L{(box[0] + box[2]) / 2:.1f} {(box[1] + box[3]) / 2:.1f}"/>'
            )
        drawn.append(f'<text class="label" x="{box[0]:.1f}" y="{box[3] - 3:.1f}">{escape(text)}</text>')
    return drawn


def _reach(place: Place, radius: float) -> float:
    """Radius of a place's outermost ring."""
    return radius + 3.5 * min(3, len(place) - 1)


def _name(place: Place) -> str:
    names = [s.site if len(s.site) <= _LONGEST else s.site[: _LONGEST - 1] + "…" for s in place]
    return ", ".join(names) if len(names) <= 2 else f"{names[0]} +{len(names) - 1}"


def _square(x: float, y: float, half: float) -> Box:
    return x - half, y - half, x + half, y + half


def _beside(x: float, y: float, away: float, wide: float, side: tuple[float, float]) -> Box:
    """A label's box on one side of a place."""
    dx, dy = side
    left = x + away * dx - wide * (0.0 if dx > 0 else 1.0 if dx < 0 else 0.5)
    top = y + away * dy - 15.0 * (0.0 if dy > 0 else 1.0 if dy < 0 else 0.5)
    return left, top, left + wide, top + 15.0


def _within(box: Box, plan: Plan) -> bool:
    right, base = plan.left + plan.frame_width, plan.top + plan.frame_height
    return plan.left + 3 <= box[0] and box[2] <= right - 3 and plan.top + 2 <= box[1] and box[3] <= base - 2


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
