"""Makes a figure of the report one that any program draws: a file of its own, with what the style sheet says of light
pages written beside each shape.

Programs that know no style sheets, variables or ``paint-order`` (cairo, Inkscape, what reads SVG into a slide) then
draw what a browser draws. The rules that the style sheet of figures uses are those understood here: classes and names
of elements, one inside another.

https://www.w3.org/TR/SVG11/styling.html, https://www.w3.org/TR/selectors-3/#specificity
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from pipeline.report.drawing.colours import STYLE_SHEET

FONTS = "DejaVu Sans, Arial, Helvetica, sans-serif"

_SVG = "http://www.w3.org/2000/svg"
_DARK, _NIGHT = "@media screen and (prefers-color-scheme: dark)", "night"
_PAGE = ("display", "width", "height", "font")
"""What a page says of the place of a figure."""


@dataclass(frozen=True)
class _Rule:
    """What holds for elements that match ``path``: from outside to inside, each a class (".site") or a name."""

    path: tuple[str, ...]
    properties: Mapping[str, str]

    @property
    def weight(self) -> tuple[int, int]:
        """How specific it is."""
        classes = sum(part.startswith(".") for part in self.path)
        return classes, len(self.path) - classes


def flat(figure: str, width_mm: float) -> str:
    """A figure (SVG text of :mod:`pipeline.report.drawing`) as a file of its own, so wide on paper."""
    root = ET.fromstring(figure.replace("<svg ", f'<svg xmlns="{_SVG}" ', 1))
    _, _, wide, tall = map(float, root.attrib["viewBox"].split())
    rules = list(_rules(STYLE_SHEET.partition(_DARK)[0]))
    ink = next(rule.properties["color"] for rule in rules if "color" in rule.properties)
    _dress(root, [], rules, ink)
    root.attrib |= {"width": f"{width_mm:g}mm", "height": f"{width_mm * tall / wide:.3f}mm"}
    root.attrib |= {"font-size": "12", "font-family": FONTS}
    ET.register_namespace("", _SVG)
    return ET.tostring(root, encoding="unicode") + "\n"


def _rules(sheet: str) -> Iterator[_Rule]:
    """The rules of a style sheet, variables replaced by what they stand for."""
    variables = dict(re.findall(r"(--[\w-]+):\s*([^;]+);", sheet))
    for selectors, body in re.findall(r"([^{}]+)\{([^{}]*)\}", sheet):
        pairs = (line.split(":", 1) for line in body.split(";") if ":" in line)
        properties = {
            name.strip(): re.sub(r"var\((--[\w-]+)\)", lambda its: variables[its[1]], value.strip())
            for name, value in pairs
            if not name.strip().startswith("--")
        }
        for selector in selectors.split(","):
            yield _Rule(tuple(selector.split()), properties)


def _dress(element: ET.Element, around: Sequence[ET.Element], rules: Sequence[_Rule], ink: str) -> None:
    """Write beside an element, and all within it, what holds for it."""
    inside = [*around, element]
    for name, value in _style(inside, rules).items():
        if name not in _PAGE and name not in element.attrib:
            element.set(name, value.replace("currentColor", ink).removesuffix("px"))
    for name in ("fill", "stroke"):
        if element.get(name) == "currentColor":
            element.set(name, ink)
    for child in list(element):
        if _NIGHT in child.get("class", "").split():
            element.remove(child)
            continue
        _dress(child, inside, rules, ink)
        if child.attrib.pop("paint-order", "") == "stroke":  # the halo first, then the letters
            letters = _copy_without_stroke(child)
            element.insert(list(element).index(child) + 1, letters)


def _copy_without_stroke(element: ET.Element) -> ET.Element:
    copy = ET.Element(element.tag, {k: v for k, v in element.attrib.items() if not k.startswith("stroke")})
    copy.text = element.text
    return copy


def _style(path: Sequence[ET.Element], rules: Sequence[_Rule]) -> dict[str, str]:
    """What holds for the last element of a path from the root; of two rules the more specific, or the later."""
    found: dict[str, str] = {}
    for rule in sorted((rule for rule in rules if _matches(rule.path, path)), key=lambda rule: rule.weight):
        found |= rule.properties
    return found


def _matches(selector: Sequence[str], path: Sequence[ET.Element]) -> bool:
    *outer, last = selector
    if not _is(last, path[-1]):
        return False
    waiting = list(outer)
    for element in path[-2::-1]:
        if waiting and _is(waiting[-1], element):
            waiting.pop()
    return not waiting


def _is(part: str, element: ET.Element) -> bool:
    if part.startswith("."):
        return part[1:] in element.get("class", "").split()
    return element.tag == f"{{{_SVG}}}{part}"
