"""Checksums of what a study leaves beside a run, as ``sha256sum --check`` reads them.

A run's artefacts have theirs in ``run.json``; a study may be made where there is no run.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from pipeline.core import files
from pipeline.core.errors import InputError

_LINE = re.compile(r"([0-9a-f]{64})  ([^/\\\0]+)")


def write(path: Path, made: Iterable[Path]) -> None:
    """Write the checksums of files that lie beside ``path``."""
    files.write_text(path, "".join(f"{files.sha256_of(file)}  {file.name}\n" for file in made))


def check(path: Path, right: str) -> None:
    """InputError where a file that ``path`` lists is there and is another one by now; ``right`` says what to do.

    Nothing is said where there is no such list, as earlier versions left none.
    """
    for name in altered(path, right):
        raise InputError(path.with_name(name), f"is not the file of which {path.name} has the checksum", right)


def altered(path: Path, right: str) -> list[str]:
    """The names of the files that are there and are other ones by now."""
    if not path.is_file():
        return []
    found = [_LINE.fullmatch(line) for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    if not all(found):
        raise InputError(path, "is no list of checksums", right)
    beside = ((path.with_name(line[2]), line[1]) for line in found if line is not None)
    return [file.name for file, digest in beside if file.is_file() and files.sha256_of(file) != digest]
