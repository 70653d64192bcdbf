"""Read floating car data (FCD: CSV, Parquet, XML), and cut it into groups of frames.

:func:`read_fcd` reads what SUMO writes with ``--fcd-output``, gzipped or not; the first bytes tell the format. It
yields Arrow tables with the columns of :data:`FCD_SCHEMA`, so that memory does not grow with the file. Positions are
SUMO's: the centre of the front bumper, in metres (or longitude and latitude, which :func:`georeference_rows` converts);
angles are in degrees clockwise from north, slopes in degrees. Times are whole milliseconds, SUMO's unit. Rows without a
vehicle (SUMO writes one for an empty step) and rows of containers are skipped, and so are persons unless requested.

:func:`group_frames` keeps the time steps that are frames, numbers them, and yields a group as soon as its last frame is
complete. At the end, it checks that the file has all frames.
"""

from __future__ import annotations

import itertools
import shutil
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import pyarrow as pa

from egvs.core import limits, reading
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import number_of
from egvs.formats import arrow_bounds, xml
from egvs.formats.georeference import WGS84, WORLD, CoordinateReading, Georeference, look_like_degrees
from egvs.scenario.fields import MAX_COORDINATE_M

_NUMBERS = ("x", "y", "z", "angle", "slope", "speed")
FCD_SCHEMA = pa.schema(
    {"time_ms": pa.int64(), "id": pa.string(), "type": pa.string()} | dict.fromkeys(_NUMBERS, pa.float64())
)
"""Columns of all tables. z and slope are 0, and speed is NaN, if the file has none."""

_REQUIRED_COLUMNS = ("time", "id", "x", "y", "angle", "type")
_OPTIONAL_DEFAULTS = {"z": 0.0, "slope": 0.0, "speed": float("nan")}
_STRINGS = ("id", "type")
_MAY_BE_NAN = ("speed",)

_COMPLETE_FILE = "Use a complete file; create it again."
_OTHER_PREFIXES = {"vehicle": ("person_", "container_"), "person": ("vehicle_", "container_", "person_slope")}
"""Prefixes of columns to ignore. A person's slope is meaningless: SUMO writes the lane's, in either direction."""

_BLOCK_BYTES = 1 << 20
"""Arrow reads dozens of blocks ahead: with 4 MiB they take 150 MB, and reading is no faster."""

_WAIT_S = 0.05
"""Time between two looks at a file that grows."""

_BATCH_ROWS = 1 << 16
_MAX_ROWS_PER_BYTE = 10
"""Positions and angles that change take at least a bit per row."""

MIN_GAP_STEPS = 1.5
"""A time this many times the usual step has a gap; times of cameras, in whole milliseconds, vary by less."""

EXPECTED_FCD = (
    "Use FCD data with the attributes id, x, y, angle, type (--fcd-output.attributes id,x,y,z,angle,slope,type,speed)."
)

_GEO_HINT = "Set traffic.fcd_geo = true for longitude and latitude (--fcd-output.geo); without it, x and y are metres."


def georeference_rows(
    tables: Iterable[pa.Table], world: Georeference, path: Path, is_geo: bool
) -> Generator[pa.Table, None, None]:
    """Convert a user's file to the world frame.

    Parameters
    ----------
    tables
        Rows of the file.
    world
        The world frame.
    path
        The file, for messages.
    is_geo
        Whether x and y are longitude and latitude in degrees; otherwise they are metres of the world frame.

    Yields
    ------
    pyarrow.Table
        The rows, with x and y in the world frame.

    Raises
    ------
    InputError
        When no vehicle of the first table is near the region of interest, or its metres look like degrees.
    """
    coordinates: CoordinateReading | None = None
    for table in tables:
        xy = np.column_stack([table["x"].to_numpy(), table["y"].to_numpy()])
        if coordinates is None:
            if world.frame is None and not is_geo and look_like_degrees(xy):
                raise world.unknown_frame_error(str(path), "x and y look like longitude and latitude", xy)
            coordinates = world.read_coordinates(xy, str(path), WGS84 if is_geo else WORLD, _GEO_HINT)
        if coordinates.convert is not None:
            x_m, y_m = coordinates.to_world(xy).T
            for name, values in (("x", x_m), ("y", y_m)):
                table = table.set_column(FCD_SCHEMA.get_field_index(name), FCD_SCHEMA.field(name), pa.array(values))
        yield table


