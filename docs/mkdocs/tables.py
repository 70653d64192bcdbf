"""Markdown tables for the site: the public names of a package, and files of data."""

from __future__ import annotations

import ast
import csv
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def names(package: str) -> str:
    """What a package offers by name: a link to its entry in the reference, and what its docstring opens with."""
    rows = ["| name | what it is |", "|---|---|"]
    for node in ast.walk(ast.parse((ROOT / "pipeline" / package / "__init__.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{package}."):
            path = (ROOT / "pipeline").joinpath(*str(node.module).split(".")).with_suffix(".py")
            rows += [_name(f"{node.module}.{alias.name}", path) for alias in node.names if alias.name[0] != "_"]
    return "\n".join([*rows[:2], *sorted(rows[2:], key=str.lower)])


def _name(full: str, path: Path) -> str:
    name = full.rpartition(".")[2]
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            about = _as_code((ast.get_docstring(node) or "").split("\n\n")[0])
            return f"| [`egvs.{name}`][{full}] | {about} |"
    raise ValueError(f"{full} is neither a class nor a function of {path}")


def _as_code(text: str) -> str:
    """Text for a table cell; reStructuredText roles and literals become code."""
    return re.sub(r"(?::\w+:)?(`+)~?([^`]+)\1", r"`\2`", text).replace("|", "\\|").replace("\n", " ")


def data_table(stem: str) -> str:
    """All rows of ``docs/data/<stem>.csv``."""
    with (ROOT / "docs" / "data" / f"{stem}.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])
