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

import pipeline
from pipeline.core import code_digest

PACKAGE = Path(pipeline.__file__).parent
STAGES = [f"pipeline.stages.{name}" for name in ("check", "statics", "scan", "traffic", "tpog", "score")] + [
    "pipeline.report.page"
]


def by_syntax_tree(text: str, package: str) -> set[str]:
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
def test_the_pattern_sees_what_the_syntax_tree_sees(path: Path) -> None:
    text, package = path.read_text(encoding="utf-8"), "pipeline.x"
    assert by_syntax_tree(text, package) <= set(code_digest.imported(text, package))
    assert set(code_digest.imported(text, package)) - by_syntax_tree(text, package) <= {"pipeline"}  # in docstrings


ODD = """
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


def test_every_way_to_import_is_seen() -> None:
    expected = ["a", "b.c", "x.y", "x.y.e", "x.f", "x.f.g", "x.f.i", "o.p", "o.p.q", "o.p.r"]
    assert list(code_digest.imported(ODD, "x.y")) == expected
    assert by_syntax_tree(ODD, "x.y") == set(expected)


DIGESTS = f"""
import json
from pipeline.core import code_digest
print(json.dumps([code_digest.of(name).digest for name in {STAGES}]))
"""


def digests(folder: Path) -> list[str]:
    import json

    done = subprocess.run([sys.executable, "-c", DIGESTS], cwd=folder, check=True, capture_output=True, text=True)
    found: list[str] = json.loads(done.stdout)
    return found


CHANGED = {
    "kernels/march.py": {"score", "page"},
    "kernels/boxes.py": {"check", "tpog", "scan", "score", "page"},  # whose depth of contact the other kernels share
    "kernels/foliage.py": set(),  # an effect's
    "kernels/rays.py": {"check", "scan", "score", "page"},  # without kept scans, these two cast
    "traffic/sumo_folder.py": {"check", "statics", "traffic", "scan", "score", "page"},  # beside what reads the network
    "core/grid.py": {"check", "statics", "scan", "traffic", "tpog", "score", "page"},
    "scoring/targets/detectability.json": {"score"},  # numbers beside the module of the same name
    "report/evidence.json": {"page"},
    "studies/accuracy.py": set(),
    "cli/app.py": set(),
    "__init__.py": set(),
}


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("file", CHANGED)
def test_a_changed_line_changes_the_digest_of_what_imports_it(file: str, tmp_path: Path) -> None:
    shutil.copytree(PACKAGE, tmp_path / "pipeline", ignore=shutil.ignore_patterns("__pycache__"))
    before = digests(tmp_path)
    assert before == [code_digest.of(name).digest for name in STAGES]  # the same source elsewhere is the same
    path = tmp_path / "pipeline" / file
    path.write_text(path.read_text(encoding="utf-8") + "\n# changed\n", encoding="utf-8")
    after = digests(tmp_path)
    names = [name.rpartition(".")[2] for name in STAGES]
    assert {name for name, one, other in zip(names, before, after, strict=True) if one != other} == CHANGED[file]


def test_the_module_of_somebody_elses_class_counts_with_what_it_imports(tmp_path: Path, monkeypatch) -> None:
    package = tmp_path / "somebody"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "model.py").write_text("RATE = 1\n")
    (package / "effect.py").write_text("from somebody import model\nfrom pipeline.kernels import foliage\n")
    monkeypatch.syspath_prepend(str(tmp_path))

    def digest() -> code_digest.Source:
        for remembered in (code_digest.of, code_digest._read, code_digest._path):
            remembered.cache_clear()
        return code_digest.of("somebody.effect")

    before = digest()
    assert "numba" in before.libraries
    assert digest() == before
    (package / "model.py").write_text("RATE = 2\n")
    assert digest() != before


def test_versions_are_those_installed() -> None:
    import numpy

    assert code_digest.versions(frozenset({"numpy"})) == {"numpy": numpy.__version__}
    assert code_digest.of("pipeline.stages.scan").libraries >= {"numpy", "numba", "embreex", "pyarrow"}
    assert "numba" not in code_digest.of("pipeline.stages.statics").libraries
