"""Compare measured scans with the static world at the stated poses.

A measured scan is wrong where its points are in another frame than the scenario says: in the sensor's, mirrored, in
feet, or of another site. Each of these is a *reading* of the file: positions of the points relative to a sensor. For
each reading, the world is cast along the directions of the points.

A point *agrees* if it is on the surface that its beam meets, to :data:`ON_SURFACE_M` and :data:`ON_SURFACE_SHARE` of
its range, at right angles to that surface: a small error of the pose moves ground far along the beam, but hardly away
from the ground. Where effects let beams through a surface, such as the crown of a tree, points on it agree, and points
behind it.

Ground looks the same in many readings, so a reading fits clearly better if many more points agree
(:data:`MIN_LARGE_GAIN`), or some more (:data:`MIN_GAIN`) and many of those that are not on the ground
(:data:`MIN_STRUCTURE_GAIN`). Traffic, and what the map leaves out, agree in no reading. Nothing is searched: the stated
pose is right, or one of the readings is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent, number_of
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose, Site

Bools = NDArray[np.bool_]

ON_SURFACE_M, ON_SURFACE_SHARE = 0.3, 0.01
"""A point that is no farther from a surface than this distance and this share of its range together is on it."""

MIN_GAIN, MIN_STRUCTURE_GAIN, MIN_POINTS = 0.05, 0.3, 50
"""A reading fits better if this share of all points and this number of them more agree, and this share of those that
are not on the ground."""

MIN_LARGE_GAIN = 0.3
"""A reading also fits better if this share of all points more agrees."""

MIN_AGREEING = 0.5
"""Share of points that agree in a reading that fits."""

MAX_REPEATED = 0.1
"""Share of repeated points that is an error: each counts as a beam of its own."""

MAX_OTHER_SITES = 20
"""Number of other sites, the nearest ones, that a scan is compared with."""

_MAX_POINTS = 2000
_MAX_COMPARED = 2_000_000
_MIN_RANGE_M = 0.1
_FOOT_M = 0.3048

_MIRRORED = {
    "with y mirrored": np.diag([1.0, -1.0, 1.0]),
    "with x mirrored": np.diag([-1.0, 1.0, 1.0]),
    "with z mirrored": np.diag([1.0, 1.0, -1.0]),
    "with x and y swapped": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}


@dataclass(frozen=True)
class Reading:
    """A way to read the points of a scan.

    Attributes
    ----------
    name
        What the points are then, in words; empty for the stated reading.
    pose
        Where the scan was measured then.
    ends_m
        The points relative to the sensor, along the world axes, (n, 3).
    is_scaled
        Whether distances change. Then flat ground near z = 0 says little: points of any height come nearer to it.
    """

    name: str
    pose: Pose
    ends_m: FloatArray
    is_scaled: bool = False


@dataclass(frozen=True)
class Agreement:
    """How well the points of a reading agree with the static world.

    Attributes
    ----------
    points
        Number of compared points; those at the sensor agree with nothing.
    on_ground, on_structure
        Those that agree with the ground, and with other surfaces.
    """

    points: int
    on_ground: int
    on_structure: int

    @property
    def share(self) -> float:
        """Share of points that agree."""
        return (self.on_ground + self.on_structure) / self.points

    @property
    def structure_share(self) -> float:
        """Share of points that agree, of those that are not on the ground; 0 if all are on the ground."""
        return self.on_structure / max(self.points - self.on_ground, 1)

    def fits_better_than(self, other: Agreement, *, needs_structure: bool = False) -> bool:
        """Whether clearly more points agree, also of those that are not on the ground."""
        gain = self.share - other.share
        structure_gain = self.structure_share - other.structure_share
        if gain * self.points < MIN_POINTS:
            return False
        return (gain >= MIN_LARGE_GAIN and not needs_structure) or (
            gain >= MIN_GAIN and structure_gain >= MIN_STRUCTURE_GAIN
        )


def check_measured_scans(scanner: Scanner, sites: Sequence[Site]) -> Iterator[Diagnostic]:
    """Yield what is wrong or doubtful with the measured scans of some sites.

    Parameters
    ----------
    scanner
        The scanner of their scene.
    sites
        All sites; those without a measured scan are only compared with the scans of others.

    Raises
    ------
    InputError
        When a scan cannot be read.
    """
    worlds = [scanner]
    if scanner.opaque_world is not scanner.scene.world:
        worlds.append(Scanner(replace(scanner.scene, effects=())))
    for site in sites:
        if site.points is None:
            continue
        points_m = scanner.read_measured(site)
        where = f"site {site.name}: points: {site.points}"
        yield from _warn_repeated(points_m, scanner.scene.sensor(site.sensor).beams, where)
        yield from _warn_other_reading(worlds, site, points_m, sites, where)


def _warn_repeated(points_m: FloatArray, beams: int, where: str) -> Iterator[Diagnostic]:
    """Report points that occur twice, and scans with more points than the sensor has beams."""
    compared = points_m
    if len(points_m) > _MAX_COMPARED:  # the same x gives the same choice, so equal points stay together
        every = np.uint64(len(points_m) // _MAX_COMPARED + 1)
        compared = points_m[(points_m[:, 0].copy().view(np.uint64) >> np.uint64(20)) % every == 0]
    ordered = compared[np.lexsort(compared.T)]
    repeated = int((np.diff(ordered, axis=0) == 0.0).all(axis=1).sum())
    if repeated:
        problem = (
            f"expected each point once, got {repeated:,} repeated ones in {number_of(len(compared), 'point')}, which"
            " would count as beams of their own"
        )
        is_error = repeated > MAX_REPEATED * len(compared)
        yield Diagnostic("repeated points", where, problem, "Write each return once.", is_error)
    elif len(points_m) > beams:
        problem = f"{number_of(len(points_m), 'point')}, but one turn of the sensor has {number_of(beams, 'beam')}"
        hint = "Use one turn, with one return for each beam; each point counts as a beam."
        yield Diagnostic("repeated points", where, problem, hint)


def _warn_other_reading(
    worlds: Sequence[Scanner], site: Site, points_m: FloatArray, sites: Sequence[Site], where: str
) -> Iterator[Diagnostic]:
    """Report a scan that fits the static world better in another reading, or in none."""
    if not worlds[0].scene.world.faces.size:
        return
    if len(points_m) > _MAX_POINTS:
        chosen = np.random.default_rng(0).choice(len(points_m), _MAX_POINTS, replace=False)
        points_m = points_m[np.sort(chosen)]
    readings = list(_readings(site, points_m, sites))
    agreements = [compare_with_world(worlds, reading) for reading in readings]
    agreement, best_agreement, best = agreements[0], agreements[0], readings[0]
    for reading, other in zip(readings, agreements, strict=True):
        if reading.is_scaled and not other.fits_better_than(agreement, needs_structure=True):
            continue
        if other.share > best_agreement.share:
            best_agreement, best = other, reading
    text = (
        f"{format_percent(agreement.share, 0)} of {number_of(agreement.points, 'compared point')} are on surfaces of"
        " the static world, seen from the site"
    )
    if best_agreement.share >= MIN_AGREEING and best_agreement.fits_better_than(agreement):
        problem = f"{text}; {format_percent(best_agreement.share, 0)} would be {best.name}"
        hint = "Save the points of this site, in the world frame; check the pose."
        yield Diagnostic("measured scan", where, problem, hint, is_error=True)
    elif best_agreement.share < MIN_AGREEING:
        problem = f"{text}, and no more in the sensor's frame, mirrored, or from the other sites"
        yield Diagnostic("measured scan", where, problem, "Check the pose, the points and the static world.")


def _readings(site: Site, points_m: FloatArray, sites: Sequence[Site]) -> Iterator[Reading]:
    """Yield the readings of the points of a site's file, (n, 3), the stated one first."""
    position_m = np.asarray(site.pose.position_m)
    rotation = rotation_world_sensor(*site.pose.angles_deg)
    yield Reading("", site.pose, points_m - position_m)
    yield Reading("in the sensor's frame", site.pose, points_m @ rotation.T)
    yield Reading("relative to the sensor, along the axes of the world", site.pose, points_m)
    yield Reading("in feet", site.pose, points_m * _FOOT_M - position_m, is_scaled=True)
    for name, mirror in _MIRRORED.items():
        yield Reading(f"in the world frame {name}", site.pose, points_m @ mirror - position_m)
        yield Reading(f"{name} about the sensor", site.pose, (points_m - position_m) @ mirror)
        yield Reading(
            f"{name} in the sensor's frame about it",
            site.pose,
            (points_m - position_m) @ rotation @ mirror @ rotation.T,
        )
        yield Reading(f"in the sensor's frame {name}", site.pose, points_m @ mirror @ rotation.T)
    distances_m = {
        number: float(np.linalg.norm(np.subtract(other.pose.position_m, position_m)))
        for number, other in enumerate(sites)
        if other.pose != site.pose
    }
    for number in sorted(distances_m, key=distances_m.__getitem__)[:MAX_OTHER_SITES]:
        other = sites[number]
        yield Reading(f"of site {other.name}", other.pose, points_m - np.asarray(other.pose.position_m))
        turned = points_m @ rotation_world_sensor(*other.pose.angles_deg).T
        yield Reading(f"of site {other.name}, in its sensor's frame", other.pose, turned)


