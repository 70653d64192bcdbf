"""One row of the table of numerical checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """Result of one check.

    Attributes
    ----------
    case, rule, tested
        What was checked; the rule that decides; the oracle that it was compared with.
    cases, excluded, mismatches
        Numbers of all cases; of cases within the stated margin of the rule; of wrong decisions.
    worst
        The worst figure measured, with its unit, e.g. ``"2.1e-13 m"``.
    """

    case: str
    rule: str
    tested: str
    cases: int
    excluded: int
    mismatches: int
    worst: str
