"""Compare measured scans of an installed sensor with the empty scan that is expected at the same pose.

Steps: cast a beam at the static world in the direction of each measured return; assign each return to the nearest beam
of the sensor; find returns in front of the static world; find azimuths in which something near the sensor stops its
beams, and channels without returns.

Vehicles also return in front of the static world. A return counts as one of an *obstacle* (pole, sign, branch) only if
no vehicle can be there: it is within :data:`NEAR_M` of the sensor, or higher above the ground than vehicles are, or the
beam is stopped in nearly all of several scans. And a sector counts as blocked only if obstacles stop a good part of its
beams. Azimuths and elevations are in the sensor's frame, counter-clockwise from its x axis; poses in the world frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import KDTree

from egvs.clouds.simulation import static_surfaces
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.effects.returns import ReturnProbability
from egvs.extensions.hardware.installation.acceptance_limits import MAX_VEHICLE_HEIGHT_M
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.supports import without_solids

NEAR_M = 1.5
"""No vehicle comes closer to a sensor on a pole than this."""

PERSISTENT_SCANS, PERSISTENT_SHARE = 3, 0.8
"""From so many scans on, a beam that is stopped in this share of them is stopped by an obstacle at any height."""

NEARER_M, NEARER_SHARE = 0.5, 0.05
"""A return is in front of the static world if it is nearer than expected by more than both."""
_BLOCKED_M, _BLOCKED_SHARE = 1.0, 0.3
"""An obstacle is nearer than expected by more than both. A wall that the map puts a little too far away is not."""
_ON_BEAM_DEG = 1.0
"""A return is on no beam of the sensor if the nearest one is farther away."""
_BIN_DEG = 1.0
_BLOCKED_BEAMS, _SILENT_RETURNS = 0.2, 0.1
"""Share of beams with obstacles, or of expected returns that come back, from which and below which a bin is blocked."""
_MIN_EXPECTED = 5
"""Fewest expected returns of a bin, in all, whose absence says something."""
_MIN_SILENT_DEG = 2.0
SURE_RANGE, SURE_PROBABILITY = 0.5, 0.9
"""Surfaces within this share of the sensor's range are expected to return, if losses let so many of them return."""
_CHANNEL_EXPECTED, _CHANNEL_RETURNS = 50, 0.05
"""A channel is checked from so many expected returns on, and missing below this share of them."""
_MAX_CHANNELS = 256
_STRUCTURE_M = 0.5
"""Returns this high above the ground are of structure: walls, poles, vehicles."""
_AGREE_M, _AGREE_SHARE = 0.5, 0.02
"""A return agrees with the static world if they differ by at most one of these."""
_MIN_STRUCTURE = 100


class StaticWorld:
    """The static world around one sensor, without the pole, mast or sign that carries it.

    Parameters
    ----------
    scene
        The scene.
    planned
        The planned pose, which says what carries the sensor.
    """

    def __init__(self, scene: Scene, planned: Pose) -> None:
        supports = scene.own_supports(planned)
        self._scene = scene
        self._world = without_solids(scene.world, supports) if supports else scene.world
        self._caster = Caster(self._world, scene.roi)
        self._ground = _ground_heights(scene.world)

    def ranges_m(self, pose: Pose, directions: FloatArray, range_m: float) -> FloatArray:
        """Return the range at which each beam ends, infinite where it meets nothing, (n,) float64.

        Parameters
        ----------
        pose
            The sensor.
        directions
            Unit vectors in the sensor's frame, (n, 3).
        range_m
            Maximum range.
        """
        scan = self._caster.sweep(pose.position_m, _turn(directions, pose), range_m)
        return np.where(scan.returned, np.linalg.norm(scan.ends_m, axis=1), np.inf)

    def expected_returns(self, pose: Pose, sensor: Sensor) -> tuple[FloatArray, FloatArray]:
        """Return the range at which each beam of a sensor ends, and the probability that it returns, (beams,) each.

        The probability is that of simulated clouds: by range, reflectivity and angle of incidence. It is 1 where the
        scene has no losses of returns, and 0 where a beam meets nothing.
        """
        turned = _turn(sensor.directions(), pose)
        scan = self._caster.sweep(pose.position_m, turned, sensor.range_m)
        assert scan.face is not None
        range_m = np.where(scan.returned, np.linalg.norm(scan.ends_m, axis=1), np.inf)
        probability = scan.returned.astype(np.float64)
        losses = ReturnProbability.of(self._scene, sensor)
        if losses is not None:
            hit = scan.returned
            cosine, reflectivity = static_surfaces(self._world, scan.face[hit], turned[hit])
            probability[hit] = losses(range_m[hit], reflectivity * cosine, np.full(len(cosine), np.nan))
        return range_m, probability

    def heights_m(self, points_m: FloatArray) -> FloatArray:
        """Return the heights of points (n, 3) of the world frame above the ground, (n,) float64."""
        if self._ground is None:
            heights: FloatArray = points_m[:, 2].copy()
            return heights
        linear, nearest = self._ground
        ground_m = linear(points_m[:, :2])
        outside = np.isnan(ground_m)
        ground_m[outside] = nearest(points_m[outside, :2])
        above: FloatArray = points_m[:, 2] - ground_m
        return above


