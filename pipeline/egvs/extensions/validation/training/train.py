"""Trains the PointPillars detector on simulated sweeps of junctions (``egvs train``; needs PyTorch).

Steps: get static worlds and traffic from the store, or simulate them with seeds that nothing else uses; train on
samples; now and then measure average precision on held-out frames and poses; write one ONNX file, with metadata about
its training. A checkpoint is saved beside the model from time to time, so that an interrupted training can be resumed.
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
from egvs.clouds.simulation import CloudSimulator
from egvs.clouds.sweeps import Detections
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.extensions.validation.detection_metrics import EvaluationFrames, GroundTruth, evaluate
from egvs.extensions.validation.detector_results import detections_in_roi
from egvs.extensions.validation.detectors.pointpillars import Convention, PointPillars
from egvs.extensions.validation.held_out_traffic import MIN_SPACING_S, HeldOutTraffic, prepare_held_out_traffic
from egvs.extensions.validation.training import pillar_net
from egvs.extensions.validation.training.pillar_net import Batch, PillarNet, compute_loss
from egvs.extensions.validation.training.samples import BATCH, CROP_CELLS, Samples, TrainingJunction
from egvs.runs import stage_keys
from egvs.scenario.model import Scenario
from egvs.sensors.sensor import CATALOGUE

_TRAINING_STREAM, _HELD_OUT_STREAM = 0x7EAC, 0x401D
"""Make the seeds of the training traffic and of the held-out traffic differ from each other and from all others."""

_CHECKPOINT_STEPS = 100
_LEARNING_RATE = 3e-3
_WEIGHT_DECAY = 0.01
_MAX_GRADIENT_NORM = 10.0
_WARM_UP_SHARE = 0.2
_AVERAGE_WEIGHT = 0.02  # of the last step in the running mean of the losses

_HELD_OUT_MEASURES = ("ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "recall_bev_iou50")


@dataclass(frozen=True)
class Recipe:
    """Settings of a training.

    Attributes
    ----------
    steps
        Number of training steps, each on a batch of samples.
    frames
        Number of frames of traffic of each junction.
    heights_m
        Lowest and highest mounting height above the ground.
    convention
        Where the detector measures heights from.
    sensors
        Names of sensors; the whole catalogue by default.
    seed
        Seed of traffic, poses, samples and initial weights.
    look_every
        Steps between two measurements on held-out frames.
    """

    steps: int = 3000
    frames: int = 400
    heights_m: tuple[float, float] = (2.0, 8.0)
    convention: Convention = "ground"
    sensors: tuple[str, ...] = tuple(CATALOGUE)
    seed: int = 1
    look_every: int = 500


class HeldOutSet:
    """Held-out sweeps, the same for each measurement: frames of each junction from some poses, each with a sensor.

    Parameters
    ----------
    junctions
        Junctions with held-out frames.
    recipe
        Sets the sensors and the seed.
    """

    FRAMES: ClassVar[int] = 20
    POSES: ClassVar[int] = 2

    def __init__(self, junctions: Sequence[TrainingJunction], recipe: Recipe) -> None:
        self._junctions = junctions
        self._recipe = recipe

    def measure(self, model: bytes) -> dict[str, float]:
        """Return average precision and recall of a model over all held-out sweeps."""
        truth: list[GroundTruth] = []
        detections: list[Detections] = []
        with files.temporary_folder() as folder:
            path = folder / "model.onnx"
            path.write_bytes(model)
            for number in range(len(self._junctions)):
                for pose in range(self.POSES):
                    self._run_detector(PointPillars(path), number, pose, truth, detections)
        measures = evaluate(EvaluationFrames.from_frames(truth, detections)).measures
        return {name: round(measures[name].value, 4) for name in _HELD_OUT_MEASURES}

    def _run_detector(
        self, detector: PointPillars, number: int, pose: int, truth: list[GroundTruth], detections: list[Detections]
    ) -> None:
        """Append the ground truth and the detections of one pose at one junction."""
        junction = self._junctions[number]
        scene = junction.record.scene
        rng = np.random.default_rng(np.random.SeedSequence((self._recipe.seed, number, pose)))
        sensor = scene.sensor(self._recipe.sensors[(number + pose) % len(self._recipe.sensors)])
        drawn_pose = junction.draw_pose(sensor, rng)
        simulator = CloudSimulator(scene, drawn_pose, sensor, f"held out {number, pose}", junction.scanner)
        site_detector = detector.at_site(simulator.view, scene.roi)
        for frame in junction.frames[pose :: self.POSES]:
            cloud = simulator.sweep(frame, rng)
            points_on_targets = cloud.points_on(len(frame.boxes))[frame.target_rows(scene.roi)]
            truth.append(GroundTruth.from_frame(frame, points_on_targets, scene.roi))
            detections.append(detections_in_roi(site_detector.detect(cloud.sweep), scene.roi))


def train(
    scenarios: Sequence[Scenario],
    out: Path,
    recipe: Recipe,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Train a detector on junctions and write its model.

    Parameters
    ----------
    scenarios
        The training junctions.
    out
        The file to write.
    recipe
        Settings of the training.
    jobs
        Number of threads of the simulations; one per core when None.
    progress
        Receives the number of training steps.

    Returns
    -------
    dict
        The metadata of the model.

    Raises
    ------
    InputError
        For a junction without traffic, two junctions with one name, or a checkpoint of another training.
    """
    names = [scenario.name for scenario in scenarios]
    for name in sorted(set(names)):
        if names.count(name) > 1:
            raise InputError("SCENARIO", f"two junctions have the name {name!r}", "Use junctions with different names.")
    with files.temporary_folder() as folder:

        def record_junction(scenario: Scenario, stream: int, frames: int) -> TrainingJunction:
            record = _record_traffic(scenario, folder, stream, frames, recipe.seed, jobs, progress)
            return TrainingJunction(record, recipe.heights_m)

        training = [record_junction(scenario, _TRAINING_STREAM, recipe.frames) for scenario in scenarios]
        held_out = [record_junction(scenario, _HELD_OUT_STREAM, HeldOutSet.FRAMES) for scenario in scenarios]
        samples = Samples(training, recipe.sensors, recipe.convention, recipe.seed)
        metadata = {"junctions": names, "recipe": asdict(recipe)}
        return _TrainingRun(samples, HeldOutSet(held_out, recipe), recipe, out, metadata).run(progress)


