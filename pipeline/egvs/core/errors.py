"""The errors that reach a user, suggestions for misspelt names, and diagnostics about a scenario or a run.

Every error that reaches a user is an :class:`EgvsError`. Its text names the file, the key or row, what is wrong, and
what to do. ``exit_code`` is the exit code of the command line.

A :class:`Diagnostic` is an error or a warning about a scenario. A stage stores its warnings in its summary under
:data:`WARNINGS_KEY`, in the form that :meth:`Diagnostic.to_json` returns.

:func:`find_misspelling` finds the known name that a user may have meant.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from egvs.core.wording import list_first

MAX_LINE_LENGTH, MAX_LINES = 600, 30
"""Limits of a message in characters and lines."""

_MORE = re.compile(r"\.\.\. and [0-9,]+ more")

Item = TypeVar("Item")
Parsed = TypeVar("Parsed")

_CONTROL_CHARACTERS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that control a terminal, and lone surrogates, which cannot be encoded."""

_DECIMAL_COMMA = re.compile(
    r"(?:number|metres|height|angle|pose|invalid value)\b.*'[-+]?\d*,\d+'|'[-+]?\d*,\d+' as a scalar"
)
"""A problem with a number that is written with a decimal comma."""

DECIMAL_COMMA_HINT = "Write numbers with a decimal point, not with a decimal comma."
"""Hint of an error about such a number."""


class EgvsError(Exception):
    """Base of all errors that this program raises on purpose."""

    exit_code = 1


class InputError(EgvsError):
    """The user's input is wrong: a scenario, a file that it names, an option, or an artefact that was altered.

    Parameters
    ----------
    where
        File and, where known, the key or row, e.g. ``"scenario.toml: roi.voxel_m"``.
    problem
        What is wrong, e.g. ``"expected a length above 0 m, got -0.25"``.
    hint
        What to do, as a sentence, e.g. ``"Use a length such as 0.25."``.
    """

    exit_code = 2

    def __init__(self, where: object, problem: str, hint: str = "") -> None:
        self.where = truncate_text(str(where))
        self.problem = truncate_text(problem)
        if _DECIMAL_COMMA.search(self.problem) and not hint.startswith("\n"):  # further errors, but no hint
            hint = DECIMAL_COMMA_HINT
        self.hint = truncate_text(hint)
        super().__init__(format_problem(self.where, self.problem, self.hint))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return InputError, (self.where, self.problem, self.hint)  # for another process


def check_list(name: str, value: object) -> None:
    """Raise an InputError if an argument that lists texts is one text, whose letters would be taken one by one."""
    if isinstance(value, str):
        raise InputError(name, f"expected a list of texts, got {value!r}", f"Write brackets: {name}=[{value!r}].")


class RunError(EgvsError):
    """The input is valid, but the run could not do what it asks for (for example: N vehicles in every frame)."""


class MissingBackendError(RunError):
    """A program or library that the run needs is not installed or cannot start."""


class MissingExtraError(MissingBackendError):
    """A feature needs the libraries of an extra of this package that is not installed."""

    exit_code = InputError.exit_code


def format_problem(where: str, problem: str, hint: str = "") -> str:
    """Return ``WHERE: PROBLEM. HINT``."""
    if not hint or hint.startswith("\n"):  # further errors, but no hint
        return f"{where}: {problem}{hint}"
    return f"{where}: {problem}. {hint}"


def truncate_text(text: str) -> str:
    """Shorten a text to the length of a message, and escape control characters; a shortened one stays as it is."""
    lines = text.split("\n")
    is_short = len(lines) == MAX_LINES + 1 and _MORE.fullmatch(lines[-1]) is not None
    short = [_truncate_line(line) for line in lines[: MAX_LINES + is_short]]
    if len(lines) > MAX_LINES and not is_short:
        short.append(f"... and {len(lines) - MAX_LINES:,} more")
    return "\n".join(short)


