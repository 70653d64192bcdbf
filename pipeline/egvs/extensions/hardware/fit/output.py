"""Write a fitted sensor: the table ``[sensors.NAME]``, a report, the empty scan, labelled returns, figures.

The table has only keys that act on a simulation. The report (``fit.json``) has every value with its standard error.
"""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.extensions.hardware.fit import empty_scan, figures
from egvs.extensions.hardware.fit.calibration import CalibratedPose
from egvs.extensions.hardware.fit.figures import describe_fitted_roll
from egvs.extensions.hardware.fit.fit import SensorFit
from egvs.extensions.hardware.fit.map_pose import MapPose
from egvs.extensions.hardware.fit.range_noise import NoiseBin
from egvs.extensions.hardware.registration import PARAMETERS
from egvs.formats import pcd, ply
from egvs.scenario.sensor_config import SensorConfig
from egvs.sensors.ground_plane import GroundPlane
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sensor_table import format_sensor_table
from egvs.statistics.intervals import Estimate

SENSOR_FILE, REPORT_FILE = "sensor.toml", "fit.json"
EMPTY_SCAN_FILE, LABELS_FILE = "empty_scan.pcd", "returns.ply"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]{0,63}")
_ANGLE_DIGITS = 4


@dataclass(frozen=True)
class FitFolder:
    """What was written.

    Attributes
    ----------
    folder
        The folder.
    names
        Names of the files in it.
    """

    folder: Path
    names: tuple[str, ...]


def check_name(name: str) -> None:
    """Raise an InputError unless a sensor can have this name."""
    if not _NAME.fullmatch(name):
        problem = f"expected a name of letters, digits, spaces and . _ + -, got {name!r}"
        raise InputError("--name", problem, "Use a name such as north-mast.")


def write_fit(fit: SensorFit, name: str, folder: str | Path, *, without_empty_sector: bool = False) -> FitFolder:
    """Write all files of a fit.

    Parameters
    ----------
    fit
        The fitted sensor.
    name
        Name of the sensor.
    folder
        Is created if need be; files of an earlier fit are replaced.
    without_empty_sector
        Leave the widest sector without returns out of the beams.

    Raises
    ------
    InputError
        If the sensor has no sector without returns, or the folder cannot be written.
    """
    folder = Path(folder)
    table = table_text(fit, name, without_empty_sector)
    files.ensure_writable_folder(folder / SENSOR_FILE)
    names = [SENSOR_FILE, REPORT_FILE]
    files.write_text(folder / SENSOR_FILE, _comments(fit, name) + table)
    files.write_text(folder / REPORT_FILE, files.to_json_text(report(fit, name), indent=1) + "\n")
    for file, draw in figures.FIGURES.items():
        figure = draw(fit)
        if figure is not None:
            with files.atomic_write(folder / file) as partial:
                figure.savefig(partial, format="png", dpi=110)
            names.append(file)
    if fit.empty_scan is not None:
        with files.atomic_write(folder / EMPTY_SCAN_FILE) as partial:
            pcd.write(partial, upright(empty_scan_points(fit), fit.plane))
        with files.atomic_write(folder / LABELS_FILE) as partial:
            ply.write_columns(partial, _labelled_returns(fit))
        names += [EMPTY_SCAN_FILE, LABELS_FILE]
    return FitFolder(folder, tuple(names))


def table_text(fit: SensorFit, name: str, without_empty_sector: bool = False) -> str:
    """Return the lines of ``[sensors.NAME]``; raises as :func:`sensor_table`."""
    text = format_sensor_table(name, sensor_table(fit, without_empty_sector))
    SensorConfig.from_dict(tomllib.loads(text)["sensors"][name])  # a scenario can read it
    return text


