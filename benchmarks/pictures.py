"""Where do the pictures in README and docs come from?

From the report of the shipped junction: ``make pictures`` runs the scenario and takes the figures out of the page.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pipeline
from pipeline import figures

ROOT = Path(__file__).resolve().parent.parent


def figure(page: str, label: str) -> str:
    """The figure of a report whose accessible label begins with ``label``, as a file of its own."""
    found = next(svg for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL) if f'aria-label="{label}' in svg)
    return figures.standalone(found)


def main() -> None:
    """Draw the picture of the README."""
    with tempfile.TemporaryDirectory() as folder:
        pipeline.run(pipeline.load(ROOT / "scenarios" / "nishishinjuku"), folder)
        page = (Path(folder) / "report.html").read_text(encoding="utf-8")
    (ROOT / "docs" / "images" / "nishishinjuku.svg").write_text(figure(page, "Map of"), encoding="utf-8")


if __name__ == "__main__":
    main()
