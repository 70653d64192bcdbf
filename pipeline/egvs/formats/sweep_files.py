"""Read the sweeps of an installed LiDAR from point cloud files.

A file is a sweep, and so is each array of an ``.npz`` file. The formats are those of measured scans
(:mod:`egvs.formats.point_clouds`), ``.npz``, and either of them compressed with gzip. Points are in the sensor's frame
(right-handed, z along the axis of rotation), metres. Missing returns (NaN, infinite, or within 5 cm of the origin, as
many drivers write zeros for them) stay in the list, because their positions tell which pulses gave no return.

Recordings of ROS and network captures (readers of the extension hardware) hold many sweeps, of which some are read,
spread evenly.

Nothing in a file's header says how its points are ordered; fitting a sensor finds out. Many files say of each point
which ring it is from (:data:`egvs.formats.recordings.RING_FIELDS`).
"""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import files, limits, readers
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats import point_clouds
from egvs.formats.recording_options import RecordingOptions
from egvs.formats.recordings import (
    RING_FIELDS,
    TIME_FIELDS,
    RecordedSweep,
    Recording,
    chosen_sweeps,
    ring_numbers,
    times_of_field,
)

MIN_RETURNS = 2000
"""Fewest returns of a sweep; sensors with rings have 30,000 or more."""

MAX_COORDINATE_M = 10_000.0
"""Farther than any LiDAR reaches: such coordinates are not metres, or not from the sensor."""

_ORIGIN_M = 0.05
_NPZ_HINT = "Save each sweep as one array of shape (n, 3): x, y, z in metres."
_FRAME_HINT = "Export the sweep in metres, in the sensor's frame (PCD: VIEWPOINT 0 0 0 1 0 0 0)."


@dataclass(frozen=True)
class Sweep:
    """One sweep in the sensor's frame.

    Attributes
    ----------
    name
        File, and the array in it.
    points_m
        (n, 3) float64, NaN where a pulse gave no return.
    is_coarse
        Whether the coordinates were saved as float16, with steps of 6 cm beyond 64 m. Such a sweep serves the empty
        scan only.
    time_s
        Time of each point, seconds, from the first, (n,); None if the file does not say.
    recording
        The recording that the sweep is of; None for a file of one sweep.
    ring
        Which ring each point is from, (n,) int64; None if the file does not say.
    stamp_s
        When it was recorded, seconds on the recording's clock; None for a file of one sweep.
    """

    name: str
    points_m: FloatArray
    is_coarse: bool = False
    time_s: FloatArray | None = None
    recording: Recording | None = None
    ring: IntArray | None = None
    stamp_s: float | None = None

    @property
    def returns(self) -> int:
        """Number of returns."""
        return int(np.count_nonzero(np.isfinite(self.points_m[:, 0])))


def read_sweeps(paths: Sequence[str | Path], options: RecordingOptions | None = None) -> list[Sweep]:
    """Read all sweeps of some files, in their order.

    Parameters
    ----------
    paths
        Files with the suffix .pcd, .ply, .las, .laz, .csv, .e57, .bin or .npz, or of a format that an installed package
        adds; also with .gz after it. Or recordings: .bag, .mcap, .db3, the folder of a ROS 2 recording, or .pcap.
    options
        What is read of recordings.

    Raises
    ------
    InputError
        If a file is missing, damaged, of an unknown format, not in the sensor's frame, or has fewer than
        :data:`MIN_RETURNS` returns.
    """
    sweeps: list[Sweep] = []
    options = options or RecordingOptions()
    for path in map(Path, paths):
        reader = _recording_reader(path)
        if reader is not None:
            recording, recorded = reader.read(path, path.name, options)
            sweeps += _recorded(recording, recorded, options)
            continue
        limits.checked_size(path, limits.FILE)
        if path.suffix.lower() == ".gz":
            sweeps += _read_gzip(path)
        else:
            sweeps += _read_file(path, path.name)
    for sweep in sweeps:
        farthest_m = float(np.nan_to_num(np.abs(sweep.points_m)).max(initial=0.0))
        if farthest_m > MAX_COORDINATE_M:
            problem = f"expected coordinates within {MAX_COORDINATE_M:,.0f} m of the sensor, got {farthest_m:g}"
            raise InputError(sweep.name, problem, _FRAME_HINT)
        if sweep.returns < MIN_RETURNS:
            problem = f"expected a sweep of at least {MIN_RETURNS:,} returns, got {sweep.returns:,}"
            raise InputError(sweep.name, problem, "Give complete sweeps, one per file.")
    return sweeps