def _truncate_line(line: str) -> str:
    if len(line) > MAX_LINE_LENGTH:
        end = MAX_LINE_LENGTH // 4
        line = f"{line[: MAX_LINE_LENGTH - end]} ... ({len(line):,} characters) ... {line[-end:]}"
    return escape_control_characters(line)


def escape_control_characters(text: str) -> str:
    """Return a text in which characters that control a terminal, except tabs and line breaks, are escapes."""
    return _CONTROL_CHARACTERS.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


WARNINGS_KEY = "warnings"
"""The key of a stage's summary that holds its warnings."""


@dataclass(frozen=True)
class Diagnostic:
    """An error or a warning: what the user should know before trusting a ranking.

    Attributes
    ----------
    rule
        Name of the rule, e.g. ``"sites on lanes"``. It never changes.
    where
        File and key or row, or coordinates in the world frame.
    problem
        What is wrong, with numbers.
    hint
        What to do about it.
    is_error
        Whether it stops the run.
    """

    rule: str
    where: str
    problem: str
    hint: str
    is_error: bool = False

    def __str__(self) -> str:
        return format_problem(self.where, self.problem, self.hint)

    @classmethod
    def of(cls, rule: str, error: InputError) -> Diagnostic:
        """Convert an InputError."""
        return cls(rule, error.where, error.problem, error.hint, is_error=True)

    def to_json(self) -> dict[str, Any]:
        """The form in a stage's summary."""
        return asdict(self)


def collect_warnings(summaries: Iterable[Mapping[str, Any]]) -> list[Diagnostic]:
    """Return the warnings in the summaries of stages, in their order."""
    return [Diagnostic(**value) for summary in summaries for value in summary.get(WARNINGS_KEY, ())]


