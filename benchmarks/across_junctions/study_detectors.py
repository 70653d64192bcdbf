"""Detectors of the study: the installed ones, and two more PointPillars, trained with sensors 2 m above the ground.

``pointpillars_2m`` measures heights from the ground, as the shipped model does; ``pointpillars_sensor`` measures them
from the sensor, as detectors for cars do. So the first compared with the shipped one shows the effect of training at
one height, and the second compared with the first the effect of the convention. Their weights are beside this file.

The study was measured while PointPillars saw the simulated intensity of each point, so here all three still do; the
installed detector is fed a constant (:data:`egvs.extensions.validation.detectors.pointpillars.INTENSITY`).
"""

from __future__ import annotations

from pathlib import Path

from egvs.core.errors import MissingBackendError
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.detectors.base import Detector
from egvs.extensions.validation.detectors.pointpillars import PointPillars
from egvs.scenario.score_config import FROM_SENSOR

LOW, SENSOR = "pointpillars_2m", FROM_SENSOR
NAMES = (LOW, SENSOR)


def model_file(name: str) -> Path:
    """Return the weights of one of :data:`NAMES`."""
    return Path(__file__).with_name(f"{name}.onnx")


def make(name: str, where: str = "--detector") -> Detector:
    """Return a detector of the study: one of :data:`NAMES`, or an installed one.

    Parameters
    ----------
    where
        The option that names it, for messages.

    Raises
    ------
    MissingBackendError
        If a library or the file of the model is missing.
    """
    if name not in (*NAMES, PointPillars.NAME):
        return base.make_detector(name, where)
    base.make_detector(PointPillars.NAME)  # needs the same libraries
    if name == PointPillars.NAME:
        return PointPillars(intensity=None)
    if not model_file(name).is_file():
        raise MissingBackendError(f"there is no file {model_file(name).name}")
    return PointPillars(model_file(name), intensity=None)
