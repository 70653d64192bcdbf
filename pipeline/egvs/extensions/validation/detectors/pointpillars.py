"""The detector ``pointpillars``: a network run by onnxruntime on one core.

Steps for a sweep: measure heights from the ground; sort the points into pillars; run the network; decode its maps to
boxes; of two boxes that overlap, keep the one with the higher score. Windows that overlap cover a large region of
interest.

**Pillars** are made as in PointPillars (Lang et al. 2019, CVPR, section 2.1), in a square window with sides along the
world's axes, or rotated. Heights are measured from the ground (:mod:`egvs.extensions.validation.detectors.background`),
so that the mounting height does not matter. The other convention, that of detectors for cars (heights from the sensor,
from 3 m below it to 1 m above), is for comparison. The points of several sensors are combined in the world frame;
whether a point is foreground, and its range, are relative to its own sensor.

Features of a point: x, y from the centre of its pillar, height, :data:`INTENSITY`, x, y, z from the mean of the
pillar's points, whether it is foreground, and its range as a share of 50 m.

**Intensity** is not used. Simulated intensities are those of ideal surfaces, which no real sensor reports, and a
network that sees them depends on them: with 1 for all points, the shipped model loses 25 points of AP. Its channel is
therefore fed one constant, at detection and at training. With the constant, the shipped model, which was trained with
simulated intensities, has the AP that it had with them (docs/validation.md).

**Maps.** For each cell, the network returns the log odds that the centre of a vehicle is there, and the values of a
box: its centre relative to that of the cell, its height, its size, and twice its heading (a box looks the same from
both ends). Peaks of the first map are detections (Yin et al. 2021, CVPR, section 4).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core import files
from egvs.core.errors import InputError, MissingBackendError
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.extensions.validation.detectors import background
from egvs.extensions.validation.detectors.background import GroundMap
from egvs.extensions.validation.detectors.base import AtOneSite, suppress_overlaps

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


Convention = Literal["ground", "sensor"]
"""Where heights are measured from."""

HEIGHT_LIMITS_M: dict[Convention, tuple[float, float]] = {"ground": (-0.5, 4.5), "sensor": (-3.0, 1.0)}
"""Points below or above these heights are dropped."""

CELLS, PILLAR_M = 256, 0.4
"""Pillars along each side of a window, and the width of a pillar."""

POINTS_PER_PILLAR = 16
"""Largest number of points of a pillar; of more, some are selected at equal steps."""

N_FEATURES = 9

INTENSITY = 0.17
"""Stands for the intensity of every point: that of asphalt. Of the constants that ``python -m benchmarks.intensity``
tries at the training junctions, it has the highest AP."""

STRIDE = 2
"""Pillars along each side of a cell of the network's maps."""

OUTPUT_CELL_M = PILLAR_M * STRIDE

N_VALUES = 8
"""Values of a box: x and y from the centre of the cell, in cells; z; logarithms of length, width and height; sine and
cosine of twice the heading."""

SHIPPED_MODEL = Path(__file__).with_name("model.onnx")

METADATA_KEY = "egvs"
"""Key of the model's metadata, JSON: on which junctions and how it was trained, and its height convention."""

