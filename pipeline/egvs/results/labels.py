"""Names and units of the scores as people read them, and numbers as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.core.wording import format_percent
from egvs.scenario.score_config import SCORES_IN_UNITS


@dataclass(frozen=True)
class ScoreLabel:
    """Names of a score, and how its values are written.

    Attributes
    ----------
    name
        The value of ``[score] rank_by``.
    noun, head
        Name in a sentence, and at the head of a column.
    says
        What a site with a score does, with ``{}`` for the score.
    means
        How the score is defined, in one or two sentences.
    digits
        Number of decimals.
    unit
        Unit of values that are not shares.
    """

    name: str
    noun: str
    head: str
    says: str
    means: str
    digits: int = 1
    unit: str = ""

    @property
    def is_share(self) -> bool:
        """Whether values are shares, written in per cent."""
        return self.name not in SCORES_IN_UNITS

    @property
    def counts_vehicles(self) -> bool:
        """Whether the score is a mean over vehicles."""
        return self.means.endswith(_VEHICLES_NOTE)

    @property
    def title(self) -> str:
        """Head of a column of the report: two lines of HTML."""
        first, _, rest = self.head.partition(" ")
        second = rest or "of all"
        if self.unit:
            second = f"({self.unit})"
        return f"{first[0].upper()}{first[1:]}<br>{second}"

    @property
    def label(self) -> str:
        """Name of the score with its unit."""
        return f"{self.noun} ({self.unit})" if self.unit else self.noun

    @property
    def axis_title(self) -> str:
        """Title of an axis, e.g. "Share of vehicles found (%)"; its values are multiplied by :attr:`axis_factor`."""
        name = self.noun.removeprefix("the ")
        unit = "%" if self.is_share else self.unit
        return f"{name[0].upper()}{name[1:]}" + (f" ({unit})" if unit else "")

    @property
    def axis_factor(self) -> float:
        """Factor of values on an axis: 100 for shares, which are shown in per cent."""
        return 100.0 if self.is_share else 1.0

    @property
    def card_head(self) -> str:
        """Name beside a value where a narrow screen shows a row as a card."""
        return f"{self.head[0].upper()}{self.head[1:]}"

    def with_noun(self, value: float) -> str:
        """Return a value with name and unit, e.g. "EGVS 247,397 bit"."""
        return f"{self.noun} {self.with_unit(value)}"

    def value(self, value: float) -> str:
        """Return a value as text, without its unit."""
        if math.isnan(value):
            return "-"
        return format_percent(value, self.digits) if self.is_share else f"{value:,.{self.digits}f}"

    def error(self, value: float, se: float | None) -> str:
        """Return a standard error as text: in percentage points for shares, relative to the value otherwise."""
        if se is None or math.isnan(se) or not value > 0:
            return "-"
        if self.is_share:
            return f"±{self._error_number(se)} %" if se else "-"
        return format_percent(se / value)

    def with_error(self, value: float, se: float) -> str:
        """Return a value and its error, without unit, e.g. "94.6 ± 0.9 %"; the value alone if ``se`` is NaN or 0."""
        if math.isnan(value) or not se > 0.0:
            return self.value(value)
        text = f"{self._number(value)} ± {self._error_number(se)}"
        return f"{text} %" if self.is_share else text

    def with_unit(self, value: float, se: float = math.nan) -> str:
        """Return a value with its error, if that is known, and its unit, e.g. "99,220 ± 300 bit"."""
        return f"{self.with_error(value, se)} {self.unit}".rstrip()

    def change(self, value: float, se: float = math.nan) -> str:
        """Return a difference of two values, without unit: of shares in percentage points, e.g. "4.7 ± 0.5"."""
        if math.isnan(se):
            return self._number(value)
        return f"{self._number(value)} ± {self._error_number(se)}"

    @property
    def change_unit(self) -> str:
        """Unit of :meth:`change` in a sentence."""
        return "percentage points" if self.is_share else self.unit

    @property
    def change_head(self) -> str:
        """Unit of :meth:`change` at the head of a column."""
        return "% points" if self.is_share else self.unit

    def is_zero(self, value: float) -> bool:
        """Whether a difference of two values is written as 0."""
        return float(self._number(value).replace(",", "")) == 0.0

    @property
    def smallest_change(self) -> str:
        """The smallest difference that is not written as 0, without unit."""
        return f"{10.0**-self.digits:.{self.digits}f}"

    def _number(self, value: float) -> str:
        if self.is_share:
            value = 100.0 * value
        return f"{value:z,.{self.digits}f}"

    def _error_number(self, se: float) -> str:
        if se > 0.0 and self.is_zero(se):
            return f"<{self.smallest_change}"
        return self._number(se)

    def sentence(self, value: float) -> str:
        """Return what a site with this score does, e.g. "should find 87.0 % of vehicles"."""
        return self.says.format(self.with_unit(value))


_MAX_LETTERS = 18

_VEHICLES_NOTE = (
    "Vehicles with their centre in the region are counted in a sample of the recorded frames, each by the beams that "
    "hit it; buildings, trees, poles and other vehicles block beams."
)

_LABELS = (
    ScoreLabel("egvs", "EGVS", "EGVS bit", "scores {}", "",
        digits=0, unit="bit"),
    ScoreLabel(
        "entropy_seen", "the entropy seen", "entropy seen", "sees {} of the traffic’s uncertainty",
        "Sites are ranked by the share of the traffic’s uncertainty in voxels that at least one beam crosses.",
    ),
    ScoreLabel(
        "coverage", "the coverage", "coverage", "crosses {} of the voxels that traffic ever occupies",
        "Sites are ranked by coverage: of the voxels that traffic ever occupies, the share that at least one beam "
        "crosses.",
    ),
    ScoreLabel(
        "expected_visibility", "the occupancy seen", "visibility", "sees {} of the traffic’s occupancy",
        "Sites are ranked by the occupancy seen: of the summed occupancy probabilities, the share in voxels that at "
        "least one beam crosses.",
    ),
    ScoreLabel(
        "points_on_target", "the points on vehicles", "log points", "has a mean log(1 + points) of {} on vehicles",
        f"Sites are ranked by their points on vehicles: the mean of log(1 + points). "
        f"{_VEHICLES_NOTE}",
        digits=2,
    ),
    ScoreLabel(
        "seen_well", "the share of vehicles seen well", "seen well", "sees {} of vehicles well",
        "Sites are ranked by the share of vehicles that they see well: a vehicle with n points counts 1 − exp(−n / 20)."
        f" {_VEHICLES_NOTE}",
    ),
    ScoreLabel(
        "expected_detections", "the share of vehicles found", "found", "should find {} of vehicles",
        "Sites are ranked by the share of vehicles that detectors are expected to find, given the points on each "
        "vehicle, how widely they are spread over it, its distance, and the distance to the next vehicle. "
        f"{_VEHICLES_NOTE}",
    ),
    ScoreLabel(
        "noticed", "the share of vehicles noticed", "noticed", "shows {} of vehicles to people",
        "The share of vehicles that people notice in the sweeps of a site (a box within 3 m), given the points on each "
        f"vehicle. {_VEHICLES_NOTE}",
        digits=0,
    ),
)  # fmt: skip


class _ScoreLabels(dict[str, ScoreLabel]):
    """Labels by name; a score of another package has a label with its name."""

    def __missing__(self, name: str) -> ScoreLabel:
        means = f"Sites are ranked by {name}, a score of an installed package with a value for each vehicle."
        label = ScoreLabel(name, f"the score {name}", name, "scores {}", f"{means} {_VEHICLES_NOTE}")
        self[name] = label
        return label


SCORE_LABELS = _ScoreLabels((label.name, label) for label in _LABELS)
"""Labels by the name of the score."""


def format_probability(probability: float) -> str:
    """Return a probability in whole per cent; "over 99 %" and "under 1 %" where it rounds to 100 or 0.

    A value below :data:`DISTINCT_PROBABILITY` is never written as this limit.

    Examples
    --------
    >>> format_probability(0.578), format_probability(0.896), format_probability(0.9996)
    ('58 %', '89 %', 'over 99 %')
    """
    percent = round(100.0 * probability)
    limit = round(100.0 * DISTINCT_PROBABILITY)
    if percent >= 100:
        return "over 99 %"
    if percent <= 0:
        return "under 1 %"
    if percent >= limit and probability < DISTINCT_PROBABILITY:
        percent = limit - 1
    return f"{percent} %"


def format_count(value: float) -> str:
    """Return a number without decimals, e.g. "12,500"."""
    return f"{value:,.0f}"


def format_number(value: float) -> str:
    """Return a number with up to two decimals, e.g. "12.5"."""
    return f"{value:,.2f}".rstrip("0").rstrip(".")


def format_degrees(value: float) -> str:
    """Return a longitude or latitude with a resolution of about a decimetre."""
    return f"{value:.6f}"


def format_duration(seconds: float) -> str:
    """Return a time in hours, minutes and seconds, e.g. "1 h 5 min"; times below a minute keep their decimals."""
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{seconds:g} s"
    hours, minutes = divmod(minutes, 60)
    parts = ((hours, "h"), (minutes, "min"), (rest, "s"))
    return " ".join(f"{number} {unit}" for number, unit in parts if number)


def join_names(names: Sequence[str]) -> str:
    """Return names as a list in a sentence, e.g. "a, b and c"."""
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"


def shorten_name(name: str) -> str:
    """Return a name for a figure, cut after 18 letters."""
    if len(name) <= _MAX_LETTERS:
        return name
    return f"{name[: _MAX_LETTERS - 1]}…"
