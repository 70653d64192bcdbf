"""Links and headings of Markdown pages, read without the documentation tools."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

_FENCE = re.compile(r"^ *(```|~~~).*?^ *\1\s*$", re.DOTALL | re.MULTILINE)
_CODE = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)", re.DOTALL)
_LINK = re.compile(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
_HTML_LINK = re.compile(r"\b(?:src|srcset|href)=\"([^\"]+)\"")
_REFERENCE = re.compile(r"^ {0,3}\[[^\]\n]+\]:\s+(\S+)", re.MULTILINE)
_HEADING = re.compile(r"^(#{1,6}) +(.+?)(?: +\{#([\w-]+)\})? *#*$", re.MULTILINE)


class Heading(NamedTuple):
    """A heading: its level (1 to 6), its anchor, and the position in the text where its section starts."""

    level: int
    anchor: str
    start: int


def without_code(text: str) -> str:
    """Replace blocks and spans of code by spaces, so that nothing in them is read as a link or a heading."""
    blank_block = _FENCE.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)
    return _CODE.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), blank_block)


def links(text: str) -> Iterator[str]:
    """Yield the target of every link and picture, Markdown or HTML."""
    bare = without_code(text)
    for pattern in (_LINK, _HTML_LINK, _REFERENCE):
        for match in pattern.finditer(bare):
            yield match[1]


def slug(heading: str) -> str:
    """Return the anchor that MkDocs gives a heading."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "")
    ascii_only = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", ascii_only).strip().lower())


def headings(text: str) -> list[Heading]:
    """Return all headings; a repeated one gets ``_1``, ``_2`` at the end of its anchor."""
    blocks_blanked = _FENCE.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)
    used: dict[str, int] = {}
    result = []
    for match in _HEADING.finditer(blocks_blanked):
        anchor = match[3] or slug(match[2])
        count = used.get(anchor, 0)
        used[anchor] = count + 1
        if count:
            anchor = f"{anchor}_{count}"
        result.append(Heading(len(match[1]), anchor, match.start()))
    return result


def section(text: str, anchor: str) -> str:
    """Return the text below a heading, up to the next heading of its level or above."""
    found = headings(text)
    (index,) = [i for i, heading in enumerate(found) if heading.anchor == anchor]
    later = (heading.start for heading in found[index + 1 :] if heading.level <= found[index].level)
    return text[found[index].start : next(later, len(text))]
