"""What can go wrong, and who can mend it: the errors that reach a user.

Every error that reaches a user is an :class:`EgvsError`. Its text is one line (or a short list of lines) that names the
place (file, key or row), what was found there, and what would be right. ``exit_code`` is what the command line ends
with.
"""

from __future__ import annotations


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
        self.place, self.found, self.right = str(place), found, right
        super().__init__(f"{place}: {found}" + (f"; {right}" if right else ""))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return InputError, (self.place, self.found, self.right)  # to be told in another process


class RunError(EgvsError):
    """The input was accepted, but the run could not keep its promise (for example: N vehicles in every frame)."""


class MissingBackendError(RunError):
    """A program or library that the run needs is not installed or cannot start."""


class MissingExtraError(MissingBackendError):
    """The user asked for a part whose libraries only an extra of this package brings, and it was not installed."""

    exit_code = InputError.exit_code
