"""Files that a mesh's file pulls in: buffers and images of glTF and GLB, materials of OBJ; they lie beside it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

_GLB, _HEADER_BYTES = b"glTF", 20
"""How a GLB starts, and what stands before its JSON."""


def pulled_in(path: Path) -> list[Path]:
    """What a mesh's file names and is there, in its order; of a damaged file nothing, which its reader tells."""
    suffix = path.suffix.lower()
    names: list[str] = []
    if suffix in (".gltf", ".glb"):
        names = _uris(_gltf(path.read_bytes()))
    elif suffix == ".obj":
        found = re.findall(rb"(?m)^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", path.read_bytes())
        names = [name.decode("utf-8", "replace") for name in found]
    paths = [path.parent / name for name in dict.fromkeys(names) if "\0" not in name and len(name) < 1024]
    return [part for part in paths if part.is_file()]


def _gltf(data: bytes) -> Any:
    """The JSON of a glTF or GLB; None where it is damaged."""
    if data.startswith(_GLB):
        data = data[_HEADER_BYTES : _HEADER_BYTES + int.from_bytes(data[12:16], "little")]
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def _uris(value: Any) -> list[str]:
    parts = [part for key in ("buffers", "images") for part in _list(value, key)]
    uris = [part.get("uri") for part in parts if isinstance(part, dict)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _list(value: Any, key: str) -> list[Any]:
    found = value.get(key) if isinstance(value, dict) else None
    return found if isinstance(found, list) else []
