"""The network: PointPillars' encoder and backbone (Lang et al. 2019), with a head that finds centres (Yin et al. 2021).

Anchors suit one length of vehicle; kei cars of 3.4 m and buses of 12 m share this junction, so the head says where
middles are instead. Some 0.9 million parameters.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.validation.detectors.pointpillars.decoding import VALUES
from pipeline.validation.detectors.pointpillars.encoding import CELLS, FEATURES

_PILLAR = 32
_WIDTHS, _DEPTHS = (32, 64, 128), (3, 4, 4)
_UP, _HEAD = 32, 48
_RARE = -3.0  # log odds of a middle before anything was learned


class PillarNet(nn.Module):
    """Pillars to maps, see :mod:`pipeline.validation.detectors.pointpillars.decoding`."""

    def __init__(self) -> None:
        super().__init__()
        self.point = nn.Linear(FEATURES, _PILLAR, bias=False)
        self.point_norm = nn.BatchNorm1d(_PILLAR, eps=1e-3, momentum=0.01)
        blocks, ups, before = [], [], _PILLAR
        for level, (width, depth) in enumerate(zip(_WIDTHS, _DEPTHS, strict=True)):
            layers = [_convolution(before, width, 2), *(_convolution(width, width, 1) for _ in range(depth))]
            blocks.append(nn.Sequential(*layers))
            up = nn.ConvTranspose2d(width, _UP, 2**level, stride=2**level, bias=False)
            ups.append(nn.Sequential(up, _norm(_UP), nn.ReLU()))
            before = width
        self.blocks, self.ups = nn.ModuleList(blocks), nn.ModuleList(ups)
        self.head = _convolution(_UP * len(_WIDTHS), _HEAD, 1)
        self.heat = nn.Conv2d(_HEAD, 1, 1)
        self.values = nn.Conv2d(_HEAD, VALUES, 1)
        assert self.heat.bias is not None
        nn.init.constant_(self.heat.bias, _RARE)

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
        canvas = columns.new_zeros((sweeps * cells * cells, _PILLAR))
        canvas = canvas.index_put((cell,), columns)
        image = canvas.view(sweeps, cells, cells, _PILLAR).permute(0, 3, 1, 2)
        levels = []
        for block, up in zip(self.blocks, self.ups, strict=True):
            image = block(image)
            levels.append(up(image))
        shared = self.head(torch.cat(levels, dim=1))
        return self.heat(shared), self.values(shared)


def _norm(channels: int) -> nn.Module:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def _convolution(before: int, after: int, stride: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False), _norm(after), nn.ReLU())
