"""The program's own source as one digest, so that what was made by another version of the code is not taken for new.

Steps: from some modules of this package, follow every import down (those inside functions too, those for type checking
alone not); hash the sources. What is loaded by name only (effects, plug-ins) is not seen from the text: name its module
as well. A module of another package counts with its file, and with what it imports of its own package and of this one.

Imports are read by their pattern, not by a parser, which takes a tenth of the time; a line of a docstring that looks
like an import may add a module, none is missed. A file is read once in a process: one that is edited while the program
runs counts as it was when it was first asked for.
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = "pipeline"
_ROOT = Path(__file__).resolve().parent.parent

LIBRARIES = {
    "embreex": ("embreex",),
    "laspy": ("laspy", "lazrs"),
    "numba": ("numba", "llvmlite"),
    "numpy": ("numpy",),
    "onnxruntime": ("onnxruntime",),
    "osmium": ("osmium",),
    "pyarrow": ("pyarrow",),
    "pyproj": ("pyproj",),
    "scipy": ("scipy",),
    "shapely": ("shapely",),
    "sklearn": ("scikit-learn",),
    "trimesh": ("trimesh", "mapbox-earcut"),
}
"""Libraries whose version may change a result: name in an import -> distributions."""

_TYPES_ONLY = re.compile(r"^if TYPE_CHECKING:\n(?:(?:[ \t].*)?\n)+", re.MULTILINE)
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]+))", re.MULTILINE
)


@dataclass(frozen=True)
class Source:
    """The digest of some modules' sources, and the libraries of :data:`LIBRARIES` that they import."""

    digest: str
    libraries: frozenset[str]


@cache
def of(*modules: str) -> Source:
    """The source of modules, e.g. ``"pipeline.stages.score"``, and of everything that they import."""
    homes = {PACKAGE, *(module.partition(".")[0] for module in modules)}
    digests: dict[str, str] = {}
    waiting, tops = list(modules), set()
    while waiting:
        module = waiting.pop()
        if module in digests or module.partition(".")[0] not in homes or (path := _path(module)) is None:
            continue
        folder = module.rpartition(".")[0]
        digests[module], imports = _read(path, module if path.name == "__init__.py" else folder)
        waiting += (*imports, folder)
        tops |= {name.partition(".")[0] for name in imports}
    every = "".join(f"{module} {digest}\n" for module, digest in sorted(digests.items()))
    return Source(hashlib.sha256(every.encode()).hexdigest(), frozenset(tops & LIBRARIES.keys()))


def versions(libraries: frozenset[str]) -> dict[str, str]:
    """Library -> version, of those installed."""
    return {name: text for key in sorted(libraries) for name in LIBRARIES[key] if (text := _version(name)) is not None}


@cache
def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


@cache
def _read(path: Path, package: str) -> tuple[str, tuple[str, ...]]:
    """A file's digest, that of its numbers in a JSON file of its name included, and what it imports."""
    content, data = path.read_bytes(), path.with_suffix(".json")
    digest = hashlib.sha256(content + (data.read_bytes() if data.is_file() else b"")).hexdigest()
    return digest, tuple(imported(content.decode("utf-8"), package))


def imported(text: str, package: str) -> Iterator[str]:
    """The names that a module's text imports when it runs, modules and their attributes alike."""
    for source, names, whole in _IMPORT.findall(_TYPES_ONLY.sub("", text)):
        if whole:
            yield from (part.split()[0] for part in whole.partition("#")[0].split(",") if part.strip())
            continue
        if source.startswith("."):
            source = importlib.util.resolve_name(source, package)
        yield source
        for part in re.sub(r"#[^\n]*", "", names).strip("()\n ").split(","):
            if part.strip():
                yield f"{source}.{part.split()[0]}"


@cache
def _path(module: str) -> Path | None:
    """A module's file; None for an attribute of a module, and for this package's door, whose lazy names lead far."""
    top, _, rest = module.partition(".")
    if top == PACKAGE:
        inside = _ROOT.joinpath(*rest.split("."))
        here = (inside.with_suffix(".py"), inside / "__init__.py") if rest else ()
        return next((path for path in here if path.is_file()), None)
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin is not None and spec.origin.endswith(".py") else None
