"""The key of a stage, which decides whether it runs again.

The key is a hash of everything that the artefacts of a stage depend on: settings by value, input files by hash, the
source of the program, versions of libraries. A stage runs again when its key changes.

The source is followed from the module of the stage through every import (also those inside functions, but not those for
type checking only). Modules that are loaded by name (effects, plug-ins) are not visible in the text, so they are named.
Imports are found with a regular expression, ten times as fast as a parser: a line of a docstring that looks
like an import may add a module, but none is missed. A file is read once per process.
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from egvs.artefacts import parquet
from egvs.artefacts.run_record import StageRecord
from egvs.core import files
from egvs.core.digests import hash_input
from egvs.effects import registry
from egvs.runs import stage_registry
from egvs.runs.stage_registry import StageResult, stage
from egvs.scenario.model import Scenario
from egvs.stages.base import Stage, StageContext, StageDependencies

PACKAGE = "egvs"
_ROOT = Path(__file__).resolve().parent.parent

LIBRARIES = {
    "embreex": ("embreex",),
    "laspy": ("laspy", "lazrs"),
    "mapbox_earcut": ("mapbox-earcut",),
    "numba": ("numba", "llvmlite"),
    "numpy": ("numpy",),
    "onnxruntime": ("onnxruntime",),
    "osmium": ("osmium",),
    "pyarrow": ("pyarrow",),
    "pye57": ("pye57",),
    "pyproj": ("pyproj",),
    "scipy": ("scipy",),
    "shapely": ("shapely",),
    "sklearn": ("scikit-learn",),
    "trimesh": ("trimesh",),
}
"""Libraries whose version may change a result: name in an import -> distributions."""

_TYPES_ONLY = re.compile(r"^if TYPE_CHECKING:\n(?:(?:[ \t].*)?\n)+", re.MULTILINE)
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]+))", re.MULTILINE
)


@dataclass(frozen=True)
class SourceDigest:
    """Digest of the source of some modules, and the libraries of :data:`LIBRARIES` that they import."""

    digest: str
    libraries: frozenset[str]


@cache
def source_digest(*modules: str) -> SourceDigest:
    """Return the digest of modules, e.g. ``"egvs.stages.score"``, and of everything that they import.

    Modules of other packages count with what they import of their own package and of this one.
    """
    digests: dict[str, str] = {}
    libraries: set[str] = set()
    for module, (digest, imports) in source_modules(*modules).items():
        digests[module] = digest
        libraries |= {name.partition(".")[0] for name in imports} & LIBRARIES.keys()
    text = "".join(f"{module} {digest}\n" for module, digest in sorted(digests.items()))
    return SourceDigest(hashlib.sha256(text.encode()).hexdigest(), frozenset(libraries))


def text_digest(module: str) -> str:
    """Return the digest of the text of one module, without what it imports.

    Raises
    ------
    ValueError
        If there is no such module.
    """
    path = _module_path(module)
    if path is None:
        raise ValueError(f"no source of {module}")
    return _digest_module(path, module.rpartition(".")[0])[0]


def source_modules(*modules: str) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the modules and all that they import, of this package and of their own: digest and imports by name."""
    packages = {PACKAGE, *(module.partition(".")[0] for module in modules)}
    sources: dict[str, tuple[str, tuple[str, ...]]] = {}
    pending = list(modules)
    while pending:
        module = pending.pop()
        if module in sources or module.partition(".")[0] not in packages:
            continue
        path = _module_path(module)
        if path is None:
            continue
        parent = module.rpartition(".")[0]
        package = module if path.name == "__init__.py" else parent
        sources[module] = _digest_module(path, package)
        pending += (*sources[module][1], parent)
        if module == stage_registry.__name__:
            pending += stage_registry.STAGE_MODULES.values()  # imported by name
    return sources


def library_versions(libraries: frozenset[str]) -> dict[str, str]:
    """Return the versions of the installed distributions of some libraries, by name."""
    versions = {}
    for library in sorted(libraries):
        for distribution in LIBRARIES[library]:
            installed = _installed_version(distribution)
            if installed is not None:
                versions[distribution] = installed
    return versions


