"""Turn notebooks into pages of the site: Markdown for their text and code, a file for each figure.

Only the standard library reads the notebooks, so that the site is built without Jupyter. Tables and figures get the
classes of ``style.css``, and work in both colour schemes.
"""

from __future__ import annotations

import base64
import html
import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "notebooks"
SOURCE_SUFFIX, PAGE_SUFFIX = ".ipynb", ".md"

_NOTEBOOK_LINK = re.compile(r"(\]\((?!\w+:)[^)\s]*?)\.ipynb([)#])")
_GALLERY_ITEM = re.compile(r"^- \[([^\]]+)\]\(([\w-]+)\.ipynb\): (.+?)(?=^- |^$|\Z)", re.MULTILINE | re.DOTALL)
_STYLE = re.compile(r"<style.*?</style>\s*", re.DOTALL)
_TABLE_TAG = re.compile(r"<table[^>]*>")
_GALLERY_TAG = "gallery"


@dataclass(frozen=True)
class NotebookPage:
    """A notebook as a page.

    Attributes
    ----------
    name
        Name of the notebook, without suffix.
    markdown
        The page.
    figures
        Content of each figure, by file name.
    gallery_figure, gallery_alt
        File name and text alternative of the figure that the gallery shows.
    """

    name: str
    markdown: str
    figures: dict[str, bytes]
    gallery_figure: str
    gallery_alt: str


@cache
def pages() -> dict[str, NotebookPage]:
    """Return all notebooks by name."""
    return {path.stem: read_notebook(path) for path in sorted(FOLDER.glob(f"*{SOURCE_SUFFIX}"))}


def read_notebook(path: Path) -> NotebookPage:
    """Convert a notebook.

    Raises
    ------
    ValueError
        When a figure has no text alternative (``alt`` in the metadata of its cell), or no cell has the tag ``gallery``.
    """
    notebook = json.loads(path.read_text(encoding="utf-8"))
    parts: list[str] = []
    figures: dict[str, bytes] = {}
    gallery = None
    for number, cell in enumerate(notebook["cells"], 1):
        source = _text(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(_fence(source, "python"))
        alt = cell["metadata"].get("alt", "")
        for output in cell["outputs"]:
            figure = _figure(output)
            if figure is None:
                parts.append(_output(output))
                continue
            if not alt:
                raise ValueError(f"{path.name}: cell {number}: its figure has no text alternative (metadata: alt)")
            suffix, content, size = figure
            name = f"{path.stem}-{len(figures) + 1}.{suffix}"
            figures[name] = content
            parts.append(f"![{alt}]({name}){{ .notebook-figure{size} }}")
            if _GALLERY_TAG in cell["metadata"].get("tags", []):
                gallery = name, alt
    if gallery is None:
        raise ValueError(f"{path.name}: no cell with a figure has the tag {_GALLERY_TAG}")
    download = f'<a href="{path.name}" download>Download this notebook</a>'
    parts.insert(1, f'<p class="notebook-download" markdown="0">{download}</p>')
    return NotebookPage(path.stem, link_pages("\n\n".join(parts)) + "\n", figures, *gallery)


def link_pages(markdown: str) -> str:
    """Return Markdown whose links to notebooks lead to their pages."""
    return _NOTEBOOK_LINK.sub(rf"\1{PAGE_SUFFIX}\2", markdown)


def gallery(markdown: str) -> str:
    """Return the page of the gallery with its list of notebooks as cards, each with a figure of the notebook."""
    cards = _GALLERY_ITEM.sub(lambda match: _card(match[1], match[2], " ".join(match[3].split())), markdown)
    first, last = cards.index("<!-- card -->"), cards.rindex("<!-- end of card -->")
    return f'{cards[:first]}<div class="notebook-cards" markdown>\n\n{cards[first:last]}</div>\n{cards[last:]}'


def _card(title: str, name: str, sentence: str) -> str:
    page = pages()[name]
    picture = f"[![{page.gallery_alt}]({page.gallery_figure})]({name}{PAGE_SUFFIX})"
    link = f"[**{title}**]({name}{PAGE_SUFFIX})"
    card = f'<div class="notebook-card" markdown>\n\n{picture}\n\n{link}\n\n{sentence}\n\n</div>'
    return f"<!-- card -->\n{card}\n<!-- end of card -->\n"


def _figure(output: dict[str, Any]) -> tuple[str, bytes, str] | None:
    """Return the suffix, the content and the Markdown attributes of a figure; None for other outputs."""
    data = output.get("data", {})
    if "image/png" in data:
        width = output["metadata"].get("image/png", {}).get("width")
        return "png", base64.b64decode(_text(data["image/png"])), f" width={width}" if width else ""
    if "image/svg+xml" in data:
        return "svg", _text(data["image/svg+xml"]).encode(), ""
    return None


def _output(output: dict[str, Any]) -> str:
    if output["output_type"] == "stream":
        return _plain(_text(output["text"]))
    data = output["data"]
    if "text/html" in data:
        table = _TABLE_TAG.sub("<table>", _STYLE.sub("", _text(data["text/html"])))
        return f'<div class="notebook-table" markdown="0">{table}</div>'
    if "text/markdown" in data:
        return _text(data["text/markdown"])
    return _plain(_text(data["text/plain"]))


def _plain(text: str) -> str:
    return f'<pre class="notebook-output" markdown="0">{html.escape(text.rstrip())}</pre>'


def _fence(source: str, language: str) -> str:
    return f"```{language}\n{source}\n```"


def _text(value: str | list[str]) -> str:
    return value if isinstance(value, str) else "".join(value)
