"""In which frame the points and boxes of sweeps are, and whether their rings are those of the sensor.

A sensor may hang upside down, and programs write sweeps that they have levelled. Where a scenario states the pose, the
ground that it shows the sensor is held against the ground of the sweeps, in the frame of the sensor, in the level one
and in that of a sensor that is turned about its x axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.validation.measured.sensor_site import SensorSite, move_boxes, upright_normals
from egvs.formats.sweep_files import Sweep
from egvs.formats.sweep_labels import SweepLabels
from egvs.sensors.ground_plane import GroundPlane, find_ground_planes
from egvs.sensors.sensor import CATALOGUE, Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose, wrap_deg

SweepPairs = list[tuple[Sweep, SweepLabels]]

MOST_TILT_DEG = 3.0
"""The ground of the sweeps may differ by so much from that of the scenario."""

MOST_HEIGHT_M = 1.0
_CLEAR_DEG = 1.0
_NO_GROUND_DEG = 180.0
_TURN = np.diag([1.0, -1.0, -1.0])

_NEAR_M = 8.0
"""Closer returns do not show the elevation of a ring, as optics are beside the axis."""

_BIN_DEG = 0.02
_FEWEST_OF_RING = 20
_SHARE_ON_RINGS = 0.8
_RING_COUNT_TOLERANCE = 0.15
_BEYOND_DEG = 1.5
_STEP_RATIO = 1.5
_STEP_QUANTILE = 0.25
_SAME_AZIMUTH_DEG = 0.01  # a second return


def find_frame(site: SensorSite, sweeps: Sequence[Sweep]) -> SensorSite:
    """Return a site of a scenario with the frame that sweeps are in, and a sentence where it is not the sensor's.

    Raises
    ------
    InputError
        If the ground of the sweeps fits in no frame.
    """
    points_m = _returns(sweeps)
    seen_m = site.directions[site.returned] * site.range_m[site.returned, None]
    planes = _ground(seen_m, np.eye(3))
    expected = planes[0] if planes else None
    pose = site.pose
    level = replace(pose, pitch_deg=0.0, roll_deg=0.0)
    turned = replace(pose, roll_deg=wrap_deg(pose.roll_deg + 180.0))
    tilts_deg = {frame: _tilt_deg(points_m, frame, expected) for frame in (pose, level, turned)}
    best = min(tilts_deg, key=lambda frame: tilts_deg[frame])
    if expected is None and tilts_deg[best] == _NO_GROUND_DEG:
        return _with_note(site, "No ground is in sight, so the pose of the sweeps is not checked.")
    if tilts_deg[best] > MOST_TILT_DEG:
        height = "none in sight" if expected is None else f"{expected.height_m:.2f} m below the sensor"
        problem = (
            f"the ground of the sweeps is not that below site {site.name} ({height}; pitch "
            f"{pose.pitch_deg:g}, roll {pose.roll_deg:g} degrees), whether in the frame of the sensor or levelled"
        )
        raise InputError(sweeps[0].name, problem, "Name the site where they were recorded, or leave out --site.")
    if tilts_deg[pose] <= min(tilts_deg[best] + _CLEAR_DEG, MOST_TILT_DEG):
        return site
    if best == turned:
        mount = "upright" if pose.is_inverted else "inverted"
        problem = f"the sweeps are upside down for site {site.name}, with roll {pose.roll_deg:g} degrees"
        raise InputError(sweeps[0].name, problem, f"Use --set sites.mount={mount}, or turn the sweeps.")
    note = (
        f"The sweeps are levelled: their ground fits pitch 0 and roll 0, not pitch {pose.pitch_deg:g} and roll "
        f"{pose.roll_deg:g} of site {site.name}. Points and boxes are turned by the latter, beams are not."
    )
    return _with_note(replace(site, sweep_pose=level), note)


def _with_note(site: SensorSite, note: str) -> SensorSite:
    return replace(site, assumptions=(*site.assumptions, note))


def _returns(sweeps: Sequence[Sweep]) -> FloatArray:
    return np.concatenate([sweep.points_m[np.isfinite(sweep.points_m[:, 0])] for sweep in sweeps])


def _ground(points_m: FloatArray, rotation: FloatArray) -> list[GroundPlane]:
    """Return the ground planes of points that are turned into the world's axes; empty without any."""
    turned_m = points_m @ rotation.T
    try:
        return find_ground_planes(turned_m, upright_normals(turned_m), "the sweeps")
    except InputError:
        return []


