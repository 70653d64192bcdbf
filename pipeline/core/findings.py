"""What was found wrong or doubtful about a scenario or a run: where, what, and the cure.

An error stops; a warning is told on the terminal, kept in ``run.json`` and shown above the report's ranking. A stage
leaves its warnings in its summary under :data:`WARNINGS`, as :meth:`Finding.to_json` gives them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.core.errors import InputError

WARNINGS = "warnings"
"""The key of a stage's summary that holds its warnings."""


@dataclass(frozen=True)
class Finding:
    """One thing that a planner has to know before trusting a ranking.

    Attributes
    ----------
    rule
        What was held against what, a short name that stays the same: "sites on lanes".
    place
        File and key or row, or coordinates in the world frame.
    found
        What is there, with its numbers.
    cure
        What would be right, or how to get there.
    is_error
        Whether it must stop the run.
    """

    rule: str
    place: str
    found: str
    cure: str
    is_error: bool = False

    def __str__(self) -> str:
        return f"{self.place}: {self.found}" + (f"; {self.cure}" if self.cure else "")

    @classmethod
    def of(cls, rule: str, error: InputError) -> Finding:
        """What a refusal says, as an error among others."""
        return cls(rule, error.place, error.found, error.right, is_error=True)

    def to_json(self) -> dict[str, Any]:
        """As a stage's summary holds it."""
        return asdict(self)


def warnings_of(summaries: Iterable[Mapping[str, Any]]) -> list[Finding]:
    """The warnings that stages have left in their summaries, in their order."""
    return [Finding(**value) for summary in summaries for value in summary.get(WARNINGS, ())]


def seen_from(folder: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """A stage's summary whose warnings name files as seen from the scenario's folder: a report, and what the store
    holds for other folders, must not depend on where that is.
    """
    warnings = [w | {"place": w["place"].removeprefix(f"{folder}{os.sep}")} for w in summary.get(WARNINGS, ())]
    return summary | ({WARNINGS: warnings} if warnings else {})


class FindingsError(InputError):
    """What was found forbids the run; all errors at once. There is at least one.

    ``warnings`` are what else was found, for those who tell of it.
    """

    def __init__(self, findings: Iterable[Finding], warnings: Iterable[Finding] = ()) -> None:
        self.findings = first, *others = tuple(findings)
        self.warnings = tuple(warnings)
        super().__init__(first.place, first.found, "\n".join([first.cure, *map(str, others)]))
