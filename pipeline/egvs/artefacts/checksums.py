"""Checksums of the files of studies, in the format of ``sha256sum --check``.

Studies (accuracy, validation, placement) can be made where there is no run; they leave lists of checksums instead of an
entry in ``run.json``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

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
