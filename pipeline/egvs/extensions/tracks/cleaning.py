"""Clean recorded tracks: duplicates, jumps, sizes and headings. Every change is counted.

Steps, in order:

1. Rows without a finite time or position are dropped. Of rows with the same track and time, the first is kept.
2. A track is cut where two successive rows are farther apart than any road user moves (a *jump*: the identity has
   probably switched to another road user).
3. The size of a track is the median of its rows. Missing lengths, widths and heights are those of its class.
4. The heading is the recorded one, turned by 180 degrees where the road user would drive backwards (faster than
   :data:`MOVING_M_S` and more than 90 degrees off the motion; a box looks the same). A heading that is not given comes
   from the motion over at least :data:`HEADING_BASE_M` (:mod:`egvs.extensions.tracks.motion`).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.extensions.tracks.model import Tracks
from egvs.extensions.tracks.motion import motion_yaw_rad
from egvs.traffic.class_sizes import ClassSize
from egvs.traffic.shared_names import MAX_SPEED_M_S, MIN_JUMP_M, SharedNames

MOVING_M_S = 3.0
"""Speed above which the direction of motion is certain enough to check a heading."""

HEADING_BASE_M = 1.0
"""Distance over which the direction of motion is measured where no heading is recorded."""

VULNERABLE = frozenset(("pedestrian", "bicycle"))
"""Classes of people on foot and on bicycles, who do not count as vehicles."""

_SIZE_KEYS = ("length_m", "width_m", "height_m")


@dataclass
class CleaningReport:
    """What was read, changed and filled in.

    Attributes
    ----------
    rows, tracks
        Numbers in the files.
    dropped_rows
        Rows without a finite time or position.
    duplicates
        Rows with the track and the time of an earlier row, dropped.
    elsewhere, first_elsewhere
        Those of them that are more than :data:`MIN_JUMP_M` from the earlier row, and the first as a text: two road
        users share a name.
    jumps
        Where tracks were cut.
    headings_given, headings_from_motion, headings_unknown
        Rows by the source of their heading; unknown: the track never moves, so its box points east.
    flipped_headings
        Rows whose heading was turned by 180 degrees.
    filled_sizes
        Number of tracks with the size of their class, by class and dimension ("car: height_m").
    rows_with_height
        Rows with a recorded height. They are not used; boxes stand on the road.
    bottom_height_m, height_scatter_m
        Median height of the bottoms of these boxes, in the recording's system, and their standard deviation, estimated
        from the median absolute deviation.
    step_s
        Usual time between the rows of a track.
    classes
        Number of tracks of each class.
    """

    rows: int = 0
    tracks: int = 0
    dropped_rows: int = 0
    duplicates: int = 0
    elsewhere: int = 0
    first_elsewhere: str = ""
    jumps: int = 0
    headings_given: int = 0
    headings_from_motion: int = 0
    headings_unknown: int = 0
    flipped_headings: int = 0
    filled_sizes: dict[str, int] = field(default_factory=dict)
    rows_with_height: int = 0
    bottom_height_m: float = 0.0
    height_scatter_m: float = 0.0
    step_s: float = 0.0
    classes: dict[str, int] = field(default_factory=dict)

    @property
    def shared_names(self) -> SharedNames:
        """What says that two road users share a name."""
        return SharedNames(self.rows, self.elsewhere, self.jumps, self.first_elsewhere)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON."""
        return vars(self)


