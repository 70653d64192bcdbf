"""Measures a detector on frames and poses of the training junctions that it did not learn from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.core import files
from pipeline.validation.clouds.point_clouds import CloudMaker
from pipeline.validation.detectors.pointpillars.detector import PointPillars
from pipeline.validation.metrics.average_precision import evaluate
from pipeline.validation.metrics.matching import Objects, Record, within
from pipeline.validation.sweeps import Detections
from pipeline.validation.training.samples import Junction

if TYPE_CHECKING:
    from pipeline.validation.training.train import Recipe

_MEASURES = ("ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "recall_bev_iou50")


class HeldOut:
    """Sweeps of held-out frames, the same at each measurement.

    Each junction's frames are taken from a few poses, a sensor and a height each.
    """

    FRAMES: ClassVar[int] = 20
    POSES: ClassVar[int] = 2

    def __init__(self, junctions: Sequence[Junction], recipe: Recipe) -> None:
        self._junctions, self._recipe = junctions, recipe

    def measure(self, model: bytes) -> dict[str, float]:
        """Average precision of a model over all held-out sweeps."""
        truth: list[Objects] = []
        found: list[Detections] = []
        with files.scratch() as folder:
            path = folder / "model.onnx"
            path.write_bytes(model)
            for number, junction in enumerate(self._junctions):
                for pose in range(self.POSES):
                    self._look(PointPillars(path), junction, (number, pose), truth, found)
        measures = evaluate(Record.of(truth, found)).measures
        return {name: round(measures[name].value, 4) for name in _MEASURES}

    def _look(
        self,
        detector: PointPillars,
        junction: Junction,
        which: tuple[int, int],
        truth: list[Objects],
        found: list[Detections],
    ) -> None:
        scene, random = (
            junction.record.scene,
            np.random.default_rng(np.random.SeedSequence((self._recipe.seed, *which))),
        )
        sensor = scene.sensor(self._recipe.sensors[sum(which) % len(self._recipe.sensors)])
        maker = CloudMaker(scene, junction.rule.draw(sensor, random), sensor, f"held out {which}", junction.scanner)
        at_site = detector.at(maker.view, scene.roi)
        for frame in junction.frames[which[1] :: self.POSES]:
            swept = maker.sweep(frame, random)
            truth.append(Objects.of(frame, swept.points_on(len(frame.boxes)), scene.roi))
            found.append(within(at_site.detect(swept.sweep), scene.roi))
