"""Compare measured scans with the static world at the stated poses.

A measured scan is wrong where its points are in another frame than the scenario says: in the sensor's, mirrored, in
feet, or of another site. Each of these is a *reading* of the file: positions of the points relative to a sensor. For
each reading, the world is cast along the directions of the points.

A point *agrees* if it is on the surface that its beam meets, to :data:`ON_SURFACE_M` and :data:`ON_SURFACE_SHARE` of
its range, at right angles to that surface: a small error of the pose moves ground far along the beam, but hardly away
from the ground. Where effects let beams through a surface, such as the crown of a tree, points on it agree, and points
behind it.

A scan that is moved by a metre, or turned by some degrees, is in the right frame. So the move that brings the points
onto the surfaces that their beams meet is computed, once (:func:`_moved_reading`); it is a warning if many more points
that are not on the ground agree then.

Ground looks the same in many readings, so a reading fits clearly better if many more points agree
(:data:`MIN_LARGE_GAIN`), or some more (:data:`MIN_GAIN`) and many of those that are not on the ground
(:data:`MIN_STRUCTURE_GAIN`). Traffic, and what the map leaves out, agree in no reading. No pose is searched: the stated
one is right or almost right, or one of the readings is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from egvs.core.errors import Diagnostic
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.wording import format_percent, number_of
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose, Site

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

NEAR_SURFACE_M = 3.0
"""A point that is farther from the surface that its beam meets says nothing about a small move."""

MIN_MOVE_M, MIN_TURN_DEG = 0.25, 0.5
"""A smaller move and turn are within the accuracy of maps and poses."""

MIN_MOVED_POINTS = 20
"""A move fits better if at least this number of points that are not on the ground agree more, and
:data:`MIN_STRUCTURE_GAIN` of them."""

_MOVE_STEPS = 10
_AS_GOOD_SHARE = 0.01
_RIDGE = 1e-3
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

    def fits_better_after_move(self, other: Agreement) -> bool:
        """Whether more points agree than before a small move, and clearly more of those that are not on the ground."""
        if self.on_structure - other.on_structure < MIN_MOVED_POINTS or self.share <= other.share:
            return self.fits_better_than(other)
        return self.structure_share - other.structure_share >= MIN_STRUCTURE_GAIN


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
    moved, moved_agreement = _best_move(worlds, readings[0], agreement)
    if moved_agreement.share > best_agreement.share:
        problem = f"{text}; {format_percent(moved_agreement.share, 0)} would be {moved.name}"
        hint = "Check the pose, and the position of the static world."
        yield Diagnostic("measured scan", where, problem, hint)
    elif best_agreement.share >= MIN_AGREEING and best_agreement.fits_better_than(agreement):
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


def _best_move(worlds: Sequence[Scanner], reading: Reading, agreement: Agreement) -> tuple[Reading, Agreement]:
    """Return the reading after a small move, and its agreement; those of the stated reading if no move fits better.

    A shift alone, or a turn alone, is preferred to both if as many points agree.
    """
    moved = [(reading, agreement)]
    for parts in (slice(3, 6), slice(0, 3), slice(0, 6)):
        candidate = _moved_reading(worlds[0], reading, parts)
        if candidate is None:
            continue
        moved_agreement = compare_with_world(worlds, candidate)
        if moved_agreement.fits_better_after_move(agreement):
            moved.append((candidate, moved_agreement))
    best_share = max(moved_agreement.share for _, moved_agreement in moved)
    return next(pair for pair in moved if pair[1].share >= best_share - _AS_GOOD_SHARE)


def _moved_reading(scanner: Scanner, reading: Reading, parts: slice) -> Reading | None:
    """Return a reading moved a little, so that its points are on the surfaces that their beams meet.

    The move minimises the distances of the points from these surfaces, at right angles to them, in a linear
    approximation; points far from theirs have no weight. Nothing is cast again.

    Parameters
    ----------
    scanner
        The scanner of the scene.
    reading
        The reading.
    parts
        Which parts of the move are free: the turn about the axes x, y, z of the world, and the shift along them.

    Returns
    -------
    Reading or None
        None where the move is within the accuracy of maps and poses.
    """
    range_m = np.linalg.norm(reading.ends_m, axis=1)
    ends_m = reading.ends_m[range_m > _MIN_RANGE_M]
    hits_m, normals, _ = _surfaces_met(scanner, reading.pose, ends_m)
    off_m = ((ends_m - hits_m) * normals).sum(axis=1)
    is_near = np.abs(off_m) <= NEAR_SURFACE_M
    ends_m, normals, off_m = ends_m[is_near], normals[is_near], off_m[is_near]
    slopes = np.column_stack([np.cross(ends_m, normals), normals])[:, parts]
    move = np.zeros(6)
    for _ in range(_MOVE_STEPS):
        left_m = off_m + slopes @ move[parts]
        weighted = slopes / (1.0 + (left_m / ON_SURFACE_M) ** 2)[:, None]
        matrix = weighted.T @ slopes + _RIDGE * np.eye(slopes.shape[1])
        move[parts] = np.linalg.solve(matrix, -weighted.T @ off_m)
    turn_rad, shift_m = move[:3], move[3:]
    turn_deg, distance_m = float(np.rad2deg(np.linalg.norm(turn_rad))), float(np.linalg.norm(shift_m))
    words = []
    if distance_m >= MIN_MOVE_M:
        words.append("moved by ({:+.1f}, {:+.1f}, {:+.1f}) m".format(*(np.round(shift_m, 1) + 0.0)))
    if turn_deg >= MIN_TURN_DEG:
        words.append(f"turned by {turn_deg:.1f} degrees about the sensor")
    if not words:
        return None
    return Reading(f"if {' and '.join(words)}", reading.pose, reading.ends_m @ _rotation(turn_rad).T + shift_m)


def _rotation(turn_rad: FloatArray) -> FloatArray:
    """Return the matrix of a rotation about an axis, by the length of the vector."""
    from scipy.spatial.transform import Rotation

    matrix: FloatArray = Rotation.from_rotvec(turn_rad).as_matrix()
    return matrix


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


def _compare_points(
    scanner: Scanner, pose: Pose, ends_m: FloatArray, range_m: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return whether points are on the surface that their beam meets, and whether that is the ground, (n,) each."""
    hits_m, normals, is_ground = _surfaces_met(scanner, pose, ends_m)
    off_m = np.abs(((hits_m - ends_m) * normals).sum(axis=1))
    return off_m <= ON_SURFACE_M + ON_SURFACE_SHARE * range_m, is_ground


def _surfaces_met(scanner: Scanner, pose: Pose, ends_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return where the beams through points meet a surface, its normal there, (n, 3), and whether it is the ground.

    Positions are relative to the sensor; positions and normals are NaN where a beam meets nothing.
    """
    world = scanner.opaque_world
    range_m = np.linalg.norm(ends_m, axis=1)
    hits = scanner.sweep_from(pose, ends_m / range_m[:, None], 2.0 * float(range_m.max()))
    face = hits.face
    assert face is not None, "a sweep has faces"
    hit = face >= 0
    corners_m = world.triangles_m[face[hit]]
    hits_m, normals = np.full((2, *ends_m.shape), np.nan)
    hits_m[hit] = hits.ends_m[hit]
    normals[hit] = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    is_ground = np.zeros(len(ends_m), dtype=np.bool_)
    ground_solids = np.array([kind == "ground" for _, kind in world.solids], dtype=np.bool_)
    is_ground[hit] = ground_solids[world.solid_of_face[face[hit]]]
    return hits_m, normals, is_ground
