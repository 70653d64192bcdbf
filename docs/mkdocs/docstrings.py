"""Turns what docstrings (numpydoc) use of reStructuredText into Markdown; an extension of griffe.

Formulas (``.. math::``, ``:math:``) become MathML, roles (``:func:`` and its like) links where the reference has the
name, ``text::`` with an indented block code, simple tables pipe tables. Sections are left to griffe's numpy parser.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
from formulas import mathml

_MATH_BLOCK = re.compile(r"^( *)\.\. math:: *(.*(?:\n\1 +\S.*)*)", re.MULTILINE)
_MATH_ROLE = re.compile(r":math:`([^`]+)`")
_ROLE = re.compile(r":(?:func|class|meth|mod|data|attr|exc):`~?([\w.]+)`")
_RULER = re.compile(r"^( *)=+( +=+)+ *$")
_CODE_AFTER = re.compile(r"::(\n\n +\S)")


class Markdown(griffe.Extension):
    """Rewrites every docstring of a package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        _rewrite(pkg)


def _rewrite(obj: griffe.Object) -> None:
    if obj.docstring is not None:
        obj.docstring.value = _to_markdown(obj.docstring.value, obj)
    for member in obj.members.values():
        if not member.is_alias:
            _rewrite(member)  # type: ignore[arg-type]


def _to_markdown(text: str, obj: griffe.Object) -> str:
    text = _MATH_BLOCK.sub(lambda m: f"{m[1]}\n{m[1]}{mathml(m[2], 'block')}\n", text)
    text = _MATH_ROLE.sub(lambda m: mathml(m[1]), text)
    text = _ROLE.sub(lambda m: _link(m[1], obj), text)
    return _tables(_CODE_AFTER.sub(r":\1", text))


def _link(name: str, obj: griffe.Object) -> str:
    """A link to what ``name`` means where the docstring stands; plain code where the reference has no such thing."""
    try:
        path = obj.resolve(name.split(".")[0]) + name.partition(".")[1] + name.partition(".")[2]
    except griffe.NameResolutionError:
        path = name
    return f'<autoref optional identifier="{path}"><code>{name}</code></autoref>'


def _tables(text: str) -> str:
    """Simple tables: ruler, head, ruler, rows, ruler; a column is what stands under its piece of the ruler."""
    lines, out = text.splitlines(), []
    while lines:
        line = lines.pop(0)
        if not _RULER.match(line):
            out.append(line)
            continue
        starts = [m.start() for m in re.finditer("=+", line)]
        cuts = list(zip(starts, [*starts[1:], None], strict=True))
        rows: list[list[str]] = []
        rulers = 1
        while rulers < 3:
            line = lines.pop(0)
            if _RULER.match(line):
                rulers += 1
                continue
            cells = [line[a:b].strip() for a, b in cuts]
            if cells[0] or not rows:
                rows.append(cells)
            else:  # a row that goes on
                rows[-1] = [f"{old} {new}".strip() for old, new in zip(rows[-1], cells, strict=True)]
        rows.insert(1, ["---"] * len(cuts))
        out += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(out)