def compare_with_world(worlds: Sequence[Scanner], reading: Reading) -> Agreement:
    """Count the points of a reading that are on surfaces of the static world.

    Parameters
    ----------
    worlds
        Scanners of the scene, with different surfaces that let beams through.
    reading
        The reading.
    """
    range_m = np.linalg.norm(reading.ends_m, axis=1)
    ends_m = reading.ends_m[range_m > _MIN_RANGE_M]
    range_m = range_m[range_m > _MIN_RANGE_M]
    on_ground, on_structure = np.zeros((2, len(ends_m)), dtype=np.bool_)
    if len(ends_m):
        for scanner in worlds:
            is_on_surface, is_ground = _compare_points(scanner, reading.pose, ends_m, range_m)
            on_ground |= is_on_surface & is_ground
            on_structure |= is_on_surface & ~is_ground
    return Agreement(len(reading.ends_m), int((on_ground & ~on_structure).sum()), int(on_structure.sum()))


def _compare_points(scanner: Scanner, pose: Pose, ends_m: FloatArray, range_m: FloatArray) -> tuple[Bools, Bools]:
    """Return whether points are on the surface that their beam meets, and whether that is the ground, (n,) each."""
    world = scanner.opaque_world
    hits = scanner.sweep_from(pose, ends_m / range_m[:, None], 2.0 * float(range_m.max()))
    face = hits.face
    assert face is not None, "a sweep has faces"
    hit = face >= 0
    corners_m = world.triangles_m[face[hit]]
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    off_m = np.abs(((hits.ends_m[hit] - ends_m[hit]) * normals).sum(axis=1))
    is_on_surface, is_ground = np.zeros((2, len(ends_m)), dtype=np.bool_)
    is_on_surface[hit] = off_m <= ON_SURFACE_M + ON_SURFACE_SHARE * range_m[hit]
    ground_solids = np.array([kind == "ground" for _, kind in world.solids], dtype=np.bool_)
    is_ground[hit] = ground_solids[world.solid_of_face[face[hit]]]
    return is_on_surface, is_ground