def _tilt_deg(points_m: FloatArray, frame: Pose, expected: GroundPlane | None) -> float:
    """Return the angle between the expected ground, level if unknown, and the nearest of sweeps at its height."""
    planes = _ground(points_m, rotation_world_sensor(*frame.angles_deg))
    normal = np.array([0.0, 0.0, 1.0]) if expected is None else expected.normal
    if expected is not None:
        planes = [plane for plane in planes if abs(plane.height_m - expected.height_m) <= MOST_HEIGHT_M]
    cosines = [float(np.clip(plane.normal @ normal, -1.0, 1.0)) for plane in planes]
    return float(np.degrees(np.arccos(max(cosines)))) if cosines else _NO_GROUND_DEG


def stand_upright(site: SensorSite, pairs: SweepPairs) -> tuple[SensorSite, SweepPairs]:
    """Return points and boxes with z upwards, so that the lowest part of a box is below, and the site of this frame."""
    pose = site.frame_pose
    if not pose.is_inverted:
        return site, pairs
    turned = replace(pose, roll_deg=wrap_deg(pose.roll_deg + 180.0))
    stood = [
        (
            replace(sweep, points_m=sweep.points_m @ _TURN),
            labels.with_boxes(move_boxes(labels.boxes, _TURN, np.zeros(3))),
        )
        for sweep, labels in pairs
    ]
    return replace(site, sweep_pose=turned), stood


def in_sensor_frame(site: SensorSite, points_m: FloatArray) -> FloatArray:
    """Return points (n, 3) of the frame of the sweeps in that of the sensor."""
    to_world = rotation_world_sensor(*site.frame_pose.angles_deg)
    return points_m @ to_world.T @ rotation_world_sensor(*site.pose.angles_deg)


def describe_other_rings(site: SensorSite, sweeps: Sequence[Sweep]) -> str | None:
    """Return a sentence where the rings of sweeps are not those of the sensor; None where they are, or are not clear.

    Rings towards the sky may have no returns, so only those between the lowest and the highest ring with returns are
    counted. The returns of a ring are as far apart as the sensor's azimuths.
    """
    sensor = site.sensor
    points_m = [in_sensor_frame(site, sweep.points_m) for sweep in sweeps]
    elevations_deg = ring_elevations_deg(points_m, sweeps)
    if sensor.channels < 2 or len(elevations_deg) < 2:
        return None
    step_deg, own_step_deg = _azimuth_step_deg(sensor, points_m), sensor.azimuth_step_deg
    if not _fits(sensor, elevations_deg):
        low_deg, high_deg = sensor.elevation_span_deg
        text = (
            f"The rings do not match: the sweeps have {len(elevations_deg)} from {elevations_deg[0]:.2f} to "
            f"{elevations_deg[-1]:.2f} degrees, {sensor.name} has {len(_within(sensor, elevations_deg))} there, of "
            f"{sensor.channels} from {low_deg:.2f} to {high_deg:.2f}."
        )
    elif step_deg and own_step_deg and not 1.0 / _STEP_RATIO < step_deg / own_step_deg < _STEP_RATIO:
        text = (
            f"The azimuths do not match: in the sweeps, the returns of a ring are {step_deg:.3f} degrees apart, those "
            f"of {sensor.name} {own_step_deg:.3f}."
        )
    else:
        return None
    fitting = [other for other in CATALOGUE.values() if other.channels > 1 and _fits(other, elevations_deg)]
    if not fitting:
        return f"{text} No sensor of the catalogue has such rings: egvs sensor fit makes one of sweeps."
    aim_deg = step_deg or own_step_deg or 0.0
    nearest = min(
        fitting,
        key=lambda other: (
            round(_offset_deg(other, elevations_deg), 2), abs((other.azimuth_step_deg or 0.0) - aim_deg)
        ),
    )  # fmt: skip
    return f"{text} The nearest sensor of the catalogue is {nearest.name}."


