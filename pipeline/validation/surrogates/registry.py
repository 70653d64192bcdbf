"""Finds scores by name, through the entry points of the group ``egvs.scores``."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.core import plugins
from pipeline.core.errors import InputError, MissingBackendError
from pipeline.validation.surrogates.base import EVIDENCE, Score

GROUP = "egvs.scores"

_OWN = (
    "egvs", "entropy_seen", "coverage", "expected_visibility", "s_mig", "m_sog", "kl_obs", "density", "uniformity",
    "perception_entropy", "points_on_target", "seen_well", "expected_detections",
)  # fmt: skip
"""This program's own, in the order in which they are told."""


def names() -> list[str]:
    """Every score that is installed: this program's own first."""
    installed = plugins.names(GROUP)
    return [*(name for name in _OWN if name in installed), *(name for name in installed if name not in _OWN)]


def score(name: str, place: str = "--score") -> Score:
    """A score.

    Raises
    ------
    InputError
        When there is no such score.
    MissingBackendError
        When it cannot be imported, or is none.
    """
    if name not in names():
        raise InputError(place, f"unknown score {name!r}", f"one of {', '.join(names())}")
    found = plugins.load(GROUP, name)
    if problem := _problem(name, found):
        raise plugins.unusable(GROUP, name, problem)
    made: Score = found
    return made


def _problem(name: str, found: object) -> str:
    """What is wrong with what an entry point names; empty where nothing is."""
    if not isinstance(found, Score):
        return f"it is no score; right is a {Score.__module__}.{Score.__name__}"
    if found.name != name:
        return f"its name is {found.name!r}; right is {name!r}, as its entry point has it"
    if found.sign not in (1, -1):
        return f"its sign is {found.sign!r}; right is 1 where more is better, or -1"
    if unknown := [need for need in found.needs if need not in EVIDENCE]:
        return f"it needs {unknown[0]!r}; right are {', '.join(EVIDENCE)}"
    if empty := [key for key, values in found.sweep.items() if not values]:
        return f"its sweep of {empty[0]} has no value; right is one at least"
    return ""


@dataclass(frozen=True)
class Entry:
    """One score that is installed.

    Attributes
    ----------
    name
        As its entry point has it.
    score
        None where it cannot be loaded.
    package
        Which brings it; empty for this program.
    problem
        Why it cannot be loaded.
    """

    name: str
    score: Score | None
    package: str = ""
    problem: str = ""


def catalogue() -> list[Entry]:
    """Every score that is installed; one that cannot be loaded as such, since nobody may have asked for it."""
    return [_entry(name) for name in names()]


def _entry(name: str) -> Entry:
    package = plugins.package_of(GROUP, name)
    try:
        return Entry(name, score(name), "" if package == plugins.OWN else package)
    except MissingBackendError as error:
        return Entry(name, None, package, str(error))
