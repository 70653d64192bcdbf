"""What each candidate pose sees, as sparse rows of whole numbers: the cells that it hits, and how often.

Cells are whatever a score sums over: voxels with entropy, vehicle-frames. Only cells with a weight are kept, and hits
up to where more count for nothing. Rows lie in memory, or in a temporary file where they would take more than
:data:`MOST_IN_MEMORY` bytes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MOST_IN_MEMORY = 1_500_000_000
"""Bytes; more is kept in a temporary file and read from there."""

_SMALL = int(np.iinfo(np.uint16).max)


@dataclass(frozen=True, eq=False)
class Row:
    """What one pose sees.

    Attributes
    ----------
    cells
        Those that it hits, (k,) int32, ascending.
    amounts
        How often, (k,) uint16 or int64, above 0.
    """

    cells: NDArray[np.int32]
    amounts: NDArray[Any]

    @classmethod
    def of(cls, hits: NDArray[Any], most: int) -> Row:
        """From the hits of every cell, (n,) whole numbers; more than ``most`` in a cell count as so many."""
        cells = np.flatnonzero(hits).astype(np.int32)
        kind = np.uint16 if most <= _SMALL else np.int64
        return cls(cells, np.minimum(hits[cells].astype(np.int64), most).astype(kind))


@dataclass(frozen=True, eq=False)
class Sight:
    """What each candidate sees.

    Attributes
    ----------
    number
        Of cells.
    starts
        Entries starts[i] to starts[i + 1] are those of candidate i, (candidates + 1,) int64.
    cells, amounts
        As those of :class:`Row`, one candidate after another.
    """

    number: int
    starts: Ints
    cells: NDArray[np.int32]
    amounts: NDArray[Any]

    def __len__(self) -> int:
        """How many candidates."""
        return len(self.starts) - 1

    @classmethod
    def of(cls, rows: Iterable[Row], number: int) -> Sight:
        """From the rows of all candidates, over ``number`` cells."""
        growing = GrowingSight(number)
        for row in rows:
            growing.add(row)
        return growing.whole()

    def row(self, candidate: int) -> Row:
        """What one of them sees."""
        its = slice(int(self.starts[candidate]), int(self.starts[candidate + 1]))
        return Row(self.cells[its], self.amounts[its])


class GrowingSight:
    """A sight to which one candidate after another is added.

    Parameters
    ----------
    number
        Of cells.
    most_in_memory
        Bytes; more goes to a temporary file.
    """

    def __init__(self, number: int, most_in_memory: int = MOST_IN_MEMORY) -> None:
        self._number, self._most = number, most_in_memory
        self._lengths, self._size = [0], 0
        self._held: list[Row] = []
        self._files: tuple[IO[bytes], IO[bytes]] | None = None

    def add(self, row: Row) -> None:
        """The next candidate's."""
        self._lengths.append(len(row.cells))
        self._held.append(row)
        self._size += row.cells.nbytes + row.amounts.nbytes
        if self._size > self._most:
            self._spill()

    def whole(self) -> Sight:
        """What all of them see."""
        starts = np.cumsum(self._lengths, dtype=np.int64)
        if not self._held and self._files is None:
            return Sight(self._number, starts, np.empty(0, dtype=np.int32), np.empty(0, dtype=np.uint16))
        if self._files is None or not starts[-1]:
            columns = zip(*((row.cells, row.amounts) for row in self._held), strict=True)
            return Sight(self._number, starts, *(np.concatenate(parts) for parts in columns))
        kind = self._spill()
        cells = np.memmap(self._files[0], dtype=np.int32, mode="r")
        amounts: NDArray[Any] = np.memmap(self._files[1], dtype=kind, mode="r")
        for file in self._files:
            file.close()  # the mapping stays
        return Sight(self._number, starts, cells, amounts)

    def _spill(self) -> np.dtype[Any]:
        """Write what is held; the type of its amounts."""
        if self._files is None:
            self._files = _nameless(), _nameless()
            self._kind = self._held[0].amounts.dtype
        for row in self._held:
            self._files[0].write(row.cells.tobytes())
            self._files[1].write(row.amounts.tobytes())
        for file in self._files:
            file.flush()
        self._held, self._size = [], 0
        return self._kind


def _nameless() -> IO[bytes]:
    """A file that is gone when nobody reads it any more."""
    return tempfile.TemporaryFile(prefix="egvs-place-")
