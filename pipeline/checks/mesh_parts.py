"""Files that a mesh's file pulls in: buffers and images of glTF and GLB; materials of OBJ, and the textures of these;
textures of PLY. They lie beside it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from pipeline.core import files
from pipeline.core.reading import limits
from pipeline.formats.meshes import gltf

_MATERIALS = re.compile(rb"(?m)^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$")
_TEXTURES = re.compile(rb"(?mi)^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+(.+?)[ \t\r]*$")
_TEXTURES_OF_PLY = re.compile(rb"(?m)^comment TextureFile[ \t]+(.+?)[ \t\r]*$")


def pulled_in(path: Path) -> list[Path]:
    """What a mesh's file names and is there, in its order; of a damaged file nothing, which its reader tells."""
    match path.suffix.lower():
        case ".gltf" | ".glb":
            uris = _uris(_gltf(limits.read_bytes(path, limits.FILE)))
            return _there(path, (name for uri in uris for name in (uri, unquote(uri))))
        case ".obj":
            materials = _there(path, _words(_MATERIALS, limits.read_bytes(path, limits.FILE)))
            textures = [_there(its, _words(_TEXTURES, limits.read_bytes(its, limits.FILE))) for its in materials]
            return list(dict.fromkeys([*materials, *(one for several in textures for one in several)]))
        case ".ply":
            head, _, _ = limits.read_bytes(path, limits.FILE).partition(b"end_header")
            return _there(path, _words(_TEXTURES_OF_PLY, head))
    return []


def digests(path: Path, name: str) -> dict[str, str]:
    """The sha256 of a mesh's file under its ``name``, and of each file that it pulls in."""
    parts = {f"{name}: {os.path.relpath(part, path.parent)}": files.sha256_of(part) for part in pulled_in(path)}
    return {name: files.sha256_of(path), **parts}


def _there(beside: Path, names: Iterable[str]) -> list[Path]:
    """Those of some names that are files, seen from the folder of ``beside``, or in that folder itself; each once."""
    paths = (beside.parent / place for name in names for place in (name, name.rpartition("/")[2]))
    return [path for path in dict.fromkeys(paths) if _is_file(path)]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or none: nobody can read it
        return False


def _words(key: re.Pattern[bytes], data: bytes) -> list[str]:
    """What may be a name in the lines of a key: all that follows it, for a name with blanks, and each word alone."""
    lines = [found.decode("utf-8", "replace") for found in key.findall(data)]
    return [name for line in lines for name in (line, *line.split())]


def _gltf(data: bytes) -> Any:
    """The JSON of a glTF or GLB; None where it is damaged."""
    try:
        return gltf.document(data)
    except (ValueError, RecursionError):
        return None


def _uris(value: Any) -> list[str]:
    parts = [part for key in ("buffers", "images") for part in _list(value, key)]
    uris = [part.get("uri") for part in parts if isinstance(part, dict)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _list(value: Any, key: str) -> list[Any]:
    found = value.get(key) if isinstance(value, dict) else None
    return found if isinstance(found, list) else []
