r"""Estimates how far a measure may be off because the frames are few, and keeps what that is known from.

Frames are cut into blocks of neighbours: what is detected in one frame is much like what is detected in the next. The
measure is computed again with each block left out: the delete-a-group jackknife. With k blocks of m_g of T frames, h_g
= T / m_g, the measure of all frames and with block g left out (Busing, Meijer, van der Leeden, Statistics and Computing
9, 1999),

.. math:: P_g = h_g \theta - (h_g - 1) \theta_{(g)}, \qquad \tilde\theta = \sum_g P_g / h_g, \qquad
          se^2 = \frac{1}{k} \sum_g \frac{(P_g - \tilde\theta)^2}{h_g - 1}

All sites have the same frames and blocks, so that a correlation over sites can resample blocks of all sites together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError

BLOCKS = 10
"""Blocks of frames, unless asked otherwise."""


@dataclass(frozen=True)
class Estimate:
    """A measure, and how far it may be off.

    Attributes
    ----------
    value
        Of all frames; NaN where it is not defined.
    left_out
        With each block left out, (blocks,) float64; NaN where it is not defined.
    se
        Standard error; NaN where one of these is not defined.
    """

    value: float
    left_out: NDArray[np.float64]
    se: float

    @classmethod
    def of(cls, values: NDArray[np.float64], block_frames: NDArray[np.int64]) -> Estimate:
        """From the measure of all frames, then with each block left out, (1 + blocks,), and the frames of each."""
        value, left_out = values[0], values[1:]
        h = block_frames.sum() / block_frames
        pseudo = h * value - (h - 1.0) * left_out
        centre = (pseudo / h).sum()
        return cls(float(value), left_out, float(np.sqrt(((pseudo - centre) ** 2 / (h - 1.0)).mean())))


def blocks_of(frames: int, blocks: int = BLOCKS) -> NDArray[np.int64]:
    """The block of each frame, (frames,) int64: neighbours, whose numbers differ by one at most.

    Raises
    ------
    InputError
        For fewer frames than blocks.
    """
    if frames < blocks:
        raise InputError("--frames", f"{frames}", f"at least {blocks}: standard errors come from {blocks} blocks")
    return np.arange(frames, dtype=np.int64) * blocks // frames
