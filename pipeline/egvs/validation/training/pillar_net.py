"""PillarNet, its loss, ONNX export.

How far the network is from what it should say.

For the middles, the focal loss of Law and Deng (2018, ECCV, Eq. 1): -(1 - p)^2 log p in a vehicle's cell, elsewhere
-(1 - heat)^4 p^2 log(1 - p), over the number of vehicles. For the boxes, the mean distance of their values.

The network: PointPillars' encoder and backbone (Lang et al. 2019), with a head that finds centres (Yin et al. 2021).

Anchors suit one length of vehicle; kei cars of 3.4 m and buses of 12 m share this junction, so the head says where
middles are instead. Some 0.9 million parameters.

Writes a network as an ONNX model that says how it was made.
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

from egvs.validation.detectors.pointpillars import CELLS, METADATA_KEY, N_FEATURES, N_VALUES, POINTS_PER_PILLAR
from egvs.validation.training.samples import CROP_CELLS, Sample

_BOX_WEIGHT = 0.5  # weight of the boxes beside the middles


@dataclass(frozen=True)
class Batch:
    """Some samples as tensors."""

    features: Tensor
    present: Tensor
    cell: Tensor
    heat: Tensor
    counts: Tensor
    at: tuple[Tensor, Tensor, Tensor]
    values: Tensor
    sweeps: int

    @classmethod
    def of(cls, samples: list[Sample]) -> Batch:
        """Put samples together."""
        pillars, targets = [s.pillars for s in samples], [s.target for s in samples]
        cell = np.concatenate([p.cell + i * CROP_CELLS**2 for i, p in enumerate(pillars)])
        which = np.repeat(np.arange(len(samples)), [len(t.cell) for t in targets])
        at = np.concatenate([t.cell for t in targets])
        return cls(
            torch.from_numpy(np.concatenate([p.features for p in pillars])),
            torch.from_numpy(np.concatenate([p.present for p in pillars])),
            torch.from_numpy(cell),
            torch.from_numpy(np.stack([t.heat for t in targets])),
            torch.from_numpy(np.stack([t.counts for t in targets])),
            (torch.from_numpy(which), torch.from_numpy(at[:, 0].copy()), torch.from_numpy(at[:, 1].copy())),
            torch.from_numpy(np.concatenate([t.values for t in targets])),
            len(samples),
        )


def compute_loss(odds: Tensor, values: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Of the middles, and of the boxes (weighted); their sum is what is made small.

    ``odds`` (sweeps, 1, c, c) and ``values`` (sweeps, VALUES, c, c) are the network's.
    """
    odds = odds[:, 0]
    chance = torch.sigmoid(odds)
    middle = batch.heat == 1.0
    found = -((1 - chance) ** 2 * logsigmoid(odds))[middle].sum()
    false = -((1 - batch.heat) ** 4 * chance**2 * logsigmoid(-odds) * batch.counts)[~middle].sum()
    vehicles = max(1, len(batch.values))
    which, x, y = batch.at
    off = (values[which, :, x, y] - batch.values).abs().sum() / vehicles
    return (found + false) / vehicles, _BOX_WEIGHT * off


_PILLAR_CHANNELS = 32
_WIDTHS, _DEPTHS = (32, 64, 128), (3, 4, 4)
_UPSAMPLED_CHANNELS, _HEAD_CHANNELS = 32, 48
_INITIAL_LOG_ODDS = -3.0  # log odds of a middle before anything was learned


class PillarNet(nn.Module):
    """Pillars to maps, see :mod:`egvs.validation.detectors.pointpillars`."""

    def __init__(self) -> None:
        super().__init__()
        self.point = nn.Linear(N_FEATURES, _PILLAR_CHANNELS, bias=False)
        self.point_norm = nn.BatchNorm1d(_PILLAR_CHANNELS, eps=1e-3, momentum=0.01)
        blocks, ups, before = [], [], _PILLAR_CHANNELS
        for level, (width, depth) in enumerate(zip(_WIDTHS, _DEPTHS, strict=True)):
            layers = [_convolution(before, width, 2), *(_convolution(width, width, 1) for _ in range(depth))]
            blocks.append(nn.Sequential(*layers))
            up = nn.ConvTranspose2d(width, _UPSAMPLED_CHANNELS, 2**level, stride=2**level, bias=False)
            ups.append(nn.Sequential(up, _batch_norm(_UPSAMPLED_CHANNELS), nn.ReLU()))
            before = width
        self.blocks, self.ups = nn.ModuleList(blocks), nn.ModuleList(ups)
        self.head = _convolution(_UPSAMPLED_CHANNELS * len(_WIDTHS), _HEAD_CHANNELS, 1)
        self.heat = nn.Conv2d(_HEAD_CHANNELS, 1, 1)
        self.values = nn.Conv2d(_HEAD_CHANNELS, N_VALUES, 1)
        assert self.heat.bias is not None
        nn.init.constant_(self.heat.bias, _INITIAL_LOG_ODDS)

    def forward(
        self, features: Tensor, present: Tensor, cell: Tensor, sweeps: int = 1, cells: int = CELLS
    ) -> tuple[Tensor, Tensor]:
        """Log odds of a middle (sweeps, 1, c, c), and values (sweeps, VALUES, c, c), with c = cells / 2.

        Parameters
        ----------
        features, present
            Of all pillars of all sweeps, (p, POINTS, FEATURES) and (p, POINTS).
        cell
            Of each pillar, counted on from sweep to sweep, (p,).
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


def _convolution(before: int, after: int, stride: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False), _batch_norm(after), nn.ReLU()
    )


_EXAMPLE_PILLARS = 8  # of the example that the export traces; any number will do


def export_onnx(net: PillarNet, metadata: dict[str, Any]) -> bytes:
    """The model, its description under :data:`METADATA_KEY`. The network is left in training mode as it was."""
    was_training = net.training
    net.eval()
    example = (
        torch.zeros(_EXAMPLE_PILLARS, POINTS_PER_PILLAR, N_FEATURES),
        torch.ones(_EXAMPLE_PILLARS, POINTS_PER_PILLAR),
        torch.arange(_EXAMPLE_PILLARS),
    )
    pillars = torch.export.Dim("pillars", min=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about itself
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