def _turn(directions: FloatArray, pose: Pose) -> FloatArray:
    """Turn directions (n, 3) from the sensor's frame into the world's."""
    return np.ascontiguousarray(directions @ rotation_world_sensor(*pose.angles_deg).T)


def _ground_heights(world: World) -> tuple[LinearNDInterpolator, NearestNDInterpolator] | None:
    """Return the ground as functions of x and y; None where it is z = 0."""
    is_ground = np.array([solid == ("ground", "ground") for solid in world.solids], dtype=np.bool_)
    faces = np.flatnonzero(is_ground[world.solid_of_face])
    vertices = world.vertices_m[np.unique(world.faces[faces])]
    if not len(vertices) or not vertices[:, 2].any():
        return None
    linear = LinearNDInterpolator(vertices[:, :2], vertices[:, 2])
    return linear, NearestNDInterpolator(vertices[:, :2], vertices[:, 2])


@dataclass(frozen=True)
class BlockedSector:
    """Azimuths in which something stops the beams of a sensor.

    Attributes
    ----------
    first_deg, last_deg
        Its ends in the sensor's frame, counter-clockwise; ``first_deg`` is from 0 to 360.
    bearing_deg
        Direction of its middle, degrees clockwise from grid north.
    distance_m
        Median distance of the obstacle; NaN where beams give no return at all.
    elevation_deg
        Lowest and highest elevation of its returns in the sensor's frame; NaN without returns.
    share
        Share of the sector's beams that are stopped.
    """

    first_deg: float
    last_deg: float
    bearing_deg: float
    distance_m: float
    elevation_deg: tuple[float, float]
    share: float

    @property
    def width_deg(self) -> float:
        """Width in azimuth."""
        return self.last_deg - self.first_deg

    @property
    def has_returns(self) -> bool:
        """Whether the obstacle gives returns."""
        return not math.isnan(self.distance_m)


@dataclass(frozen=True, eq=False)
class ScanComparison:
    """Measured scans against the expected empty scan, beam by beam.

    Attributes
    ----------
    scans
        Number of measured scans.
    azimuth_deg, elevation_deg
        Of each beam of the sensor, (beams,) float64; azimuths from 0 to 360.
    expected_m
        Expected range of each beam, infinite for none, (beams,) float64.
    measured_m
        Median measured range of each beam, NaN for none, (beams,) float64.
    returns
        Number of measured returns of all scans.
    off_beams
        Returns on no beam of the sensor.
    nearer
        Returns in front of the static world, traffic included.
    obstacle_beams
        Beams that obstacles stop, ascending.
    obstacle_directions, obstacle_ranges_m
        Returns of obstacles: unit vectors in the sensor's frame (n, 3), and ranges (n,).
    return_share
        Share of the beams whose surface is expected to return that do, as a mean over the scans.
    sectors
        The blocked sectors, by azimuth.
    missing_channels
        Elevations of channels without returns, degrees.
    unchecked_channels
        Number of channels with too few expected returns; None if the sensor has no channels.
    structure_share
        Share of what stands above the ground, measured or expected, in which the scan and the static world agree.
    """

    scans: int
    azimuth_deg: FloatArray
    elevation_deg: FloatArray
    expected_m: FloatArray
    measured_m: FloatArray
    returns: int
    off_beams: int
    nearer: int
    obstacle_beams: IntArray
    obstacle_directions: FloatArray
    obstacle_ranges_m: FloatArray
    return_share: float
    sectors: tuple[BlockedSector, ...]
    missing_channels: tuple[float, ...]
    unchecked_channels: int | None
    structure_share: float

    @property
    def blocked_deg(self) -> float:
        """Width of all blocked sectors together."""
        return math.fsum(sector.width_deg for sector in self.sectors)

    @property
    def nearer_share(self) -> float:
        """Share of the returns in front of the static world."""
        return self.nearer / self.returns


