"""Reads the description of a glTF or GLB file, and how much it would have a program hold.

A description of a few bytes can ask for any amount: accessors of zeros, many accessors of one buffer, a mesh that is
placed many times. Source: the Khronos Group, glTF 2.0 specification, 3.6 and 4.4.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.core.reading import documents, limits

_GLB, _HEADER_BYTES = b"glTF", 20
"""How a GLB starts, and what stands before its JSON."""

_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_WIDEST = 16  # values of a matrix


def document(data: bytes) -> Any:
    """The JSON of a glTF or GLB; ValueError or RecursionError where it is damaged."""
    if data.startswith(_GLB):
        data = data[_HEADER_BYTES : _HEADER_BYTES + int.from_bytes(data[12:16], "little")]
    return json.loads(data)


def check(path: Path, place: str, data: bytes) -> None:
    """InputError where the file would have more held than the bounds say; for the rest, what its JSON raises."""
    described = document(data)
    documents.check_depth(described)
    accessors, meshes = [list(_tables(described, key)) for key in ("accessors", "meshes")]
    held = sum(_count(accessor) * _WIDEST * _BYTES.get(accessor.get("componentType", 0), 4) for accessor in accessors)
    limits.UNPACKED.check_bytes(place, held / _WIDEST, "its accessors name more than that")
    corners = [sum(_corners(part, accessors) for part in _tables(mesh, "primitives")) for mesh in meshes]
    placed = [node.get("mesh") for node in _tables(described, "nodes")]
    total = sum(corners[at] for at in placed if isinstance(at, int) and 0 <= at < len(corners))
    limits.TRIANGLES.check(place, max(total, sum(corners)) // 3)
    beside = [path.parent / uri for key in ("buffers", "images") for uri in _uris(described, key)]
    limits.FILE.check_bytes(place, sum(part.stat().st_size for part in beside if part.is_file()), "names larger files")


def _count(accessor: dict[str, Any]) -> int:
    count = accessor.get("count", 0)
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor's count is {count!r}")
    return count


def _corners(primitive: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    """Corners of a primitive's triangles: its indices, or its points where it has none."""
    attributes = primitive.get("attributes")
    points = attributes.get("POSITION") if isinstance(attributes, dict) else None
    at = primitive.get("indices", points)
    return _count(accessors[at]) if isinstance(at, int) and 0 <= at < len(accessors) else 0


def _uris(described: Any, key: str) -> Iterator[str]:
    for part in _tables(described, key):
        uri = part.get("uri")
        if isinstance(uri, str) and not uri.startswith("data:"):
            yield uri


def _tables(value: Any, key: str) -> Iterator[dict[str, Any]]:
    found = value.get(key) if isinstance(value, dict) else None
    return (part for part in (found if isinstance(found, list) else []) if isinstance(part, dict))
