"""Sites in the order of their scores, and the poles that they are mounted on."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.core.errors import InputError
from egvs.core.wording import format_percent
from egvs.results.labels import SCORE_LABELS, ScoreLabel
from egvs.results.levels import NoticedShare
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED
from egvs.sensors.sites import Pose

CLOSE_SHARE = 0.01
"""The report names the sites whose score is this close to the best, as a share of the best score."""


class ScoreValue(NamedTuple):
    """A value of a score other than the EGVS, and its standard error (None if unknown)."""

    name: str
    value: float
    se: float | None


@dataclass(frozen=True)
class RankedSite:
    """A row of ``scores.parquet``; its schema has the units.

    Attributes
    ----------
    egvs_se, beats_next, behind_best_se, best_beats
        None where no standard errors were computed; the last two also in files of earlier versions.
    behind_best_detectors_se
        None where no standard errors were computed, and for a score without several detectors.
    longitude_deg, latitude_deg
        None where the scenario has no reference system.
    noticed_low, noticed_high
        None where expected detections were not computed, and in files of earlier versions.
    user_columns
        Names and texts of the user's columns of the sites file.
    rank_by
        Name of the score that ranks.
    others
        Scores other than the EGVS.
    """

    site: str
    x_m: float
    y_m: float
    z_m: float
    egvs: float
    rank: int
    pole: str
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    sensor: str
    egvs_limit: float
    beams_in_roi: int
    returns: int
    entropy_seen: float
    egvs_se: float | None = None
    beats_next: float | None = None
    behind_best_se: float | None = None
    behind_best_detectors_se: float | None = None
    best_beats: float | None = None
    longitude_deg: float | None = None
    latitude_deg: float | None = None
    noticed_low: float | None = None
    noticed_high: float | None = None
    user_columns: tuple[tuple[str, str], ...] = ()
    rank_by: str = "egvs"
    others: tuple[ScoreValue, ...] = ()

    @classmethod
    def from_table(cls, scores: pa.Table, rank_by: str = "egvs") -> tuple[RankedSite, ...]:
        """Return the rows of ``scores.parquet``, in its order.

        Parameters
        ----------
        scores
            The table.
        rank_by
            Name of the score that ranks; the metadata of the table has it.
        """
        names = [column.name for column in fields(cls) if column.name in scores.column_names]
        known = {*parquet.column_names("scores"), *names, rank_by, f"{rank_by}_se"}
        user_names = [name for name in scores.column_names if name not in known]
        other_names = [name for name in dict.fromkeys([*SCORE_LABELS, rank_by]) if name in scores.column_names]
        other_names.remove("egvs")

        sites = []
        for row in scores.to_pylist():
            values = {name: _none_if_nan(row[name]) for name in names}
            user_columns = tuple((name, _format_extra_column(row[name])) for name in user_names)
            others = tuple(ScoreValue(name, row[name], _none_if_nan(row.get(f"{name}_se"))) for name in other_names)
            sites.append(cls(**values, user_columns=user_columns, rank_by=rank_by, others=others))
        return tuple(sites)

    @classmethod
    def read(cls, path: Path) -> tuple[RankedSite, ...]:
        """Read ``scores.parquet``."""
        scores, metadata = parquet.read_artefact(path, "scores")
        return cls.from_table(scores, metadata.get("rank_by", "egvs"))

    @property
    def pose(self) -> Pose:
        """Where the sensor is mounted."""
        return Pose(self.x_m, self.y_m, self.z_m, self.yaw_deg, self.pitch_deg, self.roll_deg)

    @property
    def is_lag_by_detectors(self) -> bool:
        """Whether most of the squared error of the difference to the best site is due to detectors."""
        if self.behind_best_se is None or self.behind_best_detectors_se is None:
            return False
        return 2.0 * self.behind_best_detectors_se**2 > self.behind_best_se**2

    @property
    def by(self) -> ScoreLabel:
        """Label of the score that ranks."""
        return SCORE_LABELS[self.rank_by]

    @property
    def score(self) -> float:
        """Value of the score that ranks."""
        value = self.value_of(self.rank_by)
        return self.egvs if value is None else value

    @property
    def score_se(self) -> float | None:
        """Standard error of the score that ranks; None if unknown."""
        if self.rank_by == "egvs":
            return self.egvs_se
        return next((other.se for other in self.others if other.name == self.rank_by), None)

    @property
    def noticed(self) -> NoticedShare | None:
        """Share of vehicles that people notice in the sweeps; None where it is unknown."""
        share = next((other for other in self.others if other.name == NOTICED), None)
        if share is None or self.noticed_low is None or self.noticed_high is None:
            return None
        return NoticedShare(share.value, share.se, self.noticed_low, self.noticed_high)

    @property
    def noticed_cell(self) -> str:
        """That share as a cell of a table, without its error."""
        return "-" if self.noticed is None else self.noticed.cell

    @property
    def noticed_text(self) -> str:
        """That share with its error."""
        return "-" if self.noticed is None else self.noticed.text

    def value_of(self, name: str) -> float | None:
        """Return the value of a score; None where it was not computed, or is not defined."""
        values = {"egvs": self.egvs, "entropy_seen": self.entropy_seen}
        for other in self.others:
            values[other.name] = other.value
        value: float | None = _none_if_nan(values.get(name))
        return value

    @property
    def is_separable(self) -> bool:
        """Whether the site is known to be better than the next one, or standard errors are unknown."""
        return self.beats_next is None or self.beats_next >= DISTINCT_PROBABILITY

    @property
    def is_below_best(self) -> bool:
        """Whether the site is known to be worse than the best one, or the probability of that is unknown."""
        return self.best_beats is None or self.best_beats >= DISTINCT_PROBABILITY


def _none_if_nan(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _format_extra_column(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.12g}"
    return str(value)


@dataclass(frozen=True)
class Pole:
    """The candidate sites on one pole, the best first; at least one."""

    name: str
    sites: tuple[RankedSite, ...]

    @property
    def best(self) -> RankedSite:
        """The best site."""
        return self.sites[0]

    @property
    def gain_text(self) -> str:
        """Lead of the best site over the worst: in percentage points for shares, else in per cent of the worst.

        Empty for a single site, and for a score that is no share where the worst is 0.
        """
        if len(self.sites) == 1:
            return ""
        by, worst = self.best.by, self.sites[-1].score
        if by.is_share:
            return by.change(self.best.score - worst)
        if not worst > 0:
            return ""
        return format_percent(self.best.score / worst - 1)

    @property
    def user_columns(self) -> tuple[str, ...]:
        """Text of each of the user's columns; different texts of the sites are separated by commas."""
        columns = []
        for column in zip(*(site.user_columns for site in self.sites), strict=True):
            texts = dict.fromkeys(text for _, text in column if text)
            columns.append(", ".join(texts))
        return tuple(columns)