def compare_scans(
    scans: Sequence[FloatArray],
    sensor: Sensor,
    pose: Pose,
    world: StaticWorld,
    max_vehicle_height_m: float = MAX_VEHICLE_HEIGHT_M,
) -> ScanComparison:
    """Compare scans with the expected one at the pose where they were measured.

    Parameters
    ----------
    scans
        Returns of each scan in the sensor's frame, (n, 3) float64 each, finite, none at the origin.
    sensor
        The sensor.
    pose
        Where the scans were measured.
    world
        The static world.
    max_vehicle_height_m
        A single return that is higher above the ground is not of a vehicle.
    """
    beams = sensor.directions()
    expected_m, probability = world.expected_returns(pose, sensor)
    points_m = np.concatenate(list(scans))
    scan_of_point = np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    range_m = np.linalg.norm(points_m, axis=1)
    directions = points_m / range_m[:, None]
    behind_m = world.ranges_m(pose, directions, sensor.range_m)
    distance, beam = KDTree(beams).query(directions)
    on_beam = distance <= 2.0 * math.sin(math.radians(_ON_BEAM_DEG) / 2.0)

    gap_m = behind_m - range_m
    with np.errstate(invalid="ignore"):
        nearer = gap_m > np.maximum(NEARER_M, NEARER_SHARE * behind_m)
        far_nearer = gap_m > np.maximum(_BLOCKED_M, _BLOCKED_SHARE * behind_m)
    is_open = np.isinf(behind_m)
    nearer |= is_open
    far_nearer |= is_open
    world_m = points_m @ rotation_world_sensor(*pose.angles_deg).T + np.asarray(pose.position_m)
    height_m = world.heights_m(world_m)
    impossible = (range_m < NEAR_M) | (height_m > max_vehicle_height_m)
    # A surface that the map ends too low, or leaves out beyond the expected ones, blocks nothing that was expected.
    impossible &= ~is_open | (range_m < SURE_RANGE * sensor.range_m)
    impossible |= _persistent(far_nearer, beam, scan_of_point, len(scans), len(beams))[beam]
    obstacle = far_nearer & impossible & on_beam

    azimuth_deg = np.mod(np.degrees(np.arctan2(beams[:, 1], beams[:, 0])), 360.0)
    elevation_deg = _elevations_deg(beams)
    returned = np.zeros((len(scans), len(beams)), dtype=np.bool_)
    returned[scan_of_point[on_beam], beam[on_beam]] = True
    sure = (expected_m <= SURE_RANGE * sensor.range_m) & (probability >= SURE_PROBABILITY)
    returns = _Returns(beam, range_m, height_m, gap_m)
    sectors = _blocked_sectors(
        azimuth_deg, sure, returned, beam[obstacle], points_m[obstacle], len(scans), pose
    )  # fmt: skip
    missing, unchecked = _missing_channels(sensor, elevation_deg, sure, returned)
    return ScanComparison(
        scans=len(scans),
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        expected_m=expected_m,
        measured_m=_median_by_beam(beam[on_beam], range_m[on_beam], len(beams)),
        returns=len(points_m),
        off_beams=int(np.count_nonzero(~on_beam)),
        nearer=int(np.count_nonzero(nearer)),
        obstacle_beams=np.unique(beam[obstacle]),
        obstacle_directions=directions[obstacle],
        obstacle_ranges_m=range_m[obstacle],
        return_share=float(returned[:, sure].mean()) if sure.any() else math.nan,
        sectors=sectors,
        missing_channels=missing,
        unchecked_channels=unchecked,
        structure_share=_structure_share(world, pose, beams, np.where(sure, expected_m, np.inf), returns),
    )


