"""What the user made is not written over: no input lies where a run writes, and nothing is written through a link."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path

from pipeline.artefacts.readers import ACCURACY_SUMS, PLACEMENT_SUMS, VALIDATION_SUMS
from pipeline.artefacts.run_record import RECORD, STAGES
from pipeline.checks import files
from pipeline.checks.mesh_parts import pulled_in
from pipeline.core.errors import InputError
from pipeline.report.detected import VALIDATION
from pipeline.report.placement import PLACEMENT
from pipeline.report.study import ACCURACY
from pipeline.runs import stages
from pipeline.scenario.models import Scenario

_CLOUDS = (".ply", ".pcd")
"""Ends of ``scan_<site>``, which ``egvs scan --points`` writes."""

_UNSHOWN = ("surrogates.parquet", "fused.parquet", ACCURACY_SUMS, VALIDATION_SUMS, PLACEMENT_SUMS)
"""What studies leave beside what the report shows."""


def keep_inputs(scenario: Scenario, folder: Path, folders: Collection[str] = ()) -> None:
    """InputError where a run in a folder would write over a file that the scenario names, or through a link.

    ``folders`` are those that a study makes in it, beside those of the stages.
    """
    if not folder.is_dir():
        return
    folders = {*_companions(), *folders}
    for name in folders:
        place = folder / name
        for path in (place, *place.rglob("*")):
            if path.is_symlink():
                raise InputError(path, "is a symbolic link, and nothing is written through one", "remove it")
    home = Path(os.path.realpath(folder))
    for key, path in _inputs(scenario):
        real = Path(os.path.realpath(path))
        if real.is_relative_to(home) and _is_written(real.relative_to(home), folders):
            found = f"holds {real.relative_to(home).as_posix()}, which the scenario names ({key}) and a run writes over"
            raise InputError(f"--out {folder}", found, "a folder of its own, for example runs/mine")


def _companions() -> set[str]:
    """The folders that stages write beside their artefacts."""
    return {name for stage in STAGES for name in getattr(stages.module_of(stage), "COMPANIONS", ())}


def _is_written(path: Path, folders: Collection[str]) -> bool:
    """Whether a run may write a file, seen from the run's folder."""
    artefacts = {name for stage in STAGES for name in stages.artefacts_of(stage)}
    is_cloud = path.name.startswith("scan_") and path.suffix in _CLOUDS
    if path.parts[0] in folders:
        return True
    return len(path.parts) == 1 and (
        is_cloud or path.name in {RECORD, ".lock", *artefacts, *ACCURACY, *VALIDATION, *PLACEMENT, *_UNSHOWN}
    )


def _inputs(scenario: Scenario) -> Iterator[tuple[str, Path]]:
    """Key and path of every file that the scenario, a mesh of it or its configuration of SUMO names."""
    bodies = ((f"validation.bodies.{kind}", name) for kind, name in scenario.validation.bodies.items())
    named = [*files.named(scenario), *bodies, *files.measured(files.sound_sites(scenario))]
    for key, name in named:
        try:
            path = scenario.find(name, key)
        except InputError:  # it is not there, which is told elsewhere
            continue
        yield key, path
        if key == "statics.meshes" or key.startswith("validation.bodies."):
            yield from ((key, part) for part in pulled_in(path))
    yield from (("traffic.sumocfg", path) for path in files.configured(scenario))
