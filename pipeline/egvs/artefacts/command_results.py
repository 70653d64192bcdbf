"""Results of commands that work on a finished run, as JSON files in its folder: what-ifs, installation sheets.

A file has one entry by name, for example for each site. With each entry it records the inputs of the stages that the
result depends on, so that the report shows an entry only while it belongs to the run.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts.checksums import add_checksum, has_valid_checksum
from egvs.core import files, reading
from egvs.core.errors import InputError

_HINT = "Remove it and repeat the command that wrote it."


@dataclass(frozen=True)
class CommandResult:
    """One entry.

    Attributes
    ----------
    stages
        Inputs (hash) of the stages that the result depends on, by their name.
    values
        The result, JSON values.
    """

    stages: Mapping[str, str]
    values: Mapping[str, Any]


def read_results(path: Path) -> dict[str, CommandResult]:
    """Return the entries of a file by name; empty if there is no such file.

    Raises
    ------
    InputError
        If the file is damaged or was changed.
    """
    if not path.is_file():
        return {}
    value = reading.read_json(path, _HINT)
    if not has_valid_checksum(value):
        raise InputError(path, "was changed: its checksum does not match the content", _HINT)
    try:
        return {name: CommandResult(entry["stages"], entry["values"]) for name, entry in value["entries"].items()}
    except (KeyError, TypeError, AttributeError):
        raise InputError(path, "is not a file of results", _HINT) from None


def write_results(path: Path, results: Mapping[str, CommandResult], removed: Collection[str] = ()) -> None:
    """Write entries into a file, in place of those of the same names; other entries stay but the ``removed`` ones."""
    entries = {name: entry for name, entry in read_results(path).items() if name not in removed} | dict(results)
    value = {
        "entries": {name: {"stages": dict(entry.stages), "values": entry.values} for name, entry in entries.items()}
    }
    files.write_text(path, files.to_json_text(add_checksum(value), indent=2) + "\n")