def _azimuth_step_deg(sensor: Sensor, points_m: Sequence[FloatArray]) -> float | None:
    """Return how far apart neighbouring returns of a ring of the sensor are; None without any.

    Most returns have their next azimuth, too: of all distances, a low quantile stands for it.
    """
    own_deg = np.sort(np.asarray(sensor.elevations_deg))
    apart_deg = []
    for points in points_m:
        range_m = np.sqrt((points**2).sum(axis=1))
        far, range_m = points[range_m > _NEAR_M], range_m[range_m > _NEAR_M]
        ring = np.searchsorted(0.5 * (own_deg[1:] + own_deg[:-1]), np.degrees(np.arcsin(far[:, 2] / range_m)))
        azimuth_deg = np.degrees(np.arctan2(far[:, 1], far[:, 0]))
        order = np.lexsort((azimuth_deg, ring))
        apart = np.diff(azimuth_deg[order])[np.diff(ring[order]) == 0]
        apart_deg.append(apart[apart > _SAME_AZIMUTH_DEG])
    all_deg = np.concatenate(apart_deg)
    return float(np.quantile(all_deg, _STEP_QUANTILE)) if len(all_deg) else None


def ring_elevations_deg(points_m: Sequence[FloatArray], sweeps: Sequence[Sweep]) -> FloatArray:
    """Return the elevations of the rings with returns, ascending, (k,) float64; by the file, else where points crowd.

    Parameters
    ----------
    points_m
        Points of each sweep in the sensor's frame, (n, 3), NaN for missing returns.
    sweeps
        The same sweeps, with the ring of each point where the file has it.
    """
    found, rings = [], []
    for points, sweep in zip(points_m, sweeps, strict=True):
        range_m = np.sqrt((points**2).sum(axis=1))
        far = range_m > _NEAR_M
        found.append(np.degrees(np.arcsin(points[far, 2] / range_m[far])))
        rings.append(np.full(int(far.sum()), -1) if sweep.ring is None else sweep.ring[far])
    elevation_deg, ring = np.concatenate(found), np.concatenate(rings)
    if not len(elevation_deg):
        return np.zeros(0)
    if (ring >= 0).all():
        members = [elevation_deg[ring == number] for number in np.unique(ring)]
        medians = [float(np.median(member)) for member in members if len(member) >= _FEWEST_OF_RING]
        return np.sort(np.array(medians))
    counts = np.bincount(np.floor((elevation_deg + 90.0) / _BIN_DEG).astype(np.int64))
    lowest = int(np.flatnonzero(counts)[0])
    crowded = counts > max(_FEWEST_OF_RING, float(counts[lowest:].mean()))
    if counts[crowded].sum() < _SHARE_ON_RINGS * counts.sum():
        return np.zeros(0)  # the points are on no rings
    edges = np.flatnonzero(np.diff(np.concatenate([[0], crowded.astype(np.int64), [0]])))
    return np.asarray((edges[::2] + edges[1::2]) * (0.5 * _BIN_DEG) - 90.0, dtype=np.float64)


def _within(sensor: Sensor, elevations_deg: FloatArray) -> FloatArray:
    """Return the distinct elevations of a sensor between the lowest and the highest of some."""
    own: FloatArray = np.unique(np.round(np.asarray(sensor.elevations_deg, dtype=np.float64), 2))
    within: FloatArray = own[(own >= elevations_deg[0] - 0.1) & (own <= elevations_deg[-1] + 0.1)]
    return within


def _fits(sensor: Sensor, elevations_deg: FloatArray) -> bool:
    low_deg, high_deg = sensor.elevation_span_deg
    if elevations_deg[0] < low_deg - _BEYOND_DEG or elevations_deg[-1] > high_deg + _BEYOND_DEG:
        return False
    count = len(_within(sensor, elevations_deg))
    return abs(count - len(elevations_deg)) <= max(1.0, _RING_COUNT_TOLERANCE * len(elevations_deg))


def _offset_deg(sensor: Sensor, elevations_deg: FloatArray) -> float:
    """Return the mean distance from each elevation to the nearest of a sensor."""
    own = np.asarray(sensor.elevations_deg)
    return float(np.abs(elevations_deg[:, None] - own[None, :]).min(axis=1).mean())