def sensor_table(fit: SensorFit, without_empty_sector: bool = False) -> dict[str, Any]:
    """Return the keys of ``[sensors.NAME]``.

    Channels are in ascending order of elevation. For a full circle, azimuths count modulo 360 degrees.

    Raises
    ------
    InputError
        If ``without_empty_sector`` is set and no sector is without returns, or the view is not a full circle.
    """
    angles = fit.angles
    order = angles.ascending
    offsets_deg = angles.azimuth_offset_deg[order]
    step_deg = float(angles.grid_step_deg)
    table: dict[str, Any] = {"elevations_deg": _rounded(angles.elevation_deg[order])}
    if without_empty_sector:
        first_deg, last_deg = _view_without_empty_sector(fit)
        steps = math.floor((last_deg - first_deg) / step_deg)
        table["azimuth_offsets_deg"] = _rounded(np.mod(offsets_deg, step_deg))
        table["azimuth_step_deg"] = step_deg
        table["azimuth_deg"] = [first_deg, first_deg + steps * step_deg]
    elif angles.is_full_circle:
        table["azimuth_offsets_deg"] = _rounded(offsets_deg)
        table["azimuth_step_deg"] = step_deg
    else:
        step_deg = round(step_deg, 6)
        first_deg = float(round(angles.first_azimuth_deg, _ANGLE_DIGITS))
        table["azimuth_offsets_deg"] = _rounded(offsets_deg)
        table["azimuth_step_deg"] = step_deg
        span_deg = (angles.azimuths - 1) * step_deg
        if first_deg + span_deg > 360.0:  # the limit of the key
            first_deg -= 360.0
        table["azimuth_deg"] = [first_deg, first_deg + span_deg]
    table["range_m"] = round(fit.max_range_m, 2)
    if fit.sigma_m is not None:
        table["range_sigma_m"] = round(fit.sigma_m.value, 5)
    if fit.plane.is_inverted:
        table["mount"] = "inverted"
    return table


def _view_without_empty_sector(fit: SensorFit) -> tuple[float, float]:
    """Return the ends of the view, counter-clockwise, within the limits of the key azimuth_deg."""
    if not fit.empty_sectors_deg or not fit.angles.is_full_circle:
        problem = "this sensor has no sector without returns, or its view is no full circle"
        raise InputError("--without-empty-sector", problem, "Omit the option.")
    start_deg, end_deg = max(fit.empty_sectors_deg, key=lambda sector: sector[1] - sector[0])
    first_deg = end_deg - 360.0
    return (first_deg, start_deg) if start_deg <= 360.0 else (first_deg - 360.0, start_deg - 360.0)


def _rounded(values: FloatArray) -> list[float]:
    return [float(value) for value in np.round(values, _ANGLE_DIGITS) + 0.0]


def _comments(fit: SensorFit, name: str) -> str:
    lines = [f"Sensor {name}, fitted by egvs sensor fit to:"]
    lines += [f"  {sweep.name} ({sweep.returns:,} returns)" for sweep in fit.sweeps]
    lines.append(f"Standard errors and all that a scenario does not use: {REPORT_FILE}.")
    plane = fit.plane
    lines.append(
        f"Pose over the chosen ground plane: {plane.height_m:.2f} m above it, "
        f"{describe_fitted_roll(plane.roll_deg)}, pitch {plane.pitch_deg:.2f} degrees."
    )
    if fit.map_pose is not None:
        pose = fit.map_pose.best.pose
        lines.append(
            f"Pose in the world of {fit.map_pose.scenario}: x {pose.x_m:.3f}, y {pose.y_m:.3f}, z {pose.z_m:.3f} m, "
            f"yaw {pose.yaw_deg:.3f}, pitch {pose.pitch_deg:.3f}, {describe_fitted_roll(pose.roll_deg, 3)} degrees."
        )
        lines += fit.map_pose.warnings
    if fit.calibrated_pose is not None:
        lines += calibration_lines(fit.calibrated_pose)
    if fit.return_rate is not None:
        lines.append(
            f"Lost returns on smooth surfaces: {format_percent(1 - fit.return_rate.value, 2)}. To model them: "
            f"[effects.dropout] share = {1 - fit.return_rate.value:.4f}"
        )
    return "".join(f"# {line}\n" for line in lines) + "\n"