def _record_traffic(
    scenario: Scenario,
    folder: Path,
    stream: int,
    frames: int,
    seed: int,
    jobs: int | None,
    progress: ProgressCallback,
) -> HeldOutTraffic:
    """Record traffic of a junction with a seed of its own."""
    sequence = np.random.SeedSequence((scenario.seed, stream, seed))
    traffic_seed = int(sequence.generate_state(1, np.uint64)[0]) >> 33
    reseeded = scenario.model_copy(update={"seed": traffic_seed})
    record_folder = folder / f"{scenario.name}-{stream}"
    record = prepare_held_out_traffic(
        reseeded, record_folder, frames, apart_s=MIN_SPACING_S, jobs=jobs, progress=progress
    )
    if not any(len(frame.target_rows(record.scene.roi)) for frame in record.read()):
        problem = f"no vehicle in any of {frames} frames"
        raise InputError(f"{scenario.file}: roi", problem, "Use a junction with traffic in its region.")
    return record


class _TrainingRun:
    """One training: its network, its step, and its checkpoints."""

    def __init__(
        self, samples: Samples, held_out: HeldOutSet, recipe: Recipe, out: Path, metadata: dict[str, Any]
    ) -> None:
        torch.manual_seed(recipe.seed)
        self._samples = samples
        self._held_out = held_out
        self._recipe = recipe
        self._out = out
        self._net = PillarNet()
        self._optimizer = torch.optim.AdamW(self._net.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
        self._schedule = torch.optim.lr_scheduler.LambdaLR(
            self._optimizer, lambda step: _learning_rate_factor(step / recipe.steps)
        )
        self._metadata = metadata | {"code": stage_keys.source_digest(__name__).digest}
        self._checkpoint = out.with_name(out.name + ".partial")
        self._step = 0
        self._curve: list[dict[str, Any]] = []
        self._mean_losses = {"middles": 0.0, "boxes": 0.0}

    def run(self, progress: ProgressCallback) -> dict[str, Any]:
        """Train to the end, from the checkpoint if there is one; return the metadata of the model."""
        self._resume()
        while self._step < self._recipe.steps:
            centre_loss, box_loss = self._train_step()
            weight = _AVERAGE_WEIGHT if self._step else 1.0
            for name, loss in (("middles", centre_loss), ("boxes", box_loss)):
                self._mean_losses[name] += (loss - self._mean_losses[name]) * weight
            self._step += 1
            progress("steps learned", self._step, self._recipe.steps)
            if self._step % self._recipe.look_every == 0 or self._step == self._recipe.steps:
                measures = self._held_out.measure(pillar_net.export_onnx(self._net, self._model_metadata()))
                losses = {name: round(loss, 4) for name, loss in self._mean_losses.items()}
                self._curve.append({"step": self._step, **losses, **measures})
            if self._step % _CHECKPOINT_STEPS == 0:
                self._save_checkpoint()
        metadata = self._model_metadata()
        with files.atomic_write(self._out) as partial:
            partial.write_bytes(pillar_net.export_onnx(self._net, metadata))
        self._checkpoint.unlink(missing_ok=True)
        return metadata

    def _train_step(self) -> tuple[float, float]:
        """Train on one batch; return the losses of centres and boxes."""
        self._net.train()
        first = self._step * BATCH
        batch = Batch.collate([self._samples.sample(first + i) for i in range(BATCH)])
        log_odds, values = self._net(batch.features, batch.present, batch.cell, batch.samples, CROP_CELLS)
        centre_loss, box_loss = compute_loss(log_odds, values, batch)
        self._optimizer.zero_grad()
        (centre_loss + box_loss).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._net.parameters(), _MAX_GRADIENT_NORM)
        self._optimizer.step()
        self._schedule.step()
        return centre_loss.item(), box_loss.item()

    def _model_metadata(self) -> dict[str, Any]:
        return {
            "name": "pointpillars",
            "convention": self._recipe.convention,
            "egvs": __version__,
            "torch": torch.__version__,
            "parameters": sum(parameter.numel() for parameter in self._net.parameters()),
            **self._metadata,
            "curve": self._curve,
        }

    def _save_checkpoint(self) -> None:
        state = {
            "about": json.dumps(self._metadata),
            "step": self._step,
            "curve": json.dumps(self._curve),
            "mean": self._mean_losses,
            "net": self._net.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "pace": self._schedule.state_dict(),
        }
        with files.atomic_write(self._checkpoint) as partial:
            torch.save(state, partial)

    def _resume(self) -> None:
        """Load the checkpoint if there is one."""
        if not self._checkpoint.is_file():
            return
        hint = "Remove the file to restart the training."
        try:
            state = torch.load(self._checkpoint, weights_only=True)
            is_same_training = state["about"] == json.dumps(self._metadata)
        except (RuntimeError, OSError, ValueError, KeyError, EOFError) as error:
            raise InputError(self._checkpoint, f"cannot be read ({error})", hint) from None
        if not is_same_training:
            problem = "the checkpoint belongs to another training run or another version of egvs"
            raise InputError(self._checkpoint, problem, hint)
        self._net.load_state_dict(state["net"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["pace"])
        self._step = int(state["step"])
        self._curve = json.loads(state["curve"])
        self._mean_losses = dict(state["mean"])


def _learning_rate_factor(progress: float) -> float:
    """Return the share of the learning rate: linear for the first fifth of the steps, then a cosine to 0."""
    if progress < _WARM_UP_SHARE:
        return 0.05 + 0.95 * progress / _WARM_UP_SHARE
    return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (progress - _WARM_UP_SHARE) / (1.0 - _WARM_UP_SHARE)))
