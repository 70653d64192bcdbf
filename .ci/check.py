"""Check the packages: sizes, imports against the rules, cycles of modules, and what each command reaches.

Imports count wherever they are: inside functions and for type checking, too. import-linter checks the same rules,
except for the imports that its contracts ignore; here these are shown with their lines, as work that is left. Exit code
1 while there is any, or while modules import each other in a circle.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import grimp
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "pipeline"
SAME_LAYER = {("kernels", "core")}
"""Packages of one layer of which the first may import the second; another contract says what."""
STAGES = ("check", "statics", "scan", "traffic", "tpog", "score")
MAY_IMPORT_REPORT = ("cli", "explore", "report")

COMMANDS = {
    "run": ["egvs.runs.run", *(f"egvs.stages.{name}" for name in STAGES), "egvs.report.page"],
    "new": ["egvs.creation.new_scenario"],
    "place": ["egvs.placement.plan"],
    "explore": ["egvs.explore.page"],
    "export": ["egvs.export.export"],
    "accuracy": ["egvs.studies.accuracy"],
}
"""The modules that a command of the core begins with."""


def main() -> int:
    """Print what is found, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--verbose", action="store_true", help="every forbidden import, not only three of a group")
    options = parser.parse_args()

    graph = grimp.build_graph("egvs", cache_dir=None)
    lines = {module: count_code_lines(module_path(module)) for module in graph.modules}
    print_sizes(lines)
    print_tests()
    print_commands(graph, lines)
    n_forbidden = print_forbidden_imports(graph, options.verbose)
    circles = find_circles(graph)
    print(f"modules that import each other in a circle: {len(circles)}")
    for circle in circles:
        print(f"  {', '.join(circle)}")
    return int(n_forbidden > 0 or len(circles) > 0)