_FAR_M = 50.0
_MIN_SCORE = 0.05
_MAX_BOXES = 100
_INPUTS = {"features": [POINTS_PER_PILLAR, N_FEATURES], "present": [POINTS_PER_PILLAR], "cell": []}
_ONNX_ERRORS = ("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "NotImplemented", "RuntimeException")
_MODEL_HINT = "Use a model written by egvs train."
_WINDOW_OVERLAP_M = 20.0  # so that each vehicle is complete in at least one window


@dataclass(frozen=True)
class PillarWindow:
    """A square of the ground.

    Attributes
    ----------
    centre_m
        World x, y.
    turn_rad
        Direction of its x axis in the world frame, counter-clockwise.
    cells
        Pillars along each side.
    """

    centre_m: tuple[float, float]
    turn_rad: float = 0.0
    cells: int = CELLS

    @property
    def size_m(self) -> float:
        """Length of each side."""
        return self.cells * PILLAR_M

    def to_window(self, xy_m: FloatArray) -> FloatArray:
        """Convert world x, y (n, 2) to positions relative to the window's first corner."""
        cos = math.cos(self.turn_rad)
        sin = math.sin(self.turn_rad)
        x, y = (xy_m - np.asarray(self.centre_m)).T
        return np.column_stack([cos * x + sin * y, cos * y - sin * x]) + self.size_m / 2

    def to_world(self, xy_m: FloatArray) -> FloatArray:
        """Convert positions relative to the window's first corner to world x, y (n, 2)."""
        cos = math.cos(self.turn_rad)
        sin = math.sin(self.turn_rad)
        x, y = (xy_m - self.size_m / 2).T
        rotated: FloatArray = np.column_stack([cos * x - sin * y, sin * x + cos * y])
        rotated += np.asarray(self.centre_m)
        return rotated


class HeightOrigin:
    """Where heights are measured from: the ground of the sites, or the sensor of the first site.

    Parameters
    ----------
    convention
        Ground or sensor.
    views
        At least one site.
    roi
        The region of interest.
    """

    def __init__(self, convention: Convention, views: Sequence[SiteView], roi: Roi) -> None:
        self._ground = GroundMap.from_empty_scans(views, roi) if convention == "ground" else None
        self._sensor_z_m = views[0].pose.z_m

    def z_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the world z of height 0 at positions (n, 2), (n,)."""
        if self._ground is None:
            return np.full(len(xy_m), self._sensor_z_m)
        return self._ground.height_m(xy_m)


@dataclass(frozen=True)
class PillarPoints:
    """The points of the sweeps of one instant, with what their features are computed from.

    Attributes
    ----------
    xy_m
        In the world frame, (n, 2).
    height_m
        By the height convention, (n,).
    intensity
        Fed to the network, (n,).
    is_foreground
        Whether each point is in front of the empty scan, (n,).
    range_m
        From the sensor, (n,).
    """

    xy_m: FloatArray
    height_m: FloatArray
    intensity: NDArray[np.float32]
    is_foreground: BoolArray
    range_m: FloatArray

    @classmethod
    def from_sweeps(
        cls,
        sweeps: Sequence[Sweep],
        views: Sequence[SiteView],
        origin: HeightOrigin,
        intensity: float | None = INTENSITY,
    ) -> PillarPoints:
        """Combine the sweeps of one instant, in the order of the sites.

        ``intensity`` stands for that of all points; with None, each has its own.
        """
        points_m = [background.points_in_world(sweep, view) for sweep, view in zip(sweeps, views, strict=True)]
        foreground = [background.foreground_mask(sweep, view) for sweep, view in zip(sweeps, views, strict=True)]
        ranges_m = [np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1)) for sweep in sweeps]
        xyz_m = np.concatenate(points_m)
        fed = np.concatenate([sweep.points[:, 3] for sweep in sweeps])
        if intensity is not None:
            fed = np.full_like(fed, intensity)
        elif np.isnan(fed).any():
            raise ValueError("the points have no intensity")
        heights_m = np.concatenate([points[:, 2] - origin.z_m(points[:, :2]) for points in points_m])
        return cls(xyz_m[:, :2], heights_m, fed, np.concatenate(foreground), np.concatenate(ranges_m))


@dataclass(frozen=True)
class Pillars:
    """The pillars of one window that contain points.

    Attributes
    ----------
    features
        (p, POINTS_PER_PILLAR, N_FEATURES) float32, 0 where there is no point.
    present
        1 where there is a point, (p, POINTS_PER_PILLAR) float32.
    cell
        Number of each pillar's cell, ix * (cells of the window) + iy, (p,) int64, ascending.
    """

    features: NDArray[np.float32]
    present: NDArray[np.float32]
    cell: IntArray


def make_pillars(points: PillarPoints, window: PillarWindow, convention: Convention) -> Pillars:
    """Return the pillars of the points in a window, within the height limits of a convention."""
    xyz_m = np.column_stack([window.to_window(points.xy_m), points.height_m])
    low, high = HEIGHT_LIMITS_M[convention]
    index = np.floor(xyz_m[:, :2] / PILLAR_M).astype(np.int64)
    inside = ((index >= 0) & (index < window.cells)).all(axis=1) & (xyz_m[:, 2] >= low) & (xyz_m[:, 2] <= high)
    cell = (index[:, 0] * window.cells + index[:, 1])[inside]
    order = np.argsort(cell, kind="stable")
    rows = np.flatnonzero(inside)[order]
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)

    # The slot of each point in its pillar; of several points with one slot, the first is used.
    pillar = np.repeat(np.arange(len(cells)), count)
    rank = np.arange(len(rows)) - first[pillar]
    slot = rank * POINTS_PER_PILLAR // np.maximum(count, POINTS_PER_PILLAR)[pillar]
    selected = np.ones(len(rows), dtype=np.bool_)
    selected[1:] = (slot[1:] != slot[:-1]) | (pillar[1:] != pillar[:-1])
    rows, pillar, slot = rows[selected], pillar[selected], slot[selected]

    xyz_m = xyz_m[rows]
    used = np.minimum(count, POINTS_PER_PILLAR)
    mean = np.column_stack([np.bincount(pillar, xyz_m[:, axis], len(cells)) for axis in range(3)]) / used[:, None]
    centre = (np.column_stack([cells // window.cells, cells % window.cells]) + 0.5) * PILLAR_M
    features = np.zeros((len(cells), POINTS_PER_PILLAR, N_FEATURES), dtype=np.float32)
    features[pillar, slot] = np.column_stack(
        [
            xyz_m[:, :2] - centre[pillar],
            xyz_m[:, 2:],
            points.intensity[rows, None],
            xyz_m - mean[pillar],
            points.is_foreground[rows, None],
            points.range_m[rows, None] / _FAR_M,
        ]
    )
    present = np.zeros((len(cells), POINTS_PER_PILLAR), dtype=np.float32)
    present[pillar, slot] = 1.0
    return Pillars(features, present, cells)


def encode_boxes(boxes: FloatArray) -> tuple[IntArray, NDArray[np.float32]]:
    """Return what the network should return for boxes: their cells (n, 2), and their values (n, N_VALUES).

    Parameters
    ----------
    boxes
        (n, 7): x, y in metres from the window's first corner, z of the centre by the height convention, length, width,
        height, heading in the window.
    """
    cell = np.floor(boxes[:, :2] / OUTPUT_CELL_M).astype(np.int64)
    from_centre = boxes[:, :2] / OUTPUT_CELL_M - cell - 0.5
    heading = np.column_stack([np.sin(2 * boxes[:, 6]), np.cos(2 * boxes[:, 6])])
    values = np.column_stack([from_centre, boxes[:, 2], np.log(boxes[:, 3:6]), heading])
    return cell, values.astype(np.float32)


def decode_boxes(probability: NDArray[np.float32], values: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
    """Return boxes (m, 7), as in :func:`encode_boxes`, and scores (m,), by descending score.

    Parameters
    ----------
    probability
        That the centre of a vehicle is in each cell, (cells, cells).
    values
        (N_VALUES, cells, cells).
    """
    peaks = (probability >= _MIN_SCORE) & (probability == maximum_filter(probability, size=3, mode="constant"))
    cell = np.argwhere(peaks)
    scores = probability[peaks].astype(np.float64)
    best = np.argsort(-scores, kind="stable")[:_MAX_BOXES]
    cell = cell[best]
    box_values = values[:, cell[:, 0], cell[:, 1]].T.astype(np.float64)
    xy_m = (cell + 0.5 + box_values[:, :2]) * OUTPUT_CELL_M
    size_m = np.exp(np.clip(box_values[:, 3:6], -2.0, 4.0))
    yaw_rad = 0.5 * np.arctan2(box_values[:, 6], box_values[:, 7])
    return np.column_stack([xy_m, box_values[:, 2], size_m, yaw_rad]), scores[best]


@dataclass(frozen=True)
class OnnxModel:
    """A network read from a file, and its metadata."""

    session: InferenceSession
    metadata: dict[str, Any]

    @classmethod
    def load(cls, path: Path) -> OnnxModel:
        """Read a model.

        Raises
        ------
        InputError
            For a file that is no ONNX model, or one with other inputs and outputs.
        MissingBackendError
            If onnxruntime is not installed.
        """
        session = _start_session(path)
        inputs = {value.name: list(value.shape)[1:] for value in session.get_inputs()}
        if inputs != _INPUTS:
            raise InputError(path, f"expected a model with inputs {_INPUTS}, got {inputs}", _MODEL_HINT)
        size = CELLS // STRIDE
        outputs = {value.name: list(value.shape) for value in session.get_outputs()}
        expected = {"heat": [1, 1, size, size], "values": [1, N_VALUES, size, size]}
        if outputs != expected:
            raise InputError(path, f"expected a model with outputs {expected}, got {outputs}", _MODEL_HINT)
        try:
            metadata = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
            if metadata["convention"] not in HEIGHT_LIMITS_M:
                raise ValueError(metadata["convention"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(path, f"its metadata has no valid height convention ({error})", _MODEL_HINT) from None
        return cls(session, metadata)


def _start_session(path: Path) -> InferenceSession:
    """Return an onnxruntime session that computes the same bits on any number of cores."""
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as onnx_errors
    except ImportError:
        raise MissingBackendError("PointPillars needs onnxruntime. Run pip install 'egvs[validate]'") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(path, error.strerror or str(error), _MODEL_HINT) from None
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except tuple(getattr(onnx_errors, name) for name in _ONNX_ERRORS) as error:
        raise InputError(path, f"not an ONNX model ({str(error).splitlines()[0][:120]})", _MODEL_HINT) from None


@dataclass(frozen=True)
class PointPillars:
    """The detector with one model; can be sent to another process.

    Attributes
    ----------
    model
        The network.
    intensity
        Fed in place of the intensity of all points; None feeds that of each point, for comparison only.
    """

    model: Path = SHIPPED_MODEL
    intensity: float | None = INTENSITY
    NAME: ClassVar[str] = "pointpillars"
    SOURCE: ClassVar[str] = "Lang et al. 2019 (pillars, backbone), Yin et al. 2021 (head); trained on simulated sweeps"

    @property
    def settings(self) -> dict[str, Any]:
        """The sha256 of the model, and the intensity that it is fed if it is not that of each point."""
        fed = {} if self.intensity is None else {"intensity": self.intensity}
        return {"model": files.hash_file(self.model), **fed}

    def at_site(self, view: SiteView, roi: Roi) -> AtOneSite[_AtSites]:
        """Prepare the detector for one site."""
        return AtOneSite(self.at_sites((view,), roi))

    def at_sites(self, views: Sequence[SiteView], roi: Roi) -> _AtSites:
        """Prepare the detector for several sites."""
        return _AtSites(OnnxModel.load(self.model), self.intensity, tuple(views), roi)


@dataclass(frozen=True)
class _AtSites:
    """The detector at several sites, whose points are combined."""

    model: OnnxModel
    intensity: float | None
    views: tuple[SiteView, ...]
    roi: Roi

    @cached_property
    def _windows(self) -> list[PillarWindow]:
        return roi_windows(self.roi)

    @cached_property
    def _origin(self) -> HeightOrigin:
        return HeightOrigin(self.model.metadata["convention"], self.views, self.roi)

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """Return the vehicles of one instant."""
        points = PillarPoints.from_sweeps(sweeps, self.views, self._origin, self.intensity)
        by_window = [self._detect_in(window, points) for window in self._windows]
        boxes = np.concatenate([detections.boxes for detections in by_window])
        scores = np.concatenate([detections.scores for detections in by_window])
        return suppress_overlaps(Detections(boxes, scores), scores)

    def _detect_in(self, window: PillarWindow, points: PillarPoints) -> Detections:
        pillars = make_pillars(points, window, self.model.metadata["convention"])
        if len(pillars.cell) == 0:
            return Detections.empty()
        inputs = {"features": pillars.features, "present": pillars.present, "cell": pillars.cell}
        log_odds, values = self.model.session.run(None, inputs)
        boxes, scores = decode_boxes(1.0 / (1.0 + np.exp(-log_odds[0, 0])), values[0])
        boxes[:, :2] = window.to_world(boxes[:, :2])
        boxes[:, 2] += self._origin.z_m(boxes[:, :2])
        boxes[:, 6] += window.turn_rad
        return Detections(boxes, scores)


def roi_windows(roi: Roi) -> list[PillarWindow]:
    """Return windows along the world's axes that cover a region of interest; one, where it is small enough."""
    size_m = CELLS * PILLAR_M
    centres_m = []
    for low_m, length_m in zip(roi.origin_m[:2], roi.size_m[:2], strict=True):
        if length_m <= size_m:
            centres_m.append([low_m + length_m / 2])
            continue
        count = math.ceil((length_m - _WINDOW_OVERLAP_M) / (size_m - _WINDOW_OVERLAP_M))
        step_m = (length_m - size_m) / (count - 1)
        centres_m.append([low_m + size_m / 2 + number * step_m for number in range(count)])
    return [PillarWindow((x_m, y_m)) for x_m in centres_m[0] for y_m in centres_m[1]]
