"""Egvs train: the loop, held-out AP.

Measures a detector on frames and poses of the training junctions that it did not learn from.

Trains the detector on sweeps of training junctions, and writes it as one ONNX file that says how it was made.

Steps: bring static worlds and records through the store, under seeds that nothing else draws; learn from samples;
now and then measure average precision on held-out frames and poses; export. What was learned is kept beside the model
every so often, so that an interrupted training goes on from there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from egvs._version import __version__
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.runs import stages
from egvs.scenario.model import Scenario
from egvs.validation.cloud_simulation import CloudSimulator
from egvs.validation.detection_metrics import EvaluationFrames, GroundTruth, evaluate
from egvs.validation.detectors.pointpillars import Convention, PointPillars
from egvs.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.sweeps import Detections, detections_in_roi
from egvs.validation.training import pillar_net
from egvs.validation.training.pillar_net import Batch, PillarNet, compute_loss
from egvs.validation.training.samples import BATCH, CROP_CELLS, Samples, TrainingJunction

_MEASURES = ("ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "recall_bev_iou50")


class HeldOutSet:
    """Sweeps of held-out frames, the same at each measurement.

    Each junction's frames are taken from a few poses, a sensor and a height each.
    """

    FRAMES: ClassVar[int] = 20
    POSES: ClassVar[int] = 2

    def __init__(self, junctions: Sequence[TrainingJunction], recipe: Recipe) -> None:
        self._junctions, self._recipe = junctions, recipe

    def measure(self, model: bytes) -> dict[str, float]:
        """Average precision of a model over all held-out sweeps."""
        truth: list[GroundTruth] = []
        found: list[Detections] = []
        with files.temporary_folder() as folder:
            path = folder / "model.onnx"
            path.write_bytes(model)
            for number, junction in enumerate(self._junctions):
                for pose in range(self.POSES):
                    self._run_detector(PointPillars(path), junction, (number, pose), truth, found)
        measures = evaluate(EvaluationFrames.from_frames(truth, found)).measures
        return {name: round(measures[name].value, 4) for name in _MEASURES}

    def _run_detector(
        self,
        detector: PointPillars,
        junction: TrainingJunction,
        which: tuple[int, int],
        truth: list[GroundTruth],
        detections: list[Detections],
    ) -> None:
        scene, random = (
            junction.record.scene,
            np.random.default_rng(np.random.SeedSequence((self._recipe.seed, *which))),
        )
        sensor = scene.sensor(self._recipe.sensors[sum(which) % len(self._recipe.sensors)])
        maker = CloudSimulator(scene, junction.rule.draw(sensor, random), sensor, f"held out {which}", junction.scanner)
        at_site = detector.at_site(maker.view, scene.roi)
        for frame in junction.frames[which[1] :: self.POSES]:
            swept = maker.sweep(frame, random)
            truth.append(
                GroundTruth.from_frame(
                    frame, swept.points_on(len(frame.boxes))[frame.target_rows(scene.roi)], scene.roi
                )
            )
            detections.append(detections_in_roi(at_site.detect(swept.sweep), scene.roi))


SENSORS = ("VLP-32C", "Pandar XT-32", "OS1-64")
_TRAINING_STREAM, _TEST_STREAM = 0x7EAC, 0x401D
"""Tell the seeds of the traffic to learn from, and of that to measure with, from each other and from all others."""

_KEEP_EVERY = 100
_RATE, _DECAY, _LONGEST = 3e-3, 0.01, 10.0
_WARM_UP = 0.2
_NEWEST = 0.02  # weight of the last step in the losses that are told


@dataclass(frozen=True)
class Recipe:
    """How a detector is trained.

    Attributes
    ----------
    steps
        Of learning, each from a batch of samples.
    frames
        Of traffic of each junction.
    heights_m
        Of the sensors above the ground, from and to.
    convention
        What the detector counts heights from.
    look_every
        Steps between two measurements on held-out frames.
    """

    steps: int = 3000
    frames: int = 400
    heights_m: tuple[float, float] = (2.0, 7.0)
    convention: Convention = "ground"
    sensors: tuple[str, ...] = SENSORS
    seed: int = 1
    look_every: int = 500


def train(
    scenarios: Sequence[Scenario],
    out: Path,
    recipe: Recipe,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Train a detector on junctions and write it; what it says of itself.

    Raises
    ------
    InputError
        For a junction without traffic, a name that occurs twice, or what is kept of another training.
    """
    names = [scenario.name for scenario in scenarios]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError("SCENARIO", f"{twice[0]!r} twice", "junctions of different names")
    with files.temporary_folder() as folder:
        learn = [_record_traffic(s, _TRAINING_STREAM, recipe, recipe.frames, folder, jobs, progress) for s in scenarios]
        hold = [_record_traffic(s, _TEST_STREAM, recipe, HeldOutSet.FRAMES, folder, jobs, progress) for s in scenarios]
        samples = Samples(
            [TrainingJunction(record, recipe.heights_m) for record in learn],
            recipe.sensors,
            recipe.convention,
            recipe.seed,
        )
        held_out = HeldOutSet([TrainingJunction(record, recipe.heights_m) for record in hold], recipe)
        course = _TrainingRun(samples, held_out, recipe, out, {"junctions": names, "recipe": asdict(recipe)})
        return course.run(progress)


