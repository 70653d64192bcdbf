"""Read tables of recorded tracks (CSV, plain or gzipped) by the names of their columns."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.formats import xml
from egvs.scenario.fields import MAX_COORDINATE_M

_HINT = "Use the file as it was published, with its header row."

MAX_SIZE_M = 100.0
"""No road user is longer; the longest trams have 75 m."""

_ROW_HINT = "Correct the row, or remove it."

MAX_TIME_S = 1e10
"""Seconds since 1970 stay below it until the year 2286; milliseconds exceed it."""

MAX_BLANK_LINES = 1000
"""A packed file of some kB can hold a billion blank lines, which take minutes to read."""

MAX_ANGLE_RAD = 1e4
"""A thousand turns, for headings that count full turns."""


@dataclass(frozen=True)
class Table:
    """Columns of a file, each with one text per row, stripped.

    Attributes
    ----------
    path
        The file.
    columns
        Texts of each column, by name.
    lines
        Line in the file of each row, for messages; without them, rows are counted.
    """

    path: Path
    columns: Mapping[str, Sequence[str]]
    lines: Sequence[int] = ()

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def texts(self, name: str) -> Sequence[str]:
        """Return the texts of a column."""
        return self.columns[name]

    def names(self, name: str) -> Sequence[str]:
        """Return the names of tracks in a column; InputError for an empty cell."""
        names = self.columns[name]
        if "" in names:
            raise self.error(list(names).index(""), name, "expected the name of a track, got nothing")
        return names

    def numbers(self, name: str) -> FloatArray:
        """Return the numbers of a column, (n,) float64; InputError for a text, an empty cell, infinity or NaN."""
        values = self.optional_numbers(name)
        for row in np.flatnonzero(np.isnan(values)).tolist():
            raise self.error(row, name, f"expected a number, got {self.columns[name][row]!r}")
        return values

    def optional_numbers(self, name: str) -> FloatArray:
        """Return the numbers of a column, NaN where a cell is empty or the column does not exist, (n,) float64."""
        if name not in self.columns:
            return np.full(self.n_rows, math.nan)
        texts = self.columns[name]
        values = _to_floats(texts)
        for row in np.flatnonzero(np.isinf(values)).tolist():
            raise self.error(row, name, f"expected a number, got {texts[row][:80]!r}")
        return values

    def times_s(self, name: str, unit_s: float = 1.0) -> FloatArray:
        """Return times in seconds, (n,) float64; InputError beyond :data:`MAX_TIME_S`."""
        hint = "Check the unit of the times: milliseconds are no seconds."
        return self._within(self.numbers(name) * unit_s, name, -MAX_TIME_S, MAX_TIME_S, "a time", "s", hint)

    def positions_m(self, name: str, unit_m: float = 1.0) -> FloatArray:
        """Return coordinates in metres, (n,) float64; InputError for those that are too large for the Earth."""
        values = self.numbers(name) * unit_m
        return self._within(values, name, -MAX_COORDINATE_M, MAX_COORDINATE_M, "a coordinate", "m")

    def heights_m(self, name: str, unit_m: float = 1.0) -> FloatArray:
        """Return coordinates in metres of a column that may be missing or have empty cells, which are NaN."""
        values = self.optional_numbers(name) * unit_m
        return self._within(values, name, -MAX_COORDINATE_M, MAX_COORDINATE_M, "a height", "m")

    def sizes_m(self, name: str, unit_m: float = 1.0) -> FloatArray:
        """Return lengths, widths or heights in metres, (n,) float64; NaN where they are missing or 0."""
        values = self._within(self.optional_numbers(name) * unit_m, name, 0.0, MAX_SIZE_M, "a size", "m")
        return np.where(values == 0.0, math.nan, values)

    def angles_rad(self, name: str, unit_rad: float = 1.0) -> FloatArray:
        """Return angles in radians, (n,) float64; NaN where they are missing."""
        values = self.optional_numbers(name) * unit_rad
        return self._within(values, name, -MAX_ANGLE_RAD, MAX_ANGLE_RAD, "an angle", "rad")

    def classes(self, name: str, classes: Mapping[str, str]) -> list[str]:
        """Return the class of each row, from its text in lower case; InputError for a text that is not in ``classes``.

        Parameters
        ----------
        name
            A column.
        classes
            Text of the file in lower case -> one of :data:`egvs.extensions.tracks.model.CLASSES`.
        """
        texts = self.columns[name]
        by_text = {text: classes.get(text.lower()) for text in set(texts)}
        if None in by_text.values():
            row = next(row for row, text in enumerate(texts) if by_text[text] is None)
            raise self.error(row, name, f"unknown class {texts[row][:80]!r}", f"Use one of {', '.join(classes)}.")
        return [by_text[text] or "" for text in texts]

    def rows_of(self, keys: Sequence[str], name: str, where: Path) -> IntArray:
        """Return the row of this table for each key of another, (len(keys),) int64.

        Parameters
        ----------
        keys
            Texts, such as ids of tracks.
        name
            The column of this table with the same texts, each once.
        where
            File of the keys, for messages.

        Raises
        ------
        InputError
            When a key is missing in this table, or occurs twice in it.
        """
        row_of: dict[str, int] = {}
        for row, text in enumerate(self.columns[name]):
            if text in row_of:
                raise self.error(row, name, f"{text[:80]!r} occurs twice")
            row_of[text] = row
        for key in keys:
            if key not in row_of:
                raise InputError(
                    where, f"{name} {key[:80]!r} is not in {self.path.name}", "Use files of one recording."
                )
        return np.array([row_of[key] for key in keys], dtype=np.int64)

    def _within(
        self, values: FloatArray, name: str, low: float, high: float, what: str, unit: str, hint: str = _ROW_HINT
    ) -> FloatArray:
        for row in np.flatnonzero((values < low) | (values > high)):
            expected = f"expected {what} from {low:g} to {high:g} {unit}"
            raise self.error(int(row), name, f"{expected}, got {values[row]:g} {unit}", hint)
        return values

    def error(self, row: int, name: str, problem: str, hint: str = _ROW_HINT) -> InputError:
        """Return an error about a cell; ``row`` counts from 0, without the header."""
        where = f"line {self.lines[row]}" if self.lines else f"row {row + 1}"
        return InputError(f"{self.path}: {where}: {name}", problem, hint)


_EMPTY = frozenset({"", "nan", "none", "null"})
"""Texts of a cell without a value, in lower case."""


def _to_floats(texts: Sequence[str]) -> FloatArray:
    """Return the numbers of texts: NaN where a text stands for a missing value, infinite where it is no number.

    Python's float also reads digits of other scripts, and underscores between digits; they are no numbers here.
    """
    try:
        values = np.fromiter(map(float, texts), dtype=np.float64, count=len(texts))
    except ValueError:
        values = np.fromiter((_to_float(text) for text in texts), dtype=np.float64, count=len(texts))
    joined = "".join(texts)
    if not joined.isascii() or "_" in joined:
        for row, text in enumerate(texts):
            if not text.isascii() or "_" in text:
                values[row] = math.inf
    return values


def _to_float(text: str) -> float:
    try:
        return math.nan if text.lower() in _EMPTY else float(text)
    except ValueError:
        return math.inf


def header(head: bytes, delimiter: str = ",") -> list[str]:
    """Return the names in the first line of a file, lower case and stripped, or [] if it is no text."""
    try:
        line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8")
    except UnicodeDecodeError:
        return []
    return [name.strip().strip('"').lower() for name in line.split(delimiter)]


def has_columns(head: bytes, *names: str) -> bool:
    """Return whether the first line of a comma-separated file names all these columns, in any case."""
    return set(name.lower() for name in names) <= set(header(head))


def read_lines(path: Path, hint: str = _HINT) -> Iterator[str]:
    """Yield the lines of a text file, plain or gzipped.

    InputError when it is damaged or no UTF-8, or has a line longer than :data:`egvs.core.limits.ELEMENT`, or more than
    :data:`MAX_BLANK_LINES` blank lines one after another.
    """
    n_blank, encoding = 0, "utf-8-sig"
    with reading.translate_errors(path, hint), xml.open_bounded(path) as file:
        while line := xml.read_line(file, path):
            text = line.decode(encoding)
            n_blank, encoding = 0 if text.strip() else n_blank + 1, "utf-8"
            if n_blank > MAX_BLANK_LINES:
                raise InputError(path, f"has more than {MAX_BLANK_LINES:,} blank lines one after another", hint)
            yield text


def read_rows(path: Path, delimiter: str = ",", hint: str = _HINT) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV file that are not empty, with their line numbers; InputError when it is damaged."""
    rows = csv.reader(read_lines(path, hint), delimiter=delimiter, skipinitialspace=True)
    with reading.translate_errors(path, hint):
        for row in rows:
            if row:
                yield rows.line_num, row


