"""What detectors make of the intensity of points: AP where all points have one value, or the values are shuffled.

``python -m benchmarks.intensity``: simulated sweeps of the three training junctions from random poses with three
sensors; their geometry is the same in every column. The first table has the shipped detectors as they are. The second
has the network of ``pointpillars`` with its channel fed: a constant instead of every intensity, and each point's own;
:data:`egvs.extensions.validation.detectors.pointpillars.INTENSITY` was chosen from its constants. AP is from above at
an overlap of 0.7, in %; ± is one standard error, from blocks of frames.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import egvs
from egvs.clouds.simulation import CloudSimulator
from egvs.clouds.sweeps import Detections, Sweep
from egvs.core.grid import Roi
from egvs.extensions.validation.detection_metrics import EvaluationFrames, GroundTruth, JackknifeEstimate, evaluate
from egvs.extensions.validation.detector_results import detections_in_roi
from egvs.extensions.validation.detectors.base import Detector, make_detector
from egvs.extensions.validation.detectors.pointpillars import INTENSITY, PointPillars
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.extensions.validation.training.samples import TrainingJunction
from egvs.sensors.sensor import CATALOGUE

SCENARIOS = Path(__file__).parents[1] / "scenarios"
JUNCTIONS, SENSORS = ("ingolstadt", "hill", "roundabout"), ("VLP-32C", "OS1-64", "Pandar128")
HEIGHTS_M, SPACING_S = (2.0, 8.0), 7.0
MEASURE = "ap_bev_r40_iou70"
DETECTORS = ("pointpillars", "range_image", "cluster")

Intensity = NDArray[np.float32]

SWEEPS: dict[str, Callable[[Intensity, np.random.Generator], Intensity]] = {
    "simulated": lambda intensity, _: intensity,
    "0": lambda intensity, _: np.zeros_like(intensity),
    "0.5": lambda intensity, _: np.full_like(intensity, 0.5),
    "1": lambda intensity, _: np.ones_like(intensity),
    "shuffled": lambda intensity, rng: rng.permutation(intensity),
    "unknown": lambda intensity, _: np.full_like(intensity, np.nan),
}
CONSTANTS = (0.0, 0.05, 0.1, INTENSITY, 0.25, 0.35, 0.5, 1.0)

_STREAM = 0x1A7E
"""Makes the seed of this traffic differ from that of any training and evaluation."""


class _Scored:
    """Ground truth, and the detections of each column."""

    def __init__(self) -> None:
        self.truth: list[GroundTruth] = []
        self.detections: dict[tuple[str, str], list[Detections]] = {}

    def add(self, key: tuple[str, str], found: Detections, roi: Roi) -> None:
        self.detections.setdefault(key, []).append(detections_in_roi(found, roi))

    def measure(self, key: tuple[str, str]) -> JackknifeEstimate:
        frames = EvaluationFrames.from_frames(self.truth, self.detections[key])
        return evaluate(frames).measures[MEASURE]


def sweeps_of(sweep: Sweep, rng: np.random.Generator) -> Iterator[tuple[str, Sweep]]:
    """Yield a sweep with the intensities of each column."""
    for name, change in SWEEPS.items():
        points = sweep.points.copy()
        points[:, 3] = change(points[:, 3], rng)
        yield name, replace(sweep, points=points)


def run(junction_name: str, frames: int, scored: _Scored) -> None:
    """Add the detections at one junction: a third of the frames with each sensor."""
    scenario = egvs.load(SCENARIOS / junction_name)
    seed = np.random.SeedSequence((scenario.seed, _STREAM)).generate_state(1, np.uint64)
    scenario = scenario.model_copy(update={"seed": int(seed[0]) >> 33})
    shipped: dict[str, Detector] = {name: make_detector(name) for name in DETECTORS}
    fed: dict[str, Detector] = {f"{value:g}": PointPillars(intensity=value) for value in CONSTANTS}
    fed["own"] = PointPillars(intensity=None)
    with tempfile.TemporaryDirectory() as work:
        record = prepare_held_out_traffic(scenario, Path(work), frames, apart_s=SPACING_S, jobs=1)
        junction = TrainingJunction(record, HEIGHTS_M)
        scene = record.scene
        for number, sensor_name in enumerate(SENSORS):
            rng = np.random.default_rng(np.random.SeedSequence((_STREAM, JUNCTIONS.index(junction_name), number)))
            sensor = CATALOGUE[sensor_name]
            simulator = CloudSimulator(scene, junction.draw_pose(sensor, rng), sensor, sensor_name, junction.scanner)
            shipped_here = {name: detector.at_site(simulator.view, scene.roi) for name, detector in shipped.items()}
            fed_here = {name: detector.at_site(simulator.view, scene.roi) for name, detector in fed.items()}
            for frame in junction.frames[number :: len(SENSORS)]:
                cloud = simulator.sweep(frame, rng)
                points = cloud.points_on(len(frame.boxes))[frame.target_rows(scene.roi)]
                scored.truth.append(GroundTruth.from_frame(frame, points, scene.roi))
                for column, sweep in sweeps_of(cloud.sweep, rng):
                    for name, at_site in shipped_here.items():
                        scored.add((name, column), at_site.detect(sweep), scene.roi)
                for column, at_site in fed_here.items():
                    scored.add(("fed", column), at_site.detect(cloud.sweep), scene.roi)
            print(f"{junction_name}, {sensor_name}: {len(scored.truth)} frames", flush=True)


def table(scored: _Scored, rows: tuple[str, ...], columns: tuple[str, ...], title: str) -> str:
    """Return AP as Markdown."""
    lines = [f"| {title} | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for row in rows:
        cells = [scored.measure((row, column)) for column in columns]
        lines.append(f"| {row} | " + " | ".join(f"{100 * ap.value:.1f} ± {100 * ap.se:.1f}" for ap in cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.intensity", description=__doc__.split("\n")[0])
    parser.add_argument("--junctions", default=",".join(JUNCTIONS))
    parser.add_argument("--frames", type=int, default=60, help="frames of each junction")
    given = parser.parse_args()
    scored = _Scored()
    for name in given.junctions.split(","):
        run(name, given.frames, scored)
    print(table(scored, DETECTORS, tuple(SWEEPS), "intensity of the sweeps"))
    print(table(scored, ("fed",), (*(f"{value:g}" for value in CONSTANTS), "own"), "fed to pointpillars"))


if __name__ == "__main__":
    main()
