"""Compiled kernels are kept for as long as no kernel's source changes, and believed only where they are undamaged.

Numba keeps what it compiled beside each source, and asks that file alone whether it is still right: a kernel that calls
another one from another file, which has changed, is not compiled again. So all kernels together are kept in one folder
that bears the digest of all their sources, of numba and of Python.

Numba also believes whatever lies there; a file that was cut ends the program. So each is written with its hash, and one
that is damaged, of another kernel, or cannot be written is as if it were not there: the kernel is compiled again.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

KEPT = 2
"""Folders of other sources that are left, the last used ones: a program that still runs may use one."""

_HASH_BYTES = hashlib.sha256().digest_size
_is_kept = True
"""Whether there is any folder that can be written."""


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel: compiled by numba for all threads, divisions as numpy's, and kept; ``options`` are numba's."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(nogil=True, error_model="numpy", **options)(function)
        if _is_kept and hasattr(dispatcher, "enable_caching"):  # not where NUMBA_DISABLE_JIT leaves the function
            dispatcher._cache = _CheckedCache(function)
        return dispatcher

    return decorate


class _CheckedCache(FunctionCache):
    """What is kept of one function: a file for each signature and processor, with its hash before it."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What was compiled for a signature; None where there is none that is whole."""
        target_context.refresh()
        key = self._index_key(sig, target_context.codegen())
        try:
            data = self._file(key).read_bytes()
        except OSError:
            return None
        digest, content = data[:_HASH_BYTES], data[_HASH_BYTES:]
        if hashlib.sha256(content).digest() != digest:
            return None
        its_key, payload = pickle.loads(content)
        return self._impl.rebuild(target_context, payload) if its_key == key else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled for a signature; nothing where it cannot be written."""
        if not self._impl.check_cachable(data):
            return
        key = self._index_key(sig, data.codegen)
        content = dumps((key, self._impl.reduce(data)))
        path = self._file(key)
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
                try:
                    file.write(hashlib.sha256(content).digest() + content)
                    file.close()
                    Path(file.name).replace(path)
                except OSError:
                    Path(file.name).unlink(missing_ok=True)

    def _file(self, key: Any) -> Path:
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return Path(self.cache_path) / f"{self._impl.filename_base}.{name}.kernel"


def keep_beside(kernels: Path) -> None:
    """Choose where to keep what is compiled of the package in the folder ``kernels``; call it before any of its modules
    is imported. Where neither that folder nor the user's cache can be written, it is kept in the temporary directory,
    and where that cannot either, nowhere."""
    global _is_kept
    every = hashlib.sha256(f"numba {numba.__version__} python {sys.version}".encode())
    for path in sorted(kernels.rglob("*.py")):
        every.update(path.relative_to(kernels).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    name = f"numba-{every.hexdigest()[:12]}"
    for parent in _parents(kernels):
        if _can_keep(parent / name):
            numba.config.CACHE_DIR = str(parent / name)  # type: ignore[attr-defined]
            _remove_older(parent, name)
            return
    _is_kept = False


def _can_keep(folder: Path) -> bool:
    """Whether a folder is there, made if need be, and takes files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _parents(kernels: Path) -> Iterator[Path]:
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(given)
    else:
        yield kernels / "__pycache__"
        with suppress(RuntimeError):  # a user without a home
            yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "egvs"
    with suppress(OSError):
        own = Path(tempfile.gettempdir()) / f"egvs-{os.geteuid()}"
        own.mkdir(mode=0o700, exist_ok=True)
        status = own.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022:
            yield own  # nobody else can lay a kernel there


def _remove_older(parent: Path, name: str) -> None:
    with suppress(OSError):  # another process removes them too
        others = [path for path in parent.glob("numba-" + "?" * 12) if path.name != name]
        for path in sorted(others, key=lambda path: path.stat().st_mtime)[:-KEPT]:
            shutil.rmtree(path, ignore_errors=True)
