"""Checksums: of JSON records, as one of their keys, and of the files of studies, as ``sha256sum --check`` reads them.

Records of this program contain their own hash, so that any damage is noticed. It is not a signature: anyone who can
write the file can recompute it.

Studies (accuracy, validation, placement) can be made where there is no run; they leave lists of checksums instead of an
entry in ``run.json``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from egvs.core import files
from egvs.core.errors import InputError

_CHECKSUM_LINE = re.compile(r"([0-9a-f]{64})  ([^/\\\0]+)")


def write_checksums(path: Path, written: Iterable[Path]) -> None:
    """Write the checksums of files in the same folder to ``path``."""
    files.write_text(path, "".join(f"{files.hash_file(file)}  {file.name}\n" for file in written))


def verify_checksums(path: Path, hint: str) -> None:
    """Check the files listed in ``path``; nothing happens where there is no list, as in folders of old versions.

    Raises
    ------
    InputError
        When a listed file exists and its checksum is another one; ``hint`` says what to do.
    """
    for name in changed_files(path, hint):
        raise InputError(path.with_name(name), f"does not match its checksum in {path.name}", hint)


def changed_files(path: Path, hint: str) -> list[str]:
    """Return the names of the existing files whose checksum differs from the list in ``path``."""
    if not path.is_file():
        return []
    changed = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        entry = _CHECKSUM_LINE.fullmatch(line)
        if entry is None:
            raise InputError(path, "is not a list of checksums", hint)
        file = path.with_name(entry[2])
        if file.is_file() and files.hash_file(file) != entry[1]:
            changed.append(file.name)
    return changed


CHECKSUM_KEY = "own_sha256"
"""Key of the hash of all other keys of a record."""


def add_checksum(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with its checksum as the last key."""
    record = {key: part for key, part in value.items() if key != CHECKSUM_KEY}
    return {**record, CHECKSUM_KEY: files.hash_json(json.loads(files.to_json_text(record)))}


def has_valid_checksum(value: Any) -> bool:
    """Return whether a value parsed from JSON is a record with the right checksum."""
    if not isinstance(value, dict):
        return False
    record = {key: part for key, part in value.items() if key != CHECKSUM_KEY}
    return value.get(CHECKSUM_KEY) == files.hash_json(record)
