"""A second PointPillars, which counts heights from the sensor as detectors for cars do: there for question C alone.

It was trained with sensors at one height, 2 m, as the source paper's are. Its weights are beside this file.
"""

from __future__ import annotations

from pathlib import Path

from pipeline.validation.detectors import registry
from pipeline.validation.detectors.base import Detector
from pipeline.validation.detectors.pointpillars.detector import PointPillars

NAME = "pointpillars_sensor"
MODEL = Path(__file__).with_name("pointpillars_sensor.onnx")


def make(name: str) -> Detector:
    """A detector of the study: this one, or one that is installed; raises as :func:`registry.make` does."""
    if name != NAME:
        return registry.make(name)
    registry.make(PointPillars.NAME)  # needs what that needs
    return PointPillars(MODEL)


def names() -> list[str]:
    """Every detector of the study."""
    return [*registry.names(), NAME]
