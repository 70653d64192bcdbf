"""Count the words of the documentation that are written by hand: ``python docs/mkdocs/words.py``.

These are the words of all Markdown pages and of the text of notebooks below ``docs``, with tables and code in them.
The pages that ``make reference`` writes do not count.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import reference

DOCS = Path(__file__).resolve().parents[1]


def count_words() -> dict[str, int]:
    """Return the number of words of each page that is written by hand, by its path below ``docs``."""
    pages = sorted({*DOCS.rglob("*.md"), *DOCS.rglob("*.ipynb")} - reference.pages().keys())
    return {path.relative_to(DOCS).as_posix(): len(_text(path).split()) for path in pages}


def _text(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    return "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")


if __name__ == "__main__":
    words = count_words()
    for name, count in words.items():
        print(f"{count:7,}  {name}")
    print(f"{sum(words.values()):7,}  words written by hand")
