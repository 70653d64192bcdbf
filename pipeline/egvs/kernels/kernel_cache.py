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
import io
import os
import pickle
import sys
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from egvs.core.cache_folder import find_cache_folder, read_checked, write_checked


class CheckedCache(FunctionCache):
    """The compiled versions of one function: a file for each signature and processor, each after its hash."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code of a signature, or None where there is no intact file.

        Numba refreshes its context here, which imports its implementations of all functions of Python and numpy. They
        serve to compile, not to load; loaded code needs the functions of the runtime only. The compiler refreshes the
        context by itself.
        """
        rtsys.initialize(target_context)
        key = self._index_key(sig, target_context.codegen())
        content = read_checked(self._file(key))
        if content is None:
            return None
        stored_key, payload = _KernelUnpickler(io.BytesIO(content)).load()
        if stored_key != key:
            return None
        return self._impl.rebuild(target_context, payload)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled code of a signature, where the folder can be written."""
        if not self._impl.check_cachable(data):
            return
        key = self._index_key(sig, data.codegen)
        write_checked(self._file(key), dumps((key, self._impl.reduce(data))))

    def _file(self, key: Any) -> Path:
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return Path(self.cache_path) / f"{self._impl.filename_base}.{name}.kernel"


class _KernelUnpickler(pickle.Unpickler):
    """Reads compiled code without importing the modules of numba and scipy that it was compiled with."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a class or function by name."""
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _rebuild_environment
        return super().find_class(module, name)


def _rebuild_environment(module: str, constants: list[Any], name: str) -> Any:
    """Return the environment of a compiled function, as numba does, but without importing its module.

    Compiled code of ``nopython`` functions reads the constants; the variables of the module are for other functions.
    """
    environment = lookup_environment(name)
    if environment is None:
        variables = sys.modules[module].__dict__ if module in sys.modules else {"__name__": module}
        environment = Environment(variables)
        environment.consts[:] = constants
        environment.env_name = name
        Environment._memo[name] = environment
    return environment


def use_cache_folder(kernels: Path) -> bool:
    """Choose the folder of compiled kernels; call it before the first kernel is compiled.

    It is the first one of :func:`egvs.core.cache_folder.find_cache_folder` that can be written.

    Parameters
    ----------
    kernels
        The folder of the package that holds the kernels of the core; those of extensions are in their folders
        ``kernels``.

    Returns
    -------
    bool
        False where no folder can be written; kernels are then not cached.
    """
    digest = hashlib.sha256(f"numba {numba.__version__} python {sys.version}".encode())
    package = kernels.parent
    for path in sorted([*kernels.rglob("*.py"), *package.glob("extensions/*/kernels/*.py")]):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    folder = find_cache_folder(kernels, "numba", digest.hexdigest(), os.environ.get("NUMBA_CACHE_DIR"))
    if folder is None:
        return False
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    return True
