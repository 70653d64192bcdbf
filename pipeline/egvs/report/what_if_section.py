"""The section of the page on what-ifs: what the best site is with solids that are there for a share of the time.

An answer is shown while it belongs to the run (:mod:`egvs.results.command_entries`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from egvs.core.wording import format_percent
from egvs.results.command_entries import Entries
from egvs.results.labels import format_probability
from egvs.results.ranking import RankedSite
from egvs.results.sensors import ScoreDifference, difference_unit, format_difference


@dataclass(frozen=True)
class WhatIfRow:
    """The answer of one table of solids, in words."""

    name: str
    share: str
    best_before: str
    best_present: str
    best_expected: str
    change: str
    chance: str
    conclusion: str


@dataclass(frozen=True)
class WhatIfSection:
    """Results of ``egvs what-if`` for a run."""

    rows: tuple[WhatIfRow, ...]
    change_unit: str

    @classmethod
    def of(cls, current: Entries, best: RankedSite) -> WhatIfSection:
        """Return the results of a run in words.

        Parameters
        ----------
        current
            The entries that belong to the run.
        best
            The best site of the run.
        """
        rows = tuple(_what_if_row(name, values, best) for name, values in current.items())
        return cls(rows, difference_unit(best))


def _what_if_row(name: str, values: Mapping[str, Any], site: RankedSite) -> WhatIfRow:
    change, chance = "not possible with it", "certain"
    if values["change"] is not None:
        change = format_difference(ScoreDifference.from_entry(values["change"]), site)
        chance = "–"
        if values["overtakes"] is not None:
            chance = f"{format_probability(values['overtakes'])} ({values['rival']})"
    share = "–" if values["share"] is None else format_percent(values["share"], 0)
    return WhatIfRow(
        name, share, values["best_before"], values["best_present"] or "–", values["best_expected"], change, chance,
        values["conclusion"],
    )  # fmt: skip