def calibration_lines(calibrated: CalibratedPose) -> list[str]:
    """Return sentences about the pose by a calibration file."""
    pose = calibrated.pose
    return [
        f"pose in {calibrated.frame} by {calibrated.file}: x {pose.x_m:.3f}, y {pose.y_m:.3f}, z {pose.z_m:.3f} m, "
        f"yaw {pose.yaw_deg:.3f}, pitch {pose.pitch_deg:.3f}, {describe_fitted_roll(pose.roll_deg, 3)} degrees",
        f"the chosen ground plane in {calibrated.frame}: z = {calibrated.ground_z_m:.2f} m below the sensor, tilted by "
        f"{calibrated.ground_tilt_deg:.2f} degrees",
    ]


# ---- the report


def report(fit: SensorFit, name: str) -> dict[str, Any]:
    """Return every fitted value with its standard error, as JSON; values that are not known are null."""
    angles = fit.angles
    direction = {1: "counter-clockwise", -1: "clockwise", 0: None}[angles.direction]
    result: dict[str, Any] = {
        "sensor": name,
        "sweeps": [
            {
                "name": sweep.name,
                "returns": sweep.returns,
                "missing": len(sweep.points_m) - sweep.returns,
                "returns_on_no_ring": grid.off_grid,
                "further_returns_of_a_pulse": grid.repeated,
                "only_for_empty_scan": sweep.is_coarse,
            }
            for sweep, grid in zip(fit.sweeps, fit.grids, strict=True)
        ],
        "order_of_points": fit.layout,
        "rings_from": "the file" if fit.has_file_rings else "the points",
        "channels_with_too_few_returns": fit.silent_channels,
        "azimuth_step_deg": _value(angles.azimuth_step_deg, angles.azimuth_step_se_deg),
        "azimuths": angles.azimuths,
        "full_circle": angles.is_full_circle,
        "first_azimuth_deg": angles.first_azimuth_deg,
        "rotation_from_above": direction,
        "rotation": _rotation(fit),
        "optics_to_axis_m": _value(angles.axis_distance_m, angles.axis_distance_se_m),
        "range_step_m": fit.range_step_m,
        "max_range_m": fit.max_range_m,
        "range_sigma_m": _estimate(fit.sigma_m),
        "channels": _channels(fit),
        "range_noise": [_noise(noise) for noise in fit.noise],
        "range_noise_on_road": [_noise(noise) for noise in fit.noise_on_road],
        "return_rate_on_smooth_surfaces": _estimate(fit.return_rate),
        "return_rates_on_smooth_surfaces": [_rate(rate) for rate in fit.return_rates],
        "return_rates_on_road": [_rate(rate) for rate in fit.road_rates],
        "return_rates_towards_road": [_rate(rate) for rate in fit.rates_towards_road],
        "sectors_without_returns_deg": [list(sector) for sector in fit.empty_sectors_deg],
        "ground_planes": [_plane(plane, plane is fit.plane) for plane in fit.planes],
    }
    if fit.map_pose is not None:
        result["map_pose"] = _map_pose(fit.map_pose)
    if fit.calibrated_pose is not None:
        result["calibrated_pose"] = asdict(fit.calibrated_pose)
    if fit.empty_scan is not None:
        background, traffic, unknown = fit.empty_scan.counts
        result["empty_scan"] = {
            "sweeps": len(fit.sweeps),
            "pulses": int(fit.empty_scan.range_m.size),
            "pulses_with_background": int(np.count_nonzero(np.isfinite(fit.empty_scan.range_m))),
            "returns_from_background": background,
            "returns_in_front_of_it": traffic,
            "returns_of_pulses_without_background": unknown,
        }
    return result


def _rotation(fit: SensorFit) -> dict[str, Any] | None:
    rotation = fit.rotation
    if rotation is None:
        return None
    return {
        "turns_per_second": _value(rotation.rate_hz, rotation.rate_se_hz),
        "from": rotation.source,
        "sweeps": rotation.sweeps,
        "firing_interval_s": rotation.firing_interval_s,
        "azimuth_step_deg": rotation.step_deg,
    }


