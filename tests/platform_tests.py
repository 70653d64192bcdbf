"""Which tests ``make test-portable`` runs: those whose result can depend on the operating system.

A module depends on it when it names one of :data:`PLATFORM_NAMES`. A test is chosen when it uses what its file imports
from such a module, or when it runs commands (fixture ``run_egvs``), which lock and write run folders; itself, or by a
function or fixture of its file. All other tests only compute: they would repeat what ``make test`` has shown.
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


@cache
def platform_tests(test_file: Path) -> frozenset[str]:
    """Return the names of the tests, and classes of tests, of a file that can have other results on another system."""
    tree = ast.parse(test_file.read_text(encoding="utf-8"))
    dependent = {"run_egvs"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            dependent |= {alias.asname or "egvs" for alias in node.names if alias.name in platform_modules()}
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported = {f"{node.module}.{alias.name}": alias.asname or alias.name for alias in node.names}
            is_platform = node.module in platform_modules()
            dependent |= {name for path, name in imported.items() if is_platform or path in platform_modules()}

    uses = {name: _names_in(statement) for statement in tree.body for name in _defined_names(statement)}
    while more := {name for name, used in uses.items() if name not in dependent and not used.isdisjoint(dependent)}:
        dependent |= more
    tests = {name for name in uses if name.startswith(("test_", "Test"))}
    if any("autouse" in uses.get(name, ()) for name in dependent):
        return frozenset(tests)
    return frozenset(tests & dependent)


def _defined_names(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    return {node.id for node in ast.walk(statement) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}


def _names_in(statement: ast.stmt) -> set[str]:
    """Return the names that a statement reads, its parameters, keywords and strings: all that can name a fixture."""
    names = set()
    for node in ast.walk(statement):
        match node:
            case ast.Name(id=name) | ast.arg(arg=name) | ast.keyword(arg=str(name)) | ast.Constant(value=str(name)):
                names.add(name)
    return names
