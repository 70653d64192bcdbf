"""Which test files ``make test-portable`` runs: those whose result can depend on the operating system.

A module depends on it when it names one of :data:`PLATFORM_NAMES`. A test file is chosen when it imports such a module,
or when it runs commands (fixture ``run_egvs``), which lock and write run folders. All other tests only compute: they
would repeat what ``make test`` has shown.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "pipeline"

PLATFORM_NAMES = re.compile(
    r"\b(fcntl|msvcrt)\b|\bimport (platform|resource)\b|\bcore(\.| import .*)platform\b|\bsys\.platform\b"
    r"|\bos\.(name|get\w*uid|sched_\w+|lockf)\b|\bO_(NOFOLLOW|DIRECTORY|CLOEXEC|PATH)\b"
    r"|\b(getattr|hasattr)\((os|signal)\b|\bsignal\.(SIGALRM|SIGKILL|setitimer|pthread_\w+)\b"
)
"""What differs between operating systems, as it reads in source code."""


def imported_names(source: str) -> set[str]:
    """Return all imports in Python source, also inside functions: ``a`` and ``a.b`` for ``from a import b``."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@cache
def platform_modules() -> frozenset[str]:
    """Return the modules of the package that depend on the operating system, with dots."""
    return frozenset(
        ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        for path in (SOURCE / "egvs").rglob("*.py")
        if PLATFORM_NAMES.search(path.read_text(encoding="utf-8"))
    )


def depends_on_platform(test_file: Path) -> bool:
    """Return whether the tests of a file can have other results on another operating system."""
    source = test_file.read_text(encoding="utf-8")
    return "run_egvs" in source or not platform_modules().isdisjoint(imported_names(source))
