"""The ``range_image`` detector: segments on the graph of beams, and a learnt box and confidence for each.

Steps for a sweep:

1. *New points*: returns well before those of the empty scan (:mod:`egvs.extensions.validation.detectors.background`),
   near the region of interest, and not on the ground.
2. *Segments*: points of neighbouring beams are joined unless the range jumps between them (depth-angle criterion of
   Bogoslavskyi and Stachniss 2016). Neighbours are found by the directions of beams, so this works for rings and for
   patterns that do not repeat. It is done with several limits (:data:`LEVELS`), from strict to generous:
   a queue is one segment with generous limits, and a partly hidden vehicle is several with strict ones.
3. *Rectangles*: two for each segment, by variance and by area (Zhang et al. 2017;
   :mod:`egvs.extensions.validation.kernels.range_segments`).
4. *Kind, box, confidence*: decision trees that were trained on simulated sweeps
   (:mod:`egvs.extensions.validation.detectors.segment_model`) tell what a segment is, how far the vehicle extends
   beyond the points, and how sure that is.
5. *Selection*: of boxes that overlap, the most confident one remains. So the levels compete, and the best one wins for
   each vehicle.

A rectangle has an axis a along its longer side and an axis b across. Both point away from the sensor, so ``low`` sides
face the sensor.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np

from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.extensions.validation.detectors import background, segment_model
from egvs.extensions.validation.detectors.background import GroundMap
from egvs.extensions.validation.detectors.base import suppress_overlaps
from egvs.extensions.validation.detectors.segment_model import SEGMENT_KINDS, VEHICLE_KINDS, SegmentModel
from egvs.extensions.validation.kernels import range_segments
from egvs.sensors.sensor import Sensor

LEVELS = ((10.0, 0.15, 0.3), (10.0, 0.25, 0.6), (8.0, 0.4, 1.0))
"""Limits of segments, each more generous than the one before: smallest angle beta in degrees, distance up to which
points are always joined, distance up to which they may be joined, in metres."""

MIN_POINTS = 4
"""A segment with fewer points is no vehicle."""

LOWEST_M, HIGHEST_M = 0.15, 5.0
"""Heights above the ground of points that are used."""

MARGIN_M = 8.0
"""Points are used up to this distance around the region of interest, because vehicles extend beyond it."""

HEADINGS = 60
"""Candidate headings of rectangles, over 90 degrees."""

LONGEST_M = 25.0
"""A segment with a longer side is no vehicle."""

NEARER_M = 0.5
"""Something hides what is beside a point if it is nearer by more than this."""

MIN_VEHICLE_PROBABILITY = 0.2
MIN_CONFIDENCE = 0.02
"""Segments that are less probably a single vehicle, and boxes of less confidence, are left out."""

SMALLEST_M = (2.0, 1.0, 1.0)
"""No vehicle is shorter, narrower or lower."""

_WRAP_DEG = 5.0  # the triangulation overlaps by this where the circle of azimuths closes
_LONGEST_STEP_DEG = 8.0  # between neighbouring beams

CRITERIA = (range_segments.BY_VARIANCE, range_segments.BY_AREA)

FEATURES = (
    "log_points", "range_m", "sensor_height_m", "spacing_m", "cos_view_a", "length_a_m", "length_b_m", "level",
    "criterion", "criterion_value", *range_segments.SUMMARY[1:],
)  # fmt: skip
"""Of each segment; the last ones as in :data:`egvs.extensions.validation.kernels.range_segments.SUMMARY`."""

BOX_FEATURES = (*SEGMENT_KINDS, "length_m", "width_m", "height_m", *segment_model.MARGINS)
"""What the confidence of a box depends on besides :data:`FEATURES`."""


# ---- beams


class BeamGraph(NamedTuple):
    """Neighbours of beams.

    Attributes
    ----------
    starts, neighbours
        Neighbours of beam b are neighbours[starts[b]] to neighbours[starts[b + 1]], (beams + 1,) and (m,) int64.
    spacing_rad
        Mean angle to the neighbours of each beam, (beams,) float64; 0 without neighbours.
    """

    starts: IntArray
    neighbours: IntArray
    spacing_rad: FloatArray


@lru_cache(maxsize=16)
def beam_graph(sensor: Sensor) -> BeamGraph:
    """Return the neighbours of the beams of a sensor.

    In a ring, beams at the azimuths before and after; in the rings above and below, the nearest beam. For a table of
    beams: the edges of a triangulation of azimuths and elevations.
    """
    direction = sensor.directions()
    pairs = _ring_pairs(sensor) if sensor.table is None else _triangulated_pairs(direction)
    beams = len(direction)
    keys = np.unique(np.concatenate([pairs[:, 0] * beams + pairs[:, 1], pairs[:, 1] * beams + pairs[:, 0]]))
    first, second = keys // beams, keys % beams
    cosine = (direction[first] * direction[second]).sum(axis=1)
    angle_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    is_near = (first != second) & (angle_rad <= math.radians(_LONGEST_STEP_DEG))
    first, second, angle_rad = first[is_near], second[is_near], angle_rad[is_near]
    counts = np.bincount(first, minlength=beams)
    total_rad = np.bincount(first, angle_rad, minlength=beams)
    return BeamGraph(np.append(0, np.cumsum(counts)), second, total_rad / np.maximum(counts, 1))


def _ring_pairs(sensor: Sensor) -> IntArray:
    """Return pairs of neighbouring beams of a sensor with rings, (n, 2); beam a * channels + r is in ring r."""
    channels, azimuths = sensor.channels, sensor.azimuths
    azimuth = np.arange(azimuths)
    step_deg = sensor.azimuth_step_deg or 360.0
    is_circle = sensor.azimuth_deg is None
    order = np.argsort(sensor.elevations_deg, kind="stable").tolist()
    pairs = [np.empty((0, 2), dtype=np.int64)]
    steps = [(ring, ring, 1) for ring in range(channels)]
    for lower, upper in itertools.pairwise(order):
        between_deg = sensor.azimuth_offsets_deg[lower] - sensor.azimuth_offsets_deg[upper]
        steps.append((lower, upper, round(between_deg / step_deg)))
    for ring, other, shift in steps:
        there = azimuth + shift
        inside = np.ones(azimuths, dtype=np.bool_) if is_circle else (there >= 0) & (there < azimuths)
        pairs.append(np.column_stack([azimuth * channels + ring, there % azimuths * channels + other])[inside])
    return np.concatenate(pairs)


def _triangulated_pairs(direction: FloatArray) -> IntArray:
    """Return pairs of neighbouring beams from their directions, (n, 2)."""
    from scipy.spatial import Delaunay, QhullError

    azimuth_deg = np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))
    elevation_deg = np.degrees(np.arcsin(np.clip(direction[:, 2], -1.0, 1.0)))
    before = np.flatnonzero(azimuth_deg > 180.0 - _WRAP_DEG)
    after = np.flatnonzero(azimuth_deg < -180.0 + _WRAP_DEG)
    beam = np.concatenate([np.arange(len(direction)), before, after])
    turned_deg = np.concatenate([azimuth_deg, azimuth_deg[before] - 360.0, azimuth_deg[after] + 360.0])
    try:
        mesh = Delaunay(np.column_stack([turned_deg, elevation_deg[beam]]))
    except (QhullError, ValueError):  # fewer than three beams, or all on one line
        order = np.lexsort((elevation_deg[beam], turned_deg))
        return np.column_stack([beam[order[:-1]], beam[order[1:]]])
    corners = np.concatenate([mesh.simplices[:, [0, 1]], mesh.simplices[:, [1, 2]], mesh.simplices[:, [2, 0]]])
    same = mesh.coplanar[:, [0, 2]]  # beams of equal direction
    pairs: IntArray = beam[np.concatenate([corners, same])].astype(np.int64)
    return pairs


# ---- segments


@dataclass(frozen=True, eq=False)
class Segments:
    """Rectangles around the segments of a sweep; m of them, several of the same points.

    Attributes
    ----------
    points
        Index of each point of each segment in the sweep, one segment after the other, (k,) int64.
    starts
        Points of segment s are points[starts[s]] to points[starts[s + 1]], (m + 1,) int64.
    axes
        Unit vectors of the axes a and b in the world frame, (m, 4) float64.
    ends_m
        Lowest and highest coordinate along a, then along b, from the sensor, (m, 4) float64.
    features
        Columns as in :data:`FEATURES`, (m, f) float64.
    """

    points: IntArray
    starts: IntArray
    axes: FloatArray
    ends_m: FloatArray
    features: FloatArray

    def __len__(self) -> int:
        """Number of rectangles."""
        return len(self.axes)


class _NewPoints(NamedTuple):
    """Points of traffic: row in the sweep, beam, sensor frame, range, plan position from the sensor, height."""

    row: IntArray
    beam: IntArray
    at_m: FloatArray
    range_m: FloatArray
    xy_m: FloatArray
    height_m: FloatArray


@dataclass(frozen=True, eq=False)
class RangeImageAtSite:
    """The detector at one site.

    Attributes
    ----------
    view, roi
        The site, and the region of interest.
    model
        The trained model; by default the one that comes with the program.
    """

    view: SiteView
    roi: Roi
    model: SegmentModel | None = None

    @cached_property
    def ground(self) -> GroundMap:
        """Heights of the ground, from the empty scan."""
        return GroundMap.from_empty_scans([self.view], self.roi)

    @cached_property
    def sensor_height_m(self) -> float:
        """Height of the sensor above the ground below it."""
        x_m, y_m, z_m = self.view.pose.position_m
        return z_m - float(self.ground.height_m(np.array([[x_m, y_m]]))[0])

    def detect(self, sweep: Sweep) -> Detections:
        """Return the vehicles of one sweep.

        Raises
        ------
        InputError
            If a point is not finite, or a beam is not one of the sensor's.
        """
        model = self.model or segment_model.read_model()
        segments = self.segments(sweep)
        if not len(segments):
            return Detections.empty()
        probabilities = model.kind_probabilities(segments.features)
        rows = np.flatnonzero(probabilities[:, : len(VEHICLE_KINDS)].sum(axis=1) >= MIN_VEHICLE_PROBABILITY)
        kind = probabilities[rows, : len(VEHICLE_KINDS)].argmax(axis=1)
        margins_m = model.margins_m(segments.features[rows], kind)
        boxes = self.boxes(segments, rows, margins_m)
        confidence = model.confidence.predict(
            np.column_stack([segments.features[rows], box_features(probabilities[rows], boxes, margins_m)])
        )
        is_sure = confidence >= MIN_CONFIDENCE
        detections = Detections(boxes[is_sure], np.clip(confidence[is_sure], 0.0, 1.0))
        return suppress_overlaps(detections, detections.scores)

    def boxes(self, segments: Segments, rows: IntArray, margins_m: FloatArray) -> FloatArray:
        """Return the boxes of some segments in the world frame, (n, 7) float64.

        Parameters
        ----------
        segments
            All segments.
        rows
            Those that have a box, (n,) int64.
        margins_m
            How far each box extends beyond the points,
            :data:`egvs.extensions.validation.detectors.segment_model.MARGINS`, (n, 5).
        """
        boxes = extended_boxes(segments.axes[rows], segments.ends_m[rows], segments.features[rows], margins_m)
        boxes[:, :2] += np.asarray(self.view.pose.position_m[:2])
        boxes[:, 2] += self.ground.height_m(boxes[:, :2])
        return boxes

    def segments(self, sweep: Sweep) -> Segments:
        """Return the segments of a sweep with their rectangles and features; errors as in :meth:`detect`."""
        graph = beam_graph(self.view.sensor)
        new = self._new_points(sweep)
        point_of_beam = np.full(len(graph.spacing_rad), -1, dtype=np.int64)
        point_of_beam[new.beam] = np.arange(len(new.beam))
        scene_range_m = self.view.empty_range_m.copy()
        scene_range_m[new.beam] = new.range_m

        known: set[tuple[int, int]] = set()
        points, level_of, hidden_of = [np.empty(0, dtype=np.int64)], [], [np.empty(0, dtype=np.bool_)]
        counts = []
        label = np.empty(len(new.beam), dtype=np.int64)
        hidden = np.empty(len(new.beam), dtype=np.bool_)
        for level, (beta_deg, joined_m, apart_m) in enumerate(LEVELS):
            limits = np.array([math.tan(math.radians(beta_deg)), joined_m, apart_m])
            range_segments.join_neighbours(
                new.at_m, new.range_m, new.beam, point_of_beam, graph.starts, graph.neighbours, limits, label
            )
            range_segments.hidden_edges(
                new.range_m, new.beam, label, point_of_beam, scene_range_m, graph.starts, graph.neighbours, NEARER_M,
                hidden,
            )  # fmt: skip
            order = np.argsort(label, kind="stable")
            names, sizes = np.unique(label, return_counts=True)
            ends = np.cumsum(sizes)
            for name, size, end in zip(names.tolist(), sizes.tolist(), ends.tolist(), strict=True):
                if size >= MIN_POINTS and (name, size) not in known:  # levels are nested: these are the same points
                    known.add((name, size))
                    members = order[end - size : end]
                    points.append(members)
                    hidden_of.append(hidden[members])
                    counts.append(size)
                    level_of.append(level)
        starts = np.append(0, np.cumsum(counts)).astype(np.int64)
        members = np.concatenate(points)
        return self._rectangles(new, members, np.concatenate(hidden_of), starts, np.array(level_of), graph.spacing_rad)

    def _new_points(self, sweep: Sweep) -> _NewPoints:
        """Return the points of traffic."""
        site = f"site {self.view.site}"
        if not np.isfinite(sweep.points[:, :3]).all():
            raise InputError(site, "expected finite points, got NaN or infinity", "Remove such points from the sweep.")
        if len(sweep.beam) and int(sweep.beam.max()) >= self.view.sensor.beams:
            problem = f"expected beams 0 to {self.view.sensor.beams - 1}, got {int(sweep.beam.max())}"
            raise InputError(site, problem, "Use the sensor that measured the sweep.")
        index = np.flatnonzero(background.foreground_mask(sweep, self.view))
        new = Sweep(sweep.points[index], sweep.beam[index])
        world_m = background.points_in_world(new, self.view)
        low_m = np.asarray(self.roi.origin_m[:2]) - MARGIN_M
        size_m = np.asarray(self.roi.size_m[:2]) + 2.0 * MARGIN_M
        height_m = world_m[:, 2] - self.ground.height_m(world_m[:, :2])
        is_used = ((world_m[:, :2] >= low_m) & (world_m[:, :2] < low_m + size_m)).all(axis=1)
        is_used &= (height_m >= LOWEST_M) & (height_m <= HIGHEST_M)
        at_m = new.points[is_used, :3].astype(np.float64)
        return _NewPoints(
            index[is_used],
            new.beam[is_used].astype(np.int64),
            at_m,
            np.sqrt((at_m**2).sum(axis=1)),
            world_m[is_used, :2] - np.asarray(self.view.pose.position_m[:2]),
            height_m[is_used],
        )

    def _rectangles(
        self,
        new: _NewPoints,
        members: IntArray,
        hidden: BoolArray,
        starts: IntArray,
        level: IntArray,
        spacing_rad: FloatArray,
    ) -> Segments:
        """Return the rectangles of segments, all by one criterion and then all by the other."""
        count = len(starts) - 1
        if not count:
            none = np.empty((0, 4))
            return Segments(members, starts, none, none, np.empty((0, len(FEATURES))))
        xy_m = np.ascontiguousarray(new.xy_m[members])
        spacing_m = np.add.reduceat(new.range_m[members] * spacing_rad[new.beam[members]], starts[:-1])
        turn = np.arange(HEADINGS) * (math.pi / 2.0 / HEADINGS)
        cosine, sine = np.cos(turn), np.sin(turn)
        all_axes, all_ends, all_features = [], [], []
        for criterion in CRITERIA:
            heading, ends_m, value = np.empty(count, dtype=np.int64), np.empty((count, 4)), np.empty(count)
            range_segments.search_rectangles(xy_m, starts, cosine, sine, criterion, heading, ends_m, value)
            axes, ends_m = _orient_axes(cosine[heading], sine[heading], ends_m)
            summary = np.empty((count, len(range_segments.SUMMARY)))
            range_segments.summarise_segments(xy_m, new.height_m[members], hidden, starts, axes, ends_m, summary)
            middle_m = np.column_stack([ends_m[:, 0] + ends_m[:, 1], ends_m[:, 2] + ends_m[:, 3]]) / 2.0
            away_m = np.hypot(middle_m[:, 0], middle_m[:, 1])
            all_axes.append(axes)
            all_ends.append(ends_m)
            all_features.append(
                np.column_stack(
                    [
                        np.log(summary[:, 0]),
                        away_m,
                        np.full(count, self.sensor_height_m),
                        spacing_m / summary[:, 0],
                        middle_m[:, 0] / np.maximum(away_m, 1e-9),
                        ends_m[:, 1] - ends_m[:, 0],
                        ends_m[:, 3] - ends_m[:, 2],
                        level,
                        np.full(count, criterion),
                        value,
                        summary[:, 1:],
                    ]
                )
            )
        axes, ends_m, features = (np.concatenate(parts) for parts in (all_axes, all_ends, all_features))
        is_short = (ends_m[:, 1] - ends_m[:, 0]) <= LONGEST_M
        twice = np.concatenate([starts, starts[1:] + starts[-1]])
        rows = np.flatnonzero(is_short)
        sizes = np.diff(twice)[rows]
        both = np.concatenate([members, members])
        selected = np.concatenate(
            [np.empty(0, np.int64), *(both[twice[row] : twice[row + 1]] for row in rows.tolist())]
        )
        return Segments(new.row[selected], np.append(0, np.cumsum(sizes)), axes[rows], ends_m[rows], features[rows])


def _orient_axes(cosine: FloatArray, sine: FloatArray, ends_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return axes a and b of rectangles: a along the longer side, both away from the sensor at the origin."""
    axes = np.stack([np.column_stack([cosine, sine]), np.column_stack([-sine, cosine])], axis=1)
    ends = ends_m.reshape(-1, 2, 2)
    is_behind = ends.sum(axis=2) < 0.0
    axes = np.where(is_behind[:, :, None], -axes, axes)
    ends = np.where(is_behind[:, :, None], -ends[:, :, ::-1], ends)
    length_m = ends[:, :, 1] - ends[:, :, 0]
    is_across = length_m[:, 1] > length_m[:, 0]
    axes = np.where(is_across[:, None, None], axes[:, ::-1], axes)
    ends = np.where(is_across[:, None, None], ends[:, ::-1], ends)
    return np.ascontiguousarray(axes.reshape(-1, 4)), np.ascontiguousarray(ends.reshape(-1, 4))


