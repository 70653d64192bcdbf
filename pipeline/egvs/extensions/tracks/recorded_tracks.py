"""Recorded tracks as traffic: from files to the rows and sizes of a recording.

Steps: read the files (:mod:`egvs.extensions.tracks.sources`), convert positions and headings to the world frame, clean
the tracks, compute their boxes at the frames, and leave out those that the recording did not cover. The boxes then take
the way of a finished FCD file: as rows with a front bumper, an angle, and a vehicle type of their size
(:mod:`egvs.traffic.fcd`).

Tracks stand on the road: heights of a recording are not used, because its zero is rarely that of the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import by_number, number_of
from egvs.extensions.tracks import cleaning, coverage, resampling
from egvs.extensions.tracks.cleaning import CleanTracks
from egvs.extensions.tracks.coverage import Coverage
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.extensions.tracks.resampling import ResampledTracks
from egvs.extensions.tracks.sources import TrackSource
from egvs.formats.georeference import WORLD, Georeference
from egvs.scenario.model import Scenario
from egvs.traffic import lane_alignment, sumo_folder
from egvs.traffic.class_sizes import CLASS_SIZES, class_sizes
from egvs.traffic.fcd import FCD_SCHEMA, FrameWindow
from egvs.traffic.lane_alignment import Alignment
from egvs.traffic.network import Network
from egvs.traffic.road_lanes import RoadLanes
from egvs.traffic.shared_names import MAX_SPEED_M_S
from egvs.traffic.vehicle_boxes import VehicleSize

FRAMES_EACH = 4096
"""Frames per table of rows."""

MAX_UNCERTAIN_SHARE = 0.05
"""Share of rows or tracks from which on something in them gets a warning."""

MAX_FRAMES = 5_000_000
"""Largest number of frames: two months at one frame per second."""

MOTOR_CLASSES = frozenset(("car", "van", "truck", "bus"))
"""Classes that should be on lanes for cars."""

_UNIT_HINT = "Check the unit of the times: seconds in a column of milliseconds give this."

_SIZE_DIGITS = 2
"""Sizes are rounded to centimetres, so that tracks of one size share a vehicle type."""


@dataclass(frozen=True)
class RecordedTracks:
    """The boxes of a recording at the frames of a scenario.

    Attributes
    ----------
    window
        The frames.
    tracks, boxes
        The cleaned rows, and the boxes.
    coverage
        What the recording could see; None for people beside simulated vehicles.
    outside
        Number of boxes outside the coverage, which are left out.
    alignment
        How well they fit the lanes; None without a network.
    roads
        The network, whose heights the boxes get; z = 0 without one.
    first_s
        Time of the first frame, on the clock of the recording.
    """

    window: FrameWindow
    tracks: CleanTracks
    boxes: ResampledTracks
    coverage: Coverage | None
    outside: int
    alignment: Alignment | None
    roads: Network | None = None
    first_s: float = 0.0

    @property
    def type_names(self) -> list[str]:
        """Vehicle type of each track: its class and size."""
        return [
            f"{name} {length_m:.2f}x{width_m:.2f}x{height_m:.2f}"
            for name, (length_m, width_m, height_m) in zip(self.tracks.classes, self._sizes_m, strict=True)
        ]

    @property
    def _sizes_m(self) -> list[list[float]]:
        sizes_m: list[list[float]] = np.round(self.tracks.size_m, _SIZE_DIGITS).tolist()
        return sizes_m

    def vulnerable_types(self) -> frozenset[str]:
        """Return the vehicle types of people on foot and on bicycles."""
        types = zip(self.type_names, self.tracks.classes, strict=True)
        return frozenset(type_name for type_name, name in types if name in cleaning.VULNERABLE)

    def vehicle_sizes(self) -> dict[str, VehicleSize]:
        """Return the size of each vehicle type."""
        sizes = {}
        for type_name, name, size_m in zip(self.type_names, self.tracks.classes, self._sizes_m, strict=True):
            length_m, width_m, height_m = size_m
            sizes[type_name] = VehicleSize(length_m, width_m, height_m, CLASS_SIZES[name].vclass)
        return sizes

    def rows(self, first_ms: int = 0) -> Iterator[pa.Table]:
        """Yield rows of :data:`egvs.traffic.fcd.FCD_SCHEMA`, in order of time; the first frame is at ``first_ms``."""
        boxes, names = self.boxes, pa.array(self.tracks.names)
        type_names = pa.array(self.type_names)
        front_m = self._fronts_m()
        heights_m = self._road_heights_m(front_m)
        for first in range(0, self.window.count, FRAMES_EACH):
            rows = slice(*np.searchsorted(boxes.frame, [first, first + FRAMES_EACH]))
            track, yaw_rad = boxes.track[rows], boxes.yaw_rad[rows]
            if not track.size:
                continue  # a pause: readers expect rows, and see from their times that frames are empty
            zeros = np.zeros(track.size)
            yield pa.table(
                [
                    first_ms + boxes.frame[rows] * self.window.period_ms,
                    names.take(pa.array(track)),
                    type_names.take(pa.array(track)),
                    *front_m[rows].T,
                    heights_m[rows],
                    90.0 - np.rad2deg(yaw_rad),
                    zeros,
                    boxes.speed_m_s[rows],
                ],
                schema=FCD_SCHEMA,
            )

    def _fronts_m(self) -> FloatArray:
        """Return the middle of the front of each box, (n, 2)."""
        boxes = self.boxes
        half_m = np.array(self._sizes_m).reshape(-1, 3)[boxes.track, 0] / 2.0
        return np.column_stack([boxes.x_m + half_m * np.cos(boxes.yaw_rad), boxes.y_m + half_m * np.sin(boxes.yaw_rad)])

    def _road_heights_m(self, front_m: FloatArray) -> FloatArray:
        """Return the height of the road below the front of each box, (n,); 0 without a network."""
        boxes = self.boxes
        if self.roads is None:
            return np.zeros(len(front_m))
        is_vehicle = np.array([name not in cleaning.VULNERABLE for name in self.tracks.classes], dtype=np.bool_)
        yaw_rad = np.where(is_vehicle[boxes.track], boxes.yaw_rad, np.nan)  # people walk across lanes
        return RoadLanes(self.roads).heights_m(boxes.track, boxes.frame, front_m, yaw_rad)

    def unknown_boxes(self) -> list[dict[str, Any]]:
        """Return the gaps in which positions are unknown, as JSON; frames count from the first of the recording.

        Keys: ``frames`` (first, and one after the last), ``start_m`` and ``end_m`` (x, y of the centre before and after
        the gap, world frame), ``yaw_rad``, ``size_m`` (length, width).
        """
        gaps = self.boxes.unknown
        rows = zip(gaps.frames, gaps.start_m, gaps.end_m, gaps.yaw_rad, gaps.track, strict=True)
        return [
            {
                "frames": frames.tolist(),
                "start_m": np.round(start_m, 3).tolist(),
                "end_m": np.round(end_m, 3).tolist(),
                "yaw_rad": round(float(yaw_rad), 6),
                "size_m": self._sizes_m[track][:2],
            }
            for frames, start_m, end_m, yaw_rad, track in rows
        ]

    def summary(self) -> dict[str, Any]:
        """Return what was read, changed and left out, as JSON."""
        report = self.tracks.report.to_json() | self.boxes.report()
        values = {**report, "outside_coverage": self.outside}
        if self.coverage is not None:
            values["coverage"] = self.coverage.to_json()
        if self.alignment is not None:
            values["alignment"] = self.alignment.to_json()
        if self.tracks.sources:
            values["sources"] = list(self.tracks.sources)
        return values


def track_files(scenario: Scenario) -> list[Path]:
    """Return the files of a scenario's tracks, or of its recorded pedestrians, with those that their readers need."""
    source = track_source(scenario)
    return [*source.paths, *source.companions()]


