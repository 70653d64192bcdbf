"""Write the reference pages of the documentation: every scenario key, artefact column, limit and module, as Markdown.

``make reference`` writes ``docs/scenario-keys.md`` and ``docs/columns.md`` from the schemas in ``data_schemas/``,
``docs/limits.md`` from ``egvs.core.limits``, and ``docs/modules.md`` from the docstrings of modules. A test fails when
the pages are out of date. Only the standard
library is used, so any Python runs this file.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = ROOT / "data_schemas"
DOCS = ROOT / "docs"
PACKAGE = ROOT / "pipeline" / "egvs"

COLUMNS_HEAD = """\
# Every column of every artefact

`make reference` writes this page from `data_schemas/*.schema.json`
([Table Schema](https://specs.frictionlessdata.io/table-schema/), with a unit and an Arrow type for each field). The
program reads its Arrow schemas from the same files. [Artefacts](artefacts.md) explains what each file is for. World
frame: right-handed, x east, y north, z up. *(optional)*: the column is not in every file.
"""
KEYS_HEAD = """\
# Every key of a scenario

`make reference` writes this page from the JSON schema that checks `scenario.toml`. A key that is not listed here is an
error. Each key can be set on the command line, for example `egvs run FOLDER --set roi.voxel_m=0.5`.
[Scenarios](scenarios.md) explains how the keys work together.
"""
CITY_HEAD = """\
## `city.toml`

The keys of a [city](city.md). Its tables, such as `[traffic]` and `[effects.<name>]`, have the same keys as in a
scenario.
"""
LIMITS_HEAD = """\
# Every limit of input

`make reference` writes this page from `egvs.core.limits`. A limit only rejects input; it never changes a result. To
raise one, set the variable of its name to a whole number: `EGVS_MAX_POINTS=100000000 egvs run ...`.
[Security](security.md#limits-by-format) says which limits apply to which format.

| variable | default | applies to |
|---|---|---|
"""
MODULES_HEAD = """\
# Every module

`make reference` writes this page from the first sentence of each module. [Architecture](architecture.md) says what the
packages may import.
"""

TABLES: dict[str, str] = {
    "scores": "scores.parquet",
    "scores_by_period": "scores_by_period.parquet",
    "levels": "levels.parquet",
    "blindspots": "blindspots.parquet",
    "zones": "zones.parquet",
    "trajectories": "trajectories.parquet",
    "tpog": "tpog.parquet",
    "scans": "scans.parquet",
    "visibility": "visibility.parquet",
    "placement": "placement.parquet",
    "curve": "curve.parquet",
    "plan_zones": "plan_zones.parquet",
    "accuracy": "accuracy.parquet",
    "surrogates": "surrogates.parquet",
    "detection": "detection.parquet",
    "correlation": "correlation.parquet",
    "fused": "fused.parquet",
    "points": "points.parquet",
    "detections": "detections.parquet",
    "city": "junctions.parquet",
    "city_plan": "plan.parquet",
    "city_curve": "curve.parquet of a city run",
    "fcd": "traffic/<junction>.parquet",
}
"""Schema -> the file that it describes, in the order of the page."""

SAFETY_LIMIT = 1e6
"""Limits this large only keep absurd values out and are not shown."""


def pages() -> dict[Path, str]:
    """Text of each reference page, by path."""
    return {
        DOCS / "columns.md": columns_page(),
        DOCS / "scenario-keys.md": keys_page(),
        DOCS / "limits.md": limits_page(),
        DOCS / "modules.md": modules_page(),
    }


def columns_page() -> str:
    """Every column of every artefact."""
    described = {path.name.removesuffix(".schema.json") for path in SCHEMAS.glob("*.schema.json")}
    if described - {"scenario", "city_file"} != set(TABLES):
        raise ValueError(f"TABLES in {Path(__file__).name} and {SCHEMAS.name}/ do not list the same artefacts")

    sections = [f"## {file}\n\n{columns(name)}\n" for name, file in TABLES.items()]
    return "\n".join([COLUMNS_HEAD, *sections])


def columns(artefact: str) -> str:
    """Columns of one artefact as a Markdown table, after the description of the file."""
    schema = _schema(artefact)
    rows = ["| column | type | unit | meaning |", "|---|---|---|---|"]
    for field in schema["fields"]:
        unit = field.get("unit", "").replace("1", "")
        optional = "" if field["constraints"]["required"] else " *(optional)*"
        rows.append(f"| `{field['name']}` | {field['arrow_type']} | {unit} | {_cell(field['description'])}{optional} |")
    text = _cell(schema["description"]) + "\n\n" + "\n".join(rows)
    key = ", ".join(f"`{name}`" for name in schema.get("primaryKey", []))
    return f"{text}\n\nKey: {key}." if key else text


def keys_page() -> str:
    """Every key of a scenario, and the top-level keys of a city."""
    scenario, city = _schema("scenario"), _schema("city_file")
    if new := set(city["$defs"]) - set(scenario["$defs"]):
        raise ValueError(f"city.toml has tables that a scenario does not have: {', '.join(sorted(new))}")
    lines = [KEYS_HEAD, *_table(scenario, scenario["$defs"], prefix="", heading="scenario.toml")]
    lines += [CITY_HEAD, *_rows(city)]
    return "\n".join(lines).rstrip() + "\n"


def limits_page() -> str:
    """Each limit with its default, as a Markdown table."""
    module = ast.parse((PACKAGE / "core" / "limits.py").read_text(encoding="utf-8"))
    rows = []
    for call in ast.walk(module):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Limit":
            name, default, unit, what = (eval(ast.unparse(value), {"__builtins__": {}}) for value in call.args)
            rows.append(f"| `{name}` | {default if unit == 'MB' else f'{default:,}'} {unit} | {what} |\n")
    return LIMITS_HEAD + "".join(rows)


def modules_page() -> str:
    """The packages and extensions, each with a row for every module below it."""
    packages = sorted(path.parent for path in PACKAGE.glob("*/__init__.py") if path.parent.name != "extensions")
    packages += sorted(path.parent for path in PACKAGE.glob("extensions/*/__init__.py"))
    parts = [MODULES_HEAD]
    for package in packages:
        title = package.relative_to(PACKAGE).as_posix().replace("/", ".")
        rows = [f"## `{title}`\n\n{_first_sentence(package / '__init__.py')}\n"]
        rows += ["| module | what one finds there |", "|---|---|"]
        paths = (path for path in package.rglob("*.py") if path.parent != package or path.name != "__init__.py")
        for name, path in sorted((_module_name(path), path) for path in paths):
            link = f"`{name}`" if path.name == "__init__.py" else f"[`{name}`][]"  # packages have no page
            rows.append(f"| {link} | {_first_sentence(path)} |")
        parts.append("\n".join(rows) + "\n")
    return "\n".join(parts)


def _module_name(path: Path) -> str:
    folder = path.parent if path.name == "__init__.py" else path.with_suffix("")
    return ".".join(("egvs", *folder.relative_to(PACKAGE).parts))


def _first_sentence(path: Path) -> str:
    """The first paragraph of the docstring of a module, as Markdown."""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    text = " ".join(docstring.partition("\n\n")[0].split())
    text = re.sub(r":mod:`(egvs\.[\w.]*\w)`", lambda name: _module_link(name[1]), text)
    return re.sub(r":\w+:`([^`]+)`", r"`\1`", text.replace("``", "`")).replace("|", "\\|")


def _module_link(name: str) -> str:
    """A reference to a module; the name alone of a package."""
    is_package = PACKAGE.joinpath(*name.split(".")[1:]).is_dir()
    return f"`{name}`" if is_package else f"[`{name}`][]"


def _table(model: dict[str, Any], models: dict[str, Any], prefix: str, heading: str) -> list[str]:
    """The keys of one TOML table, then the tables below it."""
    below: list[str] = []
    for key, field in model.get("properties", {}).items():
        name = f"{prefix}{key}"
        is_list = field.get("type") == "array" or '"items"' in json.dumps(field)
        if "additionalProperties" in field or "patternProperties" in field:
            name = f"{name}.<name>"
        for nested in _nested_models(field):
            below += _table(models[nested], models, f"{name}.", f"[[{name}]]" if is_list else f"[{name}]")

    rows = _rows(model)
    if below and not rows:
        return below  # a table that only holds other tables needs no section
    description = _cell(model.get("description", "").split("\n\n")[0])
    return [f"## {_title(heading)}", "", *([description, ""] if prefix else []), *rows, *below]


def _rows(model: dict[str, Any]) -> list[str]:
    """The keys of one TOML table that hold a value, as a Markdown table."""
    values = {key: field for key, field in model.get("properties", {}).items() if _has_value(field)}
    if not values:
        return []
    rows = [_row(key, field, is_required=key in model.get("required", [])) for key, field in values.items()]
    return ["| key | type | default | meaning |", "|---|---|---|---|", *rows, ""]


def _has_value(field: dict[str, Any]) -> bool:
    """Whether a key may hold a value; a list of tables may be the name of a file with them instead."""
    return not _nested_models(field) or "string" in field.get("type", ())


def _nested_models(field: dict[str, Any]) -> list[str]:
    return re.findall(r'"\$ref": "#/\$defs/(\w+)"', json.dumps(field))


def _row(key: str, field: dict[str, Any], *, is_required: bool) -> str:
    default = field.get("default")
    if is_required:
        shown = "**required**"
    elif default is None:
        shown = ""
    else:
        shown = f"`{json.dumps(default)}`"
    return f"| `{key}` | {_type(field)} | {shown} | {_cell(field.get('description', ''))} |"


def _type(field: dict[str, Any]) -> str:
    """The values that a key may have, in words."""
    if "anyOf" in field:
        options = [_type(option) for option in field["anyOf"] if option.get("type") != "null"]
        return " or ".join(dict.fromkeys(options))
    if "enum" in field:
        return ", ".join(f"`{json.dumps(value)}`" for value in field["enum"])
    if "const" in field:
        return f"`{json.dumps(field['const'])}`"

    kind = field.get("type", "")
    if isinstance(kind, list):
        return "text, or tables"
    if kind == "array":
        if "prefixItems" in field:
            items = [_type(item) for item in field["prefixItems"]]
            is_uniform = len(set(items)) == 1
            return f"{len(items)} × {items[0]}" if is_uniform else "[" + "; ".join(items) + "]"
        return f"list of {_type(field.get('items', {})) or 'values'}"
    if kind == "object":
        return f"table of {_type(field['additionalProperties'])}" if _has_typed_values(field) else "table"

    words = {"number": "number", "integer": "integer", "string": "text", "boolean": "true, false"}.get(kind, kind)
    limits = [
        f"{sign} {field[keyword]:g}"
        for keyword, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if abs(field.get(keyword, SAFETY_LIMIT)) < SAFETY_LIMIT
    ]
    return " ".join([words, *limits]) if len(limits) < 2 else f"{words} {', '.join(limits)}"


def _has_typed_values(field: dict[str, Any]) -> bool:
    return isinstance(field.get("additionalProperties"), dict) and bool(field["additionalProperties"])


def _cell(text: str) -> str:
    """Text for a table cell; reStructuredText roles and literals become code."""
    code = re.sub(r"(?::\w+:)?(`+)~?([^`]+)\1", r"`\2`", text).replace("|", "\\|").replace("\n", " ")
    return re.sub(r"(`[^`]*`)|<", lambda found: found[1] or "&lt;", code)


def _title(heading: str) -> str:
    """Return the heading of a table of keys; "Table" keeps its anchor apart from the headings of other pages."""
    return f"Table `{heading}`" if heading.startswith("[") else f"`{heading}`"


def _schema(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads((SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8"))
    return schema


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(ROOT))
