"""Two more PointPillars, trained with sensors 2 m above the ground, as the source paper's are: there for question C.

One counts heights from the ground, as the shipped one does, the other from the sensor, as detectors for cars do. So the
first against the shipped one shows what training at one height does, the second against the first what the convention
does. Their weights are beside this file.
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


def model(name: str) -> Path:
    """The file of one of the two."""
    return Path(__file__).with_name(f"{name}.onnx")


def make(name: str, where: str = "--detector") -> Detector:
    """A detector of the study: one of these, or one that is installed.

    Parameters
    ----------
    name
        Its name.
    where
        The option that names it, for messages.

    Raises
    ------
    MissingBackendError
        Also where the file of the model is not there.
    """
    if name not in NAMES:
        return base.make_detector(name, where)
    base.make_detector(PointPillars.NAME)  # needs what that needs
    if not model(name).is_file():
        raise MissingBackendError(f"{model(name).name} is not there")
    return PointPillars(model(name))


def names() -> list[str]:
    """Every detector of the study."""
    return [*base.detector_names(), *NAMES]
