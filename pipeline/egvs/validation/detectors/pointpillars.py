"""PointPillars by onnxruntime: pillars in, boxes out.

Turns a sweep into pillars, as PointPillars (Lang et al. 2019, CVPR, section 2.1) does.

The window is a square over the region of interest with sides along the world's axes, or turned; heights count from the
ground (:mod:`egvs.validation.detectors.background`), so that it does not matter how high the sensor hangs. The other
convention, that of detectors made for cars (heights from the sensor, from 3 m below it to 1 m above), is here to show
what it does.

Several sensors' points are put together in the world frame; whether a point is new, and its range, are said by the
sensor that it is of.

Features of a point: from the pillar's centre (x, y), height, intensity, from the mean of the pillar's points (x, y, z),
whether it is new since the empty scan, and its share of 50 m from the sensor.

Turns the network's maps into boxes.

At each cell of the output map, the network says how much this looks like the middle of a vehicle, and what a box there
is: how far its middle is from the cell's, its height over the ground, its size, and twice its heading (a box looks the
same from both ends). Peaks of the first map are detections (Yin et al. 2021, CVPR, section 4); of two that overlap, the
surer one stays.

PointPillars at a site, or at several: the shipped model, run by onnxruntime on one core.

Steps for a sweep: heights over the ground, pillars, the network, boxes; windows that together cover the region of
interest each keep what is in their own part of it; of two boxes that overlap, the surer one stays.
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

from egvs.core import files
from egvs.core.errors import InputError, MissingBackendError
from egvs.core.grid import Roi
from egvs.validation.detectors import background
from egvs.validation.detectors.background import GroundMap
from egvs.validation.detectors.base import suppress_overlaps
from egvs.validation.sweeps import Detections, SiteView, Sweep

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


CELLS, PILLAR_M = 256, 0.4
"""Pillars along each side of a window where a detector looks, and how wide one is."""

POINTS_PER_PILLAR = 16
"""Points of a pillar at most; of more, every so many is taken."""

N_FEATURES = 9
Convention = Literal["ground", "sensor"]
HEIGHT_LIMITS_M: dict[Convention, tuple[float, float]] = {"ground": (-0.5, 4.5), "sensor": (-3.0, 1.0)}
"""What is lower or higher is left out."""

_FAR_M = 50.0


@dataclass(frozen=True)
class PillarWindow:
    """A square of the ground.

    Attributes
    ----------
    centre_m
        World x, y.
    turn_rad
        How its x axis is turned from the world's, counter-clockwise.
    cells
        Pillars along each side.
    """

    centre_m: tuple[float, float]
    turn_rad: float = 0.0
    cells: int = CELLS

    @property
    def size_m(self) -> float:
        """How long each side is."""
        return self.cells * PILLAR_M

    def to_window(self, xy_m: Floats) -> Floats:
        """World x, y (n, 2) to metres from the window's first corner."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        x, y = (xy_m - np.asarray(self.centre_m)).T
        return np.column_stack([c * x + s * y, c * y - s * x]) + self.size_m / 2

    def to_world(self, xy_m: Floats) -> Floats:
        """The other way round."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        x, y = (xy_m - self.size_m / 2).T
        turned: Floats = np.column_stack([c * x - s * y, s * x + c * y])
        turned += np.asarray(self.centre_m)
        return turned


@dataclass(frozen=True)
class PillarPoints:
    """The points of a sweep, or of several, with all that pillars tell of them.

    Attributes
    ----------
    xy_m
        In the world frame, (n, 2).
    height_m
        As the convention counts it, (n,).
    intensity, new, range_m
        0 to 1; whether it is new since the empty scan; from the sensor. (n,) each.
    """

    xy_m: Floats
    height_m: Floats
    intensity: NDArray[np.float32]
    new: NDArray[np.bool_]
    range_m: Floats

    @classmethod
    def of(cls, sweep: Sweep, view: SiteView, zero: HeightZero) -> PillarPoints:
        """Of a sweep."""
        return cls.together((sweep,), (view,), zero)

    @classmethod
    def together(cls, sweeps: Sequence[Sweep], views: Sequence[SiteView], zero: HeightZero) -> PillarPoints:
        """Of the sweeps of one instant, in the order of the sites."""
        each = [cls._of_one(sweep, view, zero) for sweep, view in zip(sweeps, views, strict=True)]
        if len(each) == 1:
            return each[0]
        return cls(
            *(
                np.concatenate([getattr(its, name) for its in each])
                for name in ("xy_m", "height_m", "intensity", "new", "range_m")
            )
        )

    @classmethod
    def _of_one(cls, sweep: Sweep, view: SiteView, zero: HeightZero) -> PillarPoints:
        at = background.points_in_world(sweep, view)
        range_m = np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
        heights = at[:, 2] - zero.below_m(at[:, :2])
        return cls(at[:, :2], heights, sweep.points[:, 3], background.foreground_mask(sweep, view), range_m)


class HeightZero:
    """What heights are counted from at one site, or at several: their ground, or the first one's sensor."""

    def __init__(self, convention: Convention, view: SiteView, roi: Roi, others: Sequence[SiteView] = ()) -> None:
        self._ground = GroundMap.together((view, *others), roi) if convention == "ground" else None
        self._sensor_m = view.pose.z_m

    def below_m(self, xy_m: Floats) -> Floats:
        """World z of height 0 at places (n, 2), (n,)."""
        return np.full(len(xy_m), self._sensor_m) if self._ground is None else self._ground.height_m(xy_m)


