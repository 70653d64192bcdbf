"""Draws the packages: boxes in layers, an arrow from each package to those that it builds on.

An arrow is left out where a chain of others says the same (transitive reduction), so what is drawn is all that one has
to know: a package may use everything that its arrows lead to, directly or further down, and nothing above.
"""

from __future__ import annotations

import ast
import html
import re
import textwrap
import tomllib
from functools import cache
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "pipeline" / "egvs"
_TITLE = "The packages in layers, each with arrows to those that it builds on"
_TIP = (
    "<defs><marker id='tip' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' markerHeight='7' orient='auto'>"
    "<path d='M0 0L8 4L0 8z' class='wings-tip'/></marker></defs>"
)
_WIDE, _LANE, _HIGH, _GAP, _ROW = 316, 6, 62, 18, 92


@cache
def layers() -> tuple[tuple[str, ...], ...]:
    """Packages by layer, from low to high, as in ``pyproject.toml``; modules at the top are left out."""
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    listed = next(c["layers"] for c in tools["importlinter"]["contracts"] if c["type"] == "layers")
    rows = [re.findall(r"\w+", layer) for layer in reversed(listed)]
    return tuple(names for row in rows if (names := tuple(name for name in row if (PACKAGE / name).is_dir())))


@cache
def packages() -> tuple[str, ...]:
    """All packages, from low to high."""
    return tuple(name for layer in layers() for name in layer)


@cache
def boxes() -> tuple[str, ...]:
    """What is drawn, from low to high: the packages of the core, then the extensions, as ``extensions.maps``."""
    extensions = sorted(path.parent.name for path in PACKAGE.glob("extensions/*/__init__.py"))
    return (*(name for name in packages() if name != "extensions"), *(f"extensions.{name}" for name in extensions))


def _imports(name: str) -> set[str]:
    """The boxes that one imports: lazily, only to check types, or by a name in a string too."""
    found: set[str] = set()
    for path in (PACKAGE / name.replace(".", "/")).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.Constant) and re.fullmatch(r"egvs\.\w+\.[\w.]*", str(node.value)):
                found.add(str(node.value))
    parts = [module.split(".") for module in found if module.startswith("egvs.")]
    named = {".".join(p[1:3]) if p[1] == "extensions" else p[1] for p in parts}
    return {box for box in boxes() if box in named and box != name}


def _reduced() -> dict[str, set[str]]:
    """Imports without those that follow from others; one against the layers would have failed the contracts before."""
    order = {name: at for at, name in enumerate(boxes())}
    direct = {name: {other for other in _imports(name) if order[other] < order[name]} for name in boxes()}
    reach: dict[str, set[str]] = {}
    for name in boxes():
        reach[name] = direct[name].union(*(reach[other] for other in direct[name]))
    return {name: {o for o in mine if not any(o in reach[p] for p in mine)} for name, mine in direct.items()}


def _rows(arrows: dict[str, set[str]]) -> tuple[list[list[str]], list[list[str]]]:
    """Rows from low to high, and the arrows as chains of places from row to row.

    An arrow that skips rows gets a place of its own in each (``a>b@3``), so that it passes between the boxes."""
    rows = [[name for name in layer if name != "extensions"] for layer in layers()]
    rows[-1] = [name for name in boxes() if "." in name]
    row = {name: at for at, names in enumerate(rows) for name in names}
    chains = []
    for name, others in arrows.items():
        for other in sorted(others):
            between = [f"{name}>{other}@{at}" for at in range(row[name] - 1, row[other], -1)]
            for at, place in zip(range(row[name] - 1, row[other], -1), between, strict=True):
                rows[at].append(place)
            chains.append([name, *between, other])
    return rows, chains


def _places(rows: list[list[str]], chains: list[list[str]]) -> dict[str, float]:
    """Middle of each place; rows are sorted by where their neighbours are, up and down a few times."""
    beside: dict[str, list[str]] = {place: [] for row in rows for place in row}
    for chain in chains:
        for one, other in pairwise(chain):
            beside[one].append(other)
            beside[other].append(one)
    x = {place: float(k) for row in rows for k, place in enumerate(row)}
    for row in [*rows, *reversed(rows)] * 6:
        row.sort(key=lambda place: sum(x[other] for other in beside[place]) / max(1, len(beside[place])))
        widths = [_LANE if ">" in place else _WIDE for place in row]
        at = -(sum(widths) + _GAP * (len(row) - 1)) / 2
        for place, width in zip(row, widths, strict=True):
            x[place] = at + width / 2
            at += width + _GAP
    return x


def _about(name: str) -> str:
    module = PACKAGE / name.replace(".", "/") / "__init__.py"
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    return text.partition("\n\n")[0].replace("\n", " ").strip(". \n")


def _box(name: str, x: float, y: float) -> str:
    lines = textwrap.wrap(_about(name), 47)
    lines = [lines[0], lines[1] + " …"] if len(lines) > 2 else lines
    text = "".join(
        f"<text x='{x:.0f}' y='{y + 37 + 15 * k:.0f}' class='wings-about'>{html.escape(line)}</text>"
        for k, line in enumerate(lines)
    )
    page, title = name.partition(".")[0], name.rpartition(".")[2]
    return (
        f"<a href='api/{page}.html'><rect x='{x - _WIDE / 2:.0f}' y='{y:.0f}' width='{_WIDE}' height='{_HIGH}' rx='6'/>"
        f"<text x='{x:.0f}' y='{y + 19:.0f}' class='wings-name'>{title}</text>{text}</a>"
    )


def picture() -> str:
    """The picture as one element of HTML, in the colours of the page around it."""
    rows, chains = _rows(_reduced())
    x = _places(rows, chains)
    y = {place: 4 + (len(rows) - 1 - at) * _ROW for at, row in enumerate(rows) for place in row}
    left = min(x[name] for name in boxes()) - _WIDE / 2 - 4
    left = min(left, *(x[place] - _LANE for place in x))
    lines = []
    for chain in chains:
        path = f"M{x[chain[0]]:.0f} {y[chain[0]] + _HIGH}"
        for one, other in pairwise(chain):
            low, high = y[one] + _HIGH, y[other] - (5 if other == chain[-1] else 0)
            bend = (high - low) * 0.6
            path += f"C{x[one]:.0f} {low + bend:.0f} {x[other]:.0f} {high - bend:.0f} {x[other]:.0f} {high}"
            path += f"V{y[other] + _HIGH}" if other != chain[-1] else ""
        lines.append(f"<path d='{path}'/>")
    body = "".join([*lines, *(_box(name, x[name], y[name]) for name in boxes())])
    view = f"{left:.0f} 0 {-2 * left:.0f} {(len(rows) - 1) * _ROW + _HIGH + 8}"
    head = f"<svg viewBox='{view}' style='max-width: {-2 * left:.0f}px' role='img' aria-label='{_TITLE}'>"
    return f"<div class='wings'>{head}{_TIP}{body}</svg></div>"
