"""Measures one part of the study: the sites of one junction with one sensor, by all detectors and scores.

What detectors find from a site is in the store (:mod:`egvs.validation.detector_runs`), so a part that was interrupted
goes on site by site; a part that is whole is kept in the study's folder under the hash of all that it depends on.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.validity import low_models
from benchmarks.validity.record import Estimates, Record, StudySite, beside_of, measures_of
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core import files
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.runs import stages
from egvs.scenario.model import Scenario
from egvs.sensors import site_feasibility
from egvs.sensors.sites import Site
from egvs.validation import detection_metrics, surrogates
from egvs.validation.detection_metrics import ALL_OBJECTS, SiteDetection
from egvs.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.results import ScoreName
from egvs.validation.surrogates import Surrogates
from egvs.validation.sweeps import POINT_COUNTS_NAME, DetectorResult


@dataclass(frozen=True)
class Part:
    """What is to be measured.

    Attributes
    ----------
    name
        Of its files.
    scenario
        With the sites.
    given
        Names of the junction's own sites.
    detectors
        By name, the sites that it looks from; ``points`` looks from all.
    frames, apart_s
        Of unseen traffic, and the time between two.
    scores
        Which; all when None.
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
    told: Callable[[str], None] = print,
) -> Record:
    """The record of a part, kept or made; milliseconds that scores took lie beside it, in ``NAME.costs.json``."""
    path = folder / f"{part.name}.json"
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as temporary:
        unseen = prepare_held_out_traffic(
            part.scenario, Path(temporary) / "unseen", part.frames, apart_s=part.apart_s, jobs=jobs, progress=progress
        )
        made = {name: {name: low_models.make(name)} if name != POINT_COUNTS_NAME else {} for name in part.detectors}
        looks = {name: SiteDetectionTask(unseen, its) for name, its in made.items()}
        key = _key(part, looks)
        if path.is_file() and (kept := Record.read(path)).key == key:
            told(f"{part.name}: kept")
            return kept
        found: dict[str, dict[str, DetectorResult]] = {site.name: {} for site in unseen.scene.sites}
        for name, look in looks.items():
            mine = [
                site for site in unseen.scene.sites if name == POINT_COUNTS_NAME or site.name in part.detectors[name]
            ]
            for site, its in run_detectors(mine, look, jobs=jobs, progress=progress).items():
                found[site] |= its
        rows, _ = detection_metrics.measure_detection(list(unseen.read()), unseen.scene.roi, found)
        scored = surrogates.compute_surrogates(
            part.scenario, Path(temporary) / "scores", part.scores, jobs=jobs, progress=progress
        )
        record = _record(part, key, unseen, rows, scored)
    (folder / f"{part.name}.costs.json").write_text(json.dumps(scored.costs_ms(), indent=1) + "\n", encoding="utf-8")
    record.write(path)
    return record


def _key(part: Part, looks: Mapping[str, SiteDetectionTask]) -> str:
    """Hash of everything that a record depends on."""
    looked = {
        name: [
            look.key(site, name)
            for site in look.record.scene.sites
            if name == POINT_COUNTS_NAME or site.name in part.detectors[name]
        ]
        for name, look in looks.items()
    }
    source = stages.source_digest(detection_metrics.__name__, surrogates.__name__)
    about = {
        "part": [part.name, part.junction, part.role, part.sensor, sorted(part.given), part.frames, part.apart_s],
        "looked": looked,
        "scores": surrogates.surrogates_key(part.scenario, part.scores),
        "program": [
            source.digest,
            files.hash_file(Path(__file__)),
            files.hash_file(Path(__file__).with_name("record.py")),
        ],
        "libraries": stages.library_versions(source.libraries),
    }
    return files.hash_json(about)


def _record(part: Part, key: str, unseen: HeldOutTraffic, rows: Sequence[SiteDetection], scored: Surrogates) -> Record:
    sites = tuple(site.name for site in unseen.scene.sites)
    place = {name: number for number, name in enumerate(sites)}
    scores: dict[str, list[float]] = {}
    for row in scored.rows:
        name = str(ScoreName(row.score, row.parameters_json))
        scores.setdefault(name, [float("nan")] * len(sites))[place[row.site]] = row.sign * row.value
    all_rows = [row for row in rows if row.objects_of == ALL_OBJECTS]
    by_detector = {name: [row for row in all_rows if row.detector == name] for name in part.detectors}
    found = {
        name: {m: _estimates(mine, m, place) for m in (*measures_of(name), *beside_of(name))}
        for name, mine in by_detector.items()
    }
    frames = list(unseen.read())
    seeds = {"TPOG": part.scenario.seed, "unseen": unseen.scenario.seed}
    return Record(
        key, part.junction, part.role, part.sensor, unseen.frames, all_rows[0].objects, seeds,
        [_site(site, part, unseen, frames) for site in unseen.scene.sites], scores, found,
        [str(doubt) for doubt in scored.skipped],
    )  # fmt: skip


def _estimates(rows: Sequence[SiteDetection], measure: str, place: Mapping[str, int]) -> Estimates:
    its = [row.measures[measure] for row in rows]
    left_out = [e.left_out.tolist() for e in its]
    return Estimates([place[row.site] for row in rows], [e.value for e in its], [e.se for e in its], left_out)


def _site(site: Site, part: Part, unseen: HeldOutTraffic, frames: Sequence[TrafficFrame]) -> StudySite:
    scene, pose = unseen.scene, site.pose
    ground_m = site_feasibility.ground_height_m(scene.world, pose) if scene.scenario.statics.ground else 0.0
    at = np.concatenate([frame.boxes[frame.target_rows(scene.roi), :2] for frame in frames])
    away_m = float(np.hypot(*(at - np.array(pose.position_m[:2])).T).mean()) if len(at) else float("nan")
    return StudySite(site.name, site.pole, round(pose.z_m - ground_m, 3), away_m, site.name in part.given)
