"""Public names of packages that are imported on first use, so that importing a package costs nothing."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_exports(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package that imports its public names on first use (PEP 562).

    Parameters
    ----------
    package
        The package: ``__name__`` in its ``__init__.py``.
    modules
        Module, relative to the package or, from ``egvs.`` on, in full, to the public names that it defines.
    """
    module_of = {}
    for module, names in modules.items():
        full_name = module if module.startswith("egvs.") else f"{package}.{module}"
        module_of.update(dict.fromkeys(names, full_name))

    def get_attribute(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(module_of[name]), name)

    return get_attribute, lambda: sorted(module_of)