def _persistent(far_nearer: BoolArray, beam: IntArray, scan: IntArray, n_scans: int, n_beams: int) -> BoolArray:
    """Return which beams are stopped in nearly all of at least :data:`PERSISTENT_SCANS` scans, (beams,)."""
    if n_scans < PERSISTENT_SCANS:
        return np.zeros(n_beams, dtype=np.bool_)
    stopped = np.zeros((n_scans, n_beams), dtype=np.bool_)
    stopped[scan[far_nearer], beam[far_nearer]] = True
    persistent: BoolArray = stopped.mean(axis=0) >= PERSISTENT_SHARE
    return persistent


def _median_by_beam(beam: IntArray, range_m: FloatArray, n_beams: int) -> FloatArray:
    """Return the lower median range of each beam, (beams,); NaN without a return."""
    order = np.lexsort((range_m, beam))
    count = np.bincount(beam, minlength=n_beams)
    start = np.cumsum(count) - count
    median = np.full(n_beams, np.nan)
    some = count > 0
    median[some] = range_m[order][(start + (count - 1) // 2)[some]]
    return median


def _blocked_sectors(
    azimuth_deg: FloatArray,
    sure: BoolArray,
    returned: BoolArray,
    obstacle_beam: IntArray,
    obstacle_m: FloatArray,
    n_scans: int,
    pose: Pose,
) -> tuple[BlockedSector, ...]:
    n_bins = round(360.0 / _BIN_DEG)
    bin_of_beam = np.minimum((azimuth_deg / _BIN_DEG).astype(np.int64), n_bins - 1)
    beams = np.bincount(bin_of_beam, minlength=n_bins)
    stopped = np.bincount(bin_of_beam[np.unique(obstacle_beam)], minlength=n_bins)
    with np.errstate(invalid="ignore", divide="ignore"):
        has_obstacle = (beams > 0) & (stopped / beams >= _BLOCKED_BEAMS)
    expected = n_scans * np.bincount(bin_of_beam[sure], minlength=n_bins)
    came_back = np.bincount(bin_of_beam[sure], weights=returned[:, sure].sum(axis=0), minlength=n_bins)
    is_silent = (expected >= _MIN_EXPECTED) & (came_back < _SILENT_RETURNS * expected) & ~has_obstacle

    sectors = []
    obstacle_bin = bin_of_beam[obstacle_beam]
    ranges_m = np.linalg.norm(obstacle_m, axis=1)
    elevations_deg = np.degrees(np.arcsin(obstacle_m[:, 2] / ranges_m))
    for first, last in _circular_runs(has_obstacle):
        bins = np.arange(first, last) % n_bins
        inside = np.isin(obstacle_bin, bins)
        sectors.append(
            _sector(
                first, last, pose, float(np.median(ranges_m[inside])),
                (float(elevations_deg[inside].min()), float(elevations_deg[inside].max())),
                float(stopped[bins].sum() / beams[bins].sum()),
            )
        )  # fmt: skip
    for first, last in _circular_runs(is_silent):
        if (last - first) * _BIN_DEG >= _MIN_SILENT_DEG:
            bins = np.arange(first, last) % n_bins
            share = float(1.0 - came_back[bins].sum() / expected[bins].sum())
            sectors.append(_sector(first, last, pose, math.nan, (math.nan, math.nan), share))
    return tuple(sorted(sectors, key=lambda sector: sector.first_deg))


def _sector(
    first: int, last: int, pose: Pose, distance_m: float, elevation_deg: tuple[float, float], share: float
) -> BlockedSector:
    first_deg, last_deg = first * _BIN_DEG, last * _BIN_DEG
    middle = math.radians(0.5 * (first_deg + last_deg))
    ahead = rotation_world_sensor(*pose.angles_deg) @ np.array([math.cos(middle), math.sin(middle), 0.0])
    bearing_deg = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
    return BlockedSector(first_deg, last_deg, bearing_deg, distance_m, elevation_deg, share)


def _circular_runs(marked: BoolArray) -> list[tuple[int, int]]:
    """Return first and last (exclusive) of each run of marked bins on a circle; a gap of one bin does not end a run.

    Examples
    --------
    >>> _circular_runs(np.array([True, False, False, True, False, True, True]))
    [(3, 8)]
    >>> _circular_runs(np.ones(4, dtype=bool))
    [(0, 4)]
    """
    n = len(marked)
    closed = marked | (np.roll(marked, 1) & np.roll(marked, -1))
    if not closed.any():
        return []
    if closed.all():
        return [(0, n)]
    starts = np.flatnonzero(closed & ~np.roll(closed, 1))
    runs = []
    for start in starts.tolist():
        length = 1
        while closed[(start + length) % n]:
            length += 1
        runs.append((start, start + length))
    return runs


def channel_elevations_deg(sensor: Sensor) -> FloatArray:
    """Return the elevation of each channel of a sensor, (channels,) float64.

    Those of a sensor from a table are its different elevations, to a hundredth of a degree.
    """
    if sensor.table is None:
        return np.asarray(sensor.elevations_deg, dtype=np.float64)
    return np.unique(np.round(_elevations_deg(sensor.directions()), 2))


def _elevations_deg(directions: FloatArray) -> FloatArray:
    return np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))


