"""Every link of every Markdown page leads to a file, and to a heading of it; addresses on the web have a valid form."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.docs.pages import DOCS, ROOT, headings, links, section, slug

PAGES = sorted(
    [*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / ".github").rglob("*.md"), *(ROOT / "scenarios").rglob("*.md")]
)
GENERATED = re.compile(r"^docs/(api/(?!index)[\w-]+\.md)$")
"""Pages that the build of the documentation makes from the source."""


def problem(page: Path, target: str) -> str | None:
    """Return what is wrong with a link of a page, or None."""
    parts = urlsplit(target)
    if parts.scheme == "mailto":
        return None if re.fullmatch(r"[^@\s]+@[^@\s]+\.\w+", parts.path) else "no valid e-mail address"
    if parts.scheme or parts.netloc:
        valid = parts.scheme in ("http", "https") and re.fullmatch(r"[\w-]+(\.[\w-]+)+(:\d+)?", parts.netloc)
        return None if valid else "no valid http or https address"
    file = (page.parent / parts.path).resolve() if parts.path else page
    if not file.is_relative_to(ROOT):
        return "outside of the project"
    if GENERATED.match(file.relative_to(ROOT).as_posix()):
        return None
    if not file.exists():
        return "no such file"
    if parts.fragment:
        if parts.fragment in ("only-light", "only-dark"):
            return None  # the theme shows such a picture in one colour scheme only
        if file.suffix != ".md":
            return "an anchor in a file that has no headings"
        if parts.fragment not in {heading.anchor for heading in headings(file.read_text(encoding="utf-8"))}:
            return "no such heading"
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    problems = {target: reason for target in links(text) if (reason := problem(page, target))}
    assert not problems


@pytest.mark.parametrize("page", [page for page in PAGES if "<!-- data table" in page.read_text(encoding="utf-8")])
def test_tables_of_data_have_a_file_and_a_link(page: Path) -> None:
    """The site shows the table; readers of the file follow the link."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"<!-- data table (\S+) -->", text):
        file = DOCS / "data" / f"{name}.csv"
        assert f"({Path(os.path.relpath(file, page.parent)).as_posix()})" in text
        table = file.read_text(encoding="utf-8")
        assert not {target: reason for target in links(table) if (reason := problem(page, target))}


def test_pages_have_links() -> None:
    count = sum(1 for page in PAGES for _ in links(page.read_text(encoding="utf-8")))
    assert len(PAGES) > 40
    assert count > 300


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("docs/no-such-page.md", "no such file"),
        ("docs/index.md#no-such-heading", "no such heading"),
        ("Makefile#run", "an anchor in a file that has no headings"),
        ("../elsewhere.md", "outside of the project"),
        ("https://example", "no valid http or https address"),
        ("ftp://example.org/file", "no valid http or https address"),
        ("mailto:nobody", "no valid e-mail address"),
    ],
)
def test_finds_broken_link(target: str, reason: str) -> None:
    assert problem(ROOT / "README.md", target) == reason


def test_reads_links_and_headings() -> None:
    text = (
        '# A `key` & "more"\n\n[a](b.md#c "title") `[no](link.md)` ![p](q.png)\n\n```\n# no heading\n[no](x.md)\n```\n'
        '<img src="y.svg">\n\n## Twice\n\none\n\n### Below\n\ntwo\n\n## Twice\n\nthree\n\n[ref]: https://example.org\n'
    )
    assert list(links(text)) == ["b.md#c", "q.png", "y.svg", "https://example.org"]
    assert [heading.anchor for heading in headings(text)] == ["a-key-more", "twice", "below", "twice_1"]
    assert section(text, "twice") == "## Twice\n\none\n\n### Below\n\ntwo\n\n"


def test_anchors_are_those_of_mkdocs() -> None:
    toc = pytest.importorskip("markdown.extensions.toc", reason="Markdown comes with the extra docs")
    for heading in (
        "How sure is the answer?",
        "What ± contains",
        "zones.parquet, plan_zones.parquet",
        "7. Decide",
        "A – B",
    ):
        assert slug(heading) == toc.slugify(heading, "-")
