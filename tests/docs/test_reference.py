"""The reference pages of the documentation are up to date."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


def load_reference() -> ModuleType:
    """The generator, which is a script of the documentation and not part of a package."""
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "mkdocs" / "reference.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("name", ["columns.md", "limits.md", "modules.md", "scenario-keys.md"])
def test_page_is_current(name: str) -> None:
    pages = {path.name: (path, text) for path, text in load_reference().pages().items()}
    path, text = pages[name]
    assert path.read_text(encoding="utf-8") == text, f"docs/{name} is out of date; run: make reference"


def test_columns_page_describes_each_field() -> None:
    reference = load_reference()
    page = (ROOT / "docs" / "columns.md").read_text(encoding="utf-8")
    for name in reference.TABLES:
        for field in reference._schema(name)["fields"]:
            assert f"| `{field['name']}` | {field['arrow_type']} |" in page


def test_type_in_words() -> None:
    describe = load_reference()._type
    assert describe({"type": "number", "exclusiveMinimum": 0, "maximum": 1}) == "number > 0, ≤ 1"
    assert describe({"type": "integer", "minimum": 0, "maximum": 2**63}) == "integer ≥ 0"
    assert describe({"anyOf": [{"type": "number"}, {"const": "auto"}, {"type": "null"}]}) == 'number or `"auto"`'
    assert describe({"type": "array", "prefixItems": [{"type": "number"}] * 3}) == "3 × number"
    assert describe({"enum": ["exactly", "at_most"]}) == '`"exactly"`, `"at_most"`'
