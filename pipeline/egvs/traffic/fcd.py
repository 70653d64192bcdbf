"""Floating car data (CSV, Parquet, XML) in whole frames.

Reads files of floating car data (FCD), whatever their format.

Reads what SUMO writes with ``--fcd-output``: CSV, XML or Parquet, each maybe gzipped, told apart by their first bytes.
Hands out Arrow tables with the columns of :data:`FCD_SCHEMA`, piece by piece, so that memory does not grow with the
file.

Positions are SUMO's own: the middle of the front bumper in metres (or longitude and latitude, which
:func:`georeference_rows`
brings into the world frame), the angle in degrees clockwise from north, the slope in degrees. Times are whole
milliseconds, SUMO's own unit. Rows without a vehicle (SUMO writes one for an empty step) are left out; so are persons
(unless asked for) and containers.

Cuts a stream of rows of floating car data into groups of whole frames.

Steps: keep the time steps that are frames; number them; hand out a group as soon as its last frame is whole; at the end
of the stream, check that every frame was there. Times are whole milliseconds.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.formats import xml
from egvs.formats.georeference import WGS84, WORLD, CoordinateReading, Georeference, look_like_degrees
from egvs.scenario.fields import MAX_COORDINATE_M

_NUMBERS = ("x", "y", "z", "angle", "slope", "speed")
FCD_SCHEMA = pa.schema(
    {"time_ms": pa.int64(), "id": pa.string(), "type": pa.string()} | dict.fromkeys(_NUMBERS, pa.float64())
)
"""Columns of every table here. z and slope are 0 and speed is NaN where the file has none."""

_REQUIRED_COLUMNS = ("time", "id", "x", "y", "angle", "type")
_OPTIONAL_DEFAULTS = {"z": 0.0, "slope": 0.0, "speed": float("nan")}
_STRINGS = ("id", "type")
_NULLABLE = ("speed",)
"""NaN, where a file has none."""

_COMPLETE_FILE = "a whole file; make it again"
_OTHER_PREFIXES = {"vehicle": ("person_", "container_"), "person": ("vehicle_", "container_", "person_slope")}
"""Columns that belong to others, or (a person's slope) mean nothing."""
_BLOCK_BYTES = 1 << 20
"""Arrow reads dozens of blocks ahead: with 4 MiB they take 150 MB, and reading is no faster."""

_BATCH_ROWS = 1 << 16
_MAX_ROWS_PER_BYTE = 10
"""Positions and angles that change take at least a bit a row."""
EXPECTED_FCD = (
    "FCD with the attributes id, x, y, angle and type (--fcd-output.attributes id,x,y,z,angle,slope,type,speed)"
)
"""What a message asks for where a file is not right."""

_GEO_HINT = "Set traffic.fcd_geo = true for longitude and latitude (--fcd-output.geo); without it, x and y are metres."


def georeference_rows(
    tables: Iterable[pa.Table], world: Georeference, path: Path, is_geo: bool
) -> Generator[pa.Table, None, None]:
    """Yield the rows of a user's file with x, y in the world frame; ``is_geo``: they are longitude and latitude.

    InputError when no vehicle of the first table is near the region of interest, or its metres can only be degrees.
    """
    reading: CoordinateReading | None = None
    for table in tables:
        xy = np.column_stack([table["x"].to_numpy(), table["y"].to_numpy()])
        if reading is None:
            if world.frame is None and not is_geo and look_like_degrees(xy):
                raise world.unknown_frame_error(str(path), "x and y look like longitude and latitude", xy)
            reading = world.read_coordinates(xy, str(path), WGS84 if is_geo else WORLD, _GEO_HINT)
        if reading.convert is not None:
            x_m, y_m = reading.to_world(xy).T
            for name, values in (("x", x_m), ("y", y_m)):
                table = table.set_column(FCD_SCHEMA.get_field_index(name), FCD_SCHEMA.field(name), pa.array(values))
        yield table


def check_coordinates(path: Path, world: Georeference, is_geo: bool) -> None:
    """InputError where a user's file lies in other coordinates, or is none; only its head is read."""
    with closing(georeference_rows(read_fcd(path), world, path, is_geo)) as tables:
        next(tables, None)


def read_fcd(path: Path, who: str = "vehicle") -> Iterator[pa.Table]:
    """The file's rows in the order of the file, as tables of :data:`FCD_SCHEMA`.

    ``who`` is ``"vehicle"``, or ``"person"`` for what ``--person-fcd-output`` wrote. A person's slope is left out:
    people stand upright, and SUMO gives the lane's slope whichever way they walk. InputError names the file and the
    row: a column is missing, a value is no number, time runs back, the file is damaged.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "a file that SUMO wrote with --fcd-output")
    with xml.open_bounded(path) as file:
        head = file.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
    if not head:
        raise InputError(path, "is empty", EXPECTED_FCD)
    if head.startswith(b"<"):
        yield from _check_batches(_read_xml(path, who), path, f"{who} element")
    else:
        reader = _read_parquet if head.startswith(b"PAR1") else _read_csv
        yield from _check_batches(reader(path, who), path, "row")


def _read_csv(path: Path, who: str) -> Iterator[pa.RecordBatch]:
    from pyarrow import csv

    with (
        reading.translate_errors(path, _COMPLETE_FILE, "its first line cannot be read"),
        xml.open_bounded(path) as file,
    ):
        header = xml.read_line(file, path).decode("utf-8").lstrip("\ufeff").strip()
    delimiter = ";" if ";" in header else ","
    columns = _columns([name.strip('"') for name in header.split(delimiter)], path, who)
    convert = csv.ConvertOptions(
        column_types={raw: pa.string() if name in _STRINGS else pa.float64() for name, raw in columns.items()},
        include_columns=list(columns.values()),
        null_values=[""],
        strings_can_be_null=True,
    )
    options = csv.ReadOptions(block_size=_BLOCK_BYTES, use_threads=False)
    with (
        reading.translate_errors(path, _COMPLETE_FILE, "cannot be read as CSV"),
        xml.open_bounded(path) as stream,
        csv.open_csv(stream, options, csv.ParseOptions(delimiter=delimiter), convert) as batches,
    ):
        for batch in batches:
            yield batch.rename_columns(list(columns))


def _read_parquet(path: Path, who: str) -> Iterator[pa.RecordBatch]:
    import pyarrow.parquet as pq

    with (
        reading.translate_errors(path, _COMPLETE_FILE, "cannot be read as Parquet"),
        _seekable(path) as source,
        pq.ParquetFile(source) as file,
    ):
        columns = _columns(file.schema_arrow.names, path, who)
        _check_rows(file.metadata, path)
        for batch in file.iter_batches(_BATCH_ROWS, columns=list(columns.values())):
            batch.validate(full=True)  # its texts are UTF-8
            yield batch.select(list(columns.values())).rename_columns(list(columns))


@contextmanager
def _seekable(path: Path) -> Iterator[Any]:
    """Parquet is read from its end, so a gzipped one is unzipped first."""
    if xml.is_gzip(path):
        with xml.open_bounded(path) as file, tempfile.TemporaryFile() as plain:
            shutil.copyfileobj(file, plain)
            plain.seek(0)
            yield plain
    else:
        yield path


def fcd_metadata(path: Path) -> bytes | None:
    """What a Parquet file says of itself under the key ``egvs``; None of other files, and where it says nothing."""
    import pyarrow.parquet as pq

    with xml.open_bounded(path) as file:
        if not file.read(4).startswith(b"PAR1"):
            return None
    with (
        reading.translate_errors(path, _COMPLETE_FILE, "cannot be read as Parquet"),
        _seekable(path) as source,
        pq.ParquetFile(source) as parquet,
    ):
        found: bytes | None = (parquet.metadata.metadata or {}).get(b"egvs")
        return found


def _check_rows(metadata: Any, path: Path) -> None:
    """InputError where a Parquet file says that it holds more than it can."""
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    largest = max((group.total_byte_size for group in groups), default=0)
    limits.UNPACKED.check_bytes(path, largest, f"has a row group of {largest / limits.MB:,.0f} MB, unpacked")
    packed = sum(group.column(i).total_compressed_size for group in groups for i in range(group.num_columns))
    if metadata.num_rows > _MAX_ROWS_PER_BYTE * packed:
        raise InputError(path, f"says that it holds {metadata.num_rows:,} rows in {packed:,} bytes", _COMPLETE_FILE)


def _read_xml(path: Path, who: str) -> Iterator[pa.RecordBatch]:
    rows: list[dict[str, str]] = []
    for step in xml.iter_elements(path, "fcd-export"):
        rows += [{"time": step.get("time", ""), **one.attrib} for one in step.iter(who)]
        if who == "person":
            rows = [{key: value for key, value in row.items() if key != "slope"} for row in rows]
        if len(rows) >= _BATCH_ROWS:
            yield _xml_batch(rows, path)
            rows.clear()
    if rows:
        yield _xml_batch(rows, path)


def _xml_batch(rows: list[dict[str, str]], path: Path) -> pa.RecordBatch:
    names = [*_REQUIRED_COLUMNS, *(name for name in _OPTIONAL_DEFAULTS if name in rows[0])]
    columns = {name: pa.array([row.get(name) for row in rows], type=pa.string()) for name in names}
    for row in (
        i for name in _REQUIRED_COLUMNS if columns[name].null_count for i in _rows_of(pc.is_null(columns[name]))
    ):
        missing = next(name for name in _REQUIRED_COLUMNS if name not in rows[row])
        raise InputError(
            path, f"vehicle {rows[row].get('id')!r} at time {rows[row]['time']!r} has no {missing}", EXPECTED_FCD
        )
    for name in set(names) - set(_STRINGS):
        try:
            columns[name] = pc.cast(columns[name], pa.float64())
        except pa.ArrowInvalid as error:
            raise InputError(path, f"{name}: {error}", "a number") from None
    return pa.record_batch(columns)


def _columns(names: list[str], path: Path, who: str) -> dict[str, str]:
    """Our name -> the file's, for each column that we use (SUMO calls x ``vehicle_x`` in CSV and Parquet)."""
    ours = {
        name.removeprefix(f"{who}_").removeprefix("timestep_"): name
        for name in reversed(names)
        if not name.startswith(_OTHER_PREFIXES[who])
    }
    for name in _REQUIRED_COLUMNS:
        if name not in ours:
            raise InputError(path, f"there is no column for {name!r} among {', '.join(names)[:200]}", EXPECTED_FCD)
    return {name: ours[name] for name in (*_REQUIRED_COLUMNS, *_OPTIONAL_DEFAULTS) if name in ours}


def _check_batches(batches: Iterable[pa.RecordBatch], path: Path, unit: str) -> Iterator[pa.Table]:
    """Into :data:`FCD_SCHEMA`, with every number finite and time never running back."""
    done, last_ms = 0, None
    for batch in batches:
        piece = _RowBatch(batch, done, path, unit)
        done += batch.num_rows
        piece.check_types()
        for name in ("time", "x", "y", "angle", *(n for n in _OPTIONAL_DEFAULTS if n in piece.values)):
            piece.check_finite(name)
        time_ms = piece.milliseconds()
        if time_ms.size:
            piece.check_order(time_ms, last_ms)
            last_ms = int(time_ms[-1])
            yield _to_table(piece.values, time_ms)


class _RowBatch:
    """A piece of a file: the columns of the rows that have a vehicle, and where these rows are in the file."""

    def __init__(self, batch: pa.RecordBatch, done: int, path: Path, unit: str) -> None:
        """``done`` rows came before; rows count from 1, without a header."""
        names = batch.column("id")
        taken = pc.and_(pc.is_valid(names), pc.fill_null(pc.not_equal(names, ""), False))
        self.values: dict[str, Any] = {n: pc.filter(batch.column(n), taken) for n in batch.schema.names}
        self._row = _rows_of(taken) + done + 1
        self._path, self._unit = path, unit

    def check_types(self) -> None:
        for i in _rows_of(pc.fill_null(pc.equal(self.values["type"], ""), True)):
            raise self._wrong(i, f"{self._vehicle(i)} has no type", "the vehicle's type, which its size comes from")

    def check_finite(self, name: str) -> None:
        values = np.abs(_floats(self.values[name]))
        for i in np.flatnonzero(~((values <= MAX_COORDINATE_M) | (np.isnan(values) & (name in _NULLABLE)))):
            value = self.values[name][int(i)].as_py()
            what = f"{name} of {self._vehicle(i)} is {'empty' if value is None else value}"
            raise self._wrong(i, what, f"a finite number, at most {MAX_COORDINATE_M:g}")

    def milliseconds(self) -> NDArray[np.int64]:
        exact = _floats(self.values["time"]) * 1000.0
        whole = np.rint(exact)
        for i in np.flatnonzero(np.abs(exact - whole) > 1e-3):
            raise self._wrong(i, f"time {exact[i] / 1000.0:.6f} s", "a whole number of milliseconds, as SUMO counts")
        return whole.astype(np.int64)

    def check_order(self, time_ms: NDArray[np.int64], last_ms: int | None) -> None:
        before = np.concatenate([[time_ms[0] if last_ms is None else last_ms], time_ms[:-1]])
        for i in np.flatnonzero(time_ms < before):
            what = f"time {time_ms[i] / 1000:g} s comes after {before[i] / 1000:g} s"
            raise self._wrong(i, what, "rows in order of time")

    def _vehicle(self, i: np.int64) -> str:
        return f"vehicle {self.values['id'][int(i)].as_py()!r}"

    def _wrong(self, i: np.int64, what: str, expected: str) -> InputError:
        return InputError(f"{self._path}: {self._unit} {self._row[i]}", what, expected)


def _to_table(values: dict[str, Any], time_ms: NDArray[np.int64]) -> pa.Table:
    n = time_ms.size
    given = {
        name: _floats(values[name]) if name in values else np.full(n, blank)
        for name, blank in _OPTIONAL_DEFAULTS.items()
    }
    columns = values | {"time_ms": pa.array(time_ms)} | {name: pa.array(column) for name, column in given.items()}
    return pa.table([pc.cast(columns[f.name], f.type) for f in FCD_SCHEMA], schema=FCD_SCHEMA)


def _floats(column: Any) -> NDArray[np.float64]:
    """Nulls become NaN; integers and float32 widen."""
    array: NDArray[np.float64] = pc.cast(column, pa.float64()).to_numpy(zero_copy_only=False)
    return array


def _rows_of(mask: Any) -> NDArray[np.int64]:
    return np.flatnonzero(mask.to_numpy(zero_copy_only=False))


@dataclass(frozen=True)
class FrameWindow:
    """Which time steps are frames: ``count`` of them, ``period_ms`` apart.

    The first is at ``first_ms``; where that is None, ``skip_ms`` after the file's own first time step. ``complete``
    says that every step was recorded, so that a time step without rows is an empty frame and not the end of the file.
    """

    count: int
    period_ms: int
    first_ms: int | None = None
    skip_ms: int = 0
    complete: bool = False


@dataclass(frozen=True)
class FrameGroup:
    """Consecutive whole frames: ``rows`` has :data:`FCD_SCHEMA` and, at ``frame``, each row's frame."""

    first_frame: int
    frames: int
    frame: NDArray[np.int64]
    rows: pa.Table


@dataclass
class _FrameCutter:
    """Keeps the rows of the window's frames until their group is whole."""

    window: FrameWindow
    where: str
    first_ms: int | None = None
    last_ms: int = 0
    step_ms: int = 0
    time_steps: int = 0
    start: int = 0
    frames: list[NDArray[np.int64]] = field(default_factory=list)
    tables: list[pa.Table] = field(default_factory=list)

    def add(self, table: pa.Table) -> int:
        """Keep the rows of the window's frames; return how many frames are whole now."""
        window, time_ms = self.window, table["time_ms"].to_numpy()
        if self.first_ms is None:
            own = int(time_ms[0])
            self.first_ms, self.last_ms = (own + window.skip_ms if window.first_ms is None else window.first_ms), own
            self.time_steps = 1
        steps = np.diff(time_ms, prepend=self.last_ms)
        steps = steps[steps > 0]
        self.time_steps += steps.size
        self.step_ms = int(np.gcd.reduce(steps, initial=self.step_ms))
        self.last_ms = int(time_ms[-1])
        frame, off = np.divmod(time_ms - self.first_ms, window.period_ms)
        kept = np.flatnonzero((off == 0) & (frame >= 0) & (frame < window.count))
        if kept.size:
            self.frames.append(frame[kept])
            is_run = kept[-1] - kept[0] + 1 == kept.size
            self.tables.append(table.slice(int(kept[0]), kept.size) if is_run else table.take(kept))
            held = sum(table.num_rows for table in self.tables)
            limits.ROWS.check(
                self.where, held, f"has more than {limits.ROWS.maximum:,} vehicles in frames side by side"
            )
        return int(np.clip(-((self.first_ms - self.last_ms) // window.period_ms), 0, window.count))

    def take(self, frames: int) -> FrameGroup:
        """The next ``frames`` frames."""
        end = self.start + frames
        frame = np.concatenate([np.empty(0, np.int64), *self.frames])
        rows = pa.concat_tables([FCD_SCHEMA.empty_table(), *self.tables])
        cut = int(np.searchsorted(frame, end))
        group = FrameGroup(self.start, frames, frame[:cut], rows.slice(0, cut).combine_chunks())
        self.frames, self.tables, self.start = [frame[cut:]], [rows.slice(cut)], end
        return group

    def finish(self) -> None:
        """Check that the file held every frame."""
        if self.window.complete:
            return
        if self.first_ms is None:
            raise InputError(self.where, "holds no vehicle", EXPECTED_FCD)
        check_span(self.window, self.last_ms - self.first_ms, self.step_ms, self.time_steps, self.where)


def check_span(
    window: FrameWindow, lasts_ms: int, step_ms: int, time_steps: int, where: str, file: str = "the file"
) -> None:
    """InputError where a file does not hold a window's frames.

    Its ``time_steps`` are multiples of ``step_ms`` apart; it ends ``lasts_ms`` after the first frame.
    """
    if step_ms and window.period_ms % step_ms:
        what = f"{file}'s time steps are {step_ms / 1000:g} s apart"
        raise InputError(f"{where}: frame_period_s = {window.period_ms / 1000:g}", what, "a multiple of that")
    there = max(0, lasts_ms // window.period_ms + 1)
    if there < window.count:
        raise InputError(
            f"{where}: frames = {window.count}",
            f"{file} has {there} frames {window.period_ms / 1000:g} s apart after a warm-up of"
            f" {window.skip_ms / 1000:g} s ({time_steps} time steps in all)",
            f"at most {there} frames, or a shorter warmup_s",
        )


def merge_streams(some: FrameGroup, others: FrameGroup) -> FrameGroup:
    """Two streams' rows of the same frames as one group."""
    rows = pa.concat_tables([some.rows, others.rows]).combine_chunks()
    return FrameGroup(some.first_frame, some.frames, np.concatenate([some.frame, others.frame]), rows)


def group_frames(tables: Iterable[pa.Table], window: FrameWindow, frames_each: int, where: str) -> Iterator[FrameGroup]:
    """Cut a stream of rows into groups of ``frames_each`` whole frames (the last may be shorter).

    InputError when the stream ends before the window does, or its time steps do not fit the window's period.
    """
    cutter = _FrameCutter(window, where)
    for table in tables:
        whole = cutter.add(table)
        while whole - cutter.start >= frames_each:
            yield cutter.take(frames_each)
        if whole == window.count:
            break
    cutter.finish()
    while cutter.start < window.count:
        yield cutter.take(min(frames_each, window.count - cutter.start))
