"""The detector ``cluster`` on real sweeps.

``python -m benchmarks.measured_detection FOLDER [--pictures DIR]``: FOLDER contains ``sweep.pcd.gz`` and
``frames.npz``, eleven sweeps of one unit. The detector gets what it gets from a simulated site: the fitted sensor and
pose, the empty scan (of the ten frames), and one sweep after another. Its boxes on the carriageway are compared with
the vehicles that were confirmed by eye (:mod:`benchmarks.measured_vehicles`): one is found if the centre of a box lies
within :data:`NEAR_M` of its box. The other boxes are counted by lane and range: on a barrier or the median they are
false, in a lane they may be vehicles of too few returns to be confirmed. ``--pictures`` draws all sweeps from above.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.measured_sweep import fit_sweeps, fitted_sensor
from benchmarks.measured_vehicles import (
    ROAD_M,
    Vehicle,
    confirmed_vehicles,
    find_candidates,
    ground_heights,
)
from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.extensions.hardware.fit import empty_scan, output
from egvs.extensions.hardware.fit.empty_scan import EmptyScanFit
from egvs.extensions.hardware.fit.fit import SensorFit
from egvs.extensions.validation.detector_results import detections_in_roi
from egvs.extensions.validation.detectors.cluster import Cluster
from egvs.sensors.sites import Pose

NEAR_M = 1.0
BARRIERS_M = {"outer barrier": ((-16.5, -15.0), (15.5, 17.0)), "median": ((-2.2, 2.2),)}
"""Where the barriers and the median are, across the road."""
RANGES_M = 0, 20, 40, 55, 95
ACROSS_DEG = 30.0
"""A box whose heading differs by more from that of the road is across it."""
SCORES = 0.0, 0.1


@dataclass(frozen=True)
class SweepResult:
    """What the detector found in one sweep.

    Attributes
    ----------
    number
        Number of the sweep.
    detections
        Boxes on the carriageway, upright.
    vehicles
        The confirmed vehicles.
    found
        For each vehicle, whether a box is on it, (v,) bool.
    correct
        For each box, whether it is on a vehicle, (m,) bool.
    """

    number: int
    detections: Detections
    vehicles: list[Vehicle]
    found: BoolArray
    correct: BoolArray


def site_view(fit: SensorFit, background: EmptyScanFit) -> SiteView:
    """Return what the detector knows about the unit."""
    points = empty_scan.points_of(background.range_m, fit.angles)[fit.angles.ascending]
    range_m = np.linalg.norm(points, axis=-1)
    empty_m = np.where(np.isfinite(range_m), range_m, np.inf).T.ravel()
    plane = fit.plane
    pose = Pose(0.0, 0.0, plane.height_m, 0.0, plane.pitch_deg, plane.roll_deg)
    return SiteView("measured", pose, fitted_sensor(fit), empty_m)


def sweep_of(range_m: FloatArray, fit: SensorFit) -> Sweep:
    """Return a measured sweep as detectors receive it; its intensity is unknown."""
    points = empty_scan.points_of(range_m, fit.angles)[fit.angles.ascending].transpose(1, 0, 2).reshape(-1, 3)
    beam = np.flatnonzero(np.isfinite(points[:, 0]))
    columns = np.column_stack([points[beam], np.full(len(beam), np.nan)]).astype(np.float32)
    return Sweep(columns, beam.astype(np.uint32))


def detect_all(folder: Path) -> tuple[SensorFit, list[SweepResult]]:
    """Run the detector on all sweeps."""
    fit, background = fit_sweeps(folder)
    vehicles = confirmed_vehicles(find_candidates(fit, background), ground_heights(fit, background))
    (low_x, high_x), (low_y, high_y) = ROAD_M
    roi = Roi((low_x, low_y, -0.5), (high_x - low_x, high_y - low_y, 6.0))
    detector = Cluster().at_site(site_view(fit, background), roi)
    results = []
    for number, grid in enumerate(fit.grids):
        detections = detections_in_roi(detector.detect(sweep_of(grid.range_m, fit)), roi)
        members = [vehicle for vehicle in vehicles if vehicle.frame == number]
        near = np.array([[_is_near(box, vehicle.box) for box in detections.boxes] for vehicle in members])
        near = near.reshape(len(members), len(detections.boxes)).astype(np.bool_)
        found = np.asarray(np.any(near, axis=1), dtype=np.bool_)
        correct = np.asarray(np.any(near, axis=0), dtype=np.bool_)
        results.append(SweepResult(number, detections, members, found, correct))
    return fit, results


def _is_near(box: FloatArray, vehicle: FloatArray) -> bool:
    return bool((np.abs(box[:2] - vehicle[:2]) < vehicle[3:5] / 2 + NEAR_M).all())


def strip_of(y_m: float) -> str:
    """Return what is at this position across the road: a barrier, the median, or the lanes of a direction."""
    for name, strips in BARRIERS_M.items():
        if any(low <= y_m <= high for low, high in strips):
            return name
    return "lanes towards -x" if y_m > 0 else "lanes towards +x"


def report(results: list[SweepResult]) -> str:
    """Return the counts as Markdown."""
    lines = [
        "| range | confirmed vehicles | found | other boxes in lanes | boxes across the road |",
        "|---|---|---|---|---|",
    ]
    boxes = np.concatenate([result.detections.boxes for result in results])
    scores = np.concatenate([result.detections.scores for result in results])
    correct = np.concatenate([result.correct for result in results])
    found = np.concatenate([result.found for result in results])
    vehicle_m = np.array([vehicle.range_m for result in results for vehicle in result.vehicles])
    range_m = np.hypot(boxes[:, 0], boxes[:, 1])
    strips = np.array([strip_of(y_m) for y_m in boxes[:, 1]])
    in_lanes = np.char.startswith(strips, "lanes")
    across = np.abs(np.sin(boxes[:, 6])) > np.sin(np.radians(ACROSS_DEG))
    for low, high in pairwise(RANGES_M):
        members = (range_m >= low) & (range_m < high)
        vehicles = (vehicle_m >= low) & (vehicle_m < high)
        lines.append(
            f"| {low} to {high} m | {vehicles.sum()} | {found[vehicles].sum()} | "
            f"{(members & in_lanes & ~correct).sum()} | {(members & across).sum()} of {members.sum()} |"
        )
    lines += ["", "| other boxes | all | score above 0.1 |", "|---|---|---|"]
    for strip in ("lanes towards +x", "lanes towards -x", *BARRIERS_M):
        counts = [int((~correct & (strips == strip) & (scores > least)).sum()) for least in SCORES]
        lines.append(f"| {strip} | {counts[0]} | {counts[1]} |")
    return "\n".join(lines)


def draw(fit: SensorFit, results: list[SweepResult], folder: Path) -> None:
    """Draw every sweep from above with confirmed vehicles (grey) and boxes of the detector."""
    folder.mkdir(parents=True, exist_ok=True)
    for result in results:
        figure = Figure(figsize=(17, 5.5), layout="tight")
        axes = figure.subplots()
        points = output.upright(empty_scan.points_of(fit.grids[result.number].range_m, fit.angles), fit.plane).reshape(
            -1, 3
        )
        points = points[(points[:, 2] > 0.2) & (points[:, 2] < 5.0)]
        axes.plot(points[:, 0], points[:, 1], ",", color="0.5")
        for vehicle in result.vehicles:
            _draw_box(axes, vehicle.box, "0.3", 3.0)
        for box, is_correct in zip(result.detections.boxes, result.correct, strict=True):
            _draw_box(axes, box, "tab:green" if is_correct else "tab:red", 1.2)
            axes.plot(box[0] + np.cos(box[6]) * box[3] / 2, box[1] + np.sin(box[6]) * box[3] / 2, "k.", ms=4)
        axes.set_xlim(*ROAD_M[0])
        axes.set_ylim(ROAD_M[1][0] - 2, ROAD_M[1][1] + 2)
        axes.set_aspect("equal")
        axes.set_title(
            f"sweep {result.number}: {result.found.sum()} of {len(result.vehicles)} found, "
            f"{(~result.correct).sum()} other boxes"
        )
        figure.savefig(folder / f"sweep_{result.number:02d}.png", dpi=60)


def _draw_box(axes: Any, box: FloatArray, colour: str, width: float) -> None:
    corners = 0.5 * box[3:5] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]])
    cos, sin = np.cos(box[6]), np.sin(box[6])
    axes.plot(*(box[:2] + corners @ np.array([[cos, sin], [-sin, cos]])).T, color=colour, lw=width)


def main() -> None:
    """Print the counts, and draw the sweeps."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.measured_detection", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=Path, help="draw all sweeps in this folder")
    given = parser.parse_args()
    fit, results = detect_all(given.folder)
    print(report(results))
    if given.pictures is not None:
        draw(fit, results, given.pictures)


if __name__ == "__main__":
    main()
