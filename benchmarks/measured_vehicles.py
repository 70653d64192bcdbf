"""Points on vehicles: a real LiDAR against the simulator, for vehicles that a person confirmed.

``python -m benchmarks.measured_vehicles FOLDER``: FOLDER contains ``sweep.pcd.gz`` and ``frames.npz``, eleven sweeps of
one unit. Steps:

1. Fit the sensor and the static world as :mod:`benchmarks.measured_sweep` does.
2. Find candidates: clusters of the returns in front of the empty scan on the carriageway. Fit a box to each.
3. ``--sheets DIR`` draws every candidate from above and from the side, for a person. Those that are vehicles are
   listed in ``docs/data/chengdu_vehicles.csv`` (frame, box, points; no point of the recording).
4. Simulate the listed boxes with the bodies of ``egvs validate``, and count pulses that return from each, measured and
   simulated, by range; and the share of pulses onto paint and onto glass that return.

Ratios are simulated to measured; their 95 % intervals leave out one vehicle in turn. Position, yaw (along the
road), width and height come from the returns; vehicles are assumed to be at least as long, wide and high as
:data:`CAR_M`, because their far ends are not seen.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.special import expit
from scipy.stats import binomtest, t

from benchmarks.measured_sweep import build_world, cast_static, fit_sweeps, fitted_sensor
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import BodyCaster, VehicleMeshes, builtin_bodies
from egvs.core.grid import FloatArray, IntArray
from egvs.effects.base import Echoes
from egvs.effects.surface_losses import SurfaceLosses
from egvs.extensions.hardware.fit import empty_scan, output
from egvs.extensions.hardware.fit.empty_scan import EmptyScanFit
from egvs.extensions.hardware.fit.fit import SensorFit
from egvs.extensions.validation.detectors.clustering import Density, find_clusters
from egvs.scenario.effects_config import SurfaceLossesParameters
from egvs.sensors.sensor import Sensor
from egvs.world.ray_casting import EmptyScan

LIST = Path(__file__).parents[1] / "docs" / "data" / "chengdu_vehicles.csv"
ROAD_M = (-45.0, 90.0), (-16.5, 17.0)
"""The carriageway in the upright frame of the sensor, x along the road."""
HEIGHTS_M = 0.2, 5.0
DENSITY = Density(reach_m=0.7, reach_per_range=0.035, least_points=8)
CAR_M = 4.5, 1.8, 1.5
"""Length, width and height that are assumed where the returns show less."""


@dataclass(frozen=True)
class Candidate:
    """A cluster of returns on the carriageway.

    Attributes
    ----------
    frame
        Number of the sweep.
    points_m
        Its points, upright, (n, 3).
    box
        x, y, z of the centre, length, width, height, yaw.
    """

    frame: int
    points_m: FloatArray
    box: FloatArray


def find_candidates(fit: SensorFit, background: EmptyScanFit) -> list[Candidate]:
    """Return the clusters of all sweeps on the carriageway, by frame and x."""
    candidates = []
    for number, grid in enumerate(fit.grids):
        points = foreground(grid.range_m, fit, background)
        for axis, (low, high) in enumerate((*ROAD_M, HEIGHTS_M)):
            points = points[(points[:, axis] > low) & (points[:, axis] < high)]
        clusters = find_clusters(points, DENSITY)
        members = [clusters.points_m[a:b] for a, b in pairwise(clusters.starts)]
        candidates += [Candidate(number, cluster, fit_box(cluster)) for cluster in sorted(members, key=_first_x)]
    return candidates


def _first_x(points_m: FloatArray) -> float:
    return float(points_m[:, 0].min())


def foreground(range_m: FloatArray, fit: SensorFit, background: EmptyScanFit) -> FloatArray:
    """Return the returns of a sweep in front of the empty scan, upright, (n, 3)."""
    with np.errstate(invalid="ignore"):
        in_front = range_m < background.range_m - 2.0 * empty_scan.tolerance_m(background.range_m)
    return output.upright(empty_scan.points_of(range_m, fit.angles)[in_front], fit.plane)


def fit_box(points_m: FloatArray) -> FloatArray:
    """Return the box of a cluster: the road's direction, sides through the outer points.

    An axis that shows less than a car extends away from the sensor.
    """
    low, high = (np.percentile(points_m[:, :2], share, axis=0) for share in (1, 99))
    box = np.zeros(7)
    for axis in range(2):
        size = high[axis] - low[axis]
        missing = max(CAR_M[axis] - size, 0.0)
        if low[axis] > 0:
            high[axis] += missing
        elif high[axis] < 0:
            low[axis] -= missing
        else:
            low[axis], high[axis] = low[axis] - missing / 2, high[axis] + missing / 2
        box[axis], box[3 + axis] = (low[axis] + high[axis]) / 2, high[axis] - low[axis]
    box[5] = max(float(np.percentile(points_m[:, 2], 99)), CAR_M[2])
    box[2] = box[5] / 2
    return box


def draw_sheets(candidates: list[Candidate], folder: Path, columns: int = 4, rows: int = 4) -> None:
    """Draw each candidate from above and from the side."""
    folder.mkdir(parents=True, exist_ok=True)
    per_sheet = columns * rows
    for sheet in range(0, len(candidates), per_sheet):
        figure = Figure(figsize=(5 * columns, 4.6 * rows), layout="tight")
        axes = figure.subplots(2 * rows, columns, squeeze=False)
        for k, candidate in enumerate(candidates[sheet : sheet + per_sheet]):
            row, column = divmod(k, columns)
            p, b = candidate.points_m, candidate.box
            top, side = axes[2 * row, column], axes[2 * row + 1, column]
            top.scatter(p[:, 0], p[:, 1], s=3, c=p[:, 2], cmap="turbo", vmin=0, vmax=3)
            top.plot(*(b[:2] + 0.5 * b[3:5] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]])).T, "k", lw=0.6)
            side.scatter(p[:, 0], p[:, 2], s=3, c=p[:, 1], cmap="turbo")
            side.plot(
                b[0] + b[3] * np.array([0.5, 0.5, -0.5, -0.5, 0.5]), b[5] * np.array([1, 0, 0, 1, 1]), "k", lw=0.6
            )
            top.set_title(
                f"#{sheet + k} frame {candidate.frame}: ({b[0]:.1f}, {b[1]:.1f}), {len(p)} points, "
                f"{b[3]:.1f} x {b[4]:.1f} x {b[5]:.1f}", fontsize=9,
            )  # fmt: skip
            for axis in (top, side):
                axis.set_aspect("equal")
                axis.set_xlim(b[0] - 5.5, b[0] + 5.5)
            top.set_ylim(b[1] - 2.2, b[1] + 2.2)
            side.set_ylim(-0.1, 4.3)
        figure.savefig(folder / f"sheet_{sheet // per_sheet}.png", dpi=70)


@dataclass(frozen=True)
class Vehicle:
    """A confirmed vehicle, a row of :data:`LIST`.

    Attributes
    ----------
    candidate, frame
        Numbers of the candidate and of the sweep.
    kind
        "car", "van", "truck" (with a closed body) or "flatbed".
    box
        x, y, z of the centre, length, width, height, yaw; in the upright frame of the sensor.
    """

    candidate: int
    frame: int
    kind: str
    box: FloatArray

    @property
    def range_m(self) -> float:
        """Horizontal range of the centre."""
        return float(np.hypot(self.box[0], self.box[1]))


CONFIRMED = {
    "car": (
        0, 3, 6, 7, 9, 13, 14, 15, 16, 17, 19, 20, 21, 23, 25, 26, 29, 30, 32, 34, 35, 36, 37, 38, 39, 42, 43, 45, 46,
        47, 52, 53, 54, 55, 63, 64, 70, 73, 74, 75, 78, 79, 80, 81, 84, 85,
    ),
    "van": (8, 18, 51, 62, 72),
    "truck": (4, 5, 50, 57, 76),
    "flatbed": (24, 56, 71, 77),
}  # fmt: skip
"""Numbers of the candidates that were recognised as vehicles in the sheets. Not: fragments of vehicles within 7 m of
the sensor, clusters of fewer than 24 returns beyond 50 m, the ends of two trucks whose length is not seen (67, 86)."""

VCLASS = {"car": "passenger", "van": "delivery", "truck": "truck", "flatbed": "truck"}
COLUMNS = "candidate", "frame", "kind", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"
COUNTS = "points_measured", "points_simulated"
ON_VEHICLE, LOST, ELSEWHERE = range(3)
"""A pulse that the simulated vehicle stops returns from the vehicle, does not return, or returns from elsewhere: the
body has another shape, or the pulse passes through a window."""

MARGIN_M = 0.3
"""Returns up to this far outside a box are on its vehicle."""


def confirmed_vehicles(candidates: list[Candidate], ground: Callable[[FloatArray], float]) -> list[Vehicle]:
    """Return the confirmed candidates, standing on the ground, by frame."""
    vehicles = []
    for kind, numbers in CONFIRMED.items():
        for number in numbers:
            candidate = candidates[number]
            box = candidate.box.copy()
            low_m = ground(box[:2])
            box[5] = max(2 * box[2] - low_m, CAR_M[2])
            box[2] = low_m + box[5] / 2
            # Traffic keeps to the right, as the cabs of trucks on both carriageways show.
            box[6] = np.pi if box[1] > 0 else 0.0
            vehicles.append(Vehicle(number, candidate.frame, kind, box))
    return sorted(vehicles, key=lambda vehicle: vehicle.candidate)


def ground_heights(fit: SensorFit, background: EmptyScanFit) -> Callable[[FloatArray], float]:
    """Return a function that gives the height of the carriageway near a position, upright."""
    points = output.upright(empty_scan.points_of(background.range_m, fit.angles), fit.plane).reshape(-1, 3)
    points = points[np.abs(points[:, 2]) < 0.6]

    def ground(xy_m: FloatArray) -> float:
        near = np.hypot(*(points[:, :2] - xy_m).T) < 4.0
        return float(np.percentile(points[near, 2], 30)) if near.sum() >= 20 else 0.0

    return ground


@dataclass(frozen=True)
class OnVehicle:
    """Pulses of one vehicle, measured and simulated.

    Attributes
    ----------
    vehicle
        The vehicle.
    measured, simulated
        Pulses that return from it.
    expected
        Simulated pulses that return from it with the effect ``surface_losses``, as an expectation.
    inner
        Rows of pulses whose neighbours also meet the same surface of it in the simulation, by surface.
    outcome
        What each of ``inner`` did in the measurement, by surface: :data:`ON_VEHICLE`, :data:`LOST` or
        :data:`ELSEWHERE`.
    cosine
        Of the angle of incidence, by surface.
    """

    vehicle: Vehicle
    measured: int
    simulated: int
    expected: float
    inner: Mapping[str, IntArray]
    outcome: Mapping[str, IntArray]
    cosine: Mapping[str, FloatArray]


def compare_vehicles(
    fit: SensorFit, background: EmptyScanFit, vehicles: list[Vehicle], static: EmptyScan, sensor: Sensor
) -> list[OnVehicle]:
    """Simulate the vehicles of each sweep, and count the pulses on each."""
    order = fit.angles.ascending
    bodies = VehicleMeshes.from_parts(builtin_bodies())
    losses = SurfaceLosses(SurfaceLossesParameters())
    mean_dark = 1.0 - losses.parameters.dark_share * losses.parameters.dark_loss
    pose = (0.0, 0.0, fit.plane.height_m)
    caster = BodyCaster(sensor.directions(0.0, fit.plane.pitch_deg, fit.plane.roll_deg), bodies)
    static_m = np.where(static.returned, np.sqrt((static.ends_m**2).sum(axis=1)), np.inf)
    with np.errstate(invalid="ignore"):
        limit_m = (background.range_m - 2.0 * empty_scan.tolerance_m(background.range_m))[order]

    results = []
    for number, grid in enumerate(fit.grids):
        members = [vehicle for vehicle in vehicles if vehicle.frame == number]
        if not members:
            continue
        boxes = np.array([vehicle.box for vehicle in members])
        frame = TrafficFrame(
            number, tuple(map(str, range(len(members)))), tuple(VCLASS[vehicle.kind] for vehicle in members),
            boxes, np.zeros(len(members)),
        )  # fmt: skip
        hits = caster.cast(frame, pose, static_m.copy(), np.ones(len(static_m)))
        shape = (sensor.azimuths, sensor.channels)
        with np.errstate(invalid="ignore"):
            in_front = limit_m > hits.range_m.reshape(shape).T
        owner = np.where(in_front, hits.owner.reshape(shape).T, -1)
        triangle = hits.triangle.reshape(shape).T
        surface = np.where(owner >= 0, bodies.surfaces[np.maximum(triangle, 0)], "")
        cosine = (hits.intensity / bodies.shapes[6][np.maximum(hits.triangle, 0)]).reshape(shape).T

        with np.errstate(invalid="ignore"):
            measured_in_front = grid.range_m[order] < limit_m
        points = output.upright(empty_scan.points_of(grid.range_m, fit.angles)[order], fit.plane)
        for k, vehicle in enumerate(members):
            on_vehicle = measured_in_front & _inside(points, vehicle.box)
            outcome = np.where(on_vehicle, ON_VEHICLE, np.where(np.isnan(grid.range_m[order]), LOST, ELSEWHERE))
            inner, outcomes, cosines = {}, {}, {}
            for name in ("paint", "glass"):
                rows = _with_neighbours((owner == k) & (surface == name))
                inner[name] = np.flatnonzero(rows)
                outcomes[name] = outcome[rows]
                cosines[name] = cosine[rows]
            simulated = int(np.count_nonzero(owner == k))
            is_simulated = owner == k
            echoes = Echoes(
                hits.range_m.reshape(shape).T[is_simulated],
                cosine[is_simulated],
                surface[is_simulated] == "glass",
                np.full(simulated, np.nan),
            )
            expected = float(losses.probability(echoes).sum()) * mean_dark
            measured = int(np.count_nonzero(on_vehicle))
            results.append(OnVehicle(vehicle, measured, simulated, expected, inner, outcomes, cosines))
    return results


def _inside(points_m: FloatArray, box: FloatArray) -> NDArray[np.bool_]:
    half = box[3:6] / 2 + MARGIN_M
    with np.errstate(invalid="ignore"):
        is_near = np.abs(points_m - box[:3]) < half
    return np.asarray(np.all(is_near, axis=-1), dtype=np.bool_)


def _with_neighbours(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pulses whose neighbours in azimuth, two to either side, are set too.

    Channels are up to 5 degrees apart near the sensor, so neighbours in elevation say nothing.
    """
    result = mask.copy()
    for shift in (-2, -1, 1, 2):
        result &= np.roll(mask, shift, axis=1)
    return result


