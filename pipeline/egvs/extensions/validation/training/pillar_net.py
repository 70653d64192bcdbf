"""The network of the PointPillars detector, its loss, and its export to ONNX (needs PyTorch).

**Network:** PointPillars' encoder and backbone (Lang et al. 2019), with a head that finds centres (Yin et al. 2021).
Anchors fit one length of vehicles; from kei cars of 3.4 m to buses of 12 m there is more than one, so the head returns
where centres are instead. About 0.9 million parameters.

**Loss:** for the centres, the focal loss of Law and Deng (2018, ECCV, Eq. 1): -(1 - p)^2 log p in the cell of a
vehicle, elsewhere -(1 - heat)^4 p^2 log(1 - p), divided by the number of vehicles. For the boxes, the mean absolute
difference of their values.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from egvs.extensions.validation.detectors.pointpillars import (
    CELLS,
    METADATA_KEY,
    N_FEATURES,
    N_VALUES,
    POINTS_PER_PILLAR,
)
from egvs.extensions.validation.training.samples import CROP_CELLS, Sample

_BOX_WEIGHT = 0.5  # weight of the loss of the boxes, relative to that of the centres


@dataclass(frozen=True)
class Batch:
    """Samples as tensors.

    Attributes
    ----------
    features, present, cell
        Pillars of all samples; cells are counted on from sample to sample.
    heat, loss_weight
        Maps of each sample, (samples, c, c).
    centres
        Sample, row and column of the cell of each vehicle.
    values
        Values of the box of each vehicle, (vehicles, N_VALUES).
    samples
        Number of samples.
    """

    features: Tensor
    present: Tensor
    cell: Tensor
    heat: Tensor
    loss_weight: Tensor
    centres: tuple[Tensor, Tensor, Tensor]
    values: Tensor
    samples: int

    @classmethod
    def collate(cls, samples: list[Sample]) -> Batch:
        """Combine samples."""
        pillars = [sample.pillars for sample in samples]
        targets = [sample.target for sample in samples]
        cell = np.concatenate([each.cell + number * CROP_CELLS**2 for number, each in enumerate(pillars)])
        sample = np.repeat(np.arange(len(samples)), [len(target.cell) for target in targets])
        centres = np.concatenate([target.cell for target in targets])
        return cls(
            torch.from_numpy(np.concatenate([each.features for each in pillars])),
            torch.from_numpy(np.concatenate([each.present for each in pillars])),
            torch.from_numpy(cell),
            torch.from_numpy(np.stack([target.heat for target in targets])),
            torch.from_numpy(np.stack([target.loss_weight for target in targets])),
            (torch.from_numpy(sample), torch.from_numpy(centres[:, 0].copy()), torch.from_numpy(centres[:, 1].copy())),
            torch.from_numpy(np.concatenate([target.values for target in targets])),
            len(samples),
        )


def compute_loss(log_odds: Tensor, values: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return the loss of the centres, and that of the boxes with its weight; training minimises their sum.

    Parameters
    ----------
    log_odds, values
        Maps of the network, (samples, 1, c, c) and (samples, N_VALUES, c, c).
    batch
        The samples with their targets.
    """
    log_odds = log_odds[:, 0]
    probability = torch.sigmoid(log_odds)
    is_centre = batch.heat == 1.0
    centre_loss = -((1 - probability) ** 2 * logsigmoid(log_odds))[is_centre].sum()
    elsewhere = (1 - batch.heat) ** 4 * probability**2 * logsigmoid(-log_odds) * batch.loss_weight
    elsewhere_loss = -elsewhere[~is_centre].sum()
    vehicles = max(1, len(batch.values))
    sample, row, column = batch.centres
    box_loss = (values[sample, :, row, column] - batch.values).abs().sum() / vehicles
    return (centre_loss + elsewhere_loss) / vehicles, _BOX_WEIGHT * box_loss


_PILLAR_CHANNELS = 32
_BLOCK_WIDTHS = (32, 64, 128)
_BLOCK_DEPTHS = (3, 4, 4)
_UPSAMPLED_CHANNELS = 32
_HEAD_CHANNELS = 48
_INITIAL_LOG_ODDS = -3.0  # of a centre, before training
_EXAMPLE_PILLARS = 8  # of the example that the export traces; any number works


