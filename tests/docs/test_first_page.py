"""What README.md and the first page of the documentation promise agrees with the study, the program and the build."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from egvs.core.plugins import plugin_names
from tests.docs.pages import DOCS, ROOT

FIRST_PAGES = (ROOT / "README.md", DOCS / "index.md")
NUMBERS = {12: "twelve", 13: "thirteen", 14: "fourteen", 15: "fifteen"}


def words(path: Path) -> str:
    """Return the text of a page without line breaks."""
    return " ".join(path.read_text(encoding="utf-8").split())


@pytest.mark.parametrize("path", FIRST_PAGES, ids=lambda path: path.name)
def test_first_screen_says_what_for_whom_how_good_and_how_to_start(path: Path) -> None:
    first_screen = words(path).partition(" ## ")[0]
    for part in (
        "City planners",
        "LiDAR engineers",
        "Researchers",
        "pip install . egvs demo",
        "How good",
        "images/view",
    ):
        assert part in first_screen, part


@pytest.mark.parametrize("path", [*ROOT.glob("*.md"), *DOCS.glob("*.md")], ids=lambda path: path.name)
def test_no_command_needs_a_release(path: Path) -> None:
    text = words(path).replace("rom the first release on, `pip install egvs` replaces `pip install .`", "")
    assert re.search(r"pip install egvs\b(?!\[)", text) is None


@pytest.mark.parametrize("path", FIRST_PAGES, ids=lambda path: path.name)
def test_numbers_are_those_of_the_study(path: Path) -> None:
    text, study = words(path).replace("**", ""), words(DOCS / "validity.md")
    found = re.search(r"Spearman's rho[^.]*?(0\.\d+) to (0\.\d+)", text)
    assert found is not None
    low, high = found.groups()
    assert f"rho {low} to {high} by junction and detector" in study


@pytest.mark.parametrize("path", FIRST_PAGES, ids=lambda path: path.name)
def test_number_of_scores_is_current(path: Path) -> None:
    assert f"{NUMBERS[len(plugin_names('egvs.scores')) - 1]} other scores" in words(path)


def load_hooks() -> ModuleType:
    """The script that MkDocs calls while it builds the site."""
    pytest.importorskip("mkdocs", reason="MkDocs comes with the extra docs")
    pytest.importorskip("latex2mathml", reason="latex2mathml comes with the extra docs")
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "mkdocs" / "hooks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("is_built", [True, False])
def test_picture_opens_the_3d_view_if_it_was_built(is_built: bool) -> None:
    page = SimpleNamespace(file=SimpleNamespace(src_uri="index.md"))
    files = SimpleNamespace(get_file_from_path=lambda name: object() if is_built and name == "view.html" else None)
    text = load_hooks().on_page_markdown((DOCS / "index.md").read_text(encoding="utf-8"), page, {}, files)
    target = re.search(r"images/view-dark\.png#only-dark\)\]\(([^)]+)\)", text)
    assert target is not None
    assert target[1] == ("view.html" if is_built else "explore.md#one-file-to-share")


def test_make_docs_writes_the_3d_view() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^docs: .*\bbuild/view\.html$", makefile, re.MULTILINE)
    assert re.search(r"^build/view\.html:", makefile, re.MULTILINE)
    assert '"build" / "view.html"' in (DOCS / "mkdocs" / "hooks.py").read_text(encoding="utf-8")
