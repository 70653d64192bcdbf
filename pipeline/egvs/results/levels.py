"""Levels: what share of vehicles detectors find and people notice from a site, and both of each group of road users.

A share that rests on what was measured is printed as a number with its error. If more than :data:`MAX_SHARE_OUTSIDE`
of the vehicles are outside of what it rests on, it is printed as a range: from the share if none of these was found or
noticed to the share if all of them were, in steps of 5 %. Outside are, for what people notice, those outside the data
of the curves (:mod:`egvs.scoring.noticed`); for what detectors find, all groups but those at which the level of their
models was measured.

The error of what detectors find contains the level error that was measured on simulated streets, by group of road users
(:class:`DetectionLevel`). If it is larger than :data:`MAX_LEVEL_ERROR`, a range is printed, too. If the level was
measured nowhere, no number is printed. The error of what people notice is at least :data:`TRANSFER_ERROR`. Differences
between sites have neither of these errors, because they shift all sites alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from egvs.artefacts import parquet
from egvs.artefacts.readers import ALL_USERS
from egvs.core.wording import format_percent
from egvs.results.labels import SCORE_LABELS
from egvs.results.study_results import STUDY
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED, UNCORRECTED

MAX_SHARE_OUTSIDE = 0.1
"""With more vehicles outside the data, a share is printed as a range."""

MIN_NOTICED_LEAD = 0.01
"""Shares noticed that differ by less are taken as equal."""

MAX_LEVEL_ERROR = 0.1
"""With a larger error, what detectors find is printed as a range."""

TRANSFER_ERROR = 0.1
"""Smallest error of what people notice. The curves are of one junction and one sensor. Held against other data, they
were 3 to 17 points off by range (the other sensor there), 10 points (cars at another junction) and up to 12, once 47
(published recall of four sensors): docs/certainty.md."""

NOT_MEASURED = "level not measured"
"""In place of a number."""

CARS = "cars"
"""The group whose level is taken as measured where :class:`~egvs.results.study_results.StreetLevels` has no groups."""

_RANGE_STEP = 0.05


def format_range(low: float, high: float) -> str:
    """Return a range of shares in per cent, rounded outwards to steps of 5 %.

    >>> format_range(0.72, 0.93)
    '70 to 95 %'
    """
    low = math.floor(round(low / _RANGE_STEP, 6)) * _RANGE_STEP
    high = min(1.0, math.ceil(round(high / _RANGE_STEP, 6)) * _RANGE_STEP)
    return f"{100.0 * low:.0f} to {format_percent(high, 0)}"


def is_none_or_all(share: float) -> bool:
    """Return whether a share is printed as 0 or 100 %, so that its error has one side only."""
    return round(100.0 * share) in (0, 100)


@dataclass(frozen=True)
class NoticedShare:
    """The share of vehicles that people notice.

    Attributes
    ----------
    value
        The share.
    se
        Its standard error from the traffic and the curves, for comparisons of sites; None if unknown.
    low, high
        The share if none, and if all of the vehicles outside the data of the curves were noticed.

    Examples
    --------
    >>> NoticedShare(0.897, 0.017, 0.897, 0.897).text
    '90 ± 10 %'
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
        """The share with its error, at least :data:`TRANSFER_ERROR`, or a range, in per cent."""
        if not self.is_measured:
            return self.cell
        error = max(TRANSFER_ERROR, self.se or 0.0)
        if is_none_or_all(self.value):
            return format_range(max(0.0, self.value - error), self.value + error)
        return SCORE_LABELS[NOTICED].with_error(self.value, error)

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


