"""Brings the coordinates of a user's files into the world frame, and refuses those that cannot be told.

A file's coordinates are metres of the world frame, degrees, or what the file itself declares. Where it declares
nothing, they are judged by what the numbers can be, and by where they would lie beside the region of interest:

- degrees lie within +-180 and +-90, near each other, and near the region of interest;
- metres of things that stand or drive are not all within a centimetre of each other;
- what lies far from the region of interest can play no part, so it is in other coordinates.

What fits nothing is refused, with what it would be in each reading. x is east (or longitude), y north (or latitude).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.grid import Roi
from pipeline.formats import crs as systems
from pipeline.formats.crs import WorldFrame

Floats = NDArray[np.float64]

WORLD = "metres of the world frame"
"""What a file declares that says so itself: by ``"crs": null``, by a local system, by the names of its columns."""

NEAR_M, FAR_M, COUNTRY_M = 1_000.0, 10_000.0, 100_000.0
"""From the region of interest: where small numbers may be metres, where things may stand, where degrees belong."""

_CLOSE_M, _SMALL_M, _SPREAD_DEG, _NUMBER_M = 0.01, 1.0, 5.0, 1e9
_DIGITS_M, _DIGITS_DEG = 6, 9  # a micrometre, 0.1 mm: last bits of a machine's sines do not travel on
_DECLARE = (
    '"crs" in the file: "urn:ogc:def:crs:OGC:1.3:CRS84" for degrees, "urn:ogc:def:crs:EPSG::..." for a projection,'
    " null for metres of the world frame"
)


@dataclass(frozen=True)
class Reading:
    """What a file's coordinates are taken for, in words, and how they become the world frame's (None: they are)."""

    words: str
    convert: Callable[[Floats], Floats] | None = None
    place: str = ""

    def to_world(self, xy: Floats) -> Floats:
        """World-frame x, y in metres, (n, 2) float64, of coordinates (n, 2); InputError for what has no place there."""
        if self.convert is None:
            return xy
        xy_m = np.round(self.convert(xy), _DIGITS_M) + 0.0  # no -0
        for i in np.flatnonzero(~np.isfinite(xy_m).all(axis=1)):
            found = f"({xy[i, 0]:.10g}, {xy[i, 1]:.10g}) has no place in the scenario's projection"
            raise InputError(self.place, found, self.words)
        return xy_m


IN_WORLD = Reading(WORLD)
"""Of coordinates that are the world frame's already."""