@dataclass(frozen=True)
class CleanTracks:
    """Rows sorted by track and time, with sizes and headings.

    Attributes
    ----------
    names, classes
        Name and class of each track.
    size_m
        Length, width and height of each track, (n_tracks, 3).
    track
        Track of each row, (n,) int64, ascending.
    part
        Number that changes where a track is cut, (n,) int64, ascending.
    time_s, x_m, y_m, yaw_rad
        Of each row, (n,).
    report
        What was changed.
    sources
        Sentences of the readers.
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    size_m: FloatArray
    track: IntArray
    part: IntArray
    time_s: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    yaw_rad: FloatArray
    report: CleaningReport
    sources: tuple[str, ...] = ()


def clean_tracks(tracks: Tracks, sizes: Mapping[str, ClassSize]) -> CleanTracks:
    """Clean the tracks of a recording.

    Parameters
    ----------
    tracks
        As they were recorded, in the world frame.
    sizes
        Size of each class, for what is missing.
    """
    report = CleaningReport(rows=tracks.n_rows, tracks=len(tracks.names), classes=dict(Counter(tracks.classes)))
    finite = np.isfinite(tracks.time_s) & np.isfinite(tracks.x_m) & np.isfinite(tracks.y_m)
    report.dropped_rows = int((~finite).sum())
    tracks = tracks.select(finite)
    tracks = tracks.select(np.lexsort((tracks.time_s, tracks.track)))
    is_repeated = (np.diff(tracks.track, prepend=-1) == 0) & (np.diff(tracks.time_s, prepend=-np.inf) == 0)
    report.duplicates = int(is_repeated.sum())
    _report_elsewhere(tracks, is_repeated, report)
    tracks = tracks.select(~is_repeated)

    part = _cut_at_jumps(tracks, report)
    size_m = _sizes_of_tracks(tracks, sizes, report)
    _report_heights(tracks, size_m, report)
    yaw_rad = _headings(tracks, part, report)
    return CleanTracks(
        tracks.names, tracks.classes, size_m, tracks.track, part, tracks.time_s, tracks.x_m, tracks.y_m, yaw_rad,
        report, tracks.sources,
    )  # fmt: skip


def _report_elsewhere(tracks: Tracks, is_repeated: BoolArray, report: CleaningReport) -> None:
    """Count the repeated rows that are in another place than the first row of the same track and time."""
    repeated = np.flatnonzero(is_repeated)
    kept = np.maximum.accumulate(np.where(is_repeated, 0, np.arange(tracks.n_rows)))[repeated]
    distance_m = np.hypot(tracks.x_m[repeated] - tracks.x_m[kept], tracks.y_m[repeated] - tracks.y_m[kept])
    elsewhere = repeated[distance_m > MIN_JUMP_M]
    report.elsewhere = len(elsewhere)
    if len(elsewhere):
        row = elsewhere[0]
        report.first_elsewhere = f"{tracks.names[tracks.track[row]]!r} at {tracks.time_s[row]:g} s"


def _cut_at_jumps(tracks: Tracks, report: CleaningReport) -> IntArray:
    """Number the parts of tracks between jumps, and find the usual time step."""
    same_track = np.diff(tracks.track) == 0
    step_s = np.diff(tracks.time_s)
    distance_m = np.hypot(np.diff(tracks.x_m), np.diff(tracks.y_m))
    is_jump = same_track & (distance_m > MIN_JUMP_M) & (distance_m > MAX_SPEED_M_S * step_s)
    report.jumps = int(is_jump.sum())
    report.step_s = round(float(np.median(step_s[same_track])), 6) if same_track.any() else 0.0
    starts = np.concatenate([[False], ~same_track | is_jump])[: tracks.n_rows]
    return np.cumsum(starts).astype(np.int64)


def _sizes_of_tracks(tracks: Tracks, sizes: Mapping[str, ClassSize], report: CleaningReport) -> FloatArray:
    """Return the size of each track, (n_tracks, 3): the median of its rows, or the usual size of its class."""
    result = np.empty((len(tracks.names), 3))
    for axis, key in enumerate(_SIZE_KEYS):
        recorded = getattr(tracks, key)
        is_known = np.isfinite(recorded) & (recorded > 0)
        medians = _medians(tracks.track[is_known], recorded[is_known], len(tracks.names))
        for i in np.flatnonzero(np.isnan(medians)):
            name = tracks.classes[i]
            medians[i] = getattr(sizes[name], key)
            label = f"{name}: {key}"
            report.filled_sizes[label] = report.filled_sizes.get(label, 0) + 1
        result[:, axis] = medians
    return result


def _report_heights(tracks: Tracks, size_m: FloatArray, report: CleaningReport) -> None:
    bottoms_m = tracks.z_m - size_m[tracks.track, 2] / 2.0
    bottoms_m = bottoms_m[np.isfinite(bottoms_m)]
    report.rows_with_height = bottoms_m.size
    if bottoms_m.size:
        median_m = float(np.median(bottoms_m))
        report.bottom_height_m = round(median_m, 3)
        report.height_scatter_m = round(1.4826 * float(np.median(np.abs(bottoms_m - median_m))), 3)


def _medians(group: IntArray, values: FloatArray, n_groups: int) -> FloatArray:
    """Return the median of the values of each group, NaN for groups without values; ``group`` is ascending."""
    medians = np.full(n_groups, np.nan)
    for rows in _runs(group):
        medians[group[rows.start]] = np.median(values[rows])
    return medians


def _runs(group: IntArray) -> Iterator[slice]:
    """Yield the rows of each group; ``group`` is ascending."""
    bounds = np.flatnonzero(np.diff(group, prepend=-1, append=group.max(initial=-1) + 1))
    for start, end in itertools.pairwise(bounds.tolist()):
        yield slice(start, end)


def _headings(tracks: Tracks, part: IntArray, report: CleaningReport) -> FloatArray:
    """Return the heading of each row."""
    given = np.isfinite(tracks.yaw_rad)
    yaw_rad = np.where(given, tracks.yaw_rad, np.nan)
    motion_rad = motion_yaw_rad(part, tracks.time_s, tracks.x_m, tracks.y_m, HEADING_BASE_M)
    speed_m_s = _speeds(part, tracks)
    off_motion = np.cos(yaw_rad - motion_rad) < 0.0
    flipped = given & (speed_m_s > MOVING_M_S) & off_motion
    yaw_rad = np.where(flipped, yaw_rad + np.pi, yaw_rad)
    from_motion = ~given & np.isfinite(motion_rad)
    yaw_rad = np.where(from_motion, motion_rad, yaw_rad)
    unknown = np.isnan(yaw_rad)
    report.headings_given = int(given.sum())
    report.headings_from_motion = int(from_motion.sum())
    report.headings_unknown = int(unknown.sum())
    report.flipped_headings = int(flipped.sum())
    return np.where(unknown, 0.0, yaw_rad)


def _speeds(part: IntArray, tracks: Tracks) -> FloatArray:
    """Return the speed between the rows before and after each row of a track, m/s; 0 for a single row."""
    before, after = np.arange(tracks.n_rows) - 1, np.arange(tracks.n_rows) + 1
    before[np.diff(part, prepend=-1) != 0] += 1
    after[np.diff(part, append=part.max(initial=0) + 1) != 0] -= 1
    distance_m = np.hypot(tracks.x_m[after] - tracks.x_m[before], tracks.y_m[after] - tracks.y_m[before])
    duration_s = tracks.time_s[after] - tracks.time_s[before]
    return np.divide(distance_m, duration_s, out=np.zeros_like(distance_m), where=duration_s > 0)