@dataclass(frozen=True)
class DetectionRange:
    """The range of the share that detectors find, where nothing is known of many vehicles.

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


@dataclass(frozen=True)
class DetectionLevel:
    """What is known of the share that detectors find from a site.

    Attributes
    ----------
    detectors
        The detectors that the share is the mean over.
    groups
        All groups of road users, from :func:`read_levels`; empty if they are unknown.
    has_losses
        Whether losses of returns of the sensor are simulated, or cannot matter. Corrected models were tested with
        losses only.

    Examples
    --------
    >>> DetectionLevel(("cluster",)).text(0.84, 0.01)
    '84 ± 6 %'
    >>> DetectionLevel(("pointpillars_sensor",)).text(0.84, 0.01)
    'level not measured'
    """

    detectors: tuple[str, ...]
    groups: tuple[GroupLevel, ...] = ()
    has_losses: bool = True

    @property
    def is_measured(self) -> bool:
        """Whether the level of all detectors was measured under such conditions."""
        measured = STUDY.street_levels.error_points
        return bool(self.detectors) and all(
            name in measured and (self.has_losses or name.endswith(UNCORRECTED)) for name in self.detectors
        )

    @property
    def measured_groups(self) -> tuple[str, ...]:
        """The groups of road users at which the level of all detectors was measured and is near enough."""
        if not self.is_measured:
            return ()
        each = [STUDY.street_levels.groups.get(detector, (CARS,)) for detector in self.detectors]
        return tuple(name for name in each[0] if all(name in groups for groups in each))

    @property
    def range(self) -> DetectionRange | None:
        """The range where a number would not be supported: most vehicles may be of other groups than the measured ones.

        None if at most :data:`MAX_SHARE_OUTSIDE` of the vehicles are outside of :attr:`measured_groups`, if the groups
        are unknown, or if the level was not measured at all.
        """
        measured = self.measured_groups
        outside = math.fsum(level.weight_share for level in self.groups if level.road_users not in measured)
        if not self.is_measured or not outside > MAX_SHARE_OUTSIDE:
            return None
        low = math.fsum(level.weight_share * level.found for level in self.groups if level.road_users in measured)
        return DetectionRange(low, low + outside, outside, measured)

    def error(self, se: float | None) -> float:
        """Return the error of the share found of all vehicles, as a share; infinite if the level was not measured.

        The level errors of the groups are weighted by their share and added, since they can have one cause. It is that
        of the detector with the largest one.

        Parameters
        ----------
        se
            Standard error of the share, from finite traffic and the differences between detectors; None if unknown.
        """
        weights = {level.road_users: level.weight_share for level in self.groups}
        measured = {name: weight for name, weight in weights.items() if name in self.measured_groups}
        total = math.fsum(measured.values())
        if not total:
            return self._error({ALL_USERS: 1.0}, se)
        return self._error({name: weight / total for name, weight in measured.items()}, se)

    def _error(self, weights: Mapping[str, float], se: float | None) -> float:
        if not self.is_measured:
            return math.inf
        of_detectors = []
        for detector in self.detectors:
            points = STUDY.street_levels.error_points[detector]
            of_detectors.append(math.fsum(weight * points[name] for name, weight in weights.items()))
        return math.hypot(max(of_detectors) / 100.0, se or 0.0)

    def text(self, share: float, se: float | None) -> str:
        """Return the share found of all vehicles, with its error or as a range in per cent; :data:`NOT_MEASURED` if so.

        The error is rounded up, and so is not smaller than the measured one.
        """
        if self.range is not None:
            return self.range.text
        return _format_found(share, self.error(se))

    def joint_text(self, share: float, se: float | None) -> str:
        """Return the share that several sensors find together, with the level error of single sensors.

        No level of several sensors was measured. Where a number of one site would not be supported, it is the range
        from the share if none of the vehicles outside of :attr:`measured_groups` was found to the share if all were.
        """
        if self.range is not None:
            return format_range(max(0.0, share - self.range.outside), share + self.range.outside)
        return _format_found(share, self.error(se))

    def group_text(self, level: GroupLevel) -> str:
        """Return the share found of one group in the same way; :data:`NOT_MEASURED` for a group that was not measured.

        ``level`` may be one of :attr:`groups` or not.
        """
        if level.road_users not in self.measured_groups:
            return NOT_MEASURED
        return _format_found(level.found, self._error({level.road_users: 1.0}, level.found_se))


def _format_found(share: float, error: float) -> str:
    if not math.isfinite(error):
        return NOT_MEASURED
    if error > MAX_LEVEL_ERROR or is_none_or_all(share):
        return format_range(max(0.0, share - error), share + error)
    return f"{100.0 * share:.0f} ± {math.ceil(round(100.0 * error, 6))} %"


NO_DETECTORS = DetectionLevel(())
"""Of a score without detectors."""

GROUPS_NOTE = (
    "Detectors: ± contains the level error of each group on simulated streets. People: curves of one junction, with an "
    "error of at least 10 points; boxes that match by chance make them too high, by about 2 points for cars, perhaps 6 "
    "for larger vehicles and 11 for people."
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
