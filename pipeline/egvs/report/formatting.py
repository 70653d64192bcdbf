"""Score labels; percent, counts, degrees, durations as text.

How scores are told to a planner: what each is called, and what a value of it says.

The sentences and numbers of the report, in plain words.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ScoreLabel:
    """One score in words.

    Attributes
    ----------
    name
        As ``[score] rank_by`` has it.
    noun, head
        What it is called in a sentence, and at the head of a column.
    says
        What a site does that has a value of it.
    means
        What is added up, in a sentence.
    is_share
        Whether values are shares, told in per cent.
    digits
        Decimals of its values.
    unit
        Of values that are no shares.
    """

    name: str
    noun: str
    head: str
    says: str
    means: str
    is_share: bool = True
    digits: int = 1
    unit: str = ""

    @property
    def counts_vehicles(self) -> bool:
        """Whether it is a mean over vehicles."""
        return self.means.endswith(_VEHICLES_NOTE)

    @property
    def title(self) -> str:
        """At the head of a column of the report, two lines of HTML."""
        first, _, rest = self.head.partition(" ")
        return f"{first[0].upper()}{first[1:]}<br>" + (f"({self.unit})" if self.unit else rest or "of all")

    @property
    def label(self) -> str:
        """Of an axis."""
        return f"{self.noun} ({self.unit})" if self.unit else self.noun

    def with_noun(self, value: float) -> str:
        """Beside a site: "EGVS 247,397 bit"."""
        return f"{self.noun} {self.value(value)} {self.unit}".strip()

    def value(self, value: float) -> str:
        """A value in a table; its unit stands in the head."""
        if math.isnan(value):
            return "-"
        return f"{value:.{self.digits}%}" if self.is_share else f"{value:,.{self.digits}f}"

    def error(self, value: float, se: float | None) -> str:
        """A standard error in a table: of shares in per cent of the whole, of others as a share of the value."""
        if se is None or math.isnan(se) or not value > 0:
            return "-"
        return f"±{se:.1%}" if self.is_share else f"{se / value:.1%}"

    def sentence(self, value: float) -> str:
        """What a site with this value does."""
        return self.says.format(f"{value:.0%}" if self.is_share else f"{self.value(value)} {self.unit}".strip())


_VEHICLES_NOTE = (
    "Each vehicle whose centre is in the region counts, in some frames of the recorded traffic, by the beams that meet "
    "it first: buildings, trees, poles and other vehicles are in the way."
)

SCORE_LABELS = {
    its.name: its
    for its in (
        ScoreLabel("egvs", "EGVS", "EGVS bit", "scores {}", "",
            is_share=False, digits=0, unit="bit"),
        ScoreLabel(
            "entropy_seen", "the entropy seen", "entropy seen", "sees {} of the traffic’s uncertainty",
            "Sites are ranked by the share of the traffic’s uncertainty in voxels that at least one beam crosses.",
        ),
        ScoreLabel(
            "coverage", "the coverage", "coverage", "crosses {} of the voxels where traffic ever is",
            "Sites are ranked by the share of the voxels that traffic ever occupies that at least one beam crosses.",
        ),
        ScoreLabel(
            "expected_visibility", "the occupancy seen", "visibility", "sees {} of what traffic occupies",
            "Sites are ranked by the share of occupancy, the sum of its chances, in voxels that a beam crosses.",
        ),
        ScoreLabel(
            "points_on_target", "the points on vehicles", "log points", "has a mean log(1 + points) of {} on vehicles",
            f"Sites are ranked by the points that they get from vehicles: the mean of log(1 + points). "
            f"{_VEHICLES_NOTE}",
            is_share=False, digits=2,
        ),
        ScoreLabel(
            "seen_well", "the share of vehicles seen well", "seen well", "sees {} of vehicles well",
            "Sites are ranked by the share of vehicles that they see well, one with n points by 1 − exp(−n / 20). "
            + _VEHICLES_NOTE,
        ),
        ScoreLabel(
            "expected_detections", "the share of vehicles found", "found", "should find {} of vehicles",
            "Sites are ranked by the share of vehicles that detectors are expected to find, by the points on each, how "
            f"far they spread over it, how far away it is and how near the next one. {_VEHICLES_NOTE}",
        ),
    )
}  # fmt: skip
"""By name."""


def format_percent(value: float) -> str:
    """A share in per cent."""
    return f"{value:.1%}"


def format_count(value: float) -> str:
    """A number without decimals, thousands apart."""
    return f"{value:,.0f}"


def format_number(value: float) -> str:
    """A number as a person would write it."""
    return f"{value:,.2f}".rstrip("0").rstrip(".")


def format_degrees(value: float) -> str:
    """A longitude or latitude, to about a decimetre."""
    return f"{value:.6f}"


def format_duration(seconds: float) -> str:
    """A time in hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{seconds:g} s"
    hours, minutes = divmod(minutes, 60)
    return " ".join(f"{n} {unit}" for n, unit in ((hours, "h"), (minutes, "min"), (rest, "s")) if n)