@dataclass(frozen=True)
class Georeference:
    """Where a scenario's world frame lies on the Earth, if that is known, and its region of interest.

    Attributes
    ----------
    frame
        None where neither the scenario nor its network says it.
    roi
        The region of interest.
    place
        The scenario's file, for messages.
    """

    frame: WorldFrame | None
    roi: Roi
    place: str

    def reading(self, xy: Floats, place: str, declared: str | None = None, right: str = _DECLARE) -> Reading:
        """What a file's coordinates are.

        Parameters
        ----------
        xy
            Its coordinates (n, 2), or enough of them to judge by; finite.
        declared
            The coordinate reference system that the file names, :data:`WORLD`, or None where it names none.
        right
            How such a file says what its coordinates are, for messages.

        Raises
        ------
        InputError
            At ``place``, where they are in nothing that is known, or lie far from the region of interest.
        """
        if declared is not None and declared != WORLD:
            reading = self._declared(xy, place, declared)
        elif declared == WORLD or not len(xy):
            self.metres(xy, place, right)
            if self.frame is None and len(xy) and _may_be_degrees(xy) and 0 < np.ptp(xy, axis=0).max() < _CLOSE_M:
                raise self.unknown(place, f"{_span(xy)} look like longitude and latitude", xy)  # no thing is so thin
            reading = IN_WORLD
        else:
            reading = self._judged(xy, place, right)
        self._check_near(reading, xy, place, right)
        return reading

    def of_frame(self, other: WorldFrame | None, xy_m: Floats, place: str, right: str) -> Reading:
        """The reading of a file that has a world frame of its own; None: it says nothing, so it is in this one."""
        frame, reading = self.frame, IN_WORLD
        if other is not None and frame is not None and other != frame:
            reading = Reading(
                "metres of its own <location>", lambda xy: frame.from_degrees(other.to_degrees(xy)), place
            )
        self._check_near(reading, xy_m, place, right)
        return reading

    def metres(self, xy_m: Floats, place: str, right: str) -> None:
        """InputError at ``place`` where columns or a mesh that should be in world-frame metres hold degrees, or what
        lies far from the region of interest."""
        if not len(xy_m):
            return
        if self.frame is not None and _may_be_degrees(xy_m) and _is_collapsed(xy_m):
            away_m = self.distance_m(self.frame.from_degrees(xy_m))
            if away_m <= COUNTRY_M:
                found = f"{_span(xy_m)} are longitude and latitude: {_far(away_m)} from the region of interest as such"
                raise InputError(place, found, right)
        self._check_near(IN_WORLD, xy_m, place, right)

    def lon_lat_deg(self, xy_m: Floats) -> Floats | None:
        """Longitude and latitude (WGS 84), (n, 2), of world-frame points, to 1e-9 degree; None where not known."""
        return None if self.frame is None else np.round(self.frame.to_degrees(xy_m), _DIGITS_DEG)

    def distance_m(self, xy_m: Floats) -> float:
        """From the region of interest to the nearest of some world-frame points, seen from above; inf for none."""
        low = np.asarray(self.roi.origin_m[:2])
        gaps = np.maximum(np.maximum(low - xy_m, xy_m - low - np.asarray(self.roi.size_m[:2])), 0.0)
        away = np.hypot(gaps[:, 0], gaps[:, 1])
        return float(np.min(away, initial=np.inf, where=np.isfinite(away)))

    def unknown(self, place: str, what: str, lon_lat_deg: Floats | None = None) -> InputError:
        """The error for coordinates on the Earth in a scenario that does not say where its world frame lies."""
        zone = ""
        if lon_lat_deg is not None and len(lon_lat_deg):
            zone = f" (UTM there: {systems.utm_epsg(*map(float, np.median(lon_lat_deg, axis=0)))})"
        found = f"{what}, and nothing says where the scenario's world frame lies on the Earth"
        right = f"[crs] with epsg{zone} and offset_m in {self.place}, or a network with a <location>"
        return InputError(place, found, right)

    def _declared(self, xy: Floats, place: str, declared: str) -> Reading:
        frame, found = self.frame, systems.parsed(declared, place)
        if found.is_engineering:
            return IN_WORLD
        if frame is not None:
            return Reading(found.name, lambda points: frame.from_crs(points, declared), place)
        if found.is_projected and all(axis.unit_name == "metre" for axis in found.axis_info[:2]):
            return Reading(f"{found.name}, which the world frame would have to be")
        raise self.unknown(place, f"is in {found.name}", xy if found.is_geographic else None)

    def _judged(self, xy: Floats, place: str, right: str) -> Reading:
        """The reading of coordinates that nobody has declared."""
        if not _may_be_degrees(xy):
            if (odd := _no_degrees_among_degrees(xy)) is not None:
                found = f"{_span(xy)} are no metres (most lie within {_CLOSE_M:g} m of the next),"
                found += f" and ({odd[0]:.10g}, {odd[1]:.10g}) is no longitude and latitude beside the others"
                raise InputError(place, found, right)
            return IN_WORLD
        if self.frame is not None:
            believed_m = COUNTRY_M if _is_one_place(xy) else NEAR_M
            if self.distance_m(self.frame.from_degrees(xy)) <= believed_m:
                return Reading("degrees", self.frame.from_degrees, place)
        if _is_collapsed(xy) or self.distance_m(xy) > NEAR_M:
            if self.frame is None:
                raise self.unknown(place, f"{_span(xy)} look like longitude and latitude", xy)
            raise self._neither(xy, place, right)
        return IN_WORLD

    def _check_near(self, reading: Reading, xy: Floats, place: str, right: str) -> None:
        if len(xy) and self.distance_m(reading.to_world(xy)) > FAR_M:
            raise self._neither(xy, place, right, reading)

    def _neither(self, xy: Floats, place: str, right: str, taken: Reading | None = None) -> InputError:
        """The error for coordinates that lie far from everything; names what they would lie near as."""
        away_m = {words: self.distance_m(points) for words, points in self._others(xy)}
        told = [f"{_far(away)} from it as {words}" for words, away in away_m.items()]
        found = f"{_span(xy)} lie far from the region of interest"
        if taken is not None:
            found += f" ({_far(self.distance_m(taken.to_world(xy)))}) as {taken.words}"
        nearest = min(away_m, key=lambda words: away_m[words], default="")
        cure = f"they would lie beside it as {nearest}; " if away_m.get(nearest, np.inf) <= FAR_M else ""
        return InputError(place, f"{found} ({', '.join(told)})" if taken is None else found, cure + right)

    def _others(self, xy: Floats) -> Iterator[tuple[str, Floats]]:
        """What else coordinates may be."""
        if not _is_collapsed(xy):
            yield WORLD, xy
        if self.frame is not None:
            if (np.abs(xy) <= (180.0, 90.0)).all():
                yield "degrees", self.frame.from_degrees(xy)
            if (np.abs(xy) <= (90.0, 180.0)).all():
                yield "latitude and longitude, in the wrong order", self.frame.from_degrees(xy[:, ::-1])
            name = self.frame.projection if self.frame.projection.startswith("EPSG") else "the network's projection"
            yield f"eastings and northings of {name}", xy + np.asarray(self.frame.offset_m)