def read_recorded_tracks(scenario: Scenario, world: Georeference) -> RecordedTracks:
    """Read the tracks of a scenario.

    Parameters
    ----------
    scenario
        With ``traffic.tracks``.
    world
        The world frame.

    Raises
    ------
    InputError
        When a file is damaged, far from the region of interest, or shorter than the requested frames.
    """
    tracks = read_in_world_frame(track_source(scenario), world)
    window = _window(scenario, tracks)
    cleaned = cleaning.clean_tracks(tracks, class_sizes(scenario.traffic))
    first_s = float(np.nanmin(tracks.time_s)) + window.skip_ms / 1000.0
    boxes = resampling.resample(cleaned, first_s, window.period_ms / 1000.0, window.count, scenario.traffic.track_gap_s)
    roads = sumo_folder.read_network(scenario)
    lanes_m = np.empty((0, 2)) if roads is None else lane_alignment.lane_points(roads, scenario.roi.box)
    if scenario.traffic.coverage is None:
        area = coverage.estimate(cleaned, scenario.roi.box, lanes_m)
        inside = np.ones(boxes.frame.size, dtype=bool)
    else:
        path = scenario.find(scenario.traffic.coverage, "traffic.coverage")
        area = coverage.read(path, world, scenario.roi.box, lanes_m)
        inside = area.contains(np.column_stack([boxes.x_m, boxes.y_m]))
        boxes = boxes.select(inside)
    alignment = None if roads is None else lane_alignment.align(_moving_vehicles(cleaned, boxes), roads)
    outside = int((~inside).sum())
    return RecordedTracks(replace(window, skip_ms=0), cleaned, boxes, area, outside, alignment, roads)