def module_path(module: str) -> Path:
    """Return the file of a module."""
    path = SOURCE / Path(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def package_of(module: str) -> str:
    """Return the package of a module: ``"traffic"``, ``"extensions.maps"``; "" for the modules at the top."""
    parts = module.split(".")
    if len(parts) > 2 and parts[1] == "extensions":
        return ".".join(parts[1:3])
    return parts[1] if module_path(".".join(parts[:2])).name == "__init__.py" and len(parts) > 1 else ""


def is_extension(package: str) -> bool:
    """Return whether a package is an extension."""
    return package.startswith("extensions")


def count_code_lines(path: Path) -> int:
    """Return the number of lines of a file without blank lines, comments and docstrings."""
    text = path.read_text(encoding="utf-8")
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                docstrings.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    code = (number for number, line in enumerate(text.splitlines(), 1) if re.match(r"\s*[^\s#]", line))
    return sum(number not in docstrings for number in code)


def print_sizes(lines: dict[str, int]) -> None:
    """Print code lines and modules of each package, and of core and extensions."""
    size: Counter[str] = Counter()
    for module, count in lines.items():
        size[package_of(module)] += count
    n_modules = Counter(package_of(module) for module in lines)
    for package in sorted(size, key=lambda name: (is_extension(name), name)):
        print(f"{package or '(top)':<24}{n_modules[package]:>5} modules{size[package]:>8,} code lines")
    in_extensions = sum(count for package, count in size.items() if is_extension(package))
    print(f"core {size.total() - in_extensions:,} code lines, extensions {in_extensions:,}")


def print_tests() -> None:
    """Print how many test files import each extension, and which of them are not beside its other tests."""
    users: Counter[str] = Counter()
    elsewhere = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        names = set(re.findall(r"\begvs\.extensions\.(\w+)", path.read_text(encoding="utf-8")))
        users.update(names)
        if any(not path.is_relative_to(ROOT / "tests" / "extensions" / name) for name in names):
            elsewhere.append(str(path.relative_to(ROOT)))
    print("test files that name an extension:", ", ".join(f"{name} {users[name]}" for name in sorted(users)))
    print(f"of them outside the extension's own tests: {', '.join(elsewhere) or 'none'}")


def print_commands(graph: grimp.ImportGraph, lines: dict[str, int]) -> None:
    """Print how much each command of the core may import, and how much of that belongs to extensions."""
    for command, roots in COMMANDS.items():
        reached = set(roots)
        waiting = list(roots)
        while waiting:
            new = graph.find_modules_directly_imported_by(waiting.pop()) - reached - {"egvs"}
            reached |= new
            waiting += new
        extensions = Counter(package_of(module) for module in reached if is_extension(package_of(module)))
        names = ", ".join(f"{package} {count}" for package, count in sorted(extensions.items()))
        total = sum(lines[module] for module in reached)
        print(f"egvs {command}: {len(reached)} modules, {total:,} code lines; of extensions: {names or 'none'}")


def layer_ranks() -> dict[str, int]:
    """Return the layer of each package, 0 for the highest, from the contracts in ``pyproject.toml``."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    return {name: rank for rank, layer in enumerate(layers) for name in re.findall(r"\w+", layer)}


def broken_rule(importer: str, imported: str, ranks: dict[str, int]) -> str | None:
    """Return the rule that an import breaks, if any."""
    own, other = package_of(importer), package_of(imported)
    if own == other or not other or importer == "egvs.__main__":
        return None
    if is_extension(other):
        return "extensions do not import each other" if is_extension(own) else "the core imports no extension"
    if other == "report" and own not in MAY_IMPORT_REPORT and not importer.endswith("report_section"):
        return "only the command line, the explorer and report sections import the report"
    if is_extension(own) or not own or (own, other) in SAME_LAYER or ranks[own] < ranks[other]:
        return None
    return "layers"


def print_forbidden_imports(graph: grimp.ImportGraph, verbose: bool) -> int:
    """Print the imports that break a rule, by rule and packages, and return their number."""
    ranks = layer_ranks()
    groups: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for importer, imported in edges(graph):
        if rule := broken_rule(importer, imported, ranks):
            group = rule, package_of(importer) or "(top)", package_of(imported)
            for detail in graph.get_import_details(importer=importer, imported=imported):
                place = f"{module_path(importer).relative_to(SOURCE)}:{detail['line_number']}"
                groups[group].append(f"{place}: {detail['line_contents']}")
    total = sum(len(found) for found in groups.values())
    print(f"forbidden imports: {total}")
    for (rule, own, other), found in sorted(groups.items()):
        print(f"  {own} -> {other} ({rule}): {len(found)}")
        shown = found if verbose else found[:3]
        print("".join(f"    {line}\n" for line in shown), end="")
        if len(shown) < len(found):
            print(f"    and {len(found) - len(shown)} more")
    return total


def edges(graph: grimp.ImportGraph) -> Iterator[tuple[str, str]]:
    """Yield all imports as pairs of modules, in order."""
    for importer in sorted(graph.modules):
        for imported in sorted(graph.find_modules_directly_imported_by(importer)):
            yield importer, imported


def find_circles(graph: grimp.ImportGraph) -> list[list[str]]:
    """Return the groups of modules that import each other; a package imported by its own modules does not count."""
    modules = sorted(graph.modules)
    index = {module: number for number, module in enumerate(modules)}
    pairs = [(a, b) for a, b in edges(graph) if b != "egvs" and b != a.rpartition(".")[0]]
    rows, columns = [index[a] for a, _ in pairs], [index[b] for _, b in pairs]
    matrix = csr_matrix(([1] * len(pairs), (rows, columns)), shape=(len(modules), len(modules)))
    _, labels = connected_components(matrix, directed=True, connection="strong")
    groups: dict[int, list[str]] = defaultdict(list)
    for module, label in zip(modules, labels, strict=True):
        groups[label].append(module)
    return [group for group in groups.values() if len(group) > 1]


if __name__ == "__main__":
    sys.exit(main())
