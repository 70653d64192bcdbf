"""Finds detectors by name, through the entry points of the group ``egvs.detectors``."""

from __future__ import annotations

from pipeline.core import plugins
from pipeline.core.errors import InputError
from pipeline.validation.detectors.base import Detector

GROUP = "egvs.detectors"


def names() -> list[str]:
    """Every detector that is installed."""
    return plugins.names(GROUP)


def make(name: str, place: str = "--detector") -> Detector:
    """A detector.

    Raises
    ------
    InputError
        When there is no such detector.
    MissingBackendError
        When it cannot be imported (its extra is not installed), or is none.
    """
    if name not in names():
        raise InputError(place, f"unknown detector {name!r}", f"one of {', '.join(['points', *names()])}")
    found = plugins.load(GROUP, name)
    if name != found.NAME:
        raise plugins.unusable(GROUP, name, f"its NAME is {found.NAME!r}; right is {name!r}, as its entry point has it")
    made: Detector = found()
    return made