def read_recorded_pedestrians(scenario: Scenario, world: Georeference) -> RecordedTracks:
    """Read the tracks of people on foot and on bicycles, for ``traffic.pedestrian_tracks``.

    Parameters
    ----------
    scenario
        With simulated vehicles.
    world
        The world frame.

    Raises
    ------
    InputError
        When a file is damaged, far from the region of interest, shorter than the simulation, or has nobody on foot or
        on a bicycle.
    """
    source = track_source(scenario)
    tracks = read_in_world_frame(source, world)
    is_vulnerable = np.array([name in cleaning.VULNERABLE for name in tracks.classes])
    if not is_vulnerable.any():
        hint = "Use tracks of pedestrians or bicycles; with vehicles, name them in traffic.tracks."
        raise InputError(source.paths[0], "contains nobody on foot or on a bicycle", hint)
    window = _window(scenario, tracks)
    cleaned = cleaning.clean_tracks(tracks.select_tracks(is_vulnerable), class_sizes(scenario.traffic))
    first_s = float(np.nanmin(tracks.time_s))
    boxes = resampling.resample(cleaned, first_s, window.period_ms / 1000.0, window.count, scenario.traffic.track_gap_s)
    return RecordedTracks(window, cleaned, boxes, None, 0, None, sumo_folder.read_network(scenario), first_s)


def pedestrian_warnings(people: RecordedTracks, begin_s: float, where: str) -> Iterator[Diagnostic]:
    """Warn that recorded pedestrians and simulated vehicles know nothing of each other.

    There is no warning where the network replays the signals that the people were recorded under, on their clock.

    Parameters
    ----------
    people
        The recorded people, with the network of the vehicles.
    begin_s
        Time of the first frame in the simulation.
    where
        Key of the tracks, for messages.
    """
    clock = None if people.roads is None else people.roads.signal_clock
    if clock is not None:
        duration_s = (people.window.count - 1) * people.window.period_ms / 1000.0
        problem = clock.problem(begin_s, people.first_s, people.first_s + duration_s)
        if not problem:
            return
        begin_s = people.first_s - clock.zero_s
        hint = f"Set traffic.warmup_s and begin_s so that their sum is {begin_s:g}, and frames within the signals."
        yield Diagnostic("recorded pedestrians", where, problem, hint)
        return
    problem = (
        "people were recorded among other vehicles than the simulated ones, and under other signals: they do not react"
        " to each other, and may cross at the same time"
    )
    hint = "Give the recorded signals: egvs new --pedestrian-tracks with --signals. Or record or simulate both."
    yield Diagnostic("recorded pedestrians", where, problem, hint)


def _moving_vehicles(tracks: CleanTracks, boxes: ResampledTracks) -> FloatArray:
    """Return the positions of motor vehicles that move, (n, 2)."""
    is_motor = np.array([name in MOTOR_CLASSES for name in tracks.classes])
    moves = is_motor[boxes.track] & (boxes.speed_m_s > cleaning.MOVING_M_S)
    return np.column_stack([boxes.x_m[moves], boxes.y_m[moves]])


def tracks_window(scenario: Scenario) -> FrameWindow:
    """Return the frames of a scenario with tracks; InputError if a file is damaged or too short."""
    return _window(scenario, concatenate(track_source(scenario).read()))


