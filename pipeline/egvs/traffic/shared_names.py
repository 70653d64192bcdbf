"""Signs that two vehicles share a name: rows in two places at one time, and steps that no vehicle can make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from egvs.core.errors import Diagnostic
from egvs.core.wording import number_of

MAX_SPEED_M_S, MIN_JUMP_M = 60.0, 2.0
"""A step is a jump if it is longer than this distance and this speed allow."""

ERROR_SHARED_SHARE = 0.01
"""Share of rows whose vehicle is in another place at the same time that is an error; of jumps, it gets a warning."""

ERROR_JUMP_SHARE = 0.1
"""Share of rows to which a vehicle jumps that is an error."""


@dataclass
class SharedNames:
    """Signs that two vehicles share a name.

    Attributes
    ----------
    rows
        Number of rows.
    repeated
        Rows of a vehicle at a time at which it has another row, elsewhere.
    jumps
        Steps between two rows of a vehicle that are longer than any vehicle can move.
    example
        One of the vehicles, and when.
    """

    rows: int = 0
    repeated: int = 0
    jumps: int = 0
    example: str = ""

    def findings(self, where: str) -> Iterator[Diagnostic]:
        """Yield an error if so many rows are concerned that vehicles are missing, or a warning."""
        hint = "Give each vehicle a name of its own."
        if self.repeated:
            problem = (
                f"expected one row for each vehicle and time, got {self.repeated:,} others in"
                f" {number_of(self.rows, 'row')}, in other places ({self.example}): two vehicles share a name"
            )
            yield Diagnostic("shared names", where, problem, hint, self.repeated > ERROR_SHARED_SHARE * self.rows)
        elif self.jumps > ERROR_SHARED_SHARE * self.rows:
            problem = (
                f"vehicles jump in {self.jumps:,} of {number_of(self.rows, 'row')}, faster than {MAX_SPEED_M_S:g} m/s:"
                " two vehicles share a name, or times are wrong"
            )
            yield Diagnostic("jumps", where, problem, hint, self.jumps > ERROR_JUMP_SHARE * self.rows)