def check_coordinates(path: Path, world: Georeference, is_geo: bool) -> None:
    """Raise the InputError of :func:`georeference_rows` or :func:`read_fcd` for the head of a file, if any."""
    with closing(georeference_rows(read_fcd(path), world, path, is_geo)) as tables:
        next(tables, None)


def has_heights(path: Path) -> bool:
    """Return whether a file has heights (a column or an attribute ``z`` of its vehicles).

    Raises
    ------
    InputError
        As :func:`read_fcd` for the head of the file.
    """
    with closing(_source_batches(path)[0]) as batches:
        return any("z" in batch.schema.names for batch in itertools.islice(batches, 1))


def read_fcd(path: Path) -> Iterator[pa.Table]:
    """Read the vehicles of a file.

    Parameters
    ----------
    path
        The file.

    Yields
    ------
    pyarrow.Table
        Rows of :data:`FCD_SCHEMA`, in file order.

    Raises
    ------
    InputError
        Names the file and the row if a column is missing, a value is not a number, times are not in order, or the file
        is damaged.
    """
    yield from _checked_tables(*_source_batches(path))


def read_growing_fcd(path: Path, element: str, has_ended: Callable[[], bool]) -> Iterator[pa.Table]:
    """Read a CSV file while SUMO writes it, and to its end.

    Parameters
    ----------
    path
        The file; it need not exist yet.
    element
        ``"vehicle"``, or ``"person"`` for a file of ``--person-fcd-output``; slopes of persons are set to 0.
    has_ended
        Whether nothing will be added. An error that it raises ends the reading, before the last lines are read.

    Yields
    ------
    pyarrow.Table
        The rows that :func:`read_fcd` yields of the complete file; none of a file without vehicles.
    """
    yield from _checked_tables(_read_growing_csv(path, element, has_ended), path, "row")


def _source_batches(path: Path) -> tuple[Generator[pa.RecordBatch, None, None], Path, str]:
    """Return the batches of a file with the columns that are used, the file, and what it calls a row."""
    if not path.is_file():
        raise InputError(path, "no such file", "Use a file that SUMO wrote with --fcd-output.")
    with xml.open_bounded(path) as file:
        head = file.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
    if not head:
        raise InputError(path, "is empty", EXPECTED_FCD)
    if head.startswith(b"<"):
        return _read_xml(path), path, "vehicle element"
    read = _read_parquet if head.startswith(b"PAR1") else _read_csv
    return read(path), path, "row"


def _read_csv(path: Path) -> Generator[pa.RecordBatch, None, None]:
    from pyarrow import csv

    with (
        reading.translate_errors(path, _COMPLETE_FILE, "its first line cannot be read"),
        xml.open_bounded(path) as file,
    ):
        header = xml.read_line(file, path)
    layout = _CsvLayout.of(header, path, "vehicle")
    options = csv.ReadOptions(block_size=_BLOCK_BYTES, use_threads=False)
    with (
        reading.translate_errors(path, _COMPLETE_FILE, "cannot be read as CSV"),
        xml.open_bounded(path) as stream,
        csv.open_csv(stream, options, layout.parse, layout.convert) as batches,
    ):
        for batch in batches:
            yield batch.rename_columns(layout.columns)


