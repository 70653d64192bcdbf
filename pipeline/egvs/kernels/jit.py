"""The ``njit`` decorator of this program: numba is imported, and a kernel compiled, when a kernel is first called.

Loading numba takes longer than all else that a run without changes does, so modules of kernels load it only for the
first call. Compiled kernels are cached on disk (:mod:`egvs.kernels.kernel_cache`).
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

_DISPATCHER_LOCK = threading.RLock()
"""Held while a dispatcher is made: threads that call a kernel for the first time share one."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Kernel]:
    """Compile a kernel with ``numba.njit``: without the GIL, with numpy's division by zero, cached on disk.

    Parameters
    ----------
    **options
        Further options of ``numba.njit``, for example ``forceinline=True``.
    """

    def decorate(function: Callable[..., Any]) -> Kernel:
        return Kernel(function, options)

    return decorate


class Kernel:
    """A function that numba compiles for the types of its arguments when it is called.

    Parameters
    ----------
    function
        The function in Python.
    options
        Further options of ``numba.njit``.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        self._options = options
        self._made: Any = None

    def __call__(self, *arguments: Any) -> Any:
        """Call the compiled function."""
        return (self._made or self._dispatcher)(*arguments)

    @property
    def _dispatcher(self) -> Any:
        """Numba's dispatcher, which chooses among the compiled versions; a plain function under NUMBA_DISABLE_JIT."""
        with _DISPATCHER_LOCK:
            if self._made is None:
                self._made = _make_dispatcher(self._function, self._options)
        return self._made

    @property
    def _numba_type_(self) -> Any:
        """What numba asks for where another kernel calls this one."""
        return self._dispatcher._numba_type_

    @property
    def stats(self) -> Any:
        """Numba's statistics of the cache: how often compiled code was found there."""
        return self._dispatcher.stats


def _make_dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba

    from egvs.kernels.kernel_cache import CheckedCache

    is_cached = _has_cache_folder()
    dispatcher = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if is_cached and hasattr(dispatcher, "enable_caching"):  # a plain function under NUMBA_DISABLE_JIT
        dispatcher._cache = CheckedCache(function)  # numba has no public way to choose another cache
    return dispatcher


@functools.cache
def _has_cache_folder() -> bool:
    from egvs.kernels.kernel_cache import use_cache_folder

    return use_cache_folder(Path(__file__).resolve().parent)


def has_compiled_kernels() -> bool:
    """Return whether the cache has compiled kernels of these sources; True, too, where kernels are not cached."""
    if not _has_cache_folder():
        return True
    import numba

    folder = Path(numba.config.CACHE_DIR)  # type: ignore[attr-defined]
    return any(folder.rglob("*.kernel"))
