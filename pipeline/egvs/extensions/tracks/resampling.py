"""Positions of recorded tracks at the frames of a scenario.

Between two rows, positions are interpolated linearly, and headings along the shorter arc. A *gap* is a time without
rows of more than :data:`MIN_GAP_STEPS` usual steps. Gaps up to a limit are interpolated and counted. During longer
ones, and at jumps, the position is unknown: the places on the straight way between their ends are neither occupied nor
empty (:class:`UnknownBoxes`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from egvs.core import limits
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.extensions.tracks.cleaning import CleanTracks

MIN_GAP_STEPS = 1.5
"""A time between two rows this many times the usual step is a gap."""


@dataclass(frozen=True)
class ResampledTracks:
    """Boxes at frames, sorted by frame, then track. Arrays have shape (n,).

    Attributes
    ----------
    frame, track
        Frame and track of each box, int64.
    x_m, y_m, yaw_rad
        Centre and heading.
    speed_m_s
        Speed between the two rows beside the frame.
    interpolated_gaps, unknown_gaps
        Number of gaps that were interpolated, and of longer ones, in the recorded frames.
    unknown
        Boxes on the way through the longer gaps.
    """

    frame: IntArray
    track: IntArray
    x_m: FloatArray
    y_m: FloatArray
    yaw_rad: FloatArray
    speed_m_s: FloatArray
    interpolated_gaps: int
    unknown_gaps: int
    unknown: UnknownBoxes

    def select(self, mask: BoolArray) -> ResampledTracks:
        """Return some of the boxes."""
        keys = ("frame", "track", "x_m", "y_m", "yaw_rad", "speed_m_s")
        return replace(self, **{key: getattr(self, key)[mask] for key in keys})

    def report(self) -> dict[str, Any]:
        """Return the numbers of gaps as JSON."""
        return {
            "interpolated_gaps": self.interpolated_gaps,
            "unknown_gaps": self.unknown_gaps,
            "unknown_frames": int((self.unknown.frames[:, 1] - self.unknown.frames[:, 0]).sum()),
        }


@dataclass(frozen=True)
class UnknownBoxes:
    """Boxes in which a road user may have been during a gap, in all frames of the gap.

    Attributes
    ----------
    frames
        First frame of each gap, and the one after its last, (n_gaps, 2) int64; gaps without a frame are left out.
    track
        Track of each gap, (n_gaps,) int64.
    start_m, end_m
        Positions before and after the gap, (n_gaps, 2).
    yaw_rad
        Heading along the way; before the gap where the road user did not move, (n_gaps,).
    """

    frames: IntArray
    track: IntArray
    start_m: FloatArray
    end_m: FloatArray
    yaw_rad: FloatArray


def resample(tracks: CleanTracks, first_s: float, period_s: float, n_frames: int, max_gap_s: float) -> ResampledTracks:
    """Compute the boxes of all frames.

    Parameters
    ----------
    tracks
        The rows.
    first_s, period_s, n_frames
        Frame k is at first_s + k * period_s.
    max_gap_s
        Longest gap that is interpolated.

    Raises
    ------
    InputError
        When there are more boxes than :data:`egvs.core.limits.BOXES`.
    """
    frame_s = first_s + np.arange(n_frames) * period_s
    # a rounding error in the time of a row must not cost its frame
    tolerance_s = 1e-6
    gap_s = np.diff(tracks.time_s)
    same_track = np.diff(tracks.track) == 0
    is_jump = same_track & (np.diff(tracks.part) != 0)
    is_long = (same_track & (gap_s > max_gap_s + tolerance_s)) | is_jump
    is_gap = (same_track & (gap_s > MIN_GAP_STEPS * tracks.report.step_s)) | is_long
    is_joined = same_track & ~is_long

    first_frame = np.searchsorted(frame_s, tracks.time_s[:-1] - tolerance_s)
    end_frame = np.searchsorted(frame_s, tracks.time_s[1:] - tolerance_s)
    gap_frame = np.searchsorted(frame_s, tracks.time_s[:-1] + tolerance_s, side="right")
    pairs = np.flatnonzero(is_joined)
    n_boxes = int((end_frame[pairs] - first_frame[pairs]).sum())
    limits.BOXES.check("traffic.tracks", n_boxes, f"gives {n_boxes:,} boxes in {n_frames:,} frames")
    left, frame = _repeat_over_frames(pairs, first_frame, end_frame)
    # the last row of a joined sequence is at a frame, too, if the times agree
    is_last = np.append(~is_joined, True)
    rows = np.flatnonzero(is_last)
    nearest = np.searchsorted(frame_s, tracks.time_s[rows] - tolerance_s)
    hit = (nearest < n_frames) & (
        np.abs(frame_s[np.minimum(nearest, n_frames - 1)] - tracks.time_s[rows]) <= tolerance_s
    )
    rows, nearest = rows[hit], nearest[hit]

    right = left + 1
    duration_s = tracks.time_s[right] - tracks.time_s[left]
    share = np.clip((frame_s[frame] - tracks.time_s[left]) / duration_s, 0.0, 1.0)
    dx_m, dy_m = tracks.x_m[right] - tracks.x_m[left], tracks.y_m[right] - tracks.y_m[left]
    turn_rad = np.angle(np.exp(1j * (tracks.yaw_rad[right] - tracks.yaw_rad[left])))
    last_speed_m_s = np.full(tracks.time_s.size, np.nan)
    last_speed_m_s[right] = np.hypot(dx_m, dy_m) / duration_s

    all_frames = np.concatenate([frame, nearest])
    all_tracks = np.concatenate([tracks.track[left], tracks.track[rows]])
    order = np.lexsort((all_tracks, all_frames))

    def both(between: FloatArray, at_row: FloatArray) -> FloatArray:
        return np.concatenate([between, at_row])[order]

    return ResampledTracks(
        all_frames[order],
        all_tracks[order],
        both(tracks.x_m[left] + share * dx_m, tracks.x_m[rows]),
        both(tracks.y_m[left] + share * dy_m, tracks.y_m[rows]),
        both(tracks.yaw_rad[left] + share * turn_rad, tracks.yaw_rad[rows]),
        both(np.hypot(dx_m, dy_m) / duration_s, last_speed_m_s[rows]),
        int((is_gap & is_joined & (end_frame > gap_frame)).sum()),
        int((is_long & (end_frame > gap_frame)).sum()),
        _unknown_boxes(tracks, np.flatnonzero(is_long), gap_frame, end_frame),
    )


def _repeat_over_frames(pairs: IntArray, first_frame: IntArray, end_frame: IntArray) -> tuple[IntArray, IntArray]:
    """Return each pair of rows once per frame between them, and these frames."""
    counts = end_frame[pairs] - first_frame[pairs]
    left = np.repeat(pairs, counts)
    offsets = np.arange(left.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return left, first_frame[left] + offsets


def _unknown_boxes(tracks: CleanTracks, gaps: IntArray, first_frame: IntArray, end_frame: IntArray) -> UnknownBoxes:
    """Return what is known about the gaps with at least one frame."""
    gaps = gaps[end_frame[gaps] > first_frame[gaps]]
    xy_m = np.column_stack([tracks.x_m, tracks.y_m])
    start_m, end_m = xy_m[gaps], xy_m[gaps + 1]
    step_m = end_m - start_m
    moved = np.hypot(*step_m.T) > 0.5
    yaw_rad = np.where(moved, np.arctan2(step_m[:, 1], step_m[:, 0]), tracks.yaw_rad[gaps])
    frames = np.column_stack([first_frame[gaps], end_frame[gaps]])
    return UnknownBoxes(frames, tracks.track[gaps], start_m, end_m, yaw_rad)
