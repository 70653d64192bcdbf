"""Check one change in a minute: lint, types, contracts, and the tests nearest to what changed.

usage: python .ci/changed.py [BASE]

What changed is what differs from the last commit that this branch has in common with BASE (default: main), with files
that are not committed. Of the tests, those run that import a changed module, and the unit tests of its package and of
files that import a module which imports it. A changed page or schema runs the tests of the pages. `make test` runs all.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
PAGES = ("docs/", "README.md", "CHANGELOG.md", "data_schemas/", "scenarios/")
"""What the tests in ``tests/docs`` read."""
PROJECT = ("pyproject.toml", "constraints.txt", "Makefile", ".ci/", ".github/")
TRAINING = "tests/extensions/validation/training/"
MOST_INDIRECT = 50
"""Files of tests; more take longer than a minute."""


def main() -> int:
    """Run the checks, print those that fail, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", nargs="?", default="main")
    begin_s = time.monotonic()
    changed = list_changed_files(parser.parse_args().base)
    near, far = choose_tests(changed)
    print(f"{len(changed)} files changed; tests: {len(near)} files, and the unit tests of {len(far)} more", flush=True)

    with ThreadPoolExecutor() as pool:
        lint = pool.submit(run_all, list(lint_commands()))
        tests = pool.submit(run_all, list(test_commands(near, far)))
        failed = lint.result() + tests.result()
    print(f"{'failed: ' + ', '.join(failed) if failed else 'all passed'} in {time.monotonic() - begin_s:.0f} s")
    return 1 if failed else 0


def list_changed_files(base: str) -> list[str]:
    """Paths that differ from the common ancestor with `base`, and untracked ones, without those deleted."""
    ancestor = git("merge-base", "HEAD", base).strip()
    paths = git("diff", "--name-only", ancestor).splitlines()
    paths += git("ls-files", "--others", "--exclude-standard").splitlines()
    return sorted({path for path in paths if (ROOT / path).is_file()})


def git(*arguments: str) -> str:
    """Return the output of a git command."""
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout


def choose_tests(changed: list[str]) -> tuple[list[str], list[str]]:
    """Test files that import what changed, and those of the same package or that import what imports it directly."""
    modules = {name for path in changed if (name := module_name(path))}
    graph = grimp.build_graph("egvs", cache_dir=None)
    importers = set()
    for module in modules & graph.modules:
        importers |= graph.find_modules_that_directly_import(module)
    folders = {f"tests/{'/'.join(name.split('.')[1:-1])}/" for name in modules & graph.modules}

    near, package, indirect = set(), set(), set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        name = path.relative_to(ROOT).as_posix()
        imported = set(imported_modules(path))
        if name.startswith(TRAINING):
            continue
        if name in changed or imported & modules:
            near.add(name)
        elif name.startswith(tuple(folders)):
            package.add(name)
        elif imported & importers:
            indirect.add(name)
    if len(indirect) > MOST_INDIRECT:
        print(f"left out: {len(indirect)} files of tests that use it indirectly; make test runs them")
        indirect = set()
    if any(path.startswith(PAGES) for path in changed):
        near.add("tests/docs")
    if any(path.startswith(PROJECT) for path in changed):
        near.update(("tests/test_architecture.py", "tests/test_project_files.py"))
    return sorted(near), sorted(package | indirect)


def module_name(path: str) -> str | None:
    """Return the dotted name of a module of the package or of the tests."""
    if not path.endswith(".py") or not path.startswith(("pipeline/", "tests/", "benchmarks/")):
        return None
    parts = Path(path.removeprefix("pipeline/")).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path) -> Iterator[str]:
    """Names of modules that a file imports, and of everything that it imports from one."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def lint_commands() -> Iterator[list[str]]:
    """Commands of `make lint`, the fast ones first."""
    yield [str(BIN / "ruff"), "check", "."]
    yield [str(BIN / "ruff"), "format", "--check", "."]
    yield [str(BIN / "codespell"), ".", ".github"]
    yield [str(BIN / "lint-imports")]
    yield [str(BIN / "mypy")]


def test_commands(near: list[str], far: list[str]) -> Iterator[list[str]]:
    """Commands that run the chosen tests."""
    for marks, paths in (("not slow", near), ("unit", far)):
        if paths:
            yield [sys.executable, "-m", "pytest", "-q", "-m", marks, *paths]


def run_all(commands: Iterable[list[str]]) -> list[str]:
    """Run commands one after the other, print the output of those that fail, and return their names."""
    failed = []
    for command in commands:
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if result.returncode not in (0, 5):  # pytest: 5 if no test has the marks
            failed.append(" ".join([Path(command[0]).name, *command[1:5]]))
            print(result.stdout[-8000:] + result.stderr[-2000:], flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