RANGES_M = (0, 10, 20, 30, 40, 50, 90)
DARK_LOSS = 0.2
"""A vehicle that loses a larger share of the pulses onto its paint is called dark."""
MIN_PULSES = 20


@dataclass(frozen=True)
class Share:
    """A value with a 95 % interval."""

    value: float
    low: float
    high: float

    def text(self, form: str) -> str:
        """The value and its interval."""
        return f"{self.value:{form}} ({self.low:{form}} to {self.high:{form}})"


def jackknife(items: Sequence[OnVehicle], value: Callable[[Sequence[OnVehicle]], float]) -> Share:
    """Return a value with an interval that leaves out one vehicle in turn; NaN for fewer than three vehicles."""
    estimate = value(items)
    k = len(items)
    if k < 3:
        return Share(estimate, np.nan, np.nan)
    left_out = np.array([value([*items[:i], *items[i + 1 :]]) for i in range(k)])
    se = np.sqrt((k - 1) / k * ((left_out - left_out.mean()) ** 2).sum())
    half = float(t.ppf(0.975, k - 1) * se)
    return Share(estimate, estimate - half, estimate + half)


def simulated_to_measured(results: Sequence[OnVehicle]) -> float:
    """Return the ratio of the numbers of points."""
    return sum(result.simulated for result in results) / sum(result.measured for result in results)


