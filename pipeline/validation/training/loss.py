"""How far the network is from what it should say.

For the middles, the focal loss of Law and Deng (2018, ECCV, Eq. 1): -(1 - p)^2 log p in a vehicle's cell, elsewhere
-(1 - heat)^4 p^2 log(1 - p), over the number of vehicles. For the boxes, the mean distance of their values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from pipeline.validation.training.samples import CROP_CELLS, Sample

_BOXES = 0.5  # weight of the boxes beside the middles


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


def loss(odds: Tensor, values: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
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
    return (found + false) / vehicles, _BOXES * off
