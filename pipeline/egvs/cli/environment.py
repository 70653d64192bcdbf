"""Check what the shell hands over before a command starts: its arguments, environment variables and limits."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from egvs.core import files, platform
from egvs.core.errors import InputError

MIN_ADDRESS_SPACE_MB = 4000
"""Smallest limit of the address space. Libraries map far more than they use; where that fails, some end the process,
and some go on with errors that say something else."""

_OPTION_WITHOUT_VALUE = re.compile(r"(--[\w-]+)=")
_VARIABLES = ("EGVS_STORE", "SUMO_HOME", "TMPDIR")
"""Environment variables with names of folders."""


def check_environment(arguments: Sequence[str]) -> None:
    """Check the arguments, the working directory, and what the shell has set for this process.

    Raises
    ------
    InputError
        When an argument is empty, a name is not UTF-8, or a setting keeps the program from working.
    """
    for number, argument in enumerate(arguments):
        option = _OPTION_WITHOUT_VALUE.fullmatch(argument)
        if argument == "" or option:
            before = arguments[number - 1] if number and arguments[number - 1].startswith("-") else "an argument"
            where = option.group(1) if option else before
            raise InputError(where, "expected a value, got an empty text", "Give a value, or leave the option out.")
        files.check_utf8("the command line", argument)
    files.check_utf8("the working directory", os.getcwd())  # noqa: PTH109 - as text
    for name in _VARIABLES:
        files.check_utf8(name, os.environ.get(name, ""))

    if os.environ.get("NUMBA_DISABLE_JIT", "0").strip() not in ("", "0"):
        problem = "numba must compile, but this variable forbids it"
        raise InputError("NUMBA_DISABLE_JIT", problem, "Unset it: unset NUMBA_DISABLE_JIT.")
    limit_mb = platform.address_space_limit_mb()
    if limit_mb is not None and limit_mb < MIN_ADDRESS_SPACE_MB:
        problem = f"expected at least {MIN_ADDRESS_SPACE_MB:,} MB of address space, got {limit_mb:,.0f} MB"
        raise InputError("ulimit -v", problem, f"Raise the limit: ulimit -v {MIN_ADDRESS_SPACE_MB * 1000}.")