def _recording_reader(path: Path) -> Any:
    """Return the module that reads a recording; None for other files. Its folder stands for a recording of ROS 2."""
    index = path / "metadata.yaml"
    for reader in readers.list_readers("sweeps"):
        if reader.may_open(index if index.is_file() else path, b""):
            return readers.load_reader(reader, ("read",), "a module with a function read(path, where, options)")
    return None


def _recorded(recording: Recording, recorded: list[RecordedSweep], options: RecordingOptions) -> Iterator[Sweep]:
    stamps_s = recording.stamps_s[chosen_sweeps(recording.sweeps, options.max_sweeps)].tolist()
    if len(stamps_s) != len(recorded):  # of a network capture, sweeps are dropped while it is decoded
        stamps_s = [None] * len(recorded)
    for sweep, stamp_s in zip(recorded, stamps_s, strict=True):
        points_m = _clean_sweep(sweep.label, sweep.points_m).points_m
        name = f"{recording.name}: {sweep.label}"
        yield Sweep(name, points_m, time_s=sweep.time_s, recording=recording, ring=sweep.ring, stamp_s=stamp_s)


def _read_gzip(path: Path) -> list[Sweep]:
    with files.temporary_folder() as folder:
        unpacked = folder / path.stem
        try:
            with gzip.open(path) as packed, unpacked.open("wb") as file:
                size = 0
                while chunk := packed.read(1 << 20):
                    size += len(chunk)
                    limits.UNPACKED.check_bytes(path, size)
                    file.write(chunk)
        except (OSError, EOFError, gzip.zlib.error) as error:  # type: ignore[attr-defined]
            raise InputError(path, f"cannot be unpacked ({error})", COMPLETE_FILE) from None
        return _read_file(unpacked, path.name)


def _read_file(path: Path, name: str) -> list[Sweep]:
    if path.suffix.lower() == ".npz":
        return list(_read_npz(path, name))
    chunks = []
    for chunk in point_clouds.stream_points(path, name):
        if chunk.station_m is not None and path.suffix.lower() == ".pcd":
            raise InputError(name, "expected points in the sensor's frame, got a VIEWPOINT", _FRAME_HINT)
        origin_m = np.zeros(3) if chunk.station_m is None else chunk.station_m
        with np.errstate(invalid="ignore"):  # a signalling NaN is a missing return like any other
            chunks.append(chunk.points_m - origin_m)
    if not chunks:
        raise InputError(name, "expected a sweep, got no points", COMPLETE_FILE)
    sweep = _clean_sweep(name, np.concatenate(chunks))
    field = point_clouds.read_field(path, name, RING_FIELDS)
    time = point_clouds.read_field(path, name, TIME_FIELDS)
    ring = None if field is None else ring_numbers(field)
    return [replace(sweep, ring=ring, time_s=None if time is None else times_of_field(time))]


def _read_npz(path: Path, name: str) -> Iterator[Sweep]:
    with (
        translate_errors(name, doing="cannot be read as .npz"),
        path.open("rb") as file,
        zipfile.ZipFile(file) as archive,
        np.load(file, allow_pickle=False) as arrays,
    ):
        unpacked = sum(member.file_size for member in archive.infolist())
        limits.UNPACKED.check_bytes(name, unpacked, f"has {unpacked / limits.MB:,.0f} MB after decompression")
        if not arrays.files:
            raise InputError(name, "expected an array for each sweep, got none", _NPZ_HINT)
        for key in arrays.files:
            array = arrays[key]
            if not isinstance(array, np.ndarray):
                raise InputError(f"{name}: {key}", "expected an array, got another file", _NPZ_HINT)
            if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
                problem = f"expected numbers of shape (n, 3), got {array.dtype} of shape {array.shape}"
                raise InputError(f"{name}: {key}", problem, _NPZ_HINT)
            limits.POINTS.check(f"{name}: {key}", len(array))
            points = array[:, :3].astype(np.float64)
            yield _clean_sweep(f"{name}: {key}", points, array.dtype == np.float16)


def _clean_sweep(name: str, points_m: FloatArray, is_coarse: bool = False) -> Sweep:
    """Return the sweep with NaN for all missing returns."""
    with np.errstate(invalid="ignore", over="ignore"):
        missing = ~((points_m**2).sum(axis=1) > _ORIGIN_M**2) | ~np.isfinite(points_m).all(axis=1)
    points_m = np.where(missing[:, None], np.nan, points_m)
    return Sweep(name, points_m, is_coarse)
