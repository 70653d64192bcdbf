"""Records of equal layout, as PCD and PLY files hold them: x, y and z are picked from lines of text, from binary
records, or from blocks of one field each.

Steps: the header's fields give a :class:`RecordLayout`; it checks that x, y and z are there once and that the data are
as long as the header says; its three readers return the points as float64, (n, 3), in the file's order and frame. A
text file's numbers are taken at float64 even where its header says float. What is not whole is refused; nothing is
guessed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.reading import limits

AXES = ("x", "y", "z")
A_NUMBER = "a number, or nan where nothing returned"


@dataclass(frozen=True)
class RecordLayout:
    """Where x, y and z stand among ``n`` records of ``values`` text values or ``size`` bytes each."""

    place: str
    n: int
    values: int
    size: int
    columns: tuple[int, ...]
    offsets: tuple[int, ...]
    formats: tuple[str, ...]

    @classmethod
    def of(cls, place: str, n: int, names: Sequence[str], formats: Sequence[str], counts: Sequence[int]) -> Self:
        """From the fields in their order; ``formats`` are numpy's, with byte order."""
        if n == 0:
            raise InputError(place, "holds no points, says its header", "at least one return")
        limits.POINTS.check(place, n)
        for axis in AXES:
            if names.count(axis) != 1 or counts[names.index(axis)] != 1:
                problem = f"has no single field {axis!r} (its fields: {' '.join(names) or 'none'})"
                raise InputError(place, problem, "x, y and z")
        first_columns = (0, *accumulate(counts))
        first_bytes = (0, *accumulate(np.dtype(f).itemsize * count for f, count in zip(formats, counts, strict=True)))
        at = [names.index(axis) for axis in AXES]
        columns, offsets = tuple(first_columns[i] for i in at), tuple(first_bytes[i] for i in at)
        return cls(place, n, first_columns[-1], first_bytes[-1], columns, offsets, tuple(formats[i] for i in at))

    def from_text(self, text: bytes, line: int, skip: int = 0, last: bool = True) -> NDArray[np.float64]:
        """Points from lines of text, the first of which is the file's line ``line``; ``skip`` records come before."""
        rows = [(number, row) for number, row in enumerate(text.splitlines(), line) if row.strip()][skip:]
        if len(rows) < self.n or (last and len(rows) > self.n):
            right = f"{self.n}, as its header says; a whole file"
            raise InputError(self.place, f"holds {len(rows)} lines of points", right)
        rows = rows[: self.n]
        try:
            table = np.loadtxt([row for _, row in rows], comments=None, encoding="latin-1", ndmin=2)
        except ValueError as error:
            raise self._fault(rows, str(error)) from None
        if table.shape[1] != self.values:
            raise self._fault(rows, f"lines of {table.shape[1]} values")
        return np.ascontiguousarray(table[:, self.columns], dtype=np.float64)

    def from_records(self, body: memoryview, last: bool = True) -> NDArray[np.float64]:
        """Points from binary records, one after the other; nothing but white space may follow the ``last`` ones."""
        need = self.n * self.size
        if len(body) < need or (last and bytes(body[need:]).strip()):
            right = f"{need} ({self.n} points of {self.size}), as its header says; a whole file"
            raise InputError(self.place, f"holds {len(body)} bytes of points", right)
        kind = np.dtype({"names": AXES, "formats": self.formats, "offsets": self.offsets, "itemsize": self.size})
        records = np.frombuffer(body[:need], dtype=kind)
        return columns_of([records[axis] for axis in AXES])

    def from_blocks(self, body: bytes | bytearray) -> NDArray[np.float64]:
        """Points from binary data that holds each field of all records as one block (PCD's binary_compressed)."""
        parts = zip(self.formats, self.offsets, strict=True)
        return columns_of([np.frombuffer(body, dtype=f, count=self.n, offset=offset * self.n) for f, offset in parts])

    def _fault(self, rows: list[tuple[int, bytes]], error: str) -> InputError:
        for line, row in rows:
            words, place = row.decode("latin-1").split(), f"{self.place}: line {line}"
            if len(words) != self.values:
                return InputError(place, f"holds {len(words)} values", f"{self.values} in each line")
            for word in words:
                if number(word) is None:
                    return InputError(place, f"{word!r} is no number", A_NUMBER)
        return InputError(self.place, f"cannot be read as text ({error})", "numbers apart by spaces")


def columns_of(columns: Sequence[NDArray[np.generic]]) -> NDArray[np.float64]:
    """Columns x, y, z of any numeric types, (n,) each, as one (n, 3) float64."""
    points = np.empty((len(columns[0]), 3))
    with np.errstate(invalid="ignore"):  # a signalling NaN marks a missing return like any other
        for axis, column in enumerate(columns):
            points[:, axis] = column
    return points


def records_of(columns: Mapping[str, NDArray[np.generic]]) -> NDArray[np.void]:
    """Columns (n,) as records, little endian, without gaps, in the columns' order."""
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    records = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, column in columns.items():
        records[name] = column
    return records


def number(text: str) -> float | None:
    """A number as Python reads it, nan and inf included; None when it is none."""
    try:
        return float(text)
    except ValueError:
        return None


def whole_number(place: str, key: str, words: Sequence[str]) -> int:
    """The header's words after ``key`` as a count; InputError when they are none."""
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        raise InputError(place, f"{key} is {' '.join(words)!r}", "a whole number")
    return int(words[0])
