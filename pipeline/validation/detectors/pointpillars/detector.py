"""PointPillars at a site, or at several: the shipped model, run by onnxruntime on one core.

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
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pipeline.core import files
from pipeline.core.errors import InputError, MissingBackendError
from pipeline.core.grid import Roi
from pipeline.validation.detectors.overlapping import apart
from pipeline.validation.detectors.pointpillars import encoding
from pipeline.validation.detectors.pointpillars.decoding import VALUES, decode
from pipeline.validation.detectors.pointpillars.encoding import CELLS, FEATURES, POINTS, HeightZero, SeenPoints, Window
from pipeline.validation.sweeps import Detections, SiteView, Sweep

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

SHIPPED = Path(__file__).with_name("model.onnx")
ABOUT = "egvs"
"""Key of the model's own metadata, JSON: what it was trained on and how, and by which convention heights count."""

_INPUTS = {"features": [POINTS, FEATURES], "present": [POINTS], "cell": []}
_REFUSALS = ("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "NotImplemented", "RuntimeException")
_SEAM_M = 20.0  # windows share as much, so that no vehicle is cut by all of them


@dataclass(frozen=True)
class PointPillars:
    """The detector with one model; can be sent to another process."""

    model: Path = SHIPPED
    NAME: ClassVar[str] = "pointpillars"
    SOURCE: ClassVar[str] = "Lang et al. 2019 (pillars, backbone), Yin et al. 2021 (head); trained on simulated sweeps"

    @property
    def settings(self) -> dict[str, Any]:
        """The model by its hash."""
        return {"model": files.sha256_of(self.model)}

    def at(self, view: SiteView, roi: Roi) -> _AtSite:
        """The detector at one site."""
        return _AtSite(self.together((view,), roi))

    def together(self, views: Sequence[SiteView], roi: Roi) -> _AtSites:
        """The detector at several sites."""
        return _AtSites(Model.of(self.model), tuple(views), roi)


@dataclass(frozen=True)
class Model:
    """A network that was read from a file."""

    session: InferenceSession
    about: dict[str, Any]

    @classmethod
    def of(cls, path: Path) -> Model:
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
        except tuple(getattr(refusals, name) for name in _REFUSALS) as error:
            raise InputError(path, f"no ONNX model ({str(error).splitlines()[0][:120]})", right) from None
        shapes = {value.name: list(value.shape)[1:] for value in session.get_inputs()}
        if shapes != _INPUTS:
            raise InputError(path, f"a model with inputs {shapes}", f"inputs {_INPUTS}")
        size = CELLS // 2
        out = {value.name: list(value.shape) for value in session.get_outputs()}
        if out != {"heat": [1, 1, size, size], "values": [1, VALUES, size, size]}:
            raise InputError(path, f"a model with outputs {out}", right)
        try:
            about = json.loads(session.get_modelmeta().custom_metadata_map[ABOUT])
            if about["convention"] not in encoding.HEIGHTS_M:
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

    model: Model
    views: tuple[SiteView, ...]
    roi: Roi

    @cached_property
    def _windows(self) -> list[Window]:
        return windows(self.roi)

    @cached_property
    def _zero(self) -> HeightZero:
        return HeightZero(self.model.about["convention"], self.views[0], self.roi, self.views[1:])

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """The vehicles of one instant."""
        seen = SeenPoints.together(sweeps, self.views, self._zero)
        found = [self._in(window, seen) for window in self._windows]
        boxes, scores = np.concatenate([f.boxes for f in found]), np.concatenate([f.scores for f in found])
        return apart(Detections(boxes, scores), scores)

    def _in(self, window: Window, seen: SeenPoints) -> Detections:
        pillars = encoding.pillars(seen, window, self.model.about["convention"])
        if len(pillars.cell) == 0:
            return Detections.none()
        feed = {"features": pillars.features, "present": pillars.present, "cell": pillars.cell}
        heat, values = self.model.session.run(None, feed)
        boxes, scores = decode(1.0 / (1.0 + np.exp(-heat[0, 0])), values[0])
        boxes[:, :2] = window.to_world(boxes[:, :2])
        boxes[:, 2] += self._zero.below_m(boxes[:, :2])
        boxes[:, 6] += window.turn_rad
        return Detections(boxes, scores)


def windows(roi: Roi) -> list[Window]:
    """Windows along the world's axes that cover a region of interest; one, where it is small enough."""
    size = CELLS * encoding.PILLAR_M
    centres = []
    for low, length in zip(roi.origin_m[:2], roi.size_m[:2], strict=True):
        count = max(1, math.ceil((length - _SEAM_M) / (size - _SEAM_M))) if length > size else 1
        step = (length - size) / (count - 1) if count > 1 else 0.0
        first = low + (size / 2 if count > 1 else length / 2)
        centres.append([first + i * step for i in range(count)])
    return [Window((x, y)) for x in centres[0] for y in centres[1]]
