"""Do imports point one way, and does the package stay what it promises to be?

errors, grid, schemas, scenario -> kernels -> tables, statics, sensors -> stages -> workflow -> command line: no edge
runs back, none runs from stage to stage, and heavy libraries are imported only where they are needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pipeline"
STAGES = ("traffic", "statics", "tpog", "scan", "score", "report")

# Lower layers may not import higher ones; modules of one layer may import each other unless they are stages.
LAYERS = (
    ("errors",),
    ("grid", "schemas", "checked"),
    ("scenario", "tables", "cost"),
    ("kernels", "safexml", "stage", "ordered"),
    (
        "sumo",
        "network",
        "world",
        "sensors",
        "sites",
        "clouds",
        "results",
        "entropy",
        "fcd",
        "motion",
        "demand",
        "raycast",
        "crossings",
        "uncertainty",
    ),
    ("effects",),
    ("osm_reader", "osm_footprints", "osm_junction", "simulation", "survey", "visibility", "figures"),
    ("osm", *STAGES),
    ("workflow",),
    ("callings", "accuracy", "knobs", "pareto", "trials"),
    ("show",),
    ("cli",),
    ("__init__",),
)
LAYER_OF = {name: level for level, names in enumerate(LAYERS) for name in names}


def modules() -> dict[str, Path]:
    """Name -> file of every module; everything under kernels/ counts as "kernels", everything under effects/ as
    "effects"."""
    return {str(p.relative_to(PACKAGE).with_suffix("")): p for p in sorted(PACKAGE.rglob("*.py"))}


def imported(path: Path) -> set[str]:
    """The pipeline modules that a file imports at any depth of its code, type checking included."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    names = {name.split(".")[1] for name in found if name.startswith("pipeline.")}
    return {name for name in names if name in LAYER_OF}


def top(name: str) -> str:
    return name.split("/")[0] if "/" in name else name


def test_every_module_has_a_layer() -> None:
    assert {top(name) for name in modules()} == set(LAYER_OF)


@pytest.mark.parametrize("name", [name for name in modules() if name != "__init__"])
def test_imports_point_one_way(name: str) -> None:
    mine = top(name)
    for other in imported(modules()[name]) - {mine}:
        assert LAYER_OF[other] <= LAYER_OF[mine], f"{name} imports {other}, which stands above it"
        assert not (mine in STAGES and other in STAGES), f"stage {name} imports stage {other}"


def importers_of(library: str) -> set[str]:
    found = set()
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            if any(n == library or n.startswith(library + ".") for n in names):
                found.add(name)
    return found


def test_one_module_imports_sumo_and_one_reads_schemas_and_one_parquet() -> None:
    assert importers_of("traci") | importers_of("sumolib") | importers_of("libsumo") == {"sumo"}
    assert importers_of("pyarrow.parquet") <= {"tables", "fcd"}  # fcd reads what SUMO wrote
    texts = {name for name, path in modules().items() if "data_schemas" in path.read_text(encoding="utf-8")}
    assert texts - {"scenario"} == {"schemas"}  # scenario only mentions the folder


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize("module", ["pipeline", "pipeline.cli.app"])
def test_nothing_heavy_is_imported_for_help(module: str) -> None:
    heavy = "numpy numba pyarrow pydantic shapely trimesh matplotlib embreex scipy rich.table traci sumolib"
    code = f"import sys, {module}; print([m for m in {heavy.split()} if m in sys.modules])"
    assert run_python(code).strip() == "[]"


def test_every_module_opens_with_the_question_that_it_answers() -> None:
    for name, path in modules().items():
        doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert doc, f"{name} has no docstring"
        if name not in ("__init__", "kernels/__init__", "errors", "cli"):
            assert "?" in doc.split("\n\n")[0], f"{name} opens with no question"