def expected_to_measured(results: Sequence[OnVehicle]) -> float:
    """Return the ratio of the numbers of points, with the effect ``surface_losses``."""
    return sum(result.expected for result in results) / sum(result.measured for result in results)


def lost_share(results: Sequence[OnVehicle], surface: str, low_deg: float = 0.0, high_deg: float = 90.0) -> float:
    """Return the share of pulses that do not return, of those that return from the vehicle or not at all."""
    counts = np.zeros(3)
    for result in results:
        incidence_deg = np.degrees(np.arccos(np.clip(result.cosine[surface], 0.0, 1.0)))
        members = (incidence_deg >= low_deg) & (incidence_deg < high_deg)
        counts += np.bincount(result.outcome[surface][members], minlength=3)
    return float(counts[LOST] / max(1.0, counts[LOST] + counts[ON_VEHICLE]))


def elsewhere_share(results: Sequence[OnVehicle], surface: str) -> float:
    """Return the share of pulses that return from elsewhere."""
    outcomes = np.concatenate([result.outcome[surface] for result in results])
    return float(np.mean(outcomes == ELSEWHERE))


def is_dark(result: OnVehicle) -> bool:
    """Whether the vehicle loses many of the pulses onto its paint."""
    return lost_share([result], "paint") > DARK_LOSS


