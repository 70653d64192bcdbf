"""What is hashed is what is parsed: each file is hashed once, and each input file is read once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
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


def test_files_of_the_run_are_read_each_time(tmp_path: Path) -> None:
    path = tmp_path / "a"
    current = Digests(tmp_path)
    for content in (b"one", b"two"):
        path.write_bytes(content)
        with current.open(path) as file:
            assert file.read() == content


@pytest.mark.parametrize("in_run_folder", [True, False])
def test_rejects_file_that_is_not_held_and_differs_from_its_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_run_folder: bool
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    monkeypatch.setattr(digests, "MAX_HELD_BYTES", 2)
    current = Digests(tmp_path if in_run_folder else None)
    assert current.of(path) == sha256(b"one")
    with current.open(path) as file:
        assert file.read() == b"one"
    path.write_bytes(b"two")
    with pytest.raises(InputError, match="was changed while it was in use"):
        current.open(path)


def test_rejects_artefact_that_is_not_the_recorded_one_when_it_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    current = Digests(tmp_path, recorded={path: sha256(b"two")})
    with pytest.raises(InputError, match="was altered or replaced"):
        current.open(path)
    path.write_bytes(b"two")
    with current.open(path) as file:
        assert file.read() == b"two"


def test_expected_digest_is_that_of_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with files.hash_written_files(tmp_path) as written:
        files.write_text(path, "one")
        files.write_text(tmp_path / "folder" / "b", "two")
    assert written == {"a": sha256(b"one"), "folder/b": sha256(b"two")}
    path.write_bytes(b"two")
    current = Digests(tmp_path)
    current.expect({path: written["a"]})
    assert current.of(path) == sha256(b"one")
    with pytest.raises(InputError, match="was changed"):
        current.open(path)


def replace_and_put_back(path: Path) -> None:
    status, content = path.stat(), path.read_bytes()
    path.write_bytes(b"two")
    other = path.with_name("other")
    other.write_bytes(content)
    os.utime(other, ns=(status.st_atime_ns, status.st_mtime_ns))
    other.replace(path)


def write_over_and_set_times_back(path: Path) -> None:
    status = path.stat()
    path.write_bytes(b"two")
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def remove(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("change", [replace_and_put_back, write_over_and_set_times_back, remove])
def test_finds_file_that_was_changed_after_it_was_hashed(tmp_path: Path, change: Callable[[Path], None]) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    current = Digests(tmp_path)
    with current.collect() as paths:
        current.of(path)
    current.check_unchanged(paths)
    change(path)
    for check in (lambda: current.check_unchanged(paths), current.check_unchanged):
        with pytest.raises(InputError, match="a: was changed while it was in use"):
            check()


def test_finds_file_that_was_changed_while_another_process_read_it(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    with use_digests(Digests(tmp_path / "run")), digests.unchanged_inputs(path):
        path.write_bytes(b"not hashed before")
    with use_digests(Digests(tmp_path / "run")):
        hash_input(path)
        with pytest.raises(InputError, match="was changed"), digests.unchanged_inputs(path):
            path.write_bytes(b"two")


def test_new_link_and_held_content_are_no_change(tmp_path: Path) -> None:
    linked, held = tmp_path / "linked", tmp_path / "held"
    linked.write_bytes(b"one")
    held.write_bytes(b"one")
    current = Digests(tmp_path / "run")
    current.of(linked)
    current.open(held).close()
    current.of(held)
    os.link(linked, tmp_path / "link")
    held.write_bytes(b"two")
    current.check_unchanged()


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