def extended_boxes(axes: FloatArray, ends_m: FloatArray, features: FloatArray, margins_m: FloatArray) -> FloatArray:
    """Return boxes that extend beyond the points, from the sensor in plan and from the ground in height, (n, 7).

    Parameters
    ----------
    axes, ends_m, features
        As in :class:`Segments`, (n, 4), (n, 4), (n, f).
    margins_m
        As :data:`egvs.extensions.validation.detectors.segment_model.MARGINS`, (n, 5).
    """
    low_m = ends_m[:, [0, 2]] - margins_m[:, [0, 2]]
    high_m = ends_m[:, [1, 3]] + margins_m[:, [1, 3]]
    middle_m, size_m = (low_m + high_m) / 2.0, np.abs(high_m - low_m)
    xy_m = middle_m[:, [0]] * axes[:, :2] + middle_m[:, [1]] * axes[:, 2:]
    along_a = size_m[:, 0] >= size_m[:, 1]
    forward = np.where(along_a[:, None], axes[:, :2], axes[:, 2:])
    length_m = np.maximum(size_m.max(axis=1), SMALLEST_M[0])
    width_m = np.maximum(size_m.min(axis=1), SMALLEST_M[1])
    height_m = np.maximum(features[:, FEATURES.index("z_high_m")] + margins_m[:, 4], SMALLEST_M[2])
    yaw_rad = np.arctan2(forward[:, 1], forward[:, 0])
    return np.column_stack([xy_m, height_m / 2.0, length_m, width_m, height_m, yaw_rad])


def box_features(probabilities: FloatArray, boxes: FloatArray, margins_m: FloatArray) -> FloatArray:
    """Return what the confidence of boxes depends on, columns as in :data:`BOX_FEATURES`, (n, 13) float64."""
    return np.column_stack([probabilities, boxes[:, 3:6], margins_m])


# ---- entry point


@dataclass(frozen=True)
class RangeImage:
    """Segments on the graph of beams with learnt boxes."""

    NAME: ClassVar[str] = "range_image"
    SOURCE: ClassVar[str] = (
        "Bogoslavskyi and Stachniss 2016 (segments), Zhang et al. 2017 (rectangles); trees: this program"
    )

    @property
    def settings(self) -> dict[str, Any]:
        """Parameters, and the sha256 of the model."""
        return {
            "levels": LEVELS,
            "min_points": MIN_POINTS,
            "heights_m": [LOWEST_M, HIGHEST_M],
            "headings": HEADINGS,
            "model": segment_model.model_digest(),
        }

    def at_site(self, view: SiteView, roi: Roi) -> RangeImageAtSite:
        """Prepare the detector for one site."""
        return RangeImageAtSite(view, roi, segment_model.read_model())