class Mounted(Protocol):
    """A sensor on a pole: a ranked site, or a sensor of a plan."""

    @property
    def site(self) -> str:
        """Name of the site."""

    @property
    def pole(self) -> str:
        """Name of its pole."""

    @property
    def z_m(self) -> float:
        """Height in the world frame."""

    @property
    def pitch_deg(self) -> float:
        """Tilt, positive upwards."""

    @property
    def roll_deg(self) -> float:
        """Rotation about the axis of the sensor."""


_HEIGHT_IN_NAME = re.compile(r"@([0-9.]+)m")
"""What :mod:`egvs.sensors.sites` adds to the name of a site that has several heights; it counts from the ground."""


def describe_mount(mount: Mounted, *, has_relief: bool = False, is_moved: bool = False) -> str:
    """Return height and tilt of a sensor in words, e.g. "3 m up, level" or "4.5 m up, tilted 10° down".

    Parameters
    ----------
    mount
        The sensor.
    has_relief
        Whether the ground is elsewhere than at z = 0, so that z is no height above it.
    is_moved
        Whether the sensor may be at another height than its name says (``egvs place --refine``).
    """
    named = None if is_moved else _HEIGHT_IN_NAME.search(mount.site.removeprefix(mount.pole))
    if named is not None:
        height = f"{named[1]} m up"
    else:
        height = f"at z {mount.z_m:.4g} m" if has_relief else f"{mount.z_m:.4g} m up"
    tilt = "level"
    if pitch_deg := round(mount.pitch_deg, 1):
        tilt = f"tilted {abs(pitch_deg):g}° {'up' if pitch_deg > 0 else 'down'}"
    return ", ".join(words for words in (height, tilt, describe_roll(mount.roll_deg)) if words)


def describe_roll(roll_deg: float) -> str:
    """Return the roll of a sensor in words; empty without any.

    >>> describe_roll(10.0), describe_roll(180.0), describe_roll(-178.5), describe_roll(0.0)
    ('rolled by 10°', 'upside down', 'upside down, rolled by 1.5°', '')
    """
    pose = Pose(0.0, 0.0, 0.0, roll_deg=roll_deg)
    words = ["upside down"] if pose.is_inverted else []
    if side_deg := round(pose.side_tilt_deg, 1):
        words.append(f"rolled by {side_deg:g}°")
    return ", ".join(words)


def is_named_after_pole(mount: Mounted) -> bool:
    """Return whether the name of a site is that of its pole, alone or with an addition: "k04@3m+0deg", "kerb_high"."""
    rest = mount.site.removeprefix(mount.pole)
    return rest != mount.site and not rest[:1].isalnum()