def read_table(
    path: Path, required: Sequence[str], optional: Sequence[str] = (), delimiter: str = ",", hint: str = _HINT
) -> Table:
    """Read columns of a CSV file.

    Parameters
    ----------
    path
        The file, plain or gzipped.
    required, optional
        Names of columns. Names in the file may differ in case. Other columns are not read.
    delimiter
        Between the cells of a row.
    hint
        What to do when the file does not fit, for messages.

    Raises
    ------
    InputError
        When the file is damaged, a required column is missing, a requested one occurs twice, a row has another number
        of cells than the header (empty ones at its end do not count), or there is no row.
    """
    rows = read_rows(path, delimiter, hint)
    names = [name.strip() for name in next(rows, (0, []))[1]]
    positions = _positions(path, names, required, optional, hint)
    cells: dict[str, list[str]] = {name: [] for name in positions}
    columns = [(cells[name], position) for name, position in positions.items()]
    lines: list[int] = []
    most_rows = limits.ROWS.maximum
    for line, row in rows:
        if len(row) < len(names) or any(cell.strip() for cell in row[len(names) :]):
            raise InputError(f"{path}: line {line}", f"expected {len(names)} cells, got {len(row)}", "Correct the row.")
        for texts, position in columns:
            texts.append(row[position].strip())
        lines.append(line)
        if len(lines) > most_rows:
            limits.ROWS.check(path, len(lines))
    if not lines:
        raise InputError(path, "contains no rows", hint)
    return Table(path, cells, lines)


