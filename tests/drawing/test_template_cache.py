"""Compiled templates are cached; a damaged, old or foreign one is compiled again."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from jinja2 import DictLoader, Environment

from egvs.drawing.template_cache import TemplateCache, open_template_cache

TEXT = "{% for n in numbers %}{{ n }};{% endfor %}"


def render(folder: Path, text: str = TEXT) -> str:
    environment = Environment(loader=DictLoader({"page": text}), bytecode_cache=TemplateCache(folder))
    return environment.get_template("page").render(numbers=[1, 2])


def test_template_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert render(tmp_path) == "1;2;"
    monkeypatch.setattr(Environment, "compile", None)
    assert render(tmp_path) == "1;2;"


def test_changed_text_is_compiled_again(tmp_path: Path) -> None:
    render(tmp_path)
    assert render(tmp_path, "{{ numbers }}") == "[1, 2]"


def test_damaged_file_is_compiled_again(tmp_path: Path) -> None:
    render(tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    foreign = b"of another version"
    checked = hashlib.sha256(foreign).digest() + foreign
    for data in (b"", whole[:20], whole[:-5], whole[:-9] + b"?" + whole[-8:], checked):
        path.write_bytes(data)
        assert render(tmp_path) == "1;2;"
        assert path.read_bytes() == whole


def test_folder_depends_on_module_that_sets_options(tmp_path: Path) -> None:
    module = tmp_path / "page.py"
    folders = []
    for text in ("trim = True", "trim = False"):
        module.write_text(text)
        cache = open_template_cache(module)
        assert cache is not None
        folders.append(cache._folder)
    assert folders[0] != folders[1]
    assert all(folder.parent == tmp_path / "__pycache__" for folder in folders)


def test_no_writable_folder_means_no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "__pycache__").write_text("a file where the folder would be")
    (tmp_path / "page.py").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "page.py"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "page.py"))
    assert open_template_cache(tmp_path / "page.py") is None
