"""A disk cache of compiled kernels that survives damage.

Numba keeps compiled code beside each source file and checks that file alone: a kernel that calls a changed kernel of
another file is not compiled again. Here, all compiled kernels lie in one folder whose name is a digest of the sources
of all kernels, of numba's version and of Python's.

Numba also trusts the content of its cache files; a truncated one crashes the program. Here, each file starts with the
hash of its content. A file that is damaged, belongs to another kernel or cannot be written is ignored, and the kernel
is compiled again.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

MAX_OLD_CACHES = 2
"""Number of caches of other sources that stay, the most recently used ones: a running program may need one."""

_HASH_BYTES = hashlib.sha256().digest_size


class CheckedCache(FunctionCache):
    """The compiled versions of one function: a file for each signature and processor, each after its hash."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code of a signature, or None where there is no intact file."""
        target_context.refresh()
        key = self._index_key(sig, target_context.codegen())
        try:
            data = self._file(key).read_bytes()
        except OSError:
            return None
        digest, content = data[:_HASH_BYTES], data[_HASH_BYTES:]
        if hashlib.sha256(content).digest() != digest:
            return None
        stored_key, payload = pickle.loads(content)
        if stored_key != key:
            return None
        return self._impl.rebuild(target_context, payload)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled code of a signature, where the folder can be written."""
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


def use_cache_folder(kernels: Path) -> bool:
    """Choose the folder of compiled kernels; call it before the first kernel is compiled.

    The first of these that can be written: the package's ``__pycache__``, the user's cache, the temporary directory.

    Parameters
    ----------
    kernels
        The folder of the package that holds all kernels.

    Returns
    -------
    bool
        False where no folder can be written; kernels are then not cached.
    """
    digest = hashlib.sha256(f"numba {numba.__version__} python {sys.version}".encode())
    for path in sorted(kernels.rglob("*.py")):
        digest.update(path.relative_to(kernels).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    name = f"numba-{digest.hexdigest()[:12]}"
    for parent in _candidate_folders(kernels):
        if _is_writable_folder(parent / name):
            numba.config.CACHE_DIR = str(parent / name)  # type: ignore[attr-defined]
            _remove_old_caches(parent, name)
            return True
    return False


def _candidate_folders(kernels: Path) -> Iterator[Path]:
    if folder := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(folder)
    else:
        yield kernels / "__pycache__"
        with suppress(RuntimeError):  # a user without a home
            yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "egvs"
    if not hasattr(os, "geteuid"):  # Windows, where the temporary folder is the user's
        return
    with suppress(OSError):
        temporary = Path(tempfile.gettempdir()) / f"egvs-{os.geteuid()}"
        temporary.mkdir(mode=0o700, exist_ok=True)
        status = temporary.lstat()
        is_private = status.st_uid == os.geteuid() and not status.st_mode & 0o022
        if stat.S_ISDIR(status.st_mode) and is_private:
            yield temporary  # nobody else can put a kernel there


def _is_writable_folder(folder: Path) -> bool:
    """Return whether a folder exists, or can be made, and files can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _remove_old_caches(parent: Path, name: str) -> None:
    with suppress(OSError):  # another process may be removing them too
        old = [path for path in parent.glob("numba-" + "?" * 12) if path.name != name]
        old.sort(key=lambda path: path.stat().st_mtime)
        for path in old[:-MAX_OLD_CACHES]:
            shutil.rmtree(path, ignore_errors=True)
