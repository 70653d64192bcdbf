"""The picture in docs/architecture.md is that of the contracts, which import-linter compares with the imports."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_picture_shows_the_layers_of_the_contracts() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    picture = page.partition("```text\n")[2].partition("```")[0]
    rows = re.findall(r"^ *\d+  (\w+(?: \| \w+)*)", picture, re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    expected = [re.findall(r"\w+", layer) for layer in layers if layer not in ("extensions", "_version")]
    assert [row.split(" | ") for row in rows] == expected
    extensions = sorted(path.parent.name for path in ROOT.glob("pipeline/egvs/extensions/*/__init__.py"))
    assert re.search(r"extensions/((?: +\w+)+) +\(", picture)[1].split() == extensions  # type: ignore[index]


def test_page_is_one_screen() -> None:
    assert len((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()) <= 70
