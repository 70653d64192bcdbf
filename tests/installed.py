"""Marks of tests of the core that also use extensions: they run with the complete program only."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

EXTENSIONS = ("city", "desk", "hardware", "maps", "tracks", "validation")

COMPLETE = ("tests/extensions/", "tests/benchmarks/", "tests/docs/", "tests/fuzz/", "tests/install/")
"""Tests of extensions and of the complete program."""


def needs(*extensions: str) -> pytest.MarkDecorator:
    """Return the mark of a test of the core that uses extensions."""
    return pytest.mark.needs(*extensions)


def mark_complete(item: pytest.Item) -> None:
    """Mark a test that the core alone cannot pass, and skip it where an extension that it needs is missing."""
    extensions = [name for mark in item.iter_markers("needs") for name in mark.args]
    missing = [name for name in extensions if find_spec(f"egvs.extensions.{name}") is None]
    if missing:
        item.add_marker(pytest.mark.skip(reason=f"needs the extensions {', '.join(missing)}"))
    if extensions or item.nodeid.startswith(COMPLETE):
        item.add_marker("complete")
