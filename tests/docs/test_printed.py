"""What README and docs quote of the program's output is what it prints (:mod:`benchmarks.docs_figures.printed`)."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from benchmarks.docs_figures.__main__ import GROUPS, PICTURES, Group
from benchmarks.docs_figures.printed import CODE_BLOCK, SCORES, Quote, Session, pages, quotes_of
from benchmarks.docs_figures.sessions import SESSIONS, session_of

from tests.docs.pages import DOCS, ROOT

HINT = "run `make docs-figures`, and see what it lists"

UNMARKED = {
    "accuracy.md",  # seconds, which no other run repeats
    "sensor-fit.md",  # recordings that are not shipped
    "tutorial.md",  # a map that is not shipped
}
"""Pages whose output with errors is not compared."""


def all_quotes() -> list[Quote]:
    return [quote for page in pages() for quote in quotes_of(page)]


@pytest.mark.parametrize("quote", all_quotes(), ids=lambda quote: f"{quote.page.name}:{quote.line}")
def test_pages_quote_what_is_printed(quote: Quote) -> None:
    printed = "\n".join(session_of(name).stored for name in quote.sessions)
    assert not quote.stale_parts(printed), HINT


@pytest.mark.parametrize(
    "session",
    [
        pytest.param(session, id=session.name, marks=[] if session.is_quick else [pytest.mark.slow])
        for session in SESSIONS
    ],
)
@pytest.mark.system
def test_program_prints_what_is_stored(session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_STORE", str(tmp_path / "store"))
    folder = tmp_path / session.name
    assert session.printed(folder) == session.stored, HINT
    assert session.scores(folder) == json.loads(SCORES.read_text(encoding="utf-8"))["sessions"][session.name], HINT


def test_output_with_errors_is_marked_on_every_page() -> None:
    quotes = all_quotes()
    for page in pages():
        marked = [quote.text for quote in quotes if quote.page == page]
        for match in CODE_BLOCK.finditer(page.read_text(encoding="utf-8")):
            text = (match[2] or match[3]).strip()
            if re.search(r"\d ± \d", text) and page.name not in UNMARKED:
                assert any(text in quoted for quoted in marked), f"{page.name}: {text[:200]}"


def test_first_pages_quote_the_answers() -> None:
    quoting = {(quote.page.name, name) for quote in all_quotes() for name in quote.sessions}
    assert {("README.md", "demo"), ("certainty.md", "demo"), ("story.md", "story")} <= quoting


def test_commands_of_the_story_are_those_that_run() -> None:
    lines = re.findall(r"^\$ (egvs .+)$", (DOCS / "story.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert tuple(lines) == session_of("story").commands[: len(lines)]


PRINTED = (
    "kerb_NW is the best: it finds 74 ± 6 % of 1,040 vehicles.\n\n1  kerb_NW    3  73.8 %\n2  kerb_NE    3  72.9 %\n"
)


@pytest.mark.parametrize(
    ("text", "stale"),
    [
        ("**It** *finds 74 ± 6 % of\n1,040 vehicles*.", []),
        ("*It finds 74 ± 6 % of 1,040 cars.*", ["It finds 74 ± 6 % of 1,040 cars."]),
        ("It finds 75 ± 6 % of 1,040 vehicles.", ["75 ± 6 %"]),
        ("It finds 74 ± 6 % of 104 vehicles.", ["104"]),
        ("```text\nkerb_NW is the best: [...]\n1  kerb_NW 3  73.8 %\n```", []),
        ("```text\n1  kerb_NW 3  73.9 %\n```", ["1 kerb_NW 3 73.9 %"]),
        ("    1  kerb_NW    3  73.8 %\n    ...\n    2  kerb_NE    3  72.8 %\n", ["2 kerb_NE 3 72.8 %"]),
    ],
)
def test_lists_stale_parts_of_a_quote(text: str, stale: list[str], tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"Before.\n\n<!-- printed: demo -->\n{text}\n\nAfter, 12 of them.\n", encoding="utf-8")
    (quote,) = quotes_of(page)
    assert (quote.stale_parts(PRINTED), quote.sessions) == (stale, ("demo",))


@pytest.mark.parametrize("group", [group for group in GROUPS if group.session], ids=lambda group: group.name)
def test_pictures_show_the_stored_scores(group: Group) -> None:
    stored = json.loads(SCORES.read_text(encoding="utf-8"))
    assert stored["pictures"][group.name] == stored["sessions"][group.session], HINT


@pytest.mark.parametrize("picture", sorted((DOCS / "images").rglob("*.*")), ids=lambda path: path.name)
def test_every_picture_is_on_a_page_and_has_a_source(picture: Path) -> None:
    name = picture.relative_to(DOCS / "images").as_posix()
    text = "".join(page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *DOCS.rglob("*.md")])
    assert f"images/{name}" in text
    assert name in PICTURES
