"""Hides what only POSIX systems have, so that the code for Windows runs here: ``pytest -p tests.without_posix``."""

from __future__ import annotations

import os
import sys

for module in ("fcntl", "resource"):
    sys.modules[module] = None  # type: ignore[assignment]
for flag in ("O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC"):
    if hasattr(os, flag):
        delattr(os, flag)