def _read_growing_csv(path: Path, element: str, has_ended: Callable[[], bool]) -> Generator[pa.RecordBatch, None, None]:
    from pyarrow import csv

    while not path.is_file() and not has_ended():
        time.sleep(_WAIT_S)
    layout: _CsvLayout | None = None
    names: list[str] = []
    content = b""
    with path.open("rb") as file:
        is_last = False
        while not is_last:
            is_complete = has_ended()  # before reading
            block = file.read(_BLOCK_BYTES)
            content += block
            is_last = is_complete and not block
            if not is_last and len(content) < _BLOCK_BYTES:
                if not block:
                    time.sleep(_WAIT_S)
                continue
            lines, line_end, content = content.rpartition(b"\n")
            if not line_end:
                continue
            if layout is None:
                header, _, lines = lines.partition(b"\n")
                if not header:
                    return  # SUMO writes a line end if there is no vehicle
                layout = _CsvLayout.of(header, path, element)
                names = header.decode("utf-8").split(layout.parse.delimiter)
            if not lines:
                continue
            options = csv.ReadOptions(column_names=names, use_threads=False)
            table = csv.read_csv(pa.BufferReader(lines + line_end), options, layout.parse, layout.convert)
            yield from table.rename_columns(layout.columns).combine_chunks().to_batches()


class _CsvLayout(NamedTuple):
    """The columns of a CSV file that are used, by the names of :data:`FCD_SCHEMA`, and how it is read."""

    columns: list[str]
    parse: Any
    convert: Any

    @classmethod
    def of(cls, header: bytes, path: Path, element: str) -> _CsvLayout:
        """Return the layout that the first line of a file implies."""
        from pyarrow import csv

        with reading.translate_errors(path, _COMPLETE_FILE, "its first line cannot be read"):
            line = header.decode("utf-8").lstrip("\ufeff").strip()
        delimiter = ";" if ";" in line else ","
        columns = _source_columns([name.strip('"') for name in line.split(delimiter)], path, element)
        types = dict.fromkeys(columns.values(), pa.float64())
        types.update((columns[name], pa.string()) for name in _STRINGS)
        convert = csv.ConvertOptions(
            column_types=types,
            include_columns=list(columns.values()),
            null_values=[""],
            strings_can_be_null=True,
        )
        return cls(list(columns), csv.ParseOptions(delimiter=delimiter), convert)


def _read_parquet(path: Path) -> Generator[pa.RecordBatch, None, None]:
    import pyarrow.parquet as pq

    with _translate_parquet_errors(path), _open_seekable(path) as source:
        with pq.ParquetFile(source) as file:
            columns = _source_columns(file.schema_arrow.names, path, "vehicle")
            _check_rows(file.metadata.num_rows, source, path)
            largest = max(arrow_bounds.parquet_group_bytes(file, source, list(columns.values()), path), default=0)
            problem = f"has a row group of {largest / limits.MB:,.0f} MB after decompression"
            limits.UNPACKED.check_bytes(path, largest, problem)
            _check_types(file.schema_arrow, columns, path)
        # Texts stay encoded until their length is checked: a long one may occur in each row.
        with pq.ParquetFile(source, read_dictionary=[columns[name] for name in _STRINGS]) as file:
            for batch in file.iter_batches(_BATCH_ROWS, columns=list(columns.values())):
                batch.validate(full=True)  # texts must be UTF-8
                batch = batch.select(list(columns.values())).rename_columns(list(columns))
                for name in _STRINGS:
                    texts = arrow_bounds.decode_texts(batch.column(name), f"{path}: {name}")
                    batch = batch.set_column(batch.schema.get_field_index(name), name, texts)
                yield batch


def _check_types(schema: pa.Schema, columns: Mapping[str, str], path: Path) -> None:
    """Raise an InputError for a column of other values where numbers are expected."""
    for name, column in columns.items():
        kind = schema.field(column).type
        is_number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)
        if name not in _STRINGS and not is_number:
            raise InputError(f"{path}: {column}", f"expected a column of numbers, got {kind}", EXPECTED_FCD)


def _translate_parquet_errors(path: Path) -> AbstractContextManager[None]:
    return reading.translate_errors(path, _COMPLETE_FILE, "cannot be read as Parquet")


