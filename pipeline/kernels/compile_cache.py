"""Compiled kernels are kept for as long as no kernel's source changes.

Numba keeps what it compiled beside each source, and asks that file alone whether it is still right: a kernel that calls
another one from another file, which has changed, is not compiled again. So all kernels together are kept in one folder
that bears the digest of all their sources.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from contextlib import suppress
from pathlib import Path

KEPT = 2
"""Folders of other sources that are left, the last used ones: a program that still runs may use one."""


def keep_beside(kernels: Path) -> None:
    """Tell numba where to keep what it compiles of the package in the folder ``kernels``; call it before any of its
    modules is imported. Where neither that folder nor the user's cache can be written, numba chooses itself."""
    import numba

    every = hashlib.sha256()
    for path in sorted(kernels.rglob("*.py")):
        every.update(path.relative_to(kernels).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    name = f"numba-{every.hexdigest()[:12]}"
    for parent in _parents(kernels):
        try:
            (parent / name).mkdir(parents=True, exist_ok=True)
            os.utime(parent / name)
        except OSError:
            continue
        if os.access(parent / name, os.W_OK):
            numba.config.CACHE_DIR = str(parent / name)  # type: ignore[attr-defined]
            _remove_older(parent, name)
            return


def _parents(kernels: Path) -> list[Path]:
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(given)]
    return [kernels / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "egvs"]


def _remove_older(parent: Path, name: str) -> None:
    with suppress(OSError):  # another process removes them too
        others = [path for path in parent.glob("numba-" + "?" * 12) if path.name != name]
        for path in sorted(others, key=lambda path: path.stat().st_mtime)[:-KEPT]:
            shutil.rmtree(path, ignore_errors=True)