def declared_by(document: Mapping[str, Any], place: str) -> str | None:
    """What GeoJSON declares in its member ``crs`` (GeoJSON 2008; RFC 7946 has none): a name, :data:`WORLD` for null,
    None where there is no such member. InputError at ``place`` where it names nothing that PROJ knows.
    """
    match document.get("crs", ""):
        case "":
            return None
        case None:
            return WORLD
        case {"properties": {"name": str(name)}}:
            systems.parsed(name, f"{place}: crs")
            return name
        case other:
            right = '{"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}, or null'
            raise InputError(f"{place}: crs", repr(other)[:120], right)


def coordinates_of(features: Iterable[Any]) -> Floats:
    """All pairs of coordinates in GeoJSON features, in their order, (n, 2); what is no number is left to its reader."""
    pairs, waiting = list[tuple[float, float]](), list(features)[::-1]
    while waiting:
        match waiting.pop():
            case dict(item):
                waiting += [item[key] for key in ("geometry", "geometries", "coordinates") if key in item]
            case [int() | float() as x, int() | float() as y, *_] if abs(x) <= _NUMBER_M and abs(y) <= _NUMBER_M:
                pairs.append((float(x), float(y)))
            case list(item):
                waiting += item[::-1]
    return np.array(pairs, dtype=np.float64).reshape(-1, 2)


def _may_be_degrees(xy: Floats) -> bool:
    """Whether numbers can be longitude and latitude of things in one place."""
    return bool((np.abs(xy) <= (180.0, 90.0)).all() and np.ptp(xy, axis=0).max() <= _SPREAD_DEG)


def _is_one_place(xy: Floats) -> bool:
    """Whether numbers, as metres, would all be at one place: degrees of things some metres apart differ by 1e-5 or
    1e-4."""
    if np.ptp(xy, axis=0).max() >= _SMALL_M:
        return False
    return _is_close_together(xy) or not np.diff(xy, axis=0).any()


def _is_close_together(xy: Floats) -> bool:
    """Whether most numbers, as metres, are within a centimetre of the next; not where all are the same."""
    steps = np.hypot(*np.diff(xy, axis=0).T)
    steps = steps[steps > 0]
    return bool(len(steps)) and bool(np.median(steps) < _CLOSE_M)


def _is_collapsed(xy: Floats) -> bool:
    """Whether numbers, as metres, would all be at one place although they differ."""
    return _is_one_place(xy) and bool(np.ptp(xy, axis=0).max() > 0)


def _no_degrees_among_degrees(xy: Floats) -> Floats | None:
    """Of numbers that differ as degrees of buildings do, but cannot all be degrees of one place, one that is none."""
    middle = np.median(xy, axis=0)
    if not _is_close_together(xy) or (np.abs(middle) > (540.0, 90.0)).any():
        return None
    beyond = (np.abs(xy) > (180.0, 90.0)).any(axis=1)
    found: Floats = xy[np.argmax(beyond if beyond.any() else np.abs(xy - middle).max(axis=1))]
    return found


def _span(xy: Floats) -> str:
    """What a message says of coordinates."""
    (x0, y0), (x1, y1) = xy.min(axis=0), xy.max(axis=0)
    if len(xy) == 1:
        return f"its coordinates ({x0:.10g}, {y0:.10g})"
    return f"its coordinates ({x0:.10g} to {x1:.10g}, {y0:.10g} to {y1:.10g})"


def _far(distance_m: float) -> str:
    if not np.isfinite(distance_m):
        return "nowhere near"
    return f"{distance_m / 1000:,.0f} km" if distance_m >= 10_000 else f"{distance_m:.0f} m"
