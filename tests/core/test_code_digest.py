"""The digest of the program's source: it sees what a module imports, and nothing else.

Evidence: the syntax tree of every module of the package against the pattern that reads imports; copies of the package
with one line changed.
"""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import egvs
from egvs.runs import stage_keys, stage_registry

PACKAGE = Path(egvs.__file__).parent
STAGES = ("check", "statics", "scan", "traffic", "tpog", "score", "report")


def imports_by_syntax_tree(text: str, package: str) -> set[str]:
    """What a module imports when it runs, from its syntax tree."""
    tree = ast.parse(text)
    never = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for statement in node.body
        for inner in ast.walk(statement)
    }
    found = set()
    for node in ast.walk(tree):
        if id(node) in never:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            beginning = ".".join(package.split(".")[: 1 - node.level or None]) if node.level else ""
            module = ".".join(part for part in (beginning, node.module) if part)
            found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_import_pattern_matches_syntax_tree(path: Path) -> None:
    text, package = path.read_text(encoding="utf-8"), "egvs.x"
    assert imports_by_syntax_tree(text, package) <= set(stage_keys.imported_names(text, package))
    others = set(stage_keys.imported_names(text, package)) - imports_by_syntax_tree(text, package)
    in_docstring = {name for name in others if path.name == "__init__.py" and name.startswith("egvs.extensions")}
    assert others - in_docstring <= {"egvs"}


KINDS_OF_IMPORT = """
import a, b.c as d  # , no
from . import e
from ..f import (
    g,  # not h
    i as j,
)
if TYPE_CHECKING:
    from k import l

    import m
def n():
    from o.p import q, r
"""


def test_finds_every_kind_of_import() -> None:
    expected = ["a", "b.c", "x.y", "x.y.e", "x.f", "x.f.g", "x.f.i", "o.p", "o.p.q", "o.p.r"]
    assert list(stage_keys.imported_names(KINDS_OF_IMPORT, "x.y")) == expected
    assert imports_by_syntax_tree(KINDS_OF_IMPORT, "x.y") == set(expected)


ROOTS = [(stage.module, *stage.code) for stage in map(stage_registry.stage, STAGES)]

DIGESTS = f"""
import json
from egvs.runs import stage_keys, stage_registry
print(json.dumps([stage_keys.source_digest(*modules).digest for modules in {ROOTS}]))
"""


def digests(folder: Path) -> list[str]:
    import json

    done = subprocess.run([sys.executable, "-c", DIGESTS], cwd=folder, check=True, capture_output=True, text=True)
    found: list[str] = json.loads(done.stdout)
    return found


CHANGED = {
    "kernels/traversal.py": {"score", "report"},
    "kernels/occupancy.py": {
        "check",
        "tpog",
        "scan",
        "score",
        "report",
    },  # whose depth of contact the other kernels share
    "kernels/foliage.py": set(),  # an effect's
    "kernels/ray_triangle.py": {"check", "scan", "score", "report"},  # without kept scans, these two cast
    "traffic/sumo_folder.py": {
        "check",
        "statics",
        "traffic",
        "scan",
        "score",
        "report",
    },  # beside what reads the network
    "core/grid.py": {"check", "statics", "scan", "traffic", "tpog", "score", "report"},
    "scoring/target_scores.json": {"score"},  # numbers beside the module of the same name
    "results/study_results.json": {"report"},
    "studies/accuracy.py": set(),
    "cli/app.py": set(),
    "__init__.py": set(),
}


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("file", CHANGED)
def test_changed_line_changes_digest_of_importers(file: str, tmp_path: Path) -> None:
    shutil.copytree(PACKAGE, tmp_path / "egvs", ignore=shutil.ignore_patterns("__pycache__"))
    before = digests(tmp_path)
    assert before == [
        stage_keys.source_digest(*modules).digest for modules in ROOTS
    ]  # the same source elsewhere is the same
    path = tmp_path / "egvs" / file
    path.write_text(path.read_text(encoding="utf-8") + "\n# changed\n", encoding="utf-8")
    after = digests(tmp_path)
    assert {name for name, one, other in zip(STAGES, before, after, strict=True) if one != other} == CHANGED[file]


def test_module_of_other_package_counts_with_its_imports(tmp_path: Path, monkeypatch) -> None:
    package = tmp_path / "somebody"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "model.py").write_text("RATE = 1\n")
    (package / "effect.py").write_text("from somebody import model\nfrom egvs.kernels import foliage\n")
    monkeypatch.syspath_prepend(str(tmp_path))

    def digest() -> stage_keys.SourceDigest:
        for remembered in (stage_keys.source_digest, stage_keys._digest_module, stage_keys._module_path):
            remembered.cache_clear()
        return stage_keys.source_digest("somebody.effect")

    before = digest()
    assert "numba" in before.libraries
    assert digest() == before
    (package / "model.py").write_text("RATE = 2\n")
    assert digest() != before


def test_library_versions_are_those_installed() -> None:
    import numpy

    assert stage_keys.library_versions(frozenset({"numpy"})) == {"numpy": numpy.__version__}
    assert stage_keys.source_digest("egvs.stages.scan").libraries >= {"numpy", "numba", "embreex", "pyarrow"}
    assert "numba" not in stage_keys.source_digest("egvs.stages.statics").libraries


MOST_LINES = {
    "check": 20_080,  # with comparisons of heights, sizes and speeds, of vehicles with roads and of limits, and plans
    "statics": 11_310,  # with the repair of polygons, and plans of signals, in German, too
    "scan": 14_500,  # 330 of them read the files of beams that makers give and offices write
    "traffic": 11_820,  # with plans of junctions, limits of sizes, and maps read in a process of their own
    "tpog": 4_510,  # with counts that are made while SUMO goes on, and the surfaces that effects lose returns on
    "score": 19_560,  # losses of returns are part of every score; what people notice, and levels of groups
    "report": 22_920,  # with the level of plans
}
"""Code lines behind the key of each stage, at most: a stage runs again whenever one of them changes."""


def code_lines(path: Path) -> int:
    """Lines that are neither empty, nor comments, nor docstrings."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    docstring_lines: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            docstring_lines.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return sum(
        1
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#") and number not in docstring_lines
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", MOST_LINES)
def test_source_behind_stage_key_stays_small(name: str) -> None:
    stage = stage_registry.stage(name)
    modules = [module for module in stage_keys.source_modules(stage.module, *stage.code) if module.startswith("egvs")]
    paths = [stage_keys._module_path(module) for module in modules]
    # An __init__.py lists public names and computes nothing.
    total = sum(code_lines(path) for path in paths if path is not None and path.name != "__init__.py")
    assert total <= MOST_LINES[name]
