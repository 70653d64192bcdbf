"""One line of the table of hunts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """What one hunt found.

    Attributes
    ----------
    case, rule, tested
        What was tried; the rule that decides; the oracle that it was held against.
    cases, excluded, mismatches
        How many were tried; how many lie within the rule's stated margin (built to be); how many came out wrong.
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
