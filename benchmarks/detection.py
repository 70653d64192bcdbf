"""Cost of average precision, for as much data as a study evaluates.

Random traffic: 13 sites, 1000 frames, 3 detectors, about 8 objects and 10 detections per frame. All measures with each
block of frames left out, on one core. Printed by ``make bench``.
"""

from __future__ import annotations

import time

import numpy as np

from egvs.clouds.sweeps import Detections
from egvs.extensions.validation.detection_metrics import EvaluationFrames, GroundTruth, evaluate

SITES, FRAMES, DETECTORS, MAX_S = 13, 1000, 3, 60.0


def random_detections(rng: np.random.Generator, frames: int) -> tuple[list[GroundTruth], list[Detections]]:
    """Return random objects, and detections of most of them: some twice, and some where there is no object."""
    objects, detections = [], []
    for _ in range(frames):
        n = rng.poisson(8)
        centres = np.column_stack([rng.uniform(0, 50, n), rng.uniform(0, 100, n), np.full(n, 0.8)])
        size, yaw = rng.uniform([3.5, 1.6, 1.4], [5.0, 2.2, 1.8], (n, 3)), rng.uniform(-3, 3, n)
        boxes = np.column_stack([centres, size, yaw])
        objects.append(GroundTruth(boxes, rng.random(n) < 0.8, rng.integers(0, 60, n)))
        detected = np.repeat(boxes, rng.choice([0, 1, 2], n, p=[0.1, 0.7, 0.2]), axis=0)
        detected = detected + rng.normal(0, [0.2, 0.1, 0.05, 0.2, 0.1, 0.1, 0.05], detected.shape)
        false_alarms = np.column_stack([rng.uniform(0, 50, (2, 2)), np.tile([0.8, 4.5, 1.8, 1.5, 0.0], (2, 1))])
        all_boxes = np.concatenate([detected, false_alarms])
        detections.append(Detections(all_boxes, rng.random(len(all_boxes))))
    return objects, detections


def rows() -> list[tuple[str, str, str, bool]]:
    """Return a row of the table of ``make bench``."""
    rng = np.random.default_rng(0)
    evaluate(EvaluationFrames.from_frames(*random_detections(rng, 20)))  # compiles
    seconds, measures = 0.0, 0
    for _ in range(DETECTORS):
        objects, detections = random_detections(rng, FRAMES)
        for _ in range(SITES):
            start = time.perf_counter()
            measures = len(evaluate(EvaluationFrames.from_frames(objects, detections)).measures)
            seconds += time.perf_counter() - start
    what = f"AP: {SITES} sites x {FRAMES} frames x {DETECTORS} detectors, {measures} measures, 10 blocks left out"
    return [(what, f"{seconds:.1f} s", f"{MAX_S:.0f} s", seconds < MAX_S)]
