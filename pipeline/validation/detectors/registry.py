"""Finds detectors by name, through the entry points of the group ``egvs.detectors``."""

from __future__ import annotations

from pipeline.core import plugins
from pipeline.core.errors import InputError
from pipeline.validation.detectors.base import Detector

GROUP = "egvs.detectors"

_LIBRARY = {"cluster": "sklearn", "pointpillars": "onnxruntime"}
"""Of this program's own detectors; imported when one looks, long after it was made."""


def names() -> list[str]:
    """Every detector that is installed."""
    return plugins.names(GROUP)


def make(name: str, place: str = "--detector") -> Detector:
    """A detector.

    Raises
    ------
    InputError
        When there is no such detector.
    MissingExtraError
        When the library that it needs is not installed.
    MissingBackendError
        When it cannot be imported, or is none.
    """
    if name not in names():
        raise InputError(place, f"unknown detector {name!r}", f"one of {', '.join(['points', *names()])}")
    if name in _LIBRARY:
        plugins.require(f"the detector {name}", "validate", _LIBRARY[name])
    found = plugins.load(GROUP, name)
    if name != found.NAME:
        raise plugins.unusable(GROUP, name, f"its NAME is {found.NAME!r}; right is {name!r}, as its entry point has it")
    made: Detector = found()
    return made