def report(results: list[OnVehicle], fit: SensorFit) -> str:
    """Return all comparisons as Markdown."""
    head = (
        "| {} | vehicles | points measured | simulated | ratio (95 % interval) | with `surface_losses` |\n"
        + "|---" * 6
        + "|"
    )
    cars = [result for result in results if result.vehicle.kind in ("car", "van")]
    lines = [head.format("cars and vans, by range")]

    def row(name: str, members: list[OnVehicle]) -> str:
        ratio = jackknife(members, simulated_to_measured).text(".2f") if members else ""
        measured = sum(result.measured for result in members)
        simulated = sum(result.simulated for result in members)
        with_losses = jackknife(members, expected_to_measured).text(".2f") if members else ""
        return f"| {name} | {len(members)} | {measured:,} | {simulated:,} | {ratio} | {with_losses} |"

    for low, high in pairwise(RANGES_M):
        lines.append(row(f"{low} to {high} m", [r for r in cars if low <= r.vehicle.range_m < high]))
    lines.append(row("all", cars))
    lines += ["", head.format("by kind")]
    for kind in CONFIRMED:
        lines.append(row(kind, [result for result in results if result.vehicle.kind == kind]))

    measurable = [result for result in cars if _pulses(result, "paint") >= MIN_PULSES]
    dark = [result for result in measurable if is_dark(result)]
    bright = [result for result in measurable if not is_dark(result)]
    share = binomtest(len(dark), len(measurable)).proportion_ci(method="wilson")
    lines += ["", "| pulses onto cars and vans that do not return | share (95 % interval) |", "|---|---|"]

    def loss_row(name: str, members: list[OnVehicle], surface: str, low: float = 0.0, high: float = 90.0) -> str:
        estimate = jackknife(members, lambda some: lost_share(some, surface, low, high))
        return f"| {name} | {estimate.text('.1%')} |"

    lines += [
        f"| dark vehicles, which lose more than {DARK_LOSS:.0%} on paint: {len(dark)} of {len(measurable)} vehicles | "
        f"{len(dark) / len(measurable):.0%} ({share.low:.0%} to {share.high:.0%}) of vehicles |",
        loss_row("paint of dark vehicles", dark, "paint"),
        loss_row("paint of the others", bright, "paint"),
        loss_row("paint of the others, incidence below 75°", bright, "paint", 0, 75),
        loss_row("paint of the others, incidence 75° to 83°", bright, "paint", 75, 83),
        loss_row("paint of the others, incidence above 83°", bright, "paint", 83, 90),
        loss_row("windows of dark vehicles", dark, "glass"),
        loss_row("windows of the others", bright, "glass"),
    ]
    lines += [
        "",
        f"From elsewhere return {elsewhere_share(cars, 'paint'):.1%} of the pulses onto paint and "
        f"{elsewhere_share(cars, 'glass'):.1%} of those onto windows.",
        "",
        road_text(fit),
    ]
    return "\n".join(lines)


