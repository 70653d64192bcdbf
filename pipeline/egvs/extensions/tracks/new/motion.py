"""Recorded road users at a junction: motor vehicles on lanes, when they pass stop lines, and people on foot.

The tracks are read and cleaned as a run does; motor vehicles are matched to lanes
(:mod:`egvs.extensions.tracks.matching`).
World frame, metres, seconds.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.creation.junctions import Streets
from egvs.extensions.tracks import cleaning, recorded_tracks, resampling
from egvs.extensions.tracks import matching as track_matching
from egvs.extensions.tracks.cleaning import CleanTracks
from egvs.extensions.tracks.matching import MatchedTracks
from egvs.extensions.tracks.new.files import TrackFiles
from egvs.extensions.tracks.new.fleet import VEHICLE_CLASSES
from egvs.extensions.tracks.new.signal_assignment import Crossing, RecordedMotion, RecordedPeople
from egvs.extensions.tracks.resampling import ResampledTracks
from egvs.traffic import lane_alignment
from egvs.traffic.class_sizes import CLASS_SIZES
from egvs.traffic.lane_alignment import Alignment
from egvs.traffic.network import Network

_MAX_GAP_S = 2.0


@dataclass(frozen=True, eq=False)
class MatchedRecording:
    """Recorded tracks of all road users, and the motor vehicles among them on lanes.

    Attributes
    ----------
    path
        The first file, for messages.
    tracks
        The cleaned tracks.
    boxes
        Motor vehicles every :data:`track_matching.PERIOD_S`, from ``first_s`` on.
    network
        The lanes.
    first_s, duration_s
        First time on the clock of the recording, and the length of the recording.
    """

    path: Path
    tracks: CleanTracks
    boxes: ResampledTracks
    network: Network
    first_s: float
    duration_s: float

    @cached_property
    def matched(self) -> MatchedTracks:
        """The motor vehicles on lanes; times count from ``first_s``."""
        return track_matching.match_tracks(self.boxes, track_matching.PERIOD_S, self.network)

    @cached_property
    def alignment(self) -> Alignment | None:
        """How well moving vehicles fit the lanes."""
        moves = self.boxes.speed_m_s > cleaning.MOVING_M_S
        return lane_alignment.align(np.column_stack([self.boxes.x_m, self.boxes.y_m])[moves], self.network)

    def motion(self) -> RecordedMotion:
        """Return when vehicles pass stop lines, and where people walk."""
        crossings = tuple(_crossings(self.matched, self.first_s)) if self.boxes.track.size else ()
        return RecordedMotion(crossings, self._people())

    def _people(self) -> RecordedPeople | None:
        """Return the positions of people on foot, if there are any."""
        tracks = self.tracks
        is_walker = np.array([name == "pedestrian" for name in tracks.classes])[tracks.track]
        if not is_walker.any():
            return None
        xy_m = np.column_stack([tracks.x_m, tracks.y_m])[is_walker]
        return RecordedPeople(tracks.track[is_walker], tracks.time_s[is_walker], xy_m)


def match_recording(recording: TrackFiles, streets: Streets) -> MatchedRecording:
    """Read recorded tracks for the streets of a new scenario.

    Parameters
    ----------
    recording
        Files of recorded tracks.
    streets
        The streets.

    Raises
    ------
    InputError
        When a file is damaged or far from the streets.
    """
    path = recording.source.paths[0]
    cleaned = cleaning.clean_tracks(recording.read(streets), CLASS_SIZES)
    first_s, duration_s = float(cleaned.time_s.min()), float(np.ptp(cleaned.time_s))
    period_s = track_matching.PERIOD_S
    n_frames = int(duration_s / period_s + 1e-6) + 1
    if n_frames > recorded_tracks.MAX_FRAMES:
        problem = f"the tracks last {duration_s:,.0f} s, more than {recorded_tracks.MAX_FRAMES * period_s:,.0f} s"
        raise InputError(path, problem, "Check the times.")
    boxes = resampling.resample(cleaned, first_s, period_s, n_frames, _MAX_GAP_S)
    is_vehicle = np.array([name in VEHICLE_CLASSES for name in cleaned.classes])
    boxes = boxes.select(is_vehicle[boxes.track])
    return MatchedRecording(path, cleaned, boxes, streets.network, first_s, duration_s)


def _crossings(matched: MatchedTracks, first_s: float) -> Iterator[Crossing]:
    """Yield when the centres of vehicles pass the ends of roads, between two matched positions."""
    for _, rows in matched.tracks():
        numbers, times_s = matched.lane[rows], matched.time_s[rows]
        on_lane = np.flatnonzero(numbers >= 0)
        for before, after in itertools.pairwise(on_lane.tolist()):
            road, following = matched.lanes[numbers[before]], matched.lanes[numbers[after]]
            if road.is_inside or following.edge == road.edge:
                continue
            if following.is_inside and following.source != road.edge:
                continue
            yield Crossing(road.edge, following.target, first_s + float(times_s[before] + times_s[after]) / 2.0)
