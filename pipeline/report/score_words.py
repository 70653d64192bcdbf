"""How scores are told to a planner: what each is called, and what a value of it says."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ScoreWords:
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
        return self.means.endswith(_VEHICLES)

    @property
    def title(self) -> str:
        """At the head of a column of the report, two lines of HTML."""
        first, _, rest = self.head.partition(" ")
        return f"{first[0].upper()}{first[1:]}<br>" + (f"({self.unit})" if self.unit else rest or "of all")

    @property
    def label(self) -> str:
        """Of an axis."""
        return f"{self.noun} ({self.unit})" if self.unit else self.noun

    def told(self, value: float) -> str:
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


_VEHICLES = (
    "Each vehicle whose centre is in the region counts, in some frames of the recorded traffic, by the beams that meet "
    "it first: buildings, trees, poles and other vehicles are in the way."
)

SCORES = {
    its.name: its
    for its in (
        ScoreWords("egvs", "EGVS", "EGVS bit", "scores {}", "",
            is_share=False, digits=0, unit="bit"),
        ScoreWords(
            "entropy_seen", "the entropy seen", "entropy seen", "sees {} of the traffic’s uncertainty",
            "Sites are ranked by the share of the traffic’s uncertainty in voxels that at least one beam crosses.",
        ),
        ScoreWords(
            "coverage", "the coverage", "coverage", "crosses {} of the voxels where traffic ever is",
            "Sites are ranked by the share of the voxels that traffic ever occupies that at least one beam crosses.",
        ),
        ScoreWords(
            "expected_visibility", "the occupancy seen", "visibility", "sees {} of what traffic occupies",
            "Sites are ranked by the share of occupancy, the sum of its chances, in voxels that a beam crosses.",
        ),
        ScoreWords(
            "points_on_target", "the points on vehicles", "log points", "has a mean log(1 + points) of {} on vehicles",
            f"Sites are ranked by the points that they get from vehicles: the mean of log(1 + points). {_VEHICLES}",
            is_share=False, digits=2,
        ),
        ScoreWords(
            "seen_well", "the share of vehicles seen well", "seen well", "sees {} of vehicles well",
            "Sites are ranked by the share of vehicles that they see well, one with n points by 1 − exp(−n / 20). "
            + _VEHICLES,
        ),
        ScoreWords(
            "expected_detections", "the share of vehicles found", "found", "should find {} of vehicles",
            "Sites are ranked by the share of vehicles that detectors are expected to find, by the points on each, how "
            f"far they spread over it, how far away it is and how near the next one. {_VEHICLES}",
        ),
    )
}  # fmt: skip
"""By name."""