def _pulses(result: OnVehicle, surface: str) -> int:
    return int(np.count_nonzero(result.outcome[surface] != ELSEWHERE))


GRAZING_M, NOISE_M = (15.0, 100.0), (25.0, 120.0)
"""Ranges over which the loss at grazing incidence and the noise are fitted: beyond, hardly any pulse meets the road."""


def fit_grazing(fit: SensorFit) -> tuple[float, float, float]:
    """Return loss, angle and width of :mod:`egvs.effects.surface_losses` that fit the share of road returns best."""
    bins = [rate for rate in fit.road_rates if GRAZING_M[0] <= rate.from_m and rate.to_m <= GRAZING_M[1]]
    incidence_deg = np.array([(rate.from_deg + rate.to_deg) / 2 for rate in bins])
    lost = np.array([1.0 - rate.rate.value for rate in bins])
    se = np.array([max(rate.rate.se, 0.005) for rate in bins])

    def loss(angle_deg: FloatArray, most: float, middle_deg: float, width_deg: float) -> FloatArray:
        share: FloatArray = most * expit((angle_deg - middle_deg) / width_deg)
        return share

    values, _ = curve_fit(loss, incidence_deg, lost, p0=(0.6, 86.0, 0.2), sigma=se)
    return float(values[0]), float(values[1]), float(values[2])


