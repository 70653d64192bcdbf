"""Marks of tests of the core that also use an extension: without it, they are skipped."""

from __future__ import annotations

import pytest

from egvs.cli.commands import GROUP
from egvs.core import plugins


def needs(extension: str) -> pytest.MarkDecorator:
    """Return the mark of a test that uses commands of an extension."""
    return pytest.mark.skipif(extension not in plugins.plugin_names(GROUP), reason=f"needs the extension {extension}")
