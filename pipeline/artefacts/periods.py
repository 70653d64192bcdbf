r"""Periods in the metadata of a TPOG: which blocks are whose, and how much each counts in the mix.

With c_q the counts of period q over its T_q frames and w_q its weight, the mix is

.. math:: p(v) = \sum_q w_q c_q(v) / T_q \Big/ \sum_q w_q = \sum_q m_q c_q(v) \Big/ \sum_q m_q T_q

with the smallest whole numbers m_q in the ratio of w_q / T_q: it stays a count of frames, and its entropy exact.
Weights are the decimal numbers that the scenario writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from math import gcd, inf, lcm
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError

MOST_FRAMES = 2**32 - 1
"""Of a mix, so that entropies keep their digits."""


@dataclass(frozen=True)
class PeriodBlocks:
    """The blocks of one period, those after the ones of the periods before it; all blocks where there are no periods.

    Attributes
    ----------
    name, weight
        As the scenario says.
    frames, block_frames
        Recorded in the period, and in each of its blocks.
    memory_frames
        The traffic's memory.
    times
        How often each of its frames counts in the mix.
    """

    name: str
    weight: float
    frames: int
    block_frames: int
    memory_frames: float
    times: int = 1

    @property
    def blocks(self) -> int:
        """How many."""
        return self.frames // self.block_frames

    def to_json(self) -> dict[str, Any]:
        """As the metadata holds it."""
        return asdict(self)


def times(weights: Sequence[float], frames: Sequence[int], place: str) -> tuple[int, ...]:
    """How often a frame of each period counts; InputError where weights are so odd that a mix has too many frames."""
    shares = [Fraction(repr(weight)) / count for weight, count in zip(weights, frames, strict=True)]
    scaled = [int(share * lcm(*(share.denominator for share in shares))) for share in shares]
    smallest = tuple(value // gcd(*scaled) for value in scaled)
    total = sum(count * number for count, number in zip(smallest, frames, strict=True))
    if total > MOST_FRAMES:
        found = f"weights {', '.join(f'{w:g}' for w in weights)} of {', '.join(map(str, frames))} frames"
        what = f"{found} make a mix of more than {MOST_FRAMES:,} frames"
        raise InputError(f"{place}.periods", what, "weights with fewer digits, nearer to each other")
    return smallest


def periods_of(about: dict[str, Any], path: Path) -> tuple[PeriodBlocks, ...]:
    """From the metadata of ``tpog.parquet``; one without a name where there are no periods."""
    if "periods" not in about:
        whole = PeriodBlocks("", 1.0, about["frames"], about["block_frames"], about["memory_frames"])
        found: tuple[PeriodBlocks, ...] = (whole,)
    else:
        found = tuple(PeriodBlocks(**row) for row in about["periods"])
    for period in found:
        if period.frames % period.block_frames:
            what = f"{period.frames} frames in blocks of {period.block_frames}"
            raise InputError(path, what, "whole blocks; make it again")
    return found


def are_sound(value: Any) -> bool:
    """Whether metadata holds one period or more."""
    wanted = {"name": str, "weight": float, "frames": int, "block_frames": int, "memory_frames": float, "times": int}
    return (
        isinstance(value, list)
        and bool(value)
        and all(
            isinstance(row, dict)
            and row.keys() == wanted.keys()
            and all(type(row[key]) is kind for key, kind in wanted.items())
            and all(0 < row[key] < inf for key in wanted if key != "name")
            for row in value
        )
    )


def times_of_blocks(periods: Sequence[PeriodBlocks], only: str | None = None) -> NDArray[np.int64]:
    """How often each block counts, (blocks,): in the mix, or in one period alone."""
    numbers = [period.times if only is None else int(period.name == only) for period in periods]
    return np.repeat(np.array(numbers, dtype=np.int64), [period.blocks for period in periods])
