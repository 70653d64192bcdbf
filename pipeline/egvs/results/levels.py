"""Levels: what share of vehicles detectors find and people notice from a site, and both of each group of road users.

A share that rests on what was measured is printed as a number with its error. If more than :data:`MAX_SHARE_OUTSIDE`
of the vehicles are outside of what it rests on, it is printed as a range: from the share if none of these was found or
noticed to the share if all of them were, in steps of 5 %. Outside are, for what people notice, those outside the data
of the curves (:mod:`egvs.scoring.noticed`); for what detectors find, all groups but those at which the level of their
models was measured (:func:`measured_groups`).

The error of what detectors find (:func:`level_error`) contains the level error that was measured on simulated streets.
If it is larger than :data:`MAX_LEVEL_ERROR`, a range is printed, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from egvs.artefacts import parquet
from egvs.artefacts.readers import ALL_USERS
from egvs.core.wording import format_percent
from egvs.results.labels import SCORE_LABELS
from egvs.results.study_results import STUDY
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED

MAX_SHARE_OUTSIDE = 0.1
"""With more vehicles outside the data, a share is printed as a range."""

MIN_NOTICED_LEAD = 0.01
"""Shares noticed that differ by less are taken as equal."""

MAX_LEVEL_ERROR = 0.1
"""With a larger error, what detectors find is printed as a range."""

_RANGE_STEP = 0.05


def format_range(low: float, high: float) -> str:
    """Return a range of shares in per cent, rounded outwards to steps of 5 %.

    >>> format_range(0.72, 0.93)
    '70 to 95 %'
    """
    low = math.floor(round(low / _RANGE_STEP, 6)) * _RANGE_STEP
    high = min(1.0, math.ceil(round(high / _RANGE_STEP, 6)) * _RANGE_STEP)
    return f"{100.0 * low:.0f} to {format_percent(high, 0)}"


@dataclass(frozen=True)
class NoticedShare:
    """The share of vehicles that people notice.

    Attributes
    ----------
    value
        The share.
    se
        Its standard error; None if unknown.
    low, high
        The share if none, and if all of the vehicles outside the data of the curves were noticed.

    Examples
    --------
    >>> NoticedShare(0.897, 0.017, 0.897, 0.897).text
    '90 ± 2 %'
    >>> NoticedShare(0.897, 0.017, 0.72, 0.93).text
    '70 to 95 %'
    """

    value: float
    se: float | None
    low: float
    high: float

    @property
    def is_measured(self) -> bool:
        """Whether enough of the vehicles are inside the data of the curves for a number with an error."""
        return self.high - self.low <= MAX_SHARE_OUTSIDE

    @property
    def text(self) -> str:
        """The share with its error, or a range, in per cent."""
        if not self.is_measured:
            return self.cell
        return SCORE_LABELS[NOTICED].with_error(self.value, math.nan if self.se is None else self.se)

    @property
    def cell(self) -> str:
        """The share, or a range, in per cent: a cell of a table."""
        if self.is_measured:
            return SCORE_LABELS[NOTICED].value(self.value)
        return format_range(self.low, self.high)


@dataclass(frozen=True)
class GroupLevel:
    """What detectors find and people notice of one group of road users.

    Attributes
    ----------
    road_users
        Name of the group.
    observations
        Number of road users, counted once in each frame.
    weight_share
        Share of the group in the sum of the weights of all road users.
    found, found_se
        Share that detectors should find, and its standard error; None if that is unknown.
    noticed
        Share that people notice.
    """

    road_users: str
    observations: int
    weight_share: float
    found: float
    found_se: float | None
    noticed: NoticedShare

    @property
    def detection_text(self) -> str:
        """The share that detectors should find, with its error."""
        return SCORE_LABELS[DEFAULT_SCORE].with_error(self.found, math.nan if self.found_se is None else self.found_se)


@dataclass(frozen=True)
class DetectionRange:
    """The range of the share that detectors find, where nothing is known of many vehicles; see :func:`detection_range`.

    Attributes
    ----------
    low, high
        The share if none, and if all of the vehicles are found of which the level is not known.
    outside
        Share of these vehicles.
    measured
        The groups of which the level is known.
    """

    low: float
    high: float
    outside: float
    measured: tuple[str, ...]

    @property
    def text(self) -> str:
        """The range in per cent, in steps of 5 %."""
        return format_range(self.low, self.high)


def measured_groups(detectors: Sequence[str]) -> tuple[str, ...]:
    """Return the groups of road users at which the level of these models was measured."""
    groups = [STUDY.street_levels.groups.get(detector, ("cars",)) for detector in detectors]
    return tuple(name for name in groups[0] if all(name in group for group in groups)) if groups else ()


def level_error(detectors: Sequence[str], se: float | None) -> float:
    """Return the error of the share that detectors find, as a share; infinite for a detector without measured level.

    Parameters
    ----------
    detectors
        The detectors that the share is the mean over.
    se
        Its standard error, from finite traffic and the differences between the detectors; None if it is unknown.

    Examples
    --------
    >>> level_error(["pointpillars_sensor"], 0.01)
    inf
    """
    measured = [STUDY.street_levels.error_points.get(detector, math.inf) for detector in detectors]
    return math.hypot(max(measured, default=math.inf) / 100.0, se or 0.0)


def found_text(share: float, detectors: Sequence[str], se: float | None) -> str:
    """Return the share that detectors find with its error, in per cent, or a range; parameters as in level_error.

    The error is rounded up, and so is not smaller than the measured one.
    """
    error = level_error(detectors, se)
    if error > MAX_LEVEL_ERROR:
        width = max(MAX_LEVEL_ERROR, error) if math.isfinite(error) else MAX_LEVEL_ERROR
        return format_range(max(0.0, share - width), share + width)
    return f"{100.0 * share:.0f} ± {math.ceil(round(100.0 * error, 6))} %"


def detection_range(levels: Sequence[GroupLevel], detectors: Sequence[str]) -> DetectionRange | None:
    """Return the range of the share that detectors find from a site, where a number would not be supported.

    Parameters
    ----------
    levels
        All groups of road users, from :func:`read_levels`.
    detectors
        The detectors that the share is the mean over.

    Returns
    -------
    DetectionRange or None
        None if at most :data:`MAX_SHARE_OUTSIDE` of the vehicles are outside of :func:`measured_groups`, or if the
        groups are unknown.
    """
    measured = measured_groups(detectors)
    outside = math.fsum(level.weight_share for level in levels if level.road_users not in measured)
    if not outside > MAX_SHARE_OUTSIDE:
        return None
    low = math.fsum(level.weight_share * level.found for level in levels if level.road_users in measured)
    return DetectionRange(low, low + outside, outside, measured)


GROUPS_NOTE = (
    "Detectors: their models, in simulated sweeps; ± is without the error of the level, which the answer has. People: "
    "curves measured for each group."
)
"""What the levels of groups mean."""


def read_levels(path: Path, site: str) -> tuple[GroupLevel, ...]:
    """Return the groups of one site in ``levels.parquet``, without all together; empty if there is no such file."""
    if not path.exists():
        return ()
    levels = []
    for row in parquet.read_artefact(path, "levels")[0].to_pylist():
        if row["site"] != site or row["road_users"] == ALL_USERS:
            continue
        noticed = NoticedShare(row[NOTICED], row.get(f"{NOTICED}_se"), row["noticed_low"], row["noticed_high"])
        found = row[DEFAULT_SCORE], row.get(f"{DEFAULT_SCORE}_se")
        levels.append(GroupLevel(row["road_users"], row["observations"], row["weight_share"], *found, noticed))
    return tuple(levels)