@contextmanager
def _open_seekable(path: Path) -> Iterator[Path | IO[bytes]]:
    """Unzip a gzipped file first, since Parquet is read from its end."""
    if xml.is_gzip(path):
        with xml.open_bounded(path) as file, tempfile.TemporaryFile() as plain:
            shutil.copyfileobj(file, plain)
            plain.seek(0)
            yield plain
    else:
        with open_input(path) as file:
            yield file


def fcd_metadata(path: Path) -> bytes | None:
    """Return the metadata of a Parquet file under the key ``egvs``; None without such a key, and for other formats."""
    with xml.open_bounded(path) as file:
        if not file.read(4).startswith(b"PAR1"):
            return None
    import pyarrow.parquet as pq

    with _translate_parquet_errors(path), _open_seekable(path) as source, pq.ParquetFile(source) as parquet:
        values: dict[bytes, bytes] = parquet.metadata.metadata or {}
        return values.get(b"egvs")


def _check_rows(rows: int, source: Path | IO[bytes], path: Path) -> None:
    """Raise an InputError if a Parquet file declares more rows than it can contain."""
    with source.open("rb") if isinstance(source, Path) else nullcontext(source) as file:
        packed = sum(chunk.packed_bytes for group in arrow_bounds.read_parquet_groups(file) for chunk in group)
    if rows > _MAX_ROWS_PER_BYTE * packed:
        raise InputError(path, f"declares {rows:,} rows in {packed:,} bytes", _COMPLETE_FILE)


def _read_xml(path: Path) -> Generator[pa.RecordBatch, None, None]:
    rows: list[dict[str, str]] = []
    steps = _StepCheck(path)
    for step in xml.iter_elements(path, "fcd-export"):
        steps.add(step.get("time", ""))
        for vehicle in step.iter("vehicle"):
            rows.append({**vehicle.attrib, "time": step.get("time", "")})
        if len(rows) >= _BATCH_ROWS:
            yield _xml_batch(rows, path)
            rows.clear()
    if rows:
        yield _xml_batch(rows, path)


