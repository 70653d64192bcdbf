"""The registered stages; a stage's key: inputs, settings, digest of the source.

The program's own source as one digest, so that what was made by another version of the code is not taken for new.

Steps: from some modules of this package, follow every import down (those inside functions too, those for type checking
alone not); hash the sources. What is loaded by name only (effects, plug-ins) is not seen from the text: name its module
as well. A module of another package counts with its file, and with what it imports of its own package and of this one.

Imports are read by their pattern, not by a parser, which takes a tenth of the time; a line of a docstring that looks
like an import may add a module, none is missed. A file is read once in a process: one that is edited while the program
runs counts as it was when it was first asked for.

Calls the stages, which nothing else does, and says what came of one when it was made.

The key of a stage: a hash of everything that its artefacts depend on. A stage runs again when its key is another.
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
from typing import Any

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord, StageRecord
from egvs.core import files
from egvs.core.errors import with_relative_paths
from egvs.core.runtime import ResourceUsage, measure_usage
from egvs.effects import registry
from egvs.scenario.model import Scenario
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary

PACKAGE = "egvs"
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
class SourceDigest:
    """The digest of some modules' sources, and the libraries of :data:`LIBRARIES` that they import."""

    digest: str
    libraries: frozenset[str]


@cache
def source_digest(*modules: str) -> SourceDigest:
    """Return the digest of modules, e.g. ``"egvs.stages.score"``, and of everything that they import."""
    digests: dict[str, str] = {}
    libraries: set[str] = set()
    for module, (digest, imports) in source_modules(*modules).items():
        digests[module] = digest
        libraries |= {name.partition(".")[0] for name in imports} & LIBRARIES.keys()
    text = "".join(f"{module} {digest}\n" for module, digest in sorted(digests.items()))
    return SourceDigest(hashlib.sha256(text.encode()).hexdigest(), frozenset(libraries))


def source_modules(*modules: str) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the modules and all that they import, of this package and of their own: digest and imports by name."""
    packages = {PACKAGE, *(module.partition(".")[0] for module in modules)}
    found: dict[str, tuple[str, tuple[str, ...]]] = {}
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        if module in found or module.partition(".")[0] not in packages:
            continue
        path = _module_path(module)
        if path is None:
            continue
        parent = module.rpartition(".")[0]
        package = module if path.name == "__init__.py" else parent
        found[module] = _digest_module(path, package)
        waiting += (*found[module][1], parent)
    return found


def library_versions(libraries: frozenset[str]) -> dict[str, str]:
    """Library -> version, of those installed."""
    return {
        name: text
        for key in sorted(libraries)
        for name in LIBRARIES[key]
        if (text := _installed_version(name)) is not None
    }


@cache
def _installed_version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


@cache
def _digest_module(path: Path, package: str) -> tuple[str, tuple[str, ...]]:
    """A file's digest, that of its numbers in a JSON file of its name included, and what it imports."""
    content, data = path.read_bytes(), path.with_suffix(".json")
    digest = hashlib.sha256(content + (data.read_bytes() if data.is_file() else b"")).hexdigest()
    return digest, tuple(imported_names(content.decode("utf-8"), package))


def imported_names(text: str, package: str) -> Iterator[str]:
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
def _module_path(module: str) -> Path | None:
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


RANKING_STAGES = STAGE_NAMES[1:-1]
"""What a ranking takes; the check and the report are left out."""


@dataclass(frozen=True)
class StageResult:
    """What came of a stage.

    Attributes
    ----------
    artefacts
        Name -> sha256 of each file that it wrote.
    companions
        The same of further files that belong to them, by their path in the run's folder: those that open in sumo-gui.
    summary
        What the stage says of it, a JSON value.
    """

    artefacts: dict[str, str]
    companions: dict[str, str]
    summary: Summary
    cost: ResourceUsage

    @property
    def files(self) -> dict[str, str]:
        """Name -> sha256 of all of them."""
        return self.artefacts | self.companions


def stage(name: str) -> Stage:
    """Return a stage; its module is imported only now, so that ``--help`` stays quick."""
    match name:
        case "check":
            from egvs.stages.check import STAGE as check

            return check
        case "statics":
            from egvs.stages.statics import STAGE as statics

            return statics
        case "scan":
            from egvs.stages.scan import STAGE as scan

            return scan
        case "traffic":
            from egvs.stages.traffic import STAGE as traffic

            return traffic
        case "tpog":
            from egvs.stages.tpog import STAGE as tpog

            return tpog
        case "score":
            from egvs.stages.score import STAGE as score

            return score
        case "report":
            from egvs.report.page import STAGE as report

            return report
        case _:
            raise ValueError(f"expected a stage ({', '.join(STAGE_NAMES)}), got {name!r}")


def written_by(name: str) -> tuple[str, ...]:
    """Return the files that a stage can write, and the folders that it writes beside them."""
    return tuple(file.name for file in RunFolder.written_by(name))


def recorded_digests(record: RunRecord) -> dict[str, str]:
    """Return the sha256 of every artefact and companion file as a run recorded it, "" for an unknown artefact."""
    digests: dict[str, str] = {}
    for stage_record in record.stages.values():
        digests |= stage_record.companions
    known = record.digests
    for name in STAGE_NAMES:
        for artefact in stage(name).artefacts:
            digests[artefact] = known.get(artefact, "")
    return digests


def run_stage(name: str, context: StageContext, dependencies: StageDependencies, **options: Any) -> StageResult:
    """Run a stage in a folder that contains the artefacts of the stages before it."""
    running = stage(name)
    stamps_before = _companion_stamps(running, context.folder.path)
    context.forget(*written_by(name))
    with measure_usage() as cost:
        summary = with_relative_paths(context.scenario.folder, running.run(context, dependencies, **options))

    written = [artefact for artefact in running.artefacts if context.path(artefact).exists()]
    companions = {}
    for companion, stamp in sorted(_companion_stamps(running, context.folder.path).items()):
        if stamps_before.get(companion) != stamp:
            companions[companion] = files.hash_file(context.path(companion))
    return StageResult(context.digests(*written), companions, summary, cost)


def _companion_stamps(stage: Stage, folder: Path) -> dict[str, tuple[int, int, int]]:
    """Files beside the artefacts of a stage, each with a stamp that changes when the file is written."""
    stamps = {}
    for name in stage.companions:
        for path in (folder / name).rglob("*"):
            if path.is_file() and not path.is_symlink():
                status = path.stat()
                stamps[path.relative_to(folder).as_posix()] = (status.st_mtime_ns, status.st_ino, status.st_size)
    return stamps


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
    dependencies = stage(name).dependencies(context)
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
        "files": {path.name: files.hash_file(path) for path in _data_files(described)},
        "libraries": library_versions(libraries),
    }


def _data_files(stage: Stage) -> list[Path]:
    """Schemas of the artefacts of a stage, and the templates beside its module."""
    paths = [parquet.schema_folder() / f"{Path(name).stem}.schema.json" for name in stage.artefacts]
    module = _module_path(stage.module)
    if module is not None:
        paths += sorted((module.parent / "templates").rglob("*"))
    return [path for path in paths if path.is_file()]
