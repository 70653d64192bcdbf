"""Hides what only POSIX systems have, so that the code for Windows runs here: ``make test-portable``.

psutil is imported before, because on Linux it needs ``resource`` itself.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import psutil  # noqa: F401

for module in ("fcntl", "resource"):
    sys.modules[module] = None  # type: ignore[assignment]
for flag in ("O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC"):
    if hasattr(os, flag):
        delattr(os, flag)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out the test of a benchmark that measures with ``resource``."""
    return True if collection_path.name == "test_file_checks.py" else None