def _missing_channels(
    sensor: Sensor, elevation_deg: FloatArray, sure: BoolArray, returned: BoolArray
) -> tuple[tuple[float, ...], int | None]:
    """Return the elevations of channels without returns, and how many could not be checked (None without channels)."""
    elevations = channel_elevations_deg(sensor)
    if sensor.table is None:
        channel = np.arange(sensor.beams) % sensor.channels
    else:
        if len(elevations) > _MAX_CHANNELS:
            return (), None
        channel = np.searchsorted(elevations, np.round(elevation_deg, 2))
    expected = len(returned) * np.bincount(channel[sure], minlength=len(elevations))
    came_back = np.bincount(channel[sure], weights=returned[:, sure].sum(axis=0), minlength=len(elevations))
    checked = expected >= _CHANNEL_EXPECTED
    missing = checked & (came_back < _CHANNEL_RETURNS * expected)
    return tuple(sorted(elevations[missing].tolist())), int(np.count_nonzero(~checked))


class _Returns(NamedTuple):
    """Measured returns: nearest beam, range, height above the ground, and distance to the static world behind."""

    beam: IntArray
    range_m: FloatArray
    height_m: FloatArray
    gap_m: FloatArray


def _structure_share(
    world: StaticWorld, pose: Pose, beams: FloatArray, expected_m: FloatArray, returns: _Returns
) -> float:
    """Return in how much of what stands above the ground the scan and the static world agree; NaN if little stands.

    The ground looks the same everywhere; walls do not. Beams whose return is not sure have no expected range.
    """
    agrees = np.abs(returns.gap_m) <= np.maximum(_AGREE_M, _AGREE_SHARE * returns.range_m)
    is_expected = np.isfinite(expected_m)
    ends_m = np.where(is_expected, expected_m, 0.0)[:, None] * beams
    ends_m = ends_m @ rotation_world_sensor(*pose.angles_deg).T + np.asarray(pose.position_m)
    expected_structure = is_expected & (world.heights_m(ends_m) > _STRUCTURE_M)
    measured_structure = returns.height_m > _STRUCTURE_M
    confirmed = np.zeros(len(beams), dtype=np.bool_)
    confirmed[returns.beam[agrees]] = True
    shares = []
    if np.count_nonzero(expected_structure) >= _MIN_STRUCTURE:
        shares.append(float(confirmed[expected_structure].mean()))
    if np.count_nonzero(measured_structure) >= _MIN_STRUCTURE:
        shares.append(float(agrees[measured_structure].mean()))
    return min(shares, default=math.nan)