def track_warnings(recorded: RecordedTracks, where: str) -> Iterator[Diagnostic]:
    """Warn about doubtful tracks.

    Parameters
    ----------
    recorded
        The tracks.
    where
        Key of the tracks, for messages.
    """
    report = recorded.tracks.report
    if report.dropped_rows:
        problem = (
            f"{report.dropped_rows:,} of {number_of(report.rows, 'row')}"
            f" {by_number(report.dropped_rows, 'has', 'have')} no time or position: left out"
        )
        yield Diagnostic("track rows", where, problem, "Check how the file was written.")
    if report.jumps:
        problem = (
            f"tracks jump {number_of(report.jumps, 'time')}, faster than {MAX_SPEED_M_S:g} m/s; they"
            " are cut there, because"
            " the identity has probably switched to another road user"
        )
        yield Diagnostic("track jumps", where, problem, "Check the tracks there.")
    if report.flipped_headings > MAX_UNCERTAIN_SHARE * max(report.headings_given, 1):
        problem = (
            f"{report.flipped_headings:,} of {report.headings_given:,} headings point backwards, and are turned by 180"
            " degrees"
        )
        yield Diagnostic("track headings", where, problem, "No action is needed if boxes look right in the explorer.")
    if report.headings_unknown > MAX_UNCERTAIN_SHARE * max(report.rows, 1):
        problem = (
            f"{number_of(report.headings_unknown, 'box', 'boxes')} without heading"
            f" {by_number(report.headings_unknown, 'never moves, so it points', 'never move, so they point')} east"
        )
        yield Diagnostic("track headings", where, problem, "Add headings to the file.")
    boxes = recorded.boxes
    if boxes.unknown_gaps:
        frames = boxes.report()["unknown_frames"]
        problem = (
            f"{number_of(boxes.unknown_gaps, 'gap')} in tracks {by_number(boxes.unknown_gaps, 'is', 'are')} too"
            f" long to be interpolated; in {number_of(frames, 'frame')} of a track its"
            " position is unknown"
        )
        hint = "Raise track_gap_s if straight lines are good enough."
        if 2 * boxes.unknown_gaps > report.rows:
            hint = "Most steps of the file are that long: check the unit of its times, such as time_unit."
        yield Diagnostic("track gaps", where, problem, hint)
    if recorded.coverage is not None:
        yield from recorded.coverage.warnings(where)


def warn_without_vehicles(recorded: RecordedTracks, where: str) -> Iterator[Diagnostic]:
    """Warn that replayed tracks have nobody but people on foot and on bicycles, which scores do not count."""
    classes = set(recorded.tracks.classes)
    if classes <= cleaning.VULNERABLE:
        problem = f"the tracks have no vehicle, only classes {' and '.join(sorted(classes))}, which scores leave out"
        hint = (
            "Put them beside simulated vehicles (egvs new --pedestrian-tracks), or give them a weight in"
            " [score.weights.kinds]."
        )
        yield Diagnostic("no vehicles", where, problem, hint)


def track_source(scenario: Scenario) -> TrackSource:
    """Return the files of a scenario's tracks, or else of its recorded pedestrians, and how to read them.

    Raises
    ------
    InputError
        When a file does not exist.
    """
    traffic = scenario.traffic
    key = "tracks" if traffic.tracks is not None else "pedestrian_tracks"
    paths = tuple(scenario.find(name, f"traffic.{key}") for name in getattr(traffic, key) or ())
    return TrackSource(paths, traffic.track_columns, traffic.track_crs)


def read_in_world_frame(source: TrackSource, world: Georeference) -> Tracks:
    """Read files of tracks on one clock, and convert positions and headings to the world frame.

    Parameters
    ----------
    source
        The files.
    world
        The world frame.

    Raises
    ------
    InputError
        When a file is damaged, or far from the region of interest.
    """
    recorded = zip(source.read(), source.paths, strict=True)
    return concatenate([_to_world(tracks, source.crs, world, path) for tracks, path in recorded])


