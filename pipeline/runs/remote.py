"""A store on any file system that fsspec knows (``s3://``, ``gs://``, ``file://``, ...), shared by machines.

    <url>/<stage>-<key>/            the same files as an entry of a store's folder has; entry.json is written last

It stands behind a store's folder on this machine: what is not there is fetched, and what was made here is put. Locks
are this machine's alone: two machines that make the same at once both put it, which is the same bytes twice. An entry
without entry.json is none; one whose files have other hashes than it says is removed. Nothing else is ever removed.
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.core import files, plugins
from pipeline.core.errors import InputError
from pipeline.core.reading.refusing import reading

ENTRY = "entry.json"
"""What the store notes of an entry; written last."""

_RIGHT = "a place that this machine may read and write, and the library of its kind (s3fs for s3://)"


class Remote:
    """Entries at a URL. Each method raises InputError where the place cannot be reached."""

    def __init__(self, url: str) -> None:
        plugins.require(f"a store at {url}", "cluster", "fsspec")
        self.url = url
        import fsspec

        with reading(url, _RIGHT, "cannot be reached"):
            fs, root = fsspec.core.url_to_fs(url)
        self._fs: Any = fs
        self._root: str = root.rstrip("/")

    def check(self) -> None:
        """See that files can be written, read and removed there."""
        probe = self._path(".egvs", "probe")
        with reading(self.url, _RIGHT, "cannot be written"):
            self._fs.makedirs(posixpath.dirname(probe), exist_ok=True)
            self._fs.pipe_file(probe, b"egvs")
            self._fs.invalidate_cache()
            if self._fs.cat_file(probe) != b"egvs":
                raise InputError(self.url, "gives back other bytes than were written", _RIGHT)
            self._fs.rm_file(probe)

    def fetch(self, name: str, folder: Path) -> bool:
        """Lay an entry's files into a folder; whether there is such an entry, whole and sound."""
        with reading(self.url, _RIGHT, "cannot be read"):
            try:
                about = self._fs.cat_file(self._path(name, ENTRY))
            except FileNotFoundError:
                return False
            digests = _digests(about)
            if digests is None or not self._fetch_files(name, digests, folder):
                self._fs.rm(self._path(name), recursive=True)
                return False
        (folder / ENTRY).write_bytes(about)
        return True

    def _fetch_files(self, name: str, digests: dict[str, str], folder: Path) -> bool:
        for file, digest in digests.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            try:
                self._fs.get_file(self._path(name, file), str(folder / file))
            except FileNotFoundError:
                return False
            if files.sha256_of(folder / file) != digest:
                return False
        return True

    def put(self, name: str, folder: Path, names: Iterable[str]) -> None:
        """Keep an entry's files, unless it is kept already."""
        with reading(self.url, _RIGHT, "cannot be written"):
            self._fs.invalidate_cache()
            if self._fs.exists(self._path(name, ENTRY)):
                return
            for file in (*names, ENTRY):
                path = self._path(name, file)
                self._fs.makedirs(posixpath.dirname(path), exist_ok=True)
                self._fs.put_file(str(folder / file), path)

    def _path(self, *parts: str) -> str:
        return posixpath.join(self._root, *parts)


def _digests(about: bytes) -> dict[str, str] | None:
    """Name -> sha256 of an entry's files, as its record says; None where that is no record of ours."""
    try:
        value = json.loads(about)
        digests = {**value["artefacts"], **value["companions"]}
    except (ValueError, LookupError, TypeError, RecursionError):
        return None
    named = [PurePosixPath(str(name)) for name in digests]
    if any(path.is_absolute() or ".." in path.parts or not path.parts for path in named):
        return None
    return digests if all(isinstance(digest, str) for digest in digests.values()) else None
