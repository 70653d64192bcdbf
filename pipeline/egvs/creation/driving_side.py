"""On which side of the road traffic drives: what a map and its position tell, and what the user says.

A reader of roads collects :class:`Evidence` in its map (rings of one-way streets, tags, lanes of opposite directions).
:func:`side_at` adds the side of the country, and :func:`choose_side` decides, or stops where they contradict each
other.

The countries are ``left_hand_traffic.json``, made from the npm package @rapideditor/country-coder 5.6.1 (ISC licence)::

    npm pack @rapideditor/country-coder@5.6.1 && tar xf rapideditor-country-coder-5.6.1.tgz
    jq -c '.features[] | select(.properties.driveSide == "left")
           | {type, properties: {name: .properties.nameEn}, geometry}' package/src/data/borders.json

with these 106 features as rows of a FeatureCollection. Outlines are simplified: they run through the sea, and may be
some hundred metres off on land (:data:`NEAR_BORDER_M`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import shapely
from shapely.geometry import Point
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.formats.georeference import WorldFrame

Side = Literal["left", "right"]

COUNTRIES_FILE = Path(__file__).with_name("left_hand_traffic.json")

NEAR_BORDER_M = 3000.0
"""Nearer than this to countries where traffic drives on the other side, the position decides only where the map does
not.
"""

ANONYMOUS_DEG = 0.5
"""Maps nearer than this to latitude 0, longitude 0 (in the sea) hide where they are."""

CLEAR_MAJORITY = 0.8

_M_PER_DEG = 111_195.0


class Evidence(NamedTuple):
    """What tells the side of traffic.

    Attributes
    ----------
    side
        The side.
    reason
        Why, e.g. ``"the map lies in Japan"``.
    is_strong
        Whether it counts where other evidence contradicts it.
    """

    side: Side
    reason: str
    is_strong: bool = True


@dataclass(frozen=True)
class DrivingSide:
    """The side on which traffic drives, and a sentence that says why."""

    lefthand: bool
    note: str


@cache
def _countries() -> tuple[tuple[str, ...], tuple[BaseGeometry, ...], BaseGeometry]:
    """Return names and outlines of the countries with left-hand traffic, and the border around all of them."""
    features = json.loads(COUNTRIES_FILE.read_text(encoding="utf-8"))["features"]
    outlines = tuple(shapely.make_valid(shapely.geometry.shape(feature["geometry"])) for feature in features)
    names = tuple(feature["properties"]["name"] for feature in features)
    return names, outlines, shapely.union_all(outlines).boundary


def left_hand_country(lat_deg: float, lon_deg: float) -> str | None:
    """Return the country, island or region with left-hand traffic at a position; None elsewhere.

    >>> left_hand_country(51.13, 1.31), left_hand_country(50.95, 1.86)
    ('England', None)
    """
    names, outlines, _ = _countries()
    point = Point(lon_deg, lat_deg)
    return next((name for name, outline in zip(names, outlines, strict=True) if outline.covers(point)), None)


def side_at(lat_deg: float, lon_deg: float) -> Evidence | None:
    """Return the side of traffic at a position in degrees; None for a map that hides its position."""
    if max(abs(lat_deg), abs(lon_deg)) < ANONYMOUS_DEG:
        return None
    country = left_hand_country(lat_deg, lon_deg)
    side: Side = "right" if country is None else "left"
    reason = (
        "the map lies outside the countries with left-hand traffic" if country is None else f"the map lies in {country}"
    )
    border_m = _border_m(lat_deg, lon_deg)
    if border_m < NEAR_BORDER_M:
        return Evidence(side, f"{reason}, but {border_m / 1000:.1f} km from a border where the side changes", False)
    return Evidence(side, reason)


def side_in_frame(frame: WorldFrame | None, at_m: Sequence[float]) -> Evidence | None:
    """Return the side of traffic at a position of a world frame, as weak evidence beside lanes that tell the side; None
    where the frame is unknown.
    """
    if frame is None:
        return None
    ((lon_deg, lat_deg),) = frame.to_degrees(np.array([at_m[:2]], dtype=np.float64)).tolist()
    evidence = side_at(lat_deg, lon_deg) if math.isfinite(lat_deg + lon_deg) else None
    return None if evidence is None else evidence._replace(is_strong=False)


def _border_m(lat_deg: float, lon_deg: float) -> float:
    """Return about how far away the side of traffic changes."""
    _, _, border = _countries()
    shrink = math.cos(math.radians(lat_deg))
    reach_deg = 2 * NEAR_BORDER_M / _M_PER_DEG / max(shrink, 0.01)
    west_deg, south_deg = lon_deg - reach_deg, lat_deg - reach_deg
    near = shapely.clip_by_rect(border, west_deg, south_deg, lon_deg + reach_deg, lat_deg + reach_deg)
    if near.is_empty:
        return math.inf
    near_m = shapely.transform(near, lambda points: (points - [lon_deg, lat_deg]) * [shrink * _M_PER_DEG, _M_PER_DEG])
    return float(near_m.distance(Point(0.0, 0.0)))


def majority(left: float, right: float, reasons: tuple[str, str]) -> Evidence | None:
    """Return the evidence of most objects of a map.

    Parameters
    ----------
    left, right
        Number or length of the objects that tell left-hand and right-hand traffic.
    reasons
        Why, for left-hand and for right-hand traffic.

    Returns
    -------
    Evidence or None
        None without a majority of :data:`CLEAR_MAJORITY`.
    """
    if max(left, right) < CLEAR_MAJORITY * (left + right) or not left + right:
        return None
    return Evidence("left", reasons[0]) if left > right else Evidence("right", reasons[1])


def requested_left(*, lefthand: bool, righthand: bool) -> bool | None:
    """Return whether left-hand traffic was requested; None if nothing was, InputError if both sides were."""
    if lefthand and righthand:
        raise InputError("--lefthand", "cannot be combined with --righthand", "Use one of them.")
    return lefthand if lefthand or righthand else None


def choose_side(
    lefthand: bool | None, of_map: Sequence[Evidence], of_position: Evidence | None, where: str
) -> DrivingSide:
    """Decide on which side traffic drives.

    An option overrides the position, which may be made up, and a map that contradicts itself or its position. It does
    not override a map that tells the other side, and whose position does not tell otherwise.

    Parameters
    ----------
    lefthand
        What the user says (``--lefthand``, ``--righthand``); None for nothing.
    of_map
        What the map tells.
    of_position
        What its position tells; None if it is unknown.
    where
        The file, for messages.

    Raises
    ------
    InputError
        When the map contradicts the option, or nothing was said and the map contradicts itself or its position.
    """
    if lefthand is not None:
        return _requested_side(lefthand, of_map, of_position, where)
    evidence = [*of_map]
    if of_position is not None and (of_position.is_strong or not of_map):
        evidence.append(of_position)
    sides = {one.side for one in evidence}
    if len(sides) > 1:
        left, right = (_reasons([one for one in evidence if one.side == side]) for side in ("left", "right"))
        problem = f"the side of traffic is unclear: the left, as {left}; the right, as {right}"
        raise InputError(where, problem, "Add --lefthand or --righthand.")
    if not evidence:
        return DrivingSide(False, "Traffic drives on the right: neither the map nor its position tells the side.")
    side = sides.pop()
    note = f"Traffic drives on the {side}: {_reasons(evidence)}"
    if of_position is not None and of_position.side != side:
        note = f"{note}, although {of_position.reason}"
    return DrivingSide(side == "left", f"{note}.")


def _requested_side(
    lefthand: bool, of_map: Sequence[Evidence], of_position: Evidence | None, where: str
) -> DrivingSide:
    side: Side = "left" if lefthand else "right"
    against = [one for one in of_map if one.side != side]
    is_supported = of_position is not None and of_position.is_strong and of_position.side == side
    if against and len(against) == len(of_map) and not is_supported:
        other = against[0].side
        problem = f"is for {other}-hand traffic: {_reasons(against)}, so traffic drives on the {other}"
        raise InputError(where, problem, f"Leave out --{side}hand.")
    note = f"Traffic drives on the {side}, as requested"
    if of_position is not None and of_position.side != side:
        against.append(of_position)
    if against:
        note = f"{note}, although {_reasons(against)}"
    return DrivingSide(lefthand, f"{note}.")


def _reasons(evidence: Sequence[Evidence]) -> str:
    return ", and ".join(one.reason for one in evidence)
