"""Checks of arguments of the Python API."""

from __future__ import annotations

from egvs.core.errors import InputError


def check_instance(name: str, value: object, kind: type, source: str) -> None:
    """Raise an InputError if an argument is not of a class; ``source`` is the expression that makes one."""
    if not isinstance(value, kind):
        problem = f"expected a {kind.__name__}, got {type(value).__name__} {value!r}"
        raise InputError(name, problem, f"Use {source}.")