def _positions(
    path: Path, names: list[str], required: Sequence[str], optional: Sequence[str], hint: str
) -> dict[str, int]:
    """Return the position of each requested column in the file, preferably in the same case."""
    positions: dict[str, int] = {}
    for name in (*required, *optional):
        matches = [position for position, actual in enumerate(names) if actual == name]
        matches = matches or [position for position, actual in enumerate(names) if actual.lower() == name.lower()]
        if len(matches) > 1:
            raise InputError(path, f"the column {name!r} occurs {len(matches)} times", hint)
        if matches:
            positions[name] = matches[0]
        elif name in required:
            actual_names = " ".join(", ".join(names)[:200].split()) or "none"  # a quoted name may have several lines
            raise InputError(path, f"expected a column {name!r}, got {actual_names}", hint)
    return positions


def companion(path: Path, ending: str, companion_ending: str) -> Path:
    """Return the file beside a file of tracks that differs in the end of its name, plain or gzipped.

    Parameters
    ----------
    path
        The file of tracks: ``07_tracks.csv``.
    ending, companion_ending
        End of its name, and of that of the companion: ``_tracks.csv``, ``_tracksMeta.csv``.

    Raises
    ------
    InputError
        When the file has another name, or its companion does not exist.
    """
    name = path.name.removesuffix(".gz")
    if not name.endswith(ending):
        expected = f"expected a name that ends with {ending}, got {path.name}"
        raise InputError(path, expected, f"Keep the published names; ...{companion_ending} must be beside it.")
    other = name.removesuffix(ending) + companion_ending
    for candidate in (path.with_name(other), path.with_name(f"{other}.gz")):
        if candidate.is_file():
            return candidate
    raise InputError(path, f"expected the file {other} beside it", "Copy it there from the data set.")
