"""Folders of extensions: listed among the runs, and exported as layers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from egvs.core.errors import MissingBackendError
from egvs.export import folder_kinds
from tests.core.test_plugins import clear_caches, install

MODULE = """
class Survey:
    name, marker, state = "survey", "survey.txt", "all surveyed"

    def title(self, folder):
        return "title"

    def reference_run(self, folder):
        raise NotImplementedError

    def layers(self, folder):
        raise NotImplementedError

    def part_hint(self, folder):
        return "Export a part."

KIND = Survey()
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path in which an extension is installed."""
    folder = tmp_path / "site"
    install(folder, "surveys", "survey = plug_survey:KIND", {"plug_survey": MODULE}, folder_kinds.GROUP)
    monkeypatch.syspath_prepend(str(folder))
    clear_caches()
    folder_kinds.folder_kinds.cache_clear()
    yield folder
    clear_caches()
    folder_kinds.folder_kinds.cache_clear()
    sys.modules.pop("plug_survey", None)


def test_marker_tells_the_kind(site: Path, tmp_path: Path) -> None:
    assert folder_kinds.find_kind(tmp_path) is None
    (tmp_path / "survey.txt").touch()
    kind = folder_kinds.find_kind(tmp_path)
    assert kind is not None and kind.name == "survey"


def test_format_for_runs_only_says_what_to_export(site: Path, tmp_path: Path, run_egvs: Any) -> None:
    (tmp_path / "survey.txt").touch()
    code, _, error = run_egvs("export", tmp_path, "--to", "glb")
    assert code == 2
    assert f"--to glb: {tmp_path} is the folder of a survey. Export a part." in error.replace("\n", " ")


def test_rejects_object_that_is_no_kind(site: Path) -> None:
    (site / "plug_survey.py").write_text("KIND = 7")
    with pytest.raises(MissingBackendError, match="expected an object with name, marker, state"):
        folder_kinds.find_kind(site)
