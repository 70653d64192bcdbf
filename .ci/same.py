"""Compare the artefacts in two folders, and list what differs. Exit code 1 if anything does.

Parquet is compared by schema, column by column (values, types, order of rows) and by metadata; JSON when parsed; text
after masking what no two runs share: times, sizes, dates and hashes. Other files are compared byte for byte. Hidden
files count, too, except locks, digests and what is only valid for one folder.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

IGNORED_KEYS = (
    "cost", "created", "duration_s", "host", "inputs", "key", "keys", "kilobytes", "own_sha256", "pandas",
    "peak_memory_bytes", "program", "scenario_folder", "seconds", "stage_key", "started",
    "sumo_peak_mb", "sumo_seconds", "version",
)  # fmt: skip
"""Keys of JSON and of Parquet metadata that differ between any two runs or versions."""

IGNORED_FILES = (".digests", ".lock", ".unchanged")
"""How the names of files begin that are only valid for one folder."""

MASKS = (
    r"<h3>Cost of each stage</h3>[\s\S]*?</table>",  # in the report
    r"\b\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d)?(\.\d+)?(Z|[+-]\d\d:?\d\d)?)?",  # dates
    r"\b\d[\d.,]*\s?(?:ms|s|min|kB|MB|GB)\b",  # times and sizes
    r"\b[0-9a-f]{16,64}\b",  # hashes
)
TEXTS = {".css", ".csv", ".html", ".md", ".sha256", ".svg", ".toml", ".txt", ".xml"}


def main() -> int:
    """Print what differs, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("one", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--ignore", nargs="*", default=IGNORED_KEYS, help="keys of JSON and Parquet metadata")
    options = parser.parse_args()
    ignored = frozenset(options.ignore)

    ones, others = artefacts(options.one), artefacts(options.other)
    differing = 0
    for name in sorted(ones ^ others):
        differing += 1
        print(f"only in {options.one if name in ones else options.other}: {name}")
    for name in sorted(ones & others):
        if parts := different_parts(options.one / name, options.other / name, ignored):
            differing += 1
            print(f"{name}: {', '.join(parts)}")
    print(f"{len(ones & others)} files are in both folders; {differing} differ or are in one folder only")
    return int(differing > 0)


def artefacts(folder: Path) -> set[Path]:
    """Return the files in a folder, relative to it."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(IGNORED_FILES))
    return {path.relative_to(folder) for path in files}


def different_parts(one: Path, other: Path, ignored: frozenset[str]) -> list[str]:
    """Return the names of the parts of two files that differ."""
    ones, others = dict(parts(one, ignored)), dict(parts(other, ignored))
    return [name for name in sorted(ones.keys() | others.keys()) if ones.get(name) != others.get(name)]


def parts(path: Path, ignored: frozenset[str]) -> Iterator[tuple[str, str]]:
    """Yield the parts of a file, each with its name and with a text that is the same where the part is."""
    if path.suffix == ".parquet":
        yield from _table_parts(path, ignored)
    elif path.suffix in (".json", ".geojson"):
        yield "content", _canonical(json.loads(path.read_text(encoding="utf-8")), ignored)
    elif path.suffix in TEXTS:
        yield "content", _mask(path.read_text(encoding="utf-8"))
    else:
        yield "content", hashlib.sha256(path.read_bytes()).hexdigest()


def _table_parts(path: Path, ignored: frozenset[str]) -> Iterator[tuple[str, str]]:
    table = pq.read_table(path)
    yield "schema", str(table.schema.remove_metadata())
    for name in table.column_names:
        values = repr(table.column(name).to_pylist())
        yield f"column {name}", hashlib.sha256(values.encode()).hexdigest()
    for raw_key, raw_value in (table.schema.metadata or {}).items():
        key, value = raw_key.decode(), raw_value.decode(errors="replace")
        if key in ignored or key == "ARROW:schema":
            continue
        try:
            yield f"metadata {key}", _canonical(json.loads(value), ignored)
        except ValueError:
            yield f"metadata {key}", _mask(value)


def _canonical(value: Any, ignored: frozenset[str]) -> str:
    """Return JSON as text, sorted by key, without ignored keys."""
    return json.dumps(_without(value, ignored), sort_keys=True)


def _without(value: Any, ignored: frozenset[str]) -> Any:
    if isinstance(value, dict):
        return {key: _without(item, ignored) for key, item in value.items() if key not in ignored}
    if isinstance(value, list):
        return [_without(item, ignored) for item in value]
    return _mask(value) if isinstance(value, str) else value


def _mask(text: str) -> str:
    """Return a text with a ``#`` for each time, size, date and hash."""
    for pattern in MASKS:
        text = re.sub(pattern, "#", text)
    return text


if __name__ == "__main__":
    sys.exit(main())
