"""The documentation that is written by hand, and the changelog, stay short."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tests.docs.pages import DOCS, ROOT

sys.path.insert(0, str(DOCS / "mkdocs"))
import words

MAX_WORDS = 60_000
MAX_CHANGELOG_WORDS = 2_500


@pytest.mark.slow
def test_documentation_is_short() -> None:
    counts = words.count_words()
    assert {"index.md", "api/index.md", "notebooks/paper.ipynb"} <= counts.keys()
    assert not {"columns.md", "limits.md", "modules.md", "scenario-keys.md"} & counts.keys()
    longest = sorted(counts, key=counts.__getitem__)[-5:]
    assert sum(counts.values()) <= MAX_WORDS, f"shorten the docs (see docs/mkdocs/words.py); the longest are {longest}"


def test_changelog_is_short() -> None:
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split()) <= MAX_CHANGELOG_WORDS


@pytest.mark.slow
def test_counts_text_but_no_code_or_output_of_notebooks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(words, "DOCS", tmp_path)
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "page.md").write_text("# A title\n\n| one | two |\n", encoding="utf-8")
    cells = [{"cell_type": "markdown", "source": ["three words\n", "here"]}, {"cell_type": "code", "source": ["x = 1"]}]
    (tmp_path / "notebooks" / "some.ipynb").write_text(json.dumps({"cells": cells}), encoding="utf-8")
    assert words.count_words() == {"notebooks/some.ipynb": 3, "page.md": 8}
