"""Markdown tables made from what the program says of itself: columns of artefacts, keys of a scenario, public names."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = ROOT / "data_schemas"


def columns(artefact: str) -> str:
    """Markdown table of an artefact's columns."""
    schema = json.loads((SCHEMAS / f"{artefact}.schema.json").read_text(encoding="utf-8"))
    rows = ["| column | type | unit | meaning |", "|---|---|---|---|"]
    for field in schema["fields"]:
        unit = field.get("unit", "").replace("1", "")
        meaning = _cell(field["description"])
        if not field["constraints"]["required"]:
            meaning += " *(not in every file)*"
        rows.append(f"| `{field['name']}` | {field['arrow_type']} | {unit} | {meaning} |")
    keys = ", ".join(f"`{key}`" for key in schema.get("primaryKey", []))
    return "\n".join(rows) + (f"\n\nOne row for each {keys}." if keys else "")


def keys(_: str) -> str:
    """A Markdown table for each table of a scenario: key, default, meaning."""
    schema = json.loads((SCHEMAS / "scenario.schema.json").read_text(encoding="utf-8"))
    return "\n".join(_table(schema, schema["$defs"], "", "scenario.toml"))


def _table(model: dict[str, Any], models: dict[str, Any], prefix: str, heading: str) -> list[str]:
    """The keys of one table that hold a value, then the tables below it."""
    rows, below = [], []
    for key, field in model.get("properties", {}).items():
        name = f"{prefix}{key}"
        inner = [ref for ref in re.findall(r'"\$ref": "#/\$defs/(\w+)"', json.dumps(field))]
        if inner:
            many = field.get("type") == "array" or '"items"' in json.dumps(field)
            name = f"{name}.<name>" if "additionalProperties" in field else name
            for ref in inner:
                below += _table(models[ref], models, f"{name}.", f"[[{name}]]" if many else f"[{name}]")
        else:
            needed = key in model.get("required", [])
            default = "**needed**" if needed else f"`{json.dumps(field.get('default'))}`".replace("`null`", "")
            rows.append(f"| `{key}` | {default} | {_cell(field.get('description', ''))} |")
    text = [f"## `{heading}`", "", _cell(model.get("description", "").split("\n\n")[0]), ""]
    rows = ["| key | default | meaning |", "|---|---|---|", *rows, ""] if rows else []
    return [*(text if rows or not below else []), *rows, *below]


def _cell(text: str) -> str:
    """Text for a table's cell, its reStructuredText roles and literals as code."""
    return re.sub(r"(?::\w+:)?(`+)~?([^`]+)\1", r"`\2`", text).replace("|", "\\|").replace("\n", " ")


def names(package: str) -> str:
    """What a package offers by name: a link to its entry in the reference, and what its docstring opens with."""
    rows = ["| name | what it is |", "|---|---|"]
    for node in ast.walk(ast.parse((ROOT / package / "__init__.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{package}."):
            path = ROOT.joinpath(*str(node.module).split(".")).with_suffix(".py")
            rows += [_name(f"{node.module}.{alias.name}", path) for alias in node.names if alias.name[0] != "_"]
    return "\n".join([*rows[:2], *sorted(rows[2:], key=str.lower)])


def _name(full: str, path: Path) -> str:
    name = full.rpartition(".")[2]
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            about = _cell((ast.get_docstring(node) or "").split("\n\n")[0])
            return f"| [`pipeline.{name}`][{full}] | {about} |"
    raise ValueError(f"{full} is neither a class nor a function of {path}")
