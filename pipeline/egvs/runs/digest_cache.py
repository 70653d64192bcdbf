"""The digests that a run folder keeps in ``.digests.json``, so that unchanged files are not read again.

It contains the files of the last run in this folder. It only decides whether a file is read again (see
:mod:`egvs.core.digests`), and may be removed at any time; a damaged one is ignored.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from egvs.artefacts import checksums
from egvs.artefacts.run_folder import RunFolder
from egvs.core import digests, files
from egvs.core.digests import Digests, Entries


@contextmanager
def remember_digests(folder: RunFolder, *, trusted: bool = True) -> Iterator[Digests]:
    """Use the digests of the last run in a folder if they are trusted; save those of the block if it ends well."""
    earlier = _read_entries(folder.digests) if trusted else {}
    with digests.use_digests(Digests(folder.path, earlier=earlier)) as current:
        yield current
    entries = {name: entry for name, entry in sorted(current.entries.items()) if Path(name).exists()}
    if entries != earlier:
        with suppress(OSError):  # a cache that cannot be written costs time, nothing else
            files.write_text(folder.digests, files.to_json_text(checksums.add_checksum({"files": entries})) + "\n")


def _read_entries(path: Path) -> Entries:
    """Return the saved entries; none where there are none, or they are damaged."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not checksums.has_valid_checksum(value):
        return {}
    entries: Entries = value["files"]
    return entries