def _record_traffic(
    scenario: Scenario,
    stream: int,
    recipe: Recipe,
    frames: int,
    folder: Path,
    jobs: int | None,
    progress: ProgressCallback,
) -> HeldOutTraffic:
    """Traffic of a junction under a seed of its own."""
    seed = int(np.random.SeedSequence((scenario.seed, stream, recipe.seed)).generate_state(1, np.uint64)[0]) >> 33
    own = scenario.model_copy(update={"seed": seed})
    record = prepare_held_out_traffic(own, folder / f"{scenario.name}-{stream}", frames, jobs=jobs, progress=progress)
    if not any(len(frame.target_rows(record.scene.roi)) for frame in record.read()):
        raise InputError(f"{scenario.file}: roi", f"no vehicle in any of {frames} frames", "a junction with traffic")
    return record


class _TrainingRun:
    """One training: its network, how far it is, and what is kept of it."""

    def __init__(
        self, samples: Samples, held_out: HeldOutSet, recipe: Recipe, out: Path, metadata: dict[str, Any]
    ) -> None:
        torch.manual_seed(recipe.seed)
        self._samples, self._held_out, self._recipe, self._out = samples, held_out, recipe, out
        self._net = PillarNet()
        self._optimizer = torch.optim.AdamW(self._net.parameters(), lr=_RATE, weight_decay=_DECAY)
        self._pace = torch.optim.lr_scheduler.LambdaLR(
            self._optimizer, lambda step: _learning_rate_share(step / recipe.steps)
        )
        self._metadata = metadata | {"code": stages.source_digest(__name__).digest}
        self._checkpoint = out.with_name(out.name + ".partial")
        self._step, self._curve = 0, list[dict[str, Any]]()
        self._mean = {"middles": 0.0, "boxes": 0.0}

    def run(self, progress: ProgressCallback) -> dict[str, Any]:
        """Learn to the end, from where it was left."""
        self._resume()
        while self._step < self._recipe.steps:
            middles, boxes = self._learn()
            for name, value in (("middles", middles), ("boxes", boxes)):
                self._mean[name] += (value - self._mean[name]) * (_NEWEST if self._step else 1.0)
            self._step += 1
            progress("steps learned", self._step, self._recipe.steps)
            if self._step % self._recipe.look_every == 0 or self._step == self._recipe.steps:
                measured = self._held_out.measure(pillar_net.export_onnx(self._net, self._description()))
                losses = {name: round(value, 4) for name, value in self._mean.items()}
                self._curve.append({"step": self._step, **losses, **measured})
            if self._step % _KEEP_EVERY == 0:
                self._save_checkpoint()
        about = self._description()
        with files.atomic_write(self._out) as partial:
            partial.write_bytes(pillar_net.export_onnx(self._net, about))
        self._checkpoint.unlink(missing_ok=True)
        return about

    def _learn(self) -> tuple[float, float]:
        self._net.train()
        first = self._step * BATCH
        batch = Batch.of([self._samples.sample(first + i) for i in range(BATCH)])
        odds, values = self._net(batch.features, batch.present, batch.cell, batch.sweeps, CROP_CELLS)
        middles, boxes = compute_loss(odds, values, batch)
        self._optimizer.zero_grad()
        (middles + boxes).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._net.parameters(), _LONGEST)
        self._optimizer.step()
        self._pace.step()
        return middles.item(), boxes.item()

    def _description(self) -> dict[str, Any]:
        """What the model says of itself."""
        return {
            "name": "pointpillars",
            "convention": self._recipe.convention,
            "egvs": __version__,
            "torch": torch.__version__,
            "parameters": sum(p.numel() for p in self._net.parameters()),
            **self._metadata,
            "curve": self._curve,
        }

    def _save_checkpoint(self) -> None:
        state = {
            "about": json.dumps(self._metadata),
            "step": self._step,
            "curve": json.dumps(self._curve),
            "mean": self._mean,
            "net": self._net.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "pace": self._pace.state_dict(),
        }
        with files.atomic_write(self._checkpoint) as partial:
            torch.save(state, partial)

    def _resume(self) -> None:
        if not self._checkpoint.is_file():
            return
        try:
            state = torch.load(self._checkpoint, weights_only=True)
            same = state["about"] == json.dumps(self._metadata)
        except (RuntimeError, OSError, ValueError, KeyError, EOFError) as error:
            raise InputError(self._checkpoint, f"cannot be read ({error})", "remove it, and train anew") from None
        if not same:
            raise InputError(
                self._checkpoint, "is of another training, or of another program", "remove it, and train anew"
            )
        self._net.load_state_dict(state["net"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._pace.load_state_dict(state["pace"])
        self._step, self._curve, self._mean = int(state["step"]), json.loads(state["curve"]), dict(state["mean"])


def _learning_rate_share(done: float) -> float:
    """Share of the learning rate once this share of the steps is done: up for the first fifth, then a cosine to 0."""
    if done < _WARM_UP:
        return 0.05 + 0.95 * done / _WARM_UP
    return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (done - _WARM_UP) / (1.0 - _WARM_UP)))
