"""Hides what only POSIX systems have, so that the code for Windows runs here: ``make test-portable``.

Only tests that can depend on the system are collected; see :mod:`tests.platform_tests`.

psutil is imported before, because on Linux it needs ``resource`` itself.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import psutil  # noqa: F401

from tests.platform_tests import depends_on_platform

for module in ("fcntl", "resource"):
    sys.modules[module] = None  # type: ignore[assignment]
for flag in ("O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC"):
    if hasattr(os, flag):
        delattr(os, flag)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out tests that only compute, and the test of a benchmark that measures with ``resource``."""
    name = collection_path.name
    if not (name.startswith("test_") and name.endswith(".py")):
        return None
    return True if name == "test_file_checks.py" or not depends_on_platform(collection_path) else None
