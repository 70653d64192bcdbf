"""Help of commands without the libraries that it does not need.

``typer.rich_utils`` imports renderers of Markdown and of tracebacks, which highlight source code. No help text of this
program has either, and their import takes a third of the time of ``egvs --help``. While ``typer.rich_utils`` is
imported, empty modules stand in for them; and ``attr``, which rich imports where it is installed, appears to be
missing.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from typer.core import TyperCommand, TyperGroup

_UNUSED = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}
"""Modules that help does not need, and the class that is imported from each."""

_OPTIONAL = "attr"


class QuickHelpGroup(TyperGroup):
    """A group of commands whose help needs fewer imports."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help."""
        import_help()
        super().format_help(ctx, formatter)


class QuickHelpCommand(TyperCommand):
    """A command whose help needs fewer imports."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help."""
        import_help()
        super().format_help(ctx, formatter)


def import_help() -> None:
    """Import ``typer.rich_utils`` without what it does not need here."""
    if "typer.rich_utils" in sys.modules:
        return
    with _stand_ins():
        import typer.rich_utils  # noqa: F401


@contextmanager
def _stand_ins() -> Iterator[None]:
    """Replace the modules that are not needed, unless they are imported already."""
    added = {}
    for name, needed in _UNUSED.items():
        added[name] = ModuleType(name)
        setattr(added[name], needed, type(needed, (), {}))
    modules: dict[str, ModuleType | None] = {**added, _OPTIONAL: None}
    new = {name: module for name, module in modules.items() if name not in sys.modules}
    sys.modules.update(new)  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in new:
            del sys.modules[name]