@cache
def _installed_version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


@cache
def _digest_module(path: Path, package: str) -> tuple[str, tuple[str, ...]]:
    """Digest of a file and of the JSON file of the same name, if there is one; names that it imports."""
    content = path.read_bytes()
    data = path.with_suffix(".json")
    numbers = data.read_bytes() if data.is_file() else b""
    return hashlib.sha256(content + numbers).hexdigest(), tuple(imported_names(content.decode("utf-8"), package))


def imported_names(text: str, package: str) -> Iterator[str]:
    """Yield the names of modules, and of attributes of modules, that the text of a module imports.

    Parameters
    ----------
    text
        Source of the module.
    package
        Its package, for relative imports.
    """
    for source, names, modules in _IMPORT.findall(_TYPES_ONLY.sub("", text)):
        if modules:  # import a, b as c
            for part in modules.partition("#")[0].split(","):
                if part.strip():
                    yield part.split()[0]
            continue
        if source.startswith("."):
            source = importlib.util.resolve_name(source, package)
        yield source
        for part in re.sub(r"#[^\n]*", "", names).strip("()\n ").split(","):
            if part.strip():
                yield f"{source}.{part.split()[0]}"


@cache
def _module_path(module: str) -> Path | None:
    """The file of a module; None for an attribute of a module, and for ``egvs`` itself, which exports everything."""
    if module == PACKAGE:
        return None
    top, _, rest = module.partition(".")
    if top == PACKAGE:
        base = _ROOT.joinpath(*rest.split("."))
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if path.is_file():
                return path
        return None
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    return Path(spec.origin)


@dataclass(frozen=True)
class StageKey:
    """What the artefacts of a stage depend on.

    Attributes
    ----------
    key
        Hash of all dependencies: settings by value, files by sha256, the program by the digest of its source, libraries
        by version.
    dependencies
        Settings and files that the stage reads.
    """

    key: str
    dependencies: StageDependencies

    def record(self, result: StageResult) -> StageRecord:
        """Return the entry of ``run.json`` for the result of the stage."""
        read = dict(self.dependencies.files)
        return StageRecord(self.key, read, result.artefacts, result.summary, result.cost, result.companions)


def stage_key(name: str, context: StageContext) -> StageKey:
    """Return what the artefacts of a stage depend on; the folder contains the artefacts of the stages before it."""
    with context.inputs.digests.collect() as paths:
        dependencies = replace(stage(name).dependencies(context), paths=paths)
    content = {
        "stage": name,
        "inputs": dependencies.to_json(),
        "program": program_inputs(name, context.scenario, dependencies.modules),
    }
    return StageKey(files.hash_json(content), dependencies)


def program_inputs(name: str, scenario: Scenario, loaded: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the parts of the program that the artefacts of a stage depend on.

    These are its source, the source of modules loaded by name (readers of files, effects that act or whose inactivity
    the summary reports), its schemas and templates, and the libraries.
    """
    described = stage(name)
    effects = registry.scenario_effects(scenario, *(described.effect_stages or (name,)))
    modules = sorted({*loaded, *registry.effect_modules(effects)})
    source = source_digest(described.module, *described.code)
    loaded_sources = [source_digest(module) for module in modules]
    libraries = source.libraries.union(*(part.libraries for part in loaded_sources))
    return {
        "source": source.digest,
        "loaded": [part.digest for part in loaded_sources],
        "named": registry.effect_settings(effects),
        "files": {path.name: hash_input(path) for path in _data_files(described)},
        "libraries": library_versions(libraries),
    }


def _data_files(stage: Stage) -> list[Path]:
    """Schemas of the artefacts of a stage, and the templates beside its module and those that it imports."""
    paths = [parquet.schema_folder() / f"{Path(name).stem}.schema.json" for name in stage.artefacts]
    folders = {path.parent for path in map(_module_path, source_modules(stage.module)) if path is not None}
    for folder in sorted(folders):
        paths += sorted((folder / "templates").rglob("*"))
    return [path for path in paths if path.is_file()]