def _to_world(tracks: Tracks, crs: str | None, world: Georeference, path: Path) -> Tracks:
    """Convert positions and headings to the world frame."""
    frame = tracks.frame
    if crs is not None:
        frame = TrackFrame() if crs == "world" else TrackFrame(crs)
    finite = np.isfinite(tracks.x_m) & np.isfinite(tracks.y_m)
    xy = np.column_stack([tracks.x_m, tracks.y_m]) + frame.offset_m
    hint = 'Set traffic.track_crs to the coordinate system of the tracks, e.g. "EPSG:25832" or "world".'
    reading = world.read_coordinates(xy[finite], str(path), WORLD if frame.crs is None else frame.crs, hint)
    if reading.convert is None:
        return replace(tracks, x_m=xy[:, 0], y_m=xy[:, 1], frame=TrackFrame())
    xy_m = np.full_like(xy, np.nan)
    xy_m[finite] = reading.to_world(xy[finite])
    turn_rad = _grid_turn_rad(reading.convert, xy[finite])
    return replace(tracks, x_m=xy_m[:, 0], y_m=xy_m[:, 1], yaw_rad=tracks.yaw_rad + turn_rad, frame=TrackFrame())


def _grid_turn_rad(convert: Any, xy: FloatArray) -> float:
    """Return by how much a system is turned against the world frame, counter-clockwise, at the median position."""
    middle = np.median(xy, axis=0)
    start, end = convert(np.array([middle, np.add(middle, (10.0, 0.0))]))
    return float(np.arctan2(end[1] - start[1], end[0] - start[0]))


def concatenate(recorded: list[Tracks]) -> Tracks:
    """Join the tracks of several files on one clock; tracks of different files are different."""
    if len(recorded) == 1:
        return recorded[0]
    names = [f"{number}: {name}" for number, tracks in enumerate(recorded) for name in tracks.names]
    repeated = len({name for tracks in recorded for name in tracks.names}) < len(names)
    if not repeated:
        names = [name for tracks in recorded for name in tracks.names]
    starts = np.cumsum([0, *(len(tracks.names) for tracks in recorded)])
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    arrays: dict[str, FloatArray] = {key: np.concatenate([getattr(tracks, key) for tracks in recorded]) for key in keys}
    track = np.concatenate([tracks.track + start for tracks, start in zip(recorded, starts, strict=False)])
    classes = tuple(name for tracks in recorded for name in tracks.classes)
    sources = dict.fromkeys(sentence for tracks in recorded for sentence in tracks.sources)
    return Tracks(tuple(names), classes, track, frame=TrackFrame(), sources=tuple(sources), **arrays)


def _window(scenario: Scenario, tracks: Tracks) -> FrameWindow:
    """Return the frames of a recording, from its first row on."""
    traffic, where = scenario.traffic, sumo_folder.traffic_location(scenario)
    period_ms = max(1, sumo_folder.to_milliseconds(traffic.frame_period_s, f"{where}.frame_period_s"))
    skip_ms = 0
    if traffic.tracks is not None:
        skip_ms = sumo_folder.to_milliseconds(traffic.warmup_s + (traffic.begin_s or 0.0), f"{where}.warmup_s")
    finite_s = tracks.time_s[np.isfinite(tracks.time_s)]
    duration_ms = int(np.floor(np.ptp(finite_s) * 1000.0 + 1e-3)) if finite_s.size else 0
    available = (duration_ms - skip_ms) // period_ms + 1
    count = available if traffic.frames is None else traffic.frames
    if count > MAX_FRAMES:
        times = f"from {finite_s.min():g} s to {finite_s.max():g} s"
        problem = f"the tracks last {times}, which are more than {MAX_FRAMES:,} frames"
        raise InputError(f"{where}.frame_period_s", problem, "Check the times, or set a longer frame_period_s.")
    blocks = scenario.tpog.blocks
    if traffic.tracks is not None and traffic.frames is None and 0 < count < blocks:
        problem = f"{', '.join(traffic.tracks)} last {duration_ms / 1000:g} s, {number_of(count, 'frame')}"
        hint = f"{_UNIT_HINT} Or use a longer recording, a shorter frame_period_s, or fewer tpog.blocks."
        raise InputError(f"{where}.tracks", f"{problem}; expected at least {blocks} (tpog.blocks)", hint)
    if count < 1 or count > available:
        names = ", ".join(traffic.tracks or traffic.pedestrian_tracks or ())
        problem = (
            f"{names} last {duration_ms / 1000:g} s, {number_of(max(available, 0), 'frame')} after {skip_ms / 1000:g} s"
        )
        hint = "Use fewer frames, or a shorter frame_period_s or warmup_s."
        raise InputError(f"{where}.frames", problem, _UNIT_HINT if 0 < duration_ms < 1000 else hint)
    return FrameWindow(count, period_ms, 0, skip_ms, complete=True)