def with_relative_paths(folder: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """Return a stage's summary with the files in its warnings relative to the scenario's folder.

    Reports and cached results must not depend on where that folder is.
    """
    prefix = f"{folder}{os.sep}"
    warnings = [w | {"where": w["where"].removeprefix(prefix)} for w in summary.get(WARNINGS_KEY, ())]
    if not warnings:
        return summary
    return summary | {WARNINGS_KEY: warnings}


class DiagnosticsError(InputError):
    """All errors that prevent a run, at least one.

    Parameters
    ----------
    findings
        The errors.
    warnings
        Warnings that were found as well.
    """

    def __init__(self, findings: Iterable[Diagnostic], warnings: Iterable[Diagnostic] = ()) -> None:
        self.findings = tuple(findings)
        self.warnings = tuple(warnings)
        first, *others = self.findings
        super().__init__(first.where, first.problem, "\n".join([first.hint, *map(str, others)]))


def raise_together(errors: Iterable[InputError], rule: str) -> None:
    """Raise the errors of a file as one, if it has any.

    The same problem in several rows, such as a misspelt column, is reported once with the first rows.

    Parameters
    ----------
    errors
        In the order of the file.
    rule
        The rule of each :class:`Diagnostic`.
    """
    rows: dict[tuple[str, str], dict[str, None]] = {}
    for error in errors:
        findings = error.findings if isinstance(error, DiagnosticsError) else (error,)
        for finding in findings:
            rows.setdefault((finding.problem, finding.hint), {})[finding.where] = None
    grouped = [
        Diagnostic(rule, _list_locations(list(locations)), problem, hint, is_error=True)
        for (problem, hint), locations in rows.items()
    ]
    if len(grouped) == 1:
        raise InputError(grouped[0].where, grouped[0].problem, grouped[0].hint)
    if grouped:
        raise DiagnosticsError(grouped)


def parse_each(items: Iterable[Item], parse: Callable[[Item], Parsed], rule: str) -> list[Parsed]:
    """Parse all items, and raise the errors of all of them as one (:func:`raise_together`)."""
    parsed: list[Parsed] = []
    errors: list[InputError] = []
    for item in items:
        try:
            parsed.append(parse(item))
        except InputError as error:
            errors.append(error)
    raise_together(errors, rule)
    return parsed


def _list_locations(locations: Sequence[str]) -> str:
    """Return the first locations; the file that they begin with is named once."""
    file = locations[0].partition(": ")[0] + ": "
    others = [where.removeprefix(file) for where in locations[1:]]
    return list_first([locations[0], *others], _MAX_LOCATIONS)


_MAX_LOCATIONS = 3
_UNIT_SUFFIX = re.compile(r"[_ ]*[(\[]?(m|deg|rad|°)[)\]]?$")
_MIN_SIMILARITY = 0.8
"""Names that share more of their letters than this are similar."""
_MAX_NAME_LENGTH = 80


def find_misspelling(names: Iterable[str], known: Collection[str]) -> tuple[str, str] | None:
    """Find the first unknown name that is similar to a known one.

    Similar: equal except for the unit, or for a letter or two (``yaw``, ``Yaw_deg`` and ``yaw_dge`` for ``yaw_deg``).

    Parameters
    ----------
    names
        The names that a user wrote.
    known
        The names that are allowed; those that are among ``names`` already are not suggested.

    Returns
    -------
    tuple of str, or None
        The unknown name, and the known one.
    """
    given = list(names)
    missing = {name.lower(): name for name in known if name not in given}
    stems = {_UNIT_SUFFIX.sub("", low): name for low, name in missing.items()}
    for name in given:
        if name in known:
            continue
        low = name.strip().lower()
        if meant := stems.get(_UNIT_SUFFIX.sub("", low)):
            return name, meant
        near = _similar_name(low, tuple(missing))
        if near is not None:
            return name, missing[near]
    return None


@lru_cache(maxsize=10_000)
def _similar_name(name: str, known: tuple[str, ...]) -> str | None:
    """Return the most similar known name; a file may repeat its columns in each of its rows."""
    if len(name) > _MAX_NAME_LENGTH:  # the time grows with the square of the length
        return None
    near = difflib.get_close_matches(name, known, 1, _MIN_SIMILARITY)
    return near[0] if near and _name_similarity(name, near[0]) > _MIN_SIMILARITY else None


def closest_first(name: str, known: Iterable[str]) -> list[str]:
    """Return known names in the order of their similarity to an unknown one; those that begin with it come first.

    Examples
    --------
    >>> closest_first("k03", ["k01@3m", "k02@3m", "k03@3m", "k03@6m"])[:2]
    ['k03@3m', 'k03@6m']
    >>> closest_first("levl", ["behind", "tilted", "level"])[0]
    'level'
    """
    low = name.strip().lower()

    def distance(other: str) -> float:
        return -1.0 if low and other.lower().startswith(low) else 1.0 - _name_similarity(low, other.lower())

    return sorted(known, key=distance)


def choose_one(name: str, known: Sequence[str]) -> str:
    """Return a hint that lists known names for an unknown one, the most similar ones first.

    Examples
    --------
    >>> choose_one("levl", ["behind", "tilted", "level"])
    'Choose one of level, tilted, behind.'
    """
    listed = list_first(closest_first(name, known), _MAX_NAMES)
    if len(known) > _MAX_NAMES:
        listed += " (the most similar first)"
    return f"Choose one of {listed}."


_MAX_NAMES = 8


def unknown_site(
    where: object, name: str, known: Sequence[str], of: str = "there is", noun: str = "site"
) -> InputError:
    """Return the error for an unknown site, with the sites that exist.

    Parameters
    ----------
    where
        Option, or file and key.
    name
        The unknown name.
    known
        The sites.
    of
        Beginning of the sentence, e.g. "this run has".
    noun
        "pole or site" where both are meant; then ``known`` are poles.
    """
    return InputError(where, f"{of} no {noun} {name!r}", choose_one(name, known))


def _name_similarity(a: str, b: str) -> float:
    return difflib.SequenceMatcher(None, b, a).ratio()
