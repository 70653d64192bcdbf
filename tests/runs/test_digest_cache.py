"""A file is hashed again unless everything that its file system says about it is as before, and it was not new then."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.artefacts.run_folder import RunFolder
from egvs.core import digests, files
from egvs.core.digests import hash_input
from egvs.runs.digest_cache import remember_digests
from tests.conftest import write_mini

OLD_S = 1_000_000_000


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


class HashedFiles:
    """Hashes files in runs of their own, and lists those that are read."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder = RunFolder(folder)
        self.paths: list[Path] = []
        monkeypatch.setattr(files, "hash_file", self._hash)

    def digest(self, path: Path) -> str:
        """The digest of a file in a run of its own."""
        self.paths.clear()
        with remember_digests(self._folder):
            return hash_input(path)

    def _hash(self, path: Path) -> str:
        self.paths.append(path)
        return sha256(path.read_bytes())


@pytest.fixture
def all_local(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The temporary folder counts as a local file system, wherever the tests run."""
    monkeypatch.setattr(digests, "_local_devices", lambda: frozenset({tmp_path.stat().st_dev}))


@pytest.fixture
def hashed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> HashedFiles:
    return HashedFiles(tmp_path, monkeypatch)


def write_old(path: Path, content: bytes) -> None:
    """A file that was last changed long ago."""
    path.write_bytes(content)
    os.utime(path, (OLD_S, OLD_S))


def test_unchanged_old_file_is_hashed_once(all_local: None, hashed: HashedFiles, tmp_path: Path) -> None:
    write_old(tmp_path / "a", b"one")
    assert hashed.digest(tmp_path / "a") == sha256(b"one")
    assert hashed.paths
    assert hashed.digest(tmp_path / "a") == sha256(b"one")
    assert not hashed.paths


def test_edit_of_same_size_with_same_mtime_is_found(all_local: None, hashed: HashedFiles, tmp_path: Path) -> None:
    write_old(tmp_path / "a", b"one")
    hashed.digest(tmp_path / "a")
    write_old(tmp_path / "a", b"two")
    assert hashed.digest(tmp_path / "a") == sha256(b"two")


def test_edit_within_resolution_of_time_stamps_is_found(
    all_local: None, hashed: HashedFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_bytes(b"one")
    stamp = digests._file_stamp(str(tmp_path / "a"))
    monkeypatch.setattr(digests, "_file_stamp", lambda name: stamp)  # both edits within one tick of its clock
    assert hashed.digest(tmp_path / "a") == sha256(b"one")
    (tmp_path / "a").write_bytes(b"two")
    assert hashed.digest(tmp_path / "a") == sha256(b"two")


def copy_over(path: Path) -> None:
    """Replace a file by a copy that has its content and times."""
    shutil.copy2(path, path.with_name("copy"))
    path.with_name("copy").replace(path)


def append(path: Path) -> None:
    """Make a file longer, as long ago."""
    write_old(path, path.read_bytes() + b"!")


@pytest.mark.parametrize("change", [copy_over, append, lambda path: os.utime(path)], ids=["copy", "size", "mtime"])
def test_file_that_may_be_another_one_is_hashed(
    all_local: None, hashed: HashedFiles, tmp_path: Path, change: Callable[[Path], Any]
) -> None:
    write_old(tmp_path / "a", b"one")
    hashed.digest(tmp_path / "a")
    change(tmp_path / "a")
    assert hashed.digest(tmp_path / "a") == sha256((tmp_path / "a").read_bytes())
    assert hashed.paths


def test_file_on_unknown_file_system_is_always_hashed(
    hashed: HashedFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(digests, "_local_devices", frozenset)
    write_old(tmp_path / "a", b"one")
    for _ in range(2):
        assert hashed.digest(tmp_path / "a") == sha256(b"one")
        assert hashed.paths
    assert not (tmp_path / ".digests.json").exists()


@pytest.mark.parametrize("content", [b"", b"{}", b"[1]", b'{"files": {"a": []}, "own_sha256": "0"}', b"\xff"])
def test_damaged_cache_is_ignored(all_local: None, hashed: HashedFiles, tmp_path: Path, content: bytes) -> None:
    (tmp_path / ".digests.json").write_bytes(content)
    write_old(tmp_path / "a", b"one")
    assert hashed.digest(tmp_path / "a") == sha256(b"one")
    hashed.digest(tmp_path / "a")
    assert not hashed.paths


def test_cache_is_not_written_after_error(all_local: None, tmp_path: Path) -> None:
    write_old(tmp_path / "a", b"one")
    with pytest.raises(KeyError), remember_digests(RunFolder(tmp_path)):
        hash_input(tmp_path / "a")
        raise KeyError
    assert not (tmp_path / ".digests.json").exists()


def test_digests_that_are_not_trusted_are_computed_again(all_local: None, hashed: HashedFiles, tmp_path: Path) -> None:
    write_old(tmp_path / "a", b"one")
    hashed.digest(tmp_path / "a")
    hashed.paths.clear()
    with remember_digests(RunFolder(tmp_path), trusted=False):
        hash_input(tmp_path / "a")
    assert hashed.paths


def test_mount_table_lists_local_file_systems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "mountinfo"
    table.write_text(
        "27 1 254:3 / / rw,relatime - ext4 /dev/vda rw\n"
        "30 27 0:51 / /net rw shared:7 master:2 - nfs4 server:/home rw\n"
        "31 27 0:52 / /mnt rw - fuse.sshfs host: rw\n"
    )
    monkeypatch.setattr(digests, "_MOUNTS", table)
    digests._local_devices.cache_clear()
    assert digests._local_devices() == {os.makedev(254, 3)}
    monkeypatch.setattr(digests, "_MOUNTS", tmp_path / "absent")
    digests._local_devices.cache_clear()
    assert digests._local_devices() == frozenset()
    digests._local_devices.cache_clear()


@pytest.mark.slow
def test_run_finds_edit_in_same_second_without_change_of_size(all_local: None, tmp_path: Path) -> None:
    mini = write_mini(tmp_path / "mini")
    scenario, out, sites = egvs.load(mini), tmp_path / "run", mini / "sites.csv"
    status = sites.stat()
    first = egvs.run(scenario, out)
    sites.write_text(sites.read_text().replace("10,12,3", "10,12,4"))
    os.utime(sites, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert sites.stat().st_size == status.st_size

    changed = []
    second = egvs.run(scenario, out, listener=lambda stage, state, record: changed.append((stage, state)))
    assert ("scan", "runs") in changed
    assert ("traffic", "skipped") in changed
    assert second.stages["scan"].artefacts != first.stages["scan"].artefacts
    assert egvs.verify(out) == []


@pytest.mark.slow
def test_damaged_artefact_is_made_again(all_local: None, tmp_path: Path) -> None:
    scenario, out = egvs.load(write_mini(tmp_path / "mini")), tmp_path / "run"
    record = egvs.run(scenario, out)
    for _ in range(2):
        egvs.run(scenario, out)
    path = out / "scans.parquet"
    content = path.read_bytes()
    status = path.stat()
    path.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert egvs.run(scenario, out).stages["scan"].artefacts == record.stages["scan"].artefacts
    assert path.read_bytes() == content
