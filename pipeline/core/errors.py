"""What can go wrong, and who can mend it: the errors that reach a user.

Every error that reaches a user is an :class:`EgvsError`. Its text is one line (or a short list of lines) that names the
place (file, key or row), what was found there, and what would be right. ``exit_code`` is what the command line ends
with.
"""

from __future__ import annotations

import re

LONGEST_LINE, MOST_LINES = 600, 200
"""Characters and lines of a message: a file's whole content helps nobody."""

_STEERS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Signs that a terminal obeys, and halves of characters, which no file can hold."""


class EgvsError(Exception):
    """Base of all errors that this program raises on purpose."""

    exit_code = 1


class InputError(EgvsError):
    """The user's input is wrong: a scenario, a file that it names, an option, or an artefact that was altered.

    Parameters
    ----------
    place
        File, and where known the key or row, e.g. ``"scenario.toml: roi.voxel_m"``.
    found
        What stands there, e.g. ``"-0.25"`` or ``"no such file"``.
    right
        What would be right, e.g. ``"a length above 0 m"``.
    """

    exit_code = 2

    def __init__(self, place: object, found: str, right: str = "") -> None:
        self.place, self.found, self.right = cut(str(place)), cut(found), cut(right)
        super().__init__(f"{self.place}: {self.found}" + (f"; {self.right}" if right else ""))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return InputError, (self.place, self.found, self.right)  # to be told in another process


class RunError(EgvsError):
    """The input was accepted, but the run could not keep its promise (for example: N vehicles in every frame)."""


class MissingBackendError(RunError):
    """A program or library that the run needs is not installed or cannot start."""


class MissingExtraError(MissingBackendError):
    """The user asked for a part whose libraries only an extra of this package brings, and it was not installed."""

    exit_code = InputError.exit_code


def cut(text: str) -> str:
    """A text without what is too long for a message, and without signs that would steer a terminal."""
    lines = text.split("\n")
    shown = [_cut_line(line) for line in lines[:MOST_LINES]]
    return "\n".join([*shown, f"... and {len(lines) - MOST_LINES:,} more"] if len(lines) > MOST_LINES else shown)


def _cut_line(line: str) -> str:
    if len(line) > LONGEST_LINE:
        end = LONGEST_LINE // 4
        line = f"{line[: LONGEST_LINE - end]} ... ({len(line):,} characters) ... {line[-end:]}"
    return _STEERS.sub(lambda sign: sign[0].encode("unicode_escape").decode("ascii"), line)
