"""Computes the scores of all sites of a scenario; what several of them need is worked out once.

Steps: bring the static world, the empty scans and the traffic of the scenario into a folder, from the store where it
has them; for each size of voxels the TPOG; for that, with and without vehicles in the way as scores ask for it, the
hits of each site; then the scores, site by site. Traffic is that of the scenario's own seed: unseen traffic, by which
sites are judged, has no part in it.

Values depend on nothing but the scenario and the program. Seconds are measured: of the processor, by the thread that
worked for the site.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import schemas, tables
from pipeline.artefacts.readers import read_tpog
from pipeline.core import code_digest, files, plugins
from pipeline.core.errors import InputError, RunError
from pipeline.core.findings import Finding
from pipeline.core.parallel import in_order
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry as effects
from pipeline.runs.workflow import bring
from pipeline.scenario.effects import MovingOcclusionParameters
from pipeline.scenario.models import Scenario
from pipeline.scoring.targets.record import TargetRecord
from pipeline.scoring.targets.seen import SeenTargets, noticed_in, see
from pipeline.scoring.thinning import Hits
from pipeline.scoring.visibility import Beams, Visibility
from pipeline.sensing.scene import Scene
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scans import SiteBeams, scans
from pipeline.stages.shared.scene import SCANS, scene_of
from pipeline.studies.measuring import inputs_of
from pipeline.validation.surrogates import registry
from pipeline.validation.surrogates.base import GAMMA, OCCLUSION, VOXEL, Score, Value
from pipeline.validation.surrogates.evidence import Occupancy, SiteEvidence, everything

ARTEFACT = "surrogates.parquet"
_TRAJECTORIES = "trajectories.parquet"


@dataclass(frozen=True)
class SurrogateRow:
    """One score of one site.

    Attributes
    ----------
    parameters
        What the score is tried with, by name.
    sign
        1 where more is said to be better, -1 where less is.
    value
        Not a number where the score is not defined.
    seconds
        Of the processor: the evidence that the score needs, and the score itself.
    """

    site: str
    score: str
    parameters: Mapping[str, Value]
    sign: int
    value: float
    seconds: float

    @property
    def parameters_json(self) -> str:
        """The parameters as canonical JSON; infinity, which JSON lacks, as "inf"."""
        told = {name: "inf" if value == math.inf else value for name, value in self.parameters.items()}
        return files.canonical_json(told).decode()


@dataclass(frozen=True)
class Surrogates:
    """What came of it.

    Attributes
    ----------
    rows
        Site by site in their order; of each, score by score in the order of the registry.
    skipped
        Settings that cannot be tried here, and why.
    inputs
        Hash of everything that the values depend on.
    """

    rows: tuple[SurrogateRow, ...]
    skipped: tuple[Finding, ...]
    inputs: str

    def costs_ms(self) -> dict[str, dict[str, float]]:
        """Score -> parameters, as JSON -> milliseconds a site, the median over sites. Measured: another run differs."""
        seconds: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for row in self.rows:
            seconds[row.score][row.parameters_json].append(row.seconds)
        return {s: {p: round(1e3 * median(all_), 3) for p, all_ in by.items()} for s, by in seconds.items()}

    def write(self, path: Path, scenario: Scenario) -> None:
        """Write ``surrogates.parquet``: the same bytes whenever the values are the same; seconds are not in it."""
        names = ("site", "score", "sign", "value")
        columns: dict[str, Any] = {name: [getattr(row, name) for row in self.rows] for name in names}
        columns["parameters"] = [row.parameters_json for row in self.rows]
        about = {"name": scenario.name, "hash": files.hash_of(scenario.model_dump(mode="json"))}
        metadata = {"schema": schemas.VERSION, "scenario": about, "inputs": self.inputs, "seed": scenario.seed}
        tables.write(path, "surrogates", columns, metadata)


@dataclass(frozen=True)
class _Task:
    """A score with one choice of its parameters, and the ground that its evidence is gathered on."""

    score: Score
    parameters: Mapping[str, Value]
    voxel_m: float
    occlusion: bool

    @property
    def handed(self) -> dict[str, Value]:
        """The parameters that the function takes."""
        return {name: value for name, value in self.parameters.items() if name not in (VOXEL, OCCLUSION)}


def surrogates_of(
    scenario: Scenario,
    folder: Path,
    names: Sequence[str] | None = None,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
) -> Surrogates:
    """The scores of all sites.

    Parameters
    ----------
    folder
        Where artefacts of the scenario are laid while this works; made if need be. They stay there.
    names
        Which scores; by default all that are installed and can be loaded.
    jobs
        Threads; one a core when None. Values do not depend on it.

    Raises
    ------
    InputError
        What the stages refuse; an unknown score.
    MissingBackendError
        A score that cannot be loaded.
    RunError
        A score that gives no number.
    """
    chosen, broken = _chosen(names)
    tasks, unfit = _tasks(scenario, chosen)
    ready = _Ready(scenario, folder, jobs, progress)
    found: dict[str, list[tuple[int, SurrogateRow]]] = {site.name: [] for site in ready.scene.sites}
    grounds = sorted({(task.voxel_m, task.occlusion) for task in tasks})
    done, total = 0, len(grounds) * len(found)
    for voxel_m, occlusion in grounds:
        here = [(i, task) for i, task in enumerate(tasks) if (task.voxel_m, task.occlusion) == (voxel_m, occlusion)]
        for rows in ready.scored(voxel_m, occlusion, here):
            found[rows[0][1].site] += rows
            done += 1
            progress("scores", done, total)
    ordered = (row for rows in found.values() for _, row in sorted(rows, key=lambda numbered: numbered[0]))
    return Surrogates(tuple(ordered), (*broken, *unfit), inputs_key(scenario, [score.name for score in chosen]))


def inputs_key(scenario: Scenario, names: Sequence[str] | None = None) -> str:
    """Hash of everything that the scores depend on: settings, files, the program, those of other packages."""
    chosen = [score.name for score in _chosen(names)[0]]
    sweeps = {name: {key: [repr(v) for v in values] for key, values in registry.score(name).sweep.items()}
              for name in chosen}  # fmt: skip
    modules = sorted({plugins.module_of(registry.GROUP, name) for name in chosen})
    source = code_digest.of(__name__, *modules)
    program = {"source": source.digest, "libraries": code_digest.versions(source.libraries)}
    return files.hash_of({"scenario": inputs_of(scenario), "scores": sweeps, "program": program})


def _chosen(names: Sequence[str] | None) -> tuple[list[Score], list[Finding]]:
    """The scores of these names; or all, less those that cannot be loaded, which is told."""
    if names is not None:
        return [registry.score(name) for name in names], []
    entries = registry.catalogue()
    broken = [Finding("scores.broken", f"score {e.name} is left out", e.problem, "") for e in entries if not e.score]
    return [entry.score for entry in entries if entry.score is not None], broken


def _tasks(scenario: Scenario, chosen: Sequence[Score]) -> tuple[list[_Task], list[Finding]]:
    """What is tried; settings whose voxels do not fit the region of interest are left out, and told."""
    own: dict[str, Value] = {VOXEL: scenario.roi.voxel_m, GAMMA: scenario.gamma}
    named = "moving_occlusion" in scenario.effects.named
    tasks, unfit = [], dict[float, Finding]()
    for score in chosen:
        tried = {name: sorted({*values, own[name]}) if name in own else values for name, values in score.sweep.items()}
        for values in itertools.product(*tried.values()):
            parameters = dict(zip(tried, values, strict=True))
            voxel_m = float(parameters.get(VOXEL, scenario.roi.voxel_m))
            occlusion = bool(parameters.get(OCCLUSION, named))
            try:
                _with_voxels(scenario, voxel_m).roi.grid  # noqa: B018 - whether they fit
            except InputError as error:
                place = f"{scenario.file}: scores with voxels of {voxel_m:g} m are left out"
                unfit[voxel_m] = Finding("scores.voxels", place, error.found, "")
                continue
            tasks.append(_Task(score, parameters, voxel_m, occlusion))
    return tasks, list(unfit.values())


def _with_voxels(scenario: Scenario, voxel_m: float) -> Scenario:
    if voxel_m == scenario.roi.voxel_m:
        return scenario
    return scenario.model_copy(update={"roi": scenario.roi.model_copy(update={"voxel_m": voxel_m})})


class _Ready:
    """A scenario whose empty scans and traffic lie in a folder."""

    def __init__(self, scenario: Scenario, folder: Path, jobs: int | None, progress: Progress) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        kept = scenario.model_copy(update={"scan": scenario.scan.model_copy(update={"keep": True})})
        self._scenario, self._folder, self._jobs, self._progress = kept, folder, jobs, progress
        self._work = Workspace(kept, folder, jobs=jobs, progress=progress)
        bring(self._work, "statics", "scan", "traffic")
        self.scene = scene_of(self._work)
        self._seen: dict[str, SeenTargets] = {}
        self._record: TargetRecord | None = None

    def scored(
        self, voxel_m: float, occlusion: bool, tasks: list[tuple[int, _Task]]
    ) -> Iterator[list[tuple[int, SurrogateRow]]]:
        """The rows of one site after another, each with the number of its task."""
        work = Workspace(_with_voxels(self._scenario, voxel_m), self._folder, jobs=self._jobs, progress=self._progress)
        bring(work, "tpog")
        tpog, scene = read_tpog(work.path("tpog.parquet")), _with_occlusion(self.scene, occlusion)
        occupancy, visibility = Occupancy(tpog), Visibility(scene, tpog, work.path(_TRAJECTORIES))
        _ = occupancy.field.total_bit, occupancy.p, occupancy.log_free, occupancy.lowest  # before there are threads
        if self._record is None and any("vehicles" in task.score.needs for _, task in tasks):
            self._record = TargetRecord.read(work.path(_TRAJECTORIES), tpog.grid)

        def rows(given: tuple[SiteBeams, NDArray[np.bool_]]) -> list[tuple[int, SurrogateRow]]:
            scan, returned = given
            noticed = noticed_in(scene, scan.beams.sensor)

            def count(beams: Beams) -> tuple[Hits, int]:
                return visibility.borrowed_hits(beams).copy(), visibility.unit

            def look(beams: Beams) -> SeenTargets:
                if scan.site.name not in self._seen:
                    record = self._record
                    if record is None:
                        record = TargetRecord.read(work.path(_TRAJECTORIES), tpog.grid)
                    self._seen[scan.site.name] = see(record, beams, noticed)
                return self._seen[scan.site.name]

            evidence = SiteEvidence(occupancy, scan.beams, returned, count, look, noticed or everything)
            return _rows(scan.site.name, evidence, tasks)

        yield from in_order(rows, zip(scans(work), _returned(work), strict=True), work.threads)


def _with_occlusion(scene: Scene, wanted: bool) -> Scene:
    """The scene with vehicles in the way, as it names them or by default, or without."""
    others = tuple(effect for effect in scene.effects if effect.NAME != "moving_occlusion")
    if not wanted:
        return replace(scene, effects=others)
    if len(others) < len(scene.effects):
        return scene
    mixed = bool(scene.scenario.traffic.periods)  # a replay would take all periods alike
    parameters = MovingOcclusionParameters(method="independent") if mixed else MovingOcclusionParameters()
    return replace(scene, effects=(*others, effects.make("moving_occlusion", parameters)))


def _returned(work: Workspace) -> Iterator[NDArray[np.bool_]]:
    """Which beams of each site met something, in the order of the sites."""
    path = work.path(SCANS)
    with tables.reader(path, "scans") as (file, _):
        for group in range(file.num_row_groups):
            yield tables.read_group(file, group, path, ["returned"]).column("returned").to_numpy()


def _rows(site: str, evidence: SiteEvidence, tasks: list[tuple[int, _Task]]) -> list[tuple[int, SurrogateRow]]:
    """The scores of one site on one ground; evidence is timed once, and counted for each score that needs it."""
    spent: dict[str, float] = {}
    rows = []
    for number, task in tasks:
        for need in task.score.needs:
            if need not in spent:
                begun = time.thread_time()
                getattr(evidence, need)
                spent[need] = time.thread_time() - begun
        begun = time.thread_time()
        value = task.score.function(evidence, **task.handed)
        seconds = time.thread_time() - begun + sum(spent[need] for need in task.score.needs)
        if not isinstance(value, float | int):
            found = f"score {task.score.name}: gives {value!r} for the site {site}"
            raise RunError(f"{found}; right is a number, or NaN where it is not defined")
        rows.append(
            (number, SurrogateRow(site, task.score.name, task.parameters, task.score.sign, float(value), seconds))
        )
    return rows