def footprints_mrad(fit: SensorFit) -> list[tuple[float, float, float]]:
    """Return first and last range of each bin of noise on the road, and the footprint that explains its noise."""
    assert fit.sigma_m is not None
    result = []
    for noise in fit.noise_on_road:
        if NOISE_M[0] <= noise.from_m and noise.to_m <= NOISE_M[1]:
            incidence = np.radians(noise.incidence_deg)
            spread_m = fit.plane.height_m / np.cos(incidence) * np.tan(incidence)
            added_m = np.sqrt(noise.sigma_m.value**2 - fit.sigma_m.value**2)
            result.append((noise.from_m, noise.to_m, 1e3 * float(added_m / spread_m)))
    return result


def road_text(fit: SensorFit) -> str:
    """Say what was fitted to the road."""
    most, middle_deg, width_deg = fit_grazing(fit)
    bins = footprints_mrad(fit)
    mean = float(np.exp(np.mean([np.log(value) for _, _, value in bins])))
    by_range = ", ".join(f"{value:.3f} at {low:g} to {high:g} m" for low, high, value in bins)
    return (
        f"Loss on the road at grazing incidence: {most:.2f}, half of it at {middle_deg:.1f}°, width {width_deg:.2f}°. "
        f"Footprint that explains the noise: {by_range}; geometric mean {mean:.3f} mrad."
    )


def write_list(results: list[OnVehicle]) -> None:
    """Write :data:`LIST`."""
    with LIST.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*COLUMNS, *COUNTS))
        for result in results:
            vehicle = result.vehicle
            box = [f"{value + 0.0:.2f}" for value in vehicle.box[:6]]
            row = [vehicle.candidate, vehicle.frame, vehicle.kind, *box, f"{vehicle.box[6]:.4f}"]
            writer.writerow([*row, result.measured, result.simulated])


def main() -> None:
    """Draw the candidates, or compare the confirmed ones."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.measured_vehicles", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sheets", type=Path, help="draw all candidates in this folder, and compare nothing")
    parser.add_argument("--write", action="store_true", help=f"write {LIST.name}")
    given = parser.parse_args()
    fit, background = fit_sweeps(given.folder)
    candidates = find_candidates(fit, background)
    if given.sheets is not None:
        draw_sheets(candidates, given.sheets)
        return
    sensor = fitted_sensor(fit)
    static = cast_static(fit, build_world(fit, background), sensor)
    vehicles = confirmed_vehicles(candidates, ground_heights(fit, background))
    results = compare_vehicles(fit, background, vehicles, static, sensor)
    if given.write:
        write_list(results)
    print(report(results, fit))


if __name__ == "__main__":
    main()