def site_titles(mounts: Iterable[Mounted], *, has_relief: bool = False, is_moved: bool = False) -> dict[str, str]:
    """Return what people call sites, by their names, e.g. "pole k04, 3 m up, level" for "k04@3m+0deg".

    A site with a name of its own on the pole of another is called by it, e.g. "site c10, 3 m up, level". Sites that
    would have the same title have their name in it. The parameters are those of :func:`describe_mount`.
    """
    titles = {}
    for mount in mounts:
        name = mount.pole if "pole" in mount.pole.lower() else f"pole {mount.pole}"
        if not is_named_after_pole(mount):
            name = f"site {mount.site}"
        titles[mount.site] = f"{name}, {describe_mount(mount, has_relief=has_relief, is_moved=is_moved)}"
    count = Counter(titles.values())
    return {site: title if count[title] == 1 else f"{title} ({site})" for site, title in titles.items()}


def companion_score(sites: Sequence[RankedSite]) -> ScoreLabel | None:
    """Return the score shown beside the one that ranks; None if it was not computed.

    Beside the EGVS it is the recommended score or, failing that, the share of vehicles seen well; beside any other
    score it is the EGVS.
    """
    if not sites:
        return None
    names = ["egvs"]
    if sites[0].rank_by == "egvs":
        names = [DEFAULT_SCORE, "seen_well"]
    for name in names:
        if all(site.value_of(name) is not None for site in sites):
            return SCORE_LABELS[name]
    return None


def group_by_pole(sites: Iterable[RankedSite]) -> tuple[Pole, ...]:
    """Return the poles of sites in the order of their ranks: the pole with the best site first."""
    sites_of_pole: dict[str, list[RankedSite]] = {}
    for site in sites:
        sites_of_pole.setdefault(site.pole, []).append(site)
    return tuple(Pole(name, tuple(members)) for name, members in sites_of_pole.items())


@dataclass(frozen=True)
class Ranking:
    """Sites by rank; at least one.

    Attributes
    ----------
    sites
        All sites; those of equal rank are in the order of the sites file.
    best
        The sites with the best score.
    close
        The other sites within :data:`CLOSE_SHARE` of the best score.
    """

    sites: tuple[RankedSite, ...]
    best: tuple[RankedSite, ...]
    close: tuple[RankedSite, ...]

    @classmethod
    def read(cls, path: Path) -> Ranking:
        """Read ``scores.parquet``; InputError if it has no site."""
        sites = RankedSite.read(path)
        if not sites:
            raise InputError(path, "expected at least one site, got none", "Run the score stage again.")
        return cls.of(sites)

    @classmethod
    def of(cls, sites: Iterable[RankedSite]) -> Ranking:
        """Return the ranking of some sites of a run, at least one; their ranks are those among all sites."""
        ordered = tuple(sorted(sites, key=lambda site: site.rank))
        best = tuple(site for site in ordered if site.rank == ordered[0].rank)
        near = (1 - CLOSE_SHARE) * best[0].score
        close = tuple(site for site in ordered[len(best) :] if site.score >= near > 0)
        return cls(ordered, best, close)

    @property
    def last(self) -> RankedSite:
        """The worst site."""
        return self.sites[-1]

    @cached_property
    def poles(self) -> tuple[Pole, ...]:
        """The poles, the one with the best site first."""
        return group_by_pole(self.sites)

    @property
    def user_column_names(self) -> tuple[str, ...]:
        """Names of the user's columns of the sites file."""
        return tuple(name for name, _ in self.sites[0].user_columns)

    @property
    def is_tie(self) -> bool:
        """Whether all sites have the same score."""
        return len(self.best) == len(self.sites)

    @property
    def extremes(self) -> tuple[RankedSite, ...]:
        """The best and the worst site; only one where all have the same score."""
        if self.is_tie:
            return self.sites[:1]
        return self.sites[0], self.last

    @property
    def has_errors(self) -> bool:
        """Whether standard errors were computed."""
        return self.sites[0].egvs_se is not None

    @property
    def by(self) -> ScoreLabel:
        """Label of the score that ranks."""
        return self.best[0].by

    @property
    def companion_score(self) -> ScoreLabel | None:
        """The score shown beside the one that ranks; None if it was not computed."""
        return companion_score(self.sites)

    @property
    def has_noticed(self) -> bool:
        """Whether it is known what people notice from each site."""
        return all(site.noticed is not None for site in self.sites)

    @property
    def is_located(self) -> bool:
        """Whether longitude and latitude are known."""
        return self.sites[0].latitude_deg is not None

    @cached_property
    def shared_ranks(self) -> set[int]:
        """Ranks of several sites."""
        return {rank for rank, count in Counter(site.rank for site in self.sites).items() if count > 1}

    def share_of_best(self, site: RankedSite) -> float:
        """Return the score of a site as a share of the best score; 0 if that is 0."""
        best_score = self.best[0].score
        if not best_score > 0:
            return 0.0
        return site.score / best_score


def share_of_limit(site: RankedSite) -> float | None:
    """Return the EGVS as a share of its upper limit; None if there is no finite limit above 0."""
    limit = site.egvs_limit
    if not (limit > 0 and math.isfinite(limit)):
        return None
    return site.egvs / limit