class _StepCheck:
    """Checks that an XML file has all time steps: SUMO also writes those without vehicles.

    Without this check, a step that is missing would count as an empty frame.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last_s: float | None = None
        self._shortest_s, self._longest_s = np.inf, 0.0

    def add(self, time: str) -> None:
        """Check the next time step; a time that is no number is reported with its vehicles."""
        try:
            time_s = float(time)
        except ValueError:
            return
        if self._last_s is not None and time_s > self._last_s:
            step_s = time_s - self._last_s
            self._shortest_s, self._longest_s = min(self._shortest_s, step_s), max(self._longest_s, step_s)
            if self._longest_s > MIN_GAP_STEPS * self._shortest_s:
                steps = f"{self._shortest_s:g} s and {self._longest_s:g} s"
                problem = f"expected equal time steps, got {steps}: steps are missing"
                hint = "Use a file with all steps, also those without vehicles (without --fcd-output.skip-empty)."
                raise InputError(f"{self._path}: time {time}", problem, hint)
        self._last_s = time_s


def _xml_batch(rows: list[dict[str, str]], path: Path) -> pa.RecordBatch:
    import pyarrow.compute as pc

    for row in rows:
        for name in _REQUIRED_COLUMNS:
            if name not in row:
                problem = f"vehicle {row.get('id')!r} at time {row['time']!r} has no {name}"
                raise InputError(path, problem, EXPECTED_FCD)
    names = [*_REQUIRED_COLUMNS, *(name for name in _OPTIONAL_DEFAULTS if name in rows[0])]
    columns = {name: pa.array([row.get(name) for row in rows], type=pa.string()) for name in names}
    for name in columns.keys() - set(_STRINGS):
        try:
            columns[name] = pc.cast(columns[name], pa.float64())
        except pa.ArrowInvalid as error:
            raise InputError(path, f"{name}: {error}", "Use numbers.") from None
    return pa.record_batch(columns)


def _source_columns(names: list[str], path: Path, element: str) -> dict[str, str]:
    """Return the column of the file for each column that is used (x is ``vehicle_x`` in CSV and Parquet)."""
    columns: dict[str, str] = {}
    for source in names:
        if source.startswith(_OTHER_PREFIXES[element]):
            continue
        name = source.removeprefix(f"{element}_").removeprefix("timestep_")
        other = columns.setdefault(name, source)
        if name in (*_REQUIRED_COLUMNS, *_OPTIONAL_DEFAULTS) and (other != source or names.count(source) > 1):
            problem = f"the columns {other!r} and {source!r} both stand for {name!r}"
            raise InputError(path, problem, "Remove one of them.")
    for name in _REQUIRED_COLUMNS:
        if name not in columns:
            raise InputError(path, f"there is no column for {name!r} among {', '.join(names)[:200]}", EXPECTED_FCD)
    return {name: columns[name] for name in (*_REQUIRED_COLUMNS, *_OPTIONAL_DEFAULTS) if name in columns}


def _checked_tables(batches: Iterable[pa.RecordBatch], path: Path, unit: str) -> Iterator[pa.Table]:
    """Convert batches to :data:`FCD_SCHEMA`; check that numbers are finite and times are in order."""
    rows_read, last_ms = 0, np.iinfo(np.int64).min
    for batch in batches:
        rows = _RowBatch(batch, rows_read, path, unit)
        rows_read += batch.num_rows
        rows.check_types()
        for name in [name for name in rows.columns if name not in _STRINGS]:
            rows.check_finite(name)
        time_ms = rows.milliseconds()
        if time_ms.size:
            rows.check_order(time_ms, last_ms)
            last_ms = int(time_ms[-1])
            yield _to_table(rows.columns, time_ms)


class _RowBatch:
    """The rows of a batch that have a vehicle.

    Parameters
    ----------
    batch
        Rows of a file.
    rows_before
        Number of rows before the batch; rows count from 1, without a header.
    path, unit
        The file, and what it calls a row, for messages.
    """

    def __init__(self, batch: pa.RecordBatch, rows_before: int, path: Path, unit: str) -> None:
        import pyarrow.compute as pc

        names = batch.column("id")
        has_vehicle = pc.and_(pc.is_valid(names), pc.fill_null(pc.not_equal(names, ""), False))
        self.columns: dict[str, Any] = {n: pc.filter(batch.column(n), has_vehicle) for n in batch.schema.names}
        self._row = _true_positions(has_vehicle) + rows_before + 1
        self._where = f"{path}: {unit}"
        is_nameless = pc.and_not(np.isfinite(_floats(batch.column("x"))), has_vehicle)
        for i in _true_positions(is_nameless):
            where, hint = (
                f"{self._where} {i + rows_before + 1}",
                "Name each vehicle; a row without one has only a time.",
            )
            raise InputError(where, "expected a name with the position, got none", hint)

    def check_types(self) -> None:
        import pyarrow.compute as pc

        for i in _true_positions(pc.fill_null(pc.equal(self.columns["type"], ""), True)):
            hint = "Write the type of each vehicle; it determines the size."
            raise self._error(i, f"{self._vehicle(i)} has no type", hint)

    def check_finite(self, name: str) -> None:
        values = np.abs(_floats(self.columns[name]))
        valid = values <= MAX_COORDINATE_M
        if name in _MAY_BE_NAN:
            valid |= np.isnan(values)
        for i in np.flatnonzero(~valid):
            value = self.columns[name][int(i)].as_py()
            problem = f"{name} of {self._vehicle(i)} is {'empty' if value is None else value}"
            hint = f"Use a finite number, at most {MAX_COORDINATE_M:g}."
            if name == "time" and value is not None:
                hint += " Times are seconds; subtract the start of the recording from dates."
            raise self._error(i, problem, hint)

    def milliseconds(self) -> IntArray:
        exact = _floats(self.columns["time"]) * 1000.0
        rounded = np.rint(exact)
        for i in np.flatnonzero(np.abs(exact - rounded) > 1e-3):
            problem = f"expected a whole number of milliseconds, got time {exact[i] / 1000.0:.6f} s"
            raise self._error(i, problem, "Round the times; SUMO counts in milliseconds.")
        return rounded.astype(np.int64)

    def check_order(self, time_ms: IntArray, last_ms: int) -> None:
        before = np.concatenate([[last_ms], time_ms[:-1]])
        for i in np.flatnonzero(time_ms < before):
            problem = f"time {time_ms[i] / 1000:g} s comes after {before[i] / 1000:g} s"
            raise self._error(i, problem, "Sort the rows by time.")

    def _vehicle(self, i: np.int64) -> str:
        return f"vehicle {self.columns['id'][int(i)].as_py()!r}"

    def _error(self, i: np.int64, problem: str, hint: str) -> InputError:
        return InputError(f"{self._where} {self._row[i]}", problem, hint)


def _to_table(columns: dict[str, Any], time_ms: IntArray) -> pa.Table:
    import pyarrow.compute as pc

    columns = columns | {"time_ms": pa.array(time_ms)}
    for name, default in _OPTIONAL_DEFAULTS.items():
        values = _floats(columns[name]) if name in columns else np.full(time_ms.size, default)
        columns[name] = pa.array(values)
    return pa.table([pc.cast(columns[f.name], f.type) for f in FCD_SCHEMA], schema=FCD_SCHEMA)


def _floats(column: Any) -> FloatArray:
    """Convert to float64; nulls become NaN."""
    import pyarrow.compute as pc

    array: FloatArray = pc.cast(column, pa.float64()).to_numpy(zero_copy_only=False)
    return array


def _true_positions(mask: Any) -> IntArray:
    return np.flatnonzero(mask.to_numpy(zero_copy_only=False))


@dataclass(frozen=True)
class FrameWindow:
    """Which time steps of a recording are frames.

    Attributes
    ----------
    count, period_ms
        Number of frames, and time between them.
    first_ms
        Time of the first frame; None for ``skip_ms`` after the first time step.
    skip_ms
        Warm-up.
    complete
        Whether all steps were recorded, so that one without rows is an empty frame, and not the end of the file.
    """

    count: int
    period_ms: int
    first_ms: int | None = None
    skip_ms: int = 0
    complete: bool = False


@dataclass(frozen=True)
class FrameGroup:
    """Consecutive frames: ``rows`` has the columns of :data:`FCD_SCHEMA`, and ``frame`` is the frame of each row."""

    first_frame: int
    frames: int
    frame: IntArray
    rows: pa.Table


@dataclass
class _FrameBuffer:
    """Buffers the rows of frames until their group is complete.

    Attributes
    ----------
    window
        Which time steps are frames.
    where
        The traffic table, for messages.
    first_ms, last_ms
        Times of the first frame and of the last row.
    step_ms
        Greatest common divisor of the time steps.
    time_steps
        Number of distinct times.
    start
        Next frame to yield.
    frames, tables
        Buffered rows, and their frames.
    """

    window: FrameWindow
    where: str
    first_ms: int | None = None
    last_ms: int = 0
    step_ms: int = 0
    time_steps: int = 0
    start: int = 0
    frames: list[IntArray] = field(default_factory=list)
    tables: list[pa.Table] = field(default_factory=list)

    def add(self, table: pa.Table) -> int:
        """Add rows; return the number of frames that are complete now."""
        window = self.window
        time_ms = table["time_ms"].to_numpy()
        if self.first_ms is None:
            self.last_ms = int(time_ms[0])
            self.time_steps = 1
            self.first_ms = self.last_ms + window.skip_ms if window.first_ms is None else window.first_ms
        steps = np.diff(time_ms, prepend=self.last_ms)
        steps = steps[steps > 0]
        self.time_steps += steps.size
        self.step_ms = int(np.gcd.reduce(steps, initial=self.step_ms))
        self.last_ms = int(time_ms[-1])

        frame, remainder = np.divmod(time_ms - self.first_ms, window.period_ms)
        rows = np.flatnonzero((remainder == 0) & (frame >= 0) & (frame < window.count))
        if rows.size:
            self.frames.append(frame[rows])
            is_run = rows[-1] - rows[0] + 1 == rows.size
            self.tables.append(table.slice(int(rows[0]), rows.size) if is_run else table.take(rows))
            buffered = sum(table.num_rows for table in self.tables)
            problem = f"has more than {limits.ROWS.maximum:,} vehicles in the frames of a group"
            limits.ROWS.check(self.where, buffered, problem)
        return int(np.clip(-((self.first_ms - self.last_ms) // window.period_ms), 0, window.count))

    def take(self, frames: int) -> FrameGroup:
        """Remove and return the next frames."""
        end = self.start + frames
        frame = np.concatenate([np.empty(0, np.int64), *self.frames])
        rows = pa.concat_tables([FCD_SCHEMA.empty_table(), *self.tables])
        n_rows = int(np.searchsorted(frame, end))
        group = FrameGroup(self.start, frames, frame[:n_rows], rows.slice(0, n_rows).combine_chunks())
        self.frames = [frame[n_rows:]]
        self.tables = [rows.slice(n_rows)]
        self.start = end
        return group

    def check_all_read(self) -> None:
        """Raise an InputError if the file does not have all frames."""
        if self.window.complete:
            return
        if self.first_ms is None:
            raise InputError(self.where, "the file contains no vehicles", EXPECTED_FCD)
        check_span(self.window, self.last_ms - self.first_ms, self.step_ms, self.time_steps, self.where)


def check_span(
    window: FrameWindow, duration_ms: int, step_ms: int, time_steps: int, where: str, file: str = "the file"
) -> None:
    """Check that a file has all frames of a window.

    Parameters
    ----------
    window
        The frames.
    duration_ms
        Time from the first frame to the end of the file.
    step_ms
        Greatest common divisor of its time steps; 0 for a single one.
    time_steps
        Number of its time steps.
    where
        The traffic table, for messages.
    file
        The file, for messages.

    Raises
    ------
    InputError
        When the file is too short, or its time steps do not fit the period.
    """
    period_s = window.period_ms / 1000
    if step_ms and window.period_ms % step_ms:
        problem = f"the time steps of {file} are {step_ms / 1000:g} s apart"
        raise InputError(f"{where}: frame_period_s = {period_s:g}", problem, "Use a multiple of that.")
    available = max(0, duration_ms // window.period_ms + 1)
    if available < window.count:
        problem = (
            f"{file} has {number_of(available, 'frame')} {period_s:g} s apart after a warm-up of"
            f" {window.skip_ms / 1000:g} s"
            f" ({number_of(time_steps, 'time step')} in all)"
        )
        hint = f"Use at most {number_of(available, 'frame')}, or a shorter warmup_s."
        raise InputError(f"{where}: frames = {window.count}", problem, hint)


def merge_groups(vehicles: FrameGroup, persons: FrameGroup) -> FrameGroup:
    """Merge two groups of the same frames."""
    rows = pa.concat_tables([vehicles.rows, persons.rows]).combine_chunks()
    frame = np.concatenate([vehicles.frame, persons.frame])
    return FrameGroup(vehicles.first_frame, vehicles.frames, frame, rows)


def group_frames(tables: Iterable[pa.Table], window: FrameWindow, frames_each: int, where: str) -> Iterator[FrameGroup]:
    """Cut a stream of rows into groups of frames.

    Parameters
    ----------
    tables
        Rows of :data:`FCD_SCHEMA`, in order of time.
    window
        Which time steps are frames.
    frames_each
        Frames per group; the last group may be shorter.
    where
        The traffic table, for messages.

    Yields
    ------
    FrameGroup
        The groups, in order.

    Raises
    ------
    InputError
        When the stream ends too early, or its time steps do not fit the period.
    """
    buffer = _FrameBuffer(window, where)
    for table in tables:
        complete = buffer.add(table)
        while complete - buffer.start >= frames_each:
            yield buffer.take(frames_each)
        if complete == window.count:
            break
    buffer.check_all_read()
    while buffer.start < window.count:
        yield buffer.take(min(frames_each, window.count - buffer.start))
