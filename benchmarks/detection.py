"""What does average precision cost, on as much as a study measures?

Made-up traffic: 13 sites, 1000 frames, 3 detectors, about 8 objects and 10 detections a frame. All measures with each
block of frames left out, on one core. ``make bench`` shows it.
"""

from __future__ import annotations

import time

import numpy as np

from egvs.validation.detection_metrics import EvaluationFrames, GroundTruth, evaluate
from egvs.validation.sweeps import Detections

SITES, FRAMES, DETECTORS, MOST_S = 13, 1000, 3, 60.0


def made_up(rng: np.random.Generator, frames: int) -> tuple[list[GroundTruth], list[Detections]]:
    """Objects and what a fair detector makes of them: most are found, some twice, and some are not there."""
    objects, found = [], []
    for _ in range(frames):
        n = rng.poisson(8)
        where = np.column_stack([rng.uniform(0, 50, n), rng.uniform(0, 100, n), np.full(n, 0.8)])
        size, yaw = rng.uniform([3.5, 1.6, 1.4], [5.0, 2.2, 1.8], (n, 3)), rng.uniform(-3, 3, n)
        boxes = np.column_stack([where, size, yaw])
        objects.append(GroundTruth(boxes, rng.random(n) < 0.8, rng.integers(0, 60, n)))
        seen = np.repeat(boxes, rng.choice([0, 1, 2], n, p=[0.1, 0.7, 0.2]), axis=0)
        seen = seen + rng.normal(0, [0.2, 0.1, 0.05, 0.2, 0.1, 0.1, 0.05], seen.shape)
        astray = np.column_stack([rng.uniform(0, 50, (2, 2)), np.tile([0.8, 4.5, 1.8, 1.5, 0.0], (2, 1))])
        both = np.concatenate([seen, astray])
        found.append(Detections(both, rng.random(len(both))))
    return objects, found


def rows() -> list[tuple[str, str, str, bool]]:
    """Lines of the table of ``make bench``."""
    rng = np.random.default_rng(0)
    evaluate(EvaluationFrames.from_frames(*made_up(rng, 20)))  # compiles
    took, measures = 0.0, 0
    for _ in range(DETECTORS):
        objects, found = made_up(rng, FRAMES)
        for _ in range(SITES):
            start = time.perf_counter()
            measures = len(evaluate(EvaluationFrames.from_frames(objects, found)).measures)
            took += time.perf_counter() - start
    what = f"AP: {SITES} sites x {FRAMES} frames x {DETECTORS} detectors, {measures} measures, 10 blocks left out"
    return [(what, f"{took:.1f} s", f"{MOST_S:.0f} s", took < MOST_S)]