def _value(value: float, se: float) -> dict[str, float]:
    return {"value": float(value), "se": float(se)}


def _map_pose(pose: MapPose) -> dict[str, Any]:
    best = pose.best
    errors = best.standard_errors
    return {
        "scenario": pose.scenario,
        **{
            name: {
                "value": float(getattr(best.pose, name)),
                "se": errors[name] if math.isfinite(errors[name]) else None,
            }
            for name in PARAMETERS
        },
        "not_fixed": list(best.not_fixed),
        "returns": len(pose.points_m),
        "share_on_surface": pose.share_on_surface,
        "residual_m": _value(pose.residual_m, pose.residual_se_m),
        "residual_sigma_m": best.sigma_m,
        "shift_m": pose.shift_m,
        "ambiguous_yaws_deg": list(pose.ambiguous_yaws_deg),
        "warnings": list(pose.warnings),
    }


def _estimate(estimate: Estimate | None) -> dict[str, Any] | None:
    return None if estimate is None else estimate._asdict()


def _noise(noise: NoiseBin) -> dict[str, Any]:
    incidence_deg = None if math.isnan(noise.incidence_deg) else round(noise.incidence_deg, 2)
    interval = {"from_m": noise.from_m, "to_m": noise.to_m, "incidence_deg": incidence_deg}
    return interval | noise.sigma_m._asdict()


def _rate(rate: Any) -> dict[str, Any]:
    angles = {"from_incidence_deg": rate.from_deg, "to_incidence_deg": rate.to_deg}
    return {"from_m": rate.from_m, "to_m": rate.to_m, **angles, **rate.rate._asdict()}


def _channels(fit: SensorFit) -> list[dict[str, Any]]:
    angles = fit.angles
    return [
        {
            "channel_in_file": int(c),
            "elevation_deg": _value(angles.elevation_deg[c], angles.elevation_se_deg[c]),
            "vertical_offset_m": _value(angles.offset_m[c], angles.offset_se_m[c]),
            "azimuth_offset_deg": _value(angles.azimuth_offset_deg[c], angles.azimuth_offset_se_deg[c]),
            "range_sigma_m": _estimate(fit.noise_by_channel[c]),
        }
        for c in angles.ascending
    ]


def _plane(plane: GroundPlane, is_chosen: bool) -> dict[str, Any]:
    return asdict(plane) | {"normal": plane.normal.tolist(), "chosen": is_chosen}


# ---- the empty scan


def empty_scan_points(fit: SensorFit) -> FloatArray:
    """Return the empty scan in the sensor's frame, (n, 3)."""
    assert fit.empty_scan is not None
    points = empty_scan.points_of(fit.empty_scan.range_m, fit.angles)
    return points[np.isfinite(fit.empty_scan.range_m)]


def upright(points_m: FloatArray, plane: GroundPlane) -> FloatArray:
    """Turn points of the sensor's frame upright: z above the ground plane, x and y from the sensor, yaw 0."""
    rotation = rotation_world_sensor(0.0, plane.pitch_deg, plane.roll_deg)
    points: FloatArray = points_m @ rotation.T + np.array([0.0, 0.0, plane.height_m])
    return points


def _labelled_returns(fit: SensorFit) -> dict[str, Any]:
    """Return all returns in the sensor's frame, with their sweep, channel in the file, and label."""
    assert fit.empty_scan is not None
    columns: dict[str, list[Any]] = {name: [] for name in ("x", "y", "z", "sweep", "channel", "label")}
    for number, grid in enumerate(fit.grids):
        returned = np.isfinite(grid.range_m)
        points = empty_scan.points_of(grid.range_m, fit.angles)[returned]
        for axis, name in enumerate("xyz"):
            columns[name].append(points[:, axis].astype(np.float32))
        channel, _ = np.nonzero(returned)
        columns["sweep"].append(np.full(len(points), number, dtype=np.uint16))
        columns["channel"].append(channel.astype(np.uint16))
        columns["label"].append(fit.empty_scan.labels[number][returned])
    return {name: np.concatenate(parts) for name, parts in columns.items()}
