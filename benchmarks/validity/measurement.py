"""Measure one part of the study: the sites of one junction with one sensor, with all detectors and scores.

Detections from a site are cached (:mod:`egvs.extensions.validation.detector_runs`), so an interrupted part continues
site by site.
A complete part is saved in the study's folder, with a hash of everything that it depends on.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.validity import low_models
from benchmarks.validity.record import Estimates, Record, StudySite, further_measures, measures_of
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.sweeps import POINT_COUNTS_NAME, DetectorResult
from egvs.core import files
from egvs.core.progress import ProgressCallback, no_progress
from egvs.extensions.validation import detection_metrics, surrogates
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS, SiteDetection
from egvs.extensions.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.extensions.validation.results import ScoreName
from egvs.extensions.validation.surrogates import Surrogates
from egvs.runs import stage_keys
from egvs.scenario.model import Scenario
from egvs.sensors import site_feasibility
from egvs.sensors.sites import Site


@dataclass(frozen=True)
class Part:
    """What is to be measured.

    Attributes
    ----------
    name
        Name of its files.
    scenario
        With the sites.
    given
        Names of the junction's own sites.
    detectors
        Sites of each detector, by name; ``points`` is measured at all.
    frames, apart_s
        Number of frames of held-out traffic, and seconds between them.
    scores
        Names of scores; all if None.
    """

    name: str
    junction: str
    role: str
    sensor: str
    scenario: Scenario
    sites: tuple[Site, ...]
    given: frozenset[str]
    detectors: Mapping[str, frozenset[str]]
    frames: int
    apart_s: float
    scores: tuple[str, ...] | None = None


def measure(
    part: Part,
    folder: Path,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    report: Callable[[str], None] = print,
) -> Record:
    """Return the record of a part, saved or measured; the costs of scores are written to ``NAME.costs.json``."""
    path = folder / f"{part.name}.json"
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as temporary:
        held_out = prepare_held_out_traffic(
            part.scenario, Path(temporary) / "unseen", part.frames, apart_s=part.apart_s, jobs=jobs, progress=progress
        )
        detectors = {
            name: {name: low_models.make(name)} if name != POINT_COUNTS_NAME else {} for name in part.detectors
        }
        tasks = {name: SiteDetectionTask(held_out, values) for name, values in detectors.items()}
        key = _key(part, tasks)
        if path.is_file() and (saved := Record.read(path)).key == key:
            report(f"{part.name}: saved before")
            return saved
        results: dict[str, dict[str, DetectorResult]] = {site.name: {} for site in held_out.scene.sites}
        for name, task in tasks.items():
            selected = [
                site for site in held_out.scene.sites if name == POINT_COUNTS_NAME or site.name in part.detectors[name]
            ]
            for site, values in run_detectors(selected, task, jobs=jobs, progress=progress).items():
                results[site] |= values
        rows, _ = detection_metrics.measure_detection(list(held_out.read()), held_out.scene.roi, results)
        scored = surrogates.compute_surrogates(
            part.scenario, Path(temporary) / "scores", part.scores, jobs=jobs, progress=progress
        )
        record = _record(part, key, held_out, rows, scored)
    (folder / f"{part.name}.costs.json").write_text(json.dumps(scored.costs_ms(), indent=1) + "\n", encoding="utf-8")
    record.write(path)
    return record


def _key(part: Part, tasks: Mapping[str, SiteDetectionTask]) -> str:
    """Return a hash of everything that a record depends on."""
    detector_keys = {
        name: [
            task.key(site, name)
            for site in task.record.scene.sites
            if name == POINT_COUNTS_NAME or site.name in part.detectors[name]
        ]
        for name, task in tasks.items()
    }
    source = stage_keys.source_digest(detection_metrics.__name__, surrogates.__name__)
    dependencies = {
        "part": [part.name, part.junction, part.role, part.sensor, sorted(part.given), part.frames, part.apart_s],
        "looked": detector_keys,
        "scores": surrogates.surrogates_key(part.scenario, part.scores),
        "program": [
            source.digest,
            files.hash_file(Path(__file__)),
            files.hash_file(Path(__file__).with_name("record.py")),
        ],
        "libraries": stage_keys.library_versions(source.libraries),
    }
    return files.hash_json(dependencies)


def _record(
    part: Part, key: str, held_out: HeldOutTraffic, rows: Sequence[SiteDetection], scored: Surrogates
) -> Record:
    sites = tuple(site.name for site in held_out.scene.sites)
    position = {name: number for number, name in enumerate(sites)}
    scores: dict[str, list[float]] = {}
    for row in scored.rows:
        name = str(ScoreName(row.score, row.parameters_json))
        scores.setdefault(name, [float("nan")] * len(sites))[position[row.site]] = row.sign * row.value
    all_rows = [row for row in rows if row.objects_of == ALL_OBJECTS]
    by_detector = {name: [row for row in all_rows if row.detector == name] for name in part.detectors}
    results = {
        name: {m: _estimates(selected, m, position) for m in (*measures_of(name), *further_measures(name))}
        for name, selected in by_detector.items()
    }
    frames = list(held_out.read())
    seeds = {"TPOG": part.scenario.seed, "unseen": held_out.scenario.seed}
    return Record(
        key, part.junction, part.role, part.sensor, held_out.frames, all_rows[0].objects, seeds,
        [_site(site, part, held_out, frames) for site in held_out.scene.sites], scores, results,
        [str(reason) for reason in scored.skipped],
    )  # fmt: skip


def _estimates(rows: Sequence[SiteDetection], measure: str, position: Mapping[str, int]) -> Estimates:
    values = [row.measures[measure] for row in rows]
    left_out = [e.left_out.tolist() for e in values]
    return Estimates([position[row.site] for row in rows], [e.value for e in values], [e.se for e in values], left_out)


def _site(site: Site, part: Part, held_out: HeldOutTraffic, frames: Sequence[TrafficFrame]) -> StudySite:
    scene, pose = held_out.scene, site.pose
    ground_m = site_feasibility.ground_height_m(scene.world, pose) if scene.scenario.statics.ground else 0.0
    vehicles_xy = np.concatenate([frame.boxes[frame.target_rows(scene.roi), :2] for frame in frames])
    away_m = (
        float(np.hypot(*(vehicles_xy - np.array(pose.position_m[:2])).T).mean()) if len(vehicles_xy) else float("nan")
    )
    return StudySite(site.name, site.pole, round(pose.z_m - ground_m, 3), away_m, site.name in part.given)
