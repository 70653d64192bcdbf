"""Hides what only POSIX systems have, so that the code for Windows runs here: ``make test-portable``.

Only tests that can depend on the system run; see :mod:`tests.platform_tests`.

psutil is imported before, because on Linux it needs ``resource`` itself.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import psutil  # noqa: F401
import pytest

from tests.platform_tests import ROOT, platform_tests
from tests.system_tests import SYSTEM

for module in ("fcntl", "resource"):
    sys.modules[module] = None  # type: ignore[assignment]
for flag in ("O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC"):
    if hasattr(os, flag):
        delattr(os, flag)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out files whose tests only compute, and the test of a benchmark that measures with ``resource``."""
    name = collection_path.name
    if not (name.startswith("test_") and name.endswith(".py")):
        return None
    is_system = collection_path.relative_to(ROOT).as_posix().startswith(SYSTEM)
    return True if is_system or name == "test_file_checks.py" or not platform_tests(collection_path) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect tests that only compute."""
    selected, deselected = [], []
    for item in items:
        name = item.nodeid.split("::")[1].split("[")[0]
        (selected if name in platform_tests(item.path) else deselected).append(item)
    items[:] = selected
    config.hook.pytest_deselected(items=deselected)
