"""What is hashed is what is parsed: each file is hashed once, and each input file is read once."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from egvs.core import digests, files
from egvs.core.digests import Digests, hash_input, open_input, use_digests
from egvs.core.errors import InputError


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def read(path: Path) -> bytes:
    with open_input(path) as file:
        return file.read()


def test_file_that_is_edited_after_it_was_read_keeps_its_content_and_digest(tmp_path: Path) -> None:
    path = tmp_path / "sites.csv"
    path.write_bytes(b"one")
    with use_digests(Digests(tmp_path / "run")):
        assert read(path) == b"one"
        path.write_bytes(b"two, longer")
        assert read(path) == b"one"
        assert hash_input(path) == sha256(b"one")
    assert read(path) == b"two, longer"
    assert hash_input(path) == sha256(b"two, longer")


def test_rejects_file_that_is_edited_between_its_digest_and_its_parser(tmp_path: Path) -> None:
    path = tmp_path / "sites.csv"
    path.write_bytes(b"one")
    with use_digests(Digests(tmp_path / "run")):
        hash_input(path)
        path.write_bytes(b"two")
        with pytest.raises(InputError, match="was changed while it was in use"):
            open_input(path)


def test_link_and_file_have_one_content(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"one")
    link.symlink_to(path)
    current = Digests()
    assert current.open(link).read() == b"one"
    path.write_bytes(b"two")
    assert current.open(path).read() == b"one"


def test_files_of_the_run_and_large_files_are_read_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    artefact, large = tmp_path / "run" / "a", tmp_path / "large"
    artefact.parent.mkdir()
    monkeypatch.setattr(digests, "MAX_HELD_BYTES", 2)
    current = Digests(artefact.parent)
    for path in (artefact, large):
        for content in (b"one", b"two"):
            path.write_bytes(content)
            with current.open(path) as file:
                assert file.read() == content


def test_temporary_files_are_read_and_hashed_each_time(tmp_path: Path) -> None:
    current = Digests(tmp_path)
    with files.temporary_folder() as folder:
        for content in (b"one", b"two"):
            (folder / "a").write_bytes(content)
            assert current.of(folder / "a") == sha256(content)
            with current.open(folder / "a") as file:
                assert file.read() == content


def test_artefact_is_hashed_again_once_it_is_forgotten(tmp_path: Path) -> None:
    path = tmp_path / "sumo" / "a"
    path.parent.mkdir()
    path.write_bytes(b"one")
    current = Digests(tmp_path)
    current.of(path)
    path.write_bytes(b"two")
    current.forget(tmp_path / "sum", tmp_path / "other")
    assert current.of(path) == sha256(b"one")
    current.forget(tmp_path / "sumo")
    assert current.of(path) == sha256(b"two")


def test_rejects_artefact_that_is_not_the_recorded_one_until_it_is_forgotten(tmp_path: Path) -> None:
    path, unknown = tmp_path / "a", tmp_path / "b"
    for file in (path, unknown):
        file.write_bytes(b"one")
    current = Digests(tmp_path, recorded={path: sha256(b"two"), unknown: ""})
    with pytest.raises(InputError, match="was altered or replaced"):
        current.of(path)
    with pytest.raises(InputError, match="was not created by any stage"):
        current.of(unknown)
    current.forget(path, unknown)
    assert current.of(path) == current.of(unknown) == sha256(b"one")


def test_rejects_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Digests().of(tmp_path / "absent")