class PillarNet(nn.Module):
    """Computes maps from pillars, see :mod:`egvs.extensions.validation.detectors.pointpillars`."""

    def __init__(self) -> None:
        super().__init__()
        self.point = nn.Linear(N_FEATURES, _PILLAR_CHANNELS, bias=False)
        self.point_norm = nn.BatchNorm1d(_PILLAR_CHANNELS, eps=1e-3, momentum=0.01)
        blocks: list[nn.Module] = []
        ups: list[nn.Module] = []
        channels = _PILLAR_CHANNELS
        for level, (width, depth) in enumerate(zip(_BLOCK_WIDTHS, _BLOCK_DEPTHS, strict=True)):
            layers = [_convolution(channels, width, 2), *(_convolution(width, width, 1) for _ in range(depth))]
            blocks.append(nn.Sequential(*layers))
            up = nn.ConvTranspose2d(width, _UPSAMPLED_CHANNELS, 2**level, stride=2**level, bias=False)
            ups.append(nn.Sequential(up, _batch_norm(_UPSAMPLED_CHANNELS), nn.ReLU()))
            channels = width
        self.blocks = nn.ModuleList(blocks)
        self.ups = nn.ModuleList(ups)
        self.head = _convolution(_UPSAMPLED_CHANNELS * len(_BLOCK_WIDTHS), _HEAD_CHANNELS, 1)
        self.heat = nn.Conv2d(_HEAD_CHANNELS, 1, 1)
        self.values = nn.Conv2d(_HEAD_CHANNELS, N_VALUES, 1)
        assert self.heat.bias is not None
        nn.init.constant_(self.heat.bias, _INITIAL_LOG_ODDS)

    def forward(
        self, features: Tensor, present: Tensor, cell: Tensor, sweeps: int = 1, cells: int = CELLS
    ) -> tuple[Tensor, Tensor]:
        """Return log odds of centres (sweeps, 1, c, c), and values (sweeps, N_VALUES, c, c), with c = cells / 2.

        Parameters
        ----------
        features, present
            Pillars of all sweeps, (p, POINTS_PER_PILLAR, N_FEATURES) and (p, POINTS_PER_PILLAR).
        cell
            Cell of each pillar, counted on from sweep to sweep, (p,).
        sweeps
            Number of sweeps.
        cells
            Pillars along each side of a window.
        """
        points = self.point(features)
        points = self.point_norm(points.transpose(1, 2)).transpose(1, 2)
        columns = (torch.relu(points) * present.unsqueeze(2)).amax(dim=1)
        canvas = columns.new_zeros((sweeps * cells * cells, _PILLAR_CHANNELS))
        canvas = canvas.index_put((cell,), columns)
        image = canvas.view(sweeps, cells, cells, _PILLAR_CHANNELS).permute(0, 3, 1, 2)
        levels = []
        for block, up in zip(self.blocks, self.ups, strict=True):
            image = block(image)
            levels.append(up(image))
        shared = self.head(torch.cat(levels, dim=1))
        return self.heat(shared), self.values(shared)


def _batch_norm(channels: int) -> nn.Module:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def _convolution(inputs: int, outputs: int, stride: int) -> nn.Module:
    convolution = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False)
    return nn.Sequential(convolution, _batch_norm(outputs), nn.ReLU())


def export_onnx(net: PillarNet, metadata: dict[str, Any]) -> bytes:
    """Return the model as ONNX, with metadata under :data:`METADATA_KEY`.

    The network keeps its mode (training or evaluation).
    """
    was_training = net.training
    net.eval()
    example = (
        torch.zeros(_EXAMPLE_PILLARS, POINTS_PER_PILLAR, N_FEATURES),
        torch.ones(_EXAMPLE_PILLARS, POINTS_PER_PILLAR),
        torch.arange(_EXAMPLE_PILLARS),
    )
    pillars = torch.export.Dim("pillars", min=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations within the exporter
        program = torch.onnx.export(
            net,
            example,
            input_names=["features", "present", "cell"],
            output_names=["heat", "values"],
            dynamic_shapes={"features": {0: pillars}, "present": {0: pillars}, "cell": {0: pillars}},
            dynamo=True,
            verbose=False,
        )
    net.train(was_training)
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(metadata, sort_keys=True)})
    return bytes(model.SerializeToString(deterministic=True))
