"""The picture of the packages: boxes in layers, an arrow from each package to those that it builds on.

An arrow is left out where a chain of others says the same (transitive reduction), so what is drawn is all that one has to
know: everything below a box that arrows lead to may be used by it, nothing above.
"""

from __future__ import annotations

import ast
import html
import textwrap
import tomllib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "pipeline"
_WIDE, _HIGH, _GAP, _ROW = 236, 62, 28, 112



@cache
def packages() -> tuple[str, ...]:
    """All packages, from low to high, in the order of the layers in ``pyproject.toml``; others come last."""
    here = sorted(p.parent.name for p in PACKAGE.glob("*/__init__.py"))
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"].get("importlinter", {})
    layers = [layer for c in contracts.get("contracts", []) if c["type"] == "layers" for layer in c["layers"]]
    order = [name.strip().strip("()").split(".")[-1] for layer in reversed(layers) for name in layer.replace("|", ":").split(":")]
    return tuple(sorted(here, key=lambda name: (order.index(name) if name in order else len(order), name)))


def _imports(name: str) -> set[str]:
    """The packages that one imports, lazily or only to check types too."""
    found: set[str] = set()
    for path in (PACKAGE / name).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
    parts = [module.split(".") for module in found]
    return {p[1] for p in parts if p[0] == "pipeline" and len(p) > 1 and p[1] in packages()} - {name}


def _reduced() -> dict[str, set[str]]:
    """Imports without those that follow from others; one against the layers would have failed the contracts before."""
    order = {name: at for at, name in enumerate(packages())}
    direct = {name: {other for other in _imports(name) if order[other] < order[name]} for name in packages()}
    reach: dict[str, set[str]] = {}
    for name in packages():
        reach[name] = direct[name].union(*(reach[other] for other in direct[name]))
    return {name: {o for o in mine if not any(o in reach[p] for p in mine)} for name, mine in direct.items()}


def _places(arrows: dict[str, set[str]]) -> dict[str, tuple[float, int]]:
    """Middle and row of each box: as low as its arrows allow, below what it carries."""
    row: dict[str, int] = {}
    for name in packages():
        row[name] = 1 + max((row[other] for other in arrows[name]), default=-1)
    rows = [[name for name in packages() if row[name] == at] for at in range(max(row.values()) + 1)]
    places: dict[str, tuple[float, int]] = {}
    for at, names in enumerate(rows):
        names.sort(key=lambda name: sum(places[o][0] for o in arrows[name]) / max(1, len(arrows[name])))
        for k, name in enumerate(names):
            places[name] = ((k - (len(names) - 1) / 2) * (_WIDE + _GAP), at)
    return places


def _about(name: str) -> str:
    return (ast.get_docstring(ast.parse((PACKAGE / name / "__init__.py").read_text(encoding="utf-8"))) or "").strip(". \n")


def _box(name: str, x: float, y: float) -> str:
    lines = textwrap.wrap(_about(name), 38)
    lines = [*lines[:1], lines[1] + " …"] if len(lines) > 2 else lines
    text = "".join(
        f"<text x='{x:.0f}' y='{y + 38 + 14 * k:.0f}' class='wings-about'>{html.escape(line)}</text>"
        for k, line in enumerate(lines)
    )
    return (
        f"<a href='api/{name}.html'><rect x='{x - _WIDE / 2:.0f}' y='{y:.0f}' width='{_WIDE}' height='{_HIGH}' rx='6'/>"
        f"<text x='{x:.0f}' y='{y + 20:.0f}' class='wings-name'>{name}</text>{text}</a>"
    )


def picture() -> str:
    """The picture as one element of HTML, in the colours of the page around it."""
    arrows = _reduced()
    places = _places(arrows)
    top = max(at for _, at in places.values())
    left = min(x for x, _ in places.values()) - _WIDE / 2 - 4
    boxes = {name: (x, 4 + (top - at) * _ROW) for name, (x, at) in places.items()}
    lines = []
    for name, others in arrows.items():
        for other in sorted(others):
            (x0, y0), (x1, y1) = boxes[name], boxes[other]
            y0 += _HIGH
            bend = min(60, (y1 - y0) * 0.6)
            lines.append(f"<path d='M{x0:.0f} {y0:.0f} C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} {x1:.0f} {y1 - 4:.0f}'/>")
    body = "".join([*lines, *(_box(name, *at) for name, at in boxes.items())])
    view = f"{left:.0f} 0 {-2 * left:.0f} {top * _ROW + _HIGH + 8}"
    head = "<marker id='tip' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' markerHeight='7' orient='auto'><path d='M0 0L8 4L0 8z' class='wings-tip'/></marker>"
    title = "The packages in layers, each with arrows to those that it builds on"
    return f"<div class='wings'><svg viewBox='{view}' role='img' aria-label='{title}'><defs>{head}</defs>{body}</svg></div>"