@dataclass(frozen=True)
class Pillars:
    """The pillars of one window that hold points.

    Attributes
    ----------
    features
        (p, POINTS, FEATURES) float32, 0 where there is no point.
    present
        1 where there is a point, (p, POINTS) float32.
    cell
        Number of each pillar's cell, ix * (the window's cells) + iy, (p,) int64, ascending.
    """

    features: NDArray[np.float32]
    present: NDArray[np.float32]
    cell: NDArray[np.int64]


def make_pillars(sweep_points: PillarPoints, window: PillarWindow, convention: Convention) -> Pillars:
    """The pillars of what is seen in a window."""
    points = np.column_stack([window.to_window(sweep_points.xy_m), sweep_points.height_m])
    cells_wide = window.cells
    low, high = HEIGHT_LIMITS_M[convention]
    ix, iy = (np.floor(points[:, axis] / PILLAR_M).astype(np.int64) for axis in (0, 1))
    kept = (
        (ix >= 0) & (ix < cells_wide) & (iy >= 0) & (iy < cells_wide) & (points[:, 2] >= low) & (points[:, 2] <= high)
    )
    cell = (ix * cells_wide + iy)[kept]
    order = np.argsort(cell, kind="stable")
    rows, cell = np.flatnonzero(kept)[order], cell[order]
    cells, first, count = np.unique(cell, return_index=True, return_counts=True)
    pillar = np.repeat(np.arange(len(cells)), count)
    rank = np.arange(len(rows)) - first[pillar]
    slot = (
        rank * POINTS_PER_PILLAR // np.maximum(count, POINTS_PER_PILLAR)[pillar]
    )  # every so many, where there are more than fit
    leads = np.append(True, (slot[1:] != slot[:-1]) | (pillar[1:] != pillar[:-1])) if len(rows) else kept[:0]
    rows, pillar, slot = rows[leads], pillar[leads], slot[leads]
    fewer = np.minimum(count, POINTS_PER_PILLAR)
    at = points[rows]
    mean = np.column_stack([np.bincount(pillar, at[:, axis], len(cells)) for axis in range(3)]) / fewer[:, None]
    centre = (np.column_stack([cells // cells_wide, cells % cells_wide]) + 0.5) * PILLAR_M
    features = np.zeros((len(cells), POINTS_PER_PILLAR, N_FEATURES), dtype=np.float32)
    present = np.zeros((len(cells), POINTS_PER_PILLAR), dtype=np.float32)
    columns = [
        at[:, :2] - centre[pillar],
        at[:, 2:],
        sweep_points.intensity[rows, None],
        at - mean[pillar],
        sweep_points.new[rows, None],
    ]
    features[pillar, slot] = np.column_stack([*columns, sweep_points.range_m[rows, None] / _FAR_M])
    present[pillar, slot] = 1.0
    return Pillars(features, present, cells)


Floats = NDArray[np.float64]

STRIDE = 2
"""Pillars along each side of a cell of the output map."""

OUTPUT_CELL_M = PILLAR_M * STRIDE
N_VALUES = 8
"""Of a box: x and y from the cell's middle in cells, z, log length, log width, log height, sine and cosine of twice the
heading."""

_MIN_SCORE = 0.05
_MAX_BOXES = 100


def encode_boxes(boxes: Floats) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """What the network should say of boxes: their cells (n, 2), and their values (n, VALUES).

    Boxes (n, 7): x, y in metres from the window's first corner, z of the centre as the convention counts heights,
    length, width, height, heading in the window.
    """
    cell = np.floor(boxes[:, :2] / OUTPUT_CELL_M).astype(np.int64)
    from_middle = boxes[:, :2] / OUTPUT_CELL_M - cell - 0.5
    turns = np.column_stack([np.sin(2 * boxes[:, 6]), np.cos(2 * boxes[:, 6])])
    values = np.column_stack([from_middle, boxes[:, 2], np.log(boxes[:, 3:6]), turns])
    return cell, values.astype(np.float32)


def decode_boxes(heat: NDArray[np.float32], values: NDArray[np.float32]) -> tuple[Floats, Floats]:
    """Boxes (m, 7), as in :func:`encode_boxes`, and scores (m,), the surest first.

    Parameters
    ----------
    heat
        Chance that a vehicle's middle is in each cell, (cells, cells).
    values
        (VALUES, cells, cells).
    """
    peaks = (heat >= _MIN_SCORE) & (heat == maximum_filter(heat, size=3, mode="constant"))
    cell = np.argwhere(peaks)
    scores = heat[peaks].astype(np.float64)
    best = np.argsort(-scores, kind="stable")[:_MAX_BOXES]
    cell, scores = cell[best], scores[best]
    found = values[:, cell[:, 0], cell[:, 1]].T.astype(np.float64)
    xy = (cell + 0.5 + found[:, :2]) * OUTPUT_CELL_M
    sizes = np.exp(np.clip(found[:, 3:6], -2.0, 4.0))
    yaw = 0.5 * np.arctan2(found[:, 6], found[:, 7])
    return np.column_stack([xy, found[:, 2], sizes, yaw]), scores


SHIPPED_MODEL = Path(__file__).with_name("model.onnx")
METADATA_KEY = "egvs"
"""Key of the model's own metadata, JSON: what it was trained on and how, and by which convention heights count."""

_INPUTS = {"features": [POINTS_PER_PILLAR, N_FEATURES], "present": [POINTS_PER_PILLAR], "cell": []}
_ONNX_ERRORS = ("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "NotImplemented", "RuntimeException")
_WINDOW_OVERLAP_M = 20.0  # windows share as much, so that no vehicle is cut by all of them


@dataclass(frozen=True)
class PointPillars:
    """The detector with one model; can be sent to another process."""

    model: Path = SHIPPED_MODEL
    NAME: ClassVar[str] = "pointpillars"
    SOURCE: ClassVar[str] = "Lang et al. 2019 (pillars, backbone), Yin et al. 2021 (head); trained on simulated sweeps"

    @property
    def settings(self) -> dict[str, Any]:
        """The model by its hash."""
        return {"model": files.hash_file(self.model)}

    def at(self, view: SiteView, roi: Roi) -> _AtSite:
        """The detector at one site."""
        return _AtSite(self.together((view,), roi))

    def together(self, views: Sequence[SiteView], roi: Roi) -> _AtSites:
        """The detector at several sites."""
        return _AtSites(OnnxModel.of(self.model), tuple(views), roi)


@dataclass(frozen=True)
class OnnxModel:
    """A network that was read from a file."""

    session: InferenceSession
    metadata: dict[str, Any]

    @classmethod
    def of(cls, path: Path) -> OnnxModel:
        """Read a model.

        Raises
        ------
        InputError
            For a file that is no ONNX model, or one of other inputs and outputs.
        MissingBackendError
            When onnxruntime is not installed.
        """
        try:
            import onnxruntime
            from onnxruntime.capi import onnxruntime_pybind11_state as refusals
        except ImportError:
            raise MissingBackendError("PointPillars needs onnxruntime: pip install 'egvs[validate]'") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # sums in one order, whatever the machine
        options.log_severity_level = 4
        right = "a model that egvs train wrote"
        try:
            content = path.read_bytes()
        except OSError as error:
            raise InputError(path, error.strerror or str(error), right) from None
        try:
            session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except tuple(getattr(refusals, name) for name in _ONNX_ERRORS) as error:
            raise InputError(path, f"no ONNX model ({str(error).splitlines()[0][:120]})", right) from None
        shapes = {value.name: list(value.shape)[1:] for value in session.get_inputs()}
        if shapes != _INPUTS:
            raise InputError(path, f"a model with inputs {shapes}", f"inputs {_INPUTS}")
        size = CELLS // 2
        out = {value.name: list(value.shape) for value in session.get_outputs()}
        if out != {"heat": [1, 1, size, size], "values": [1, N_VALUES, size, size]}:
            raise InputError(path, f"a model with outputs {out}", right)
        try:
            about = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
            if about["convention"] not in HEIGHT_LIMITS_M:
                raise ValueError(about["convention"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(path, f"its metadata does not say how heights count ({error})", right) from None
        return cls(session, about)


@dataclass(frozen=True)
class _AtSite:
    """The detector at one site."""

    joint: _AtSites

    def detect(self, sweep: Sweep) -> Detections:
        """The vehicles of one sweep."""
        return self.joint.detect((sweep,))


@dataclass(frozen=True)
class _AtSites:
    """The detector at some sites, whose points are put together."""

    model: OnnxModel
    views: tuple[SiteView, ...]
    roi: Roi

    @cached_property
    def _windows(self) -> list[PillarWindow]:
        return roi_windows(self.roi)

    @cached_property
    def _zero(self) -> HeightZero:
        return HeightZero(self.model.metadata["convention"], self.views[0], self.roi, self.views[1:])

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """The vehicles of one instant."""
        seen = PillarPoints.together(sweeps, self.views, self._zero)
        found = [self._detect_in(window, seen) for window in self._windows]
        boxes, scores = np.concatenate([f.boxes for f in found]), np.concatenate([f.scores for f in found])
        return suppress_overlaps(Detections(boxes, scores), scores)

    def _detect_in(self, window: PillarWindow, points: PillarPoints) -> Detections:
        pillars = make_pillars(points, window, self.model.metadata["convention"])
        if len(pillars.cell) == 0:
            return Detections.empty()
        feed = {"features": pillars.features, "present": pillars.present, "cell": pillars.cell}
        heat, values = self.model.session.run(None, feed)
        boxes, scores = decode_boxes(1.0 / (1.0 + np.exp(-heat[0, 0])), values[0])
        boxes[:, :2] = window.to_world(boxes[:, :2])
        boxes[:, 2] += self._zero.below_m(boxes[:, :2])
        boxes[:, 6] += window.turn_rad
        return Detections(boxes, scores)


def roi_windows(roi: Roi) -> list[PillarWindow]:
    """Windows along the world's axes that cover a region of interest; one, where it is small enough."""
    size = CELLS * PILLAR_M
    centres = []
    for low, length in zip(roi.origin_m[:2], roi.size_m[:2], strict=True):
        count = max(1, math.ceil((length - _WINDOW_OVERLAP_M) / (size - _WINDOW_OVERLAP_M))) if length > size else 1
        step = (length - size) / (count - 1) if count > 1 else 0.0
        first = low + (size / 2 if count > 1 else length / 2)
        centres.append([first + i * step for i in range(count)])
    return [PillarWindow((x, y)) for x in centres[0] for y in centres[1]]
