"""Marks of tests of the core that also use extensions: without them, they are skipped."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

EXTENSIONS = ("city", "desk", "hardware", "maps", "tracks", "validation")


def needs(*extensions: str) -> pytest.MarkDecorator:
    """Return the mark of a test that uses extensions."""
    missing = [name for name in extensions if find_spec(f"egvs.extensions.{name}") is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs the extensions {', '.join(missing)}")
