"""Measures one part of the study: the sites of one junction with one sensor, by all detectors and scores.

What detectors find from a site is in the store (:mod:`pipeline.validation.looking`), so a part that was interrupted
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
from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core import code_digest, files
from pipeline.core.progress import Progress, silent
from pipeline.scenario.models import Scenario
from pipeline.sensing import placing
from pipeline.sensing.sites import Site
from pipeline.validation import detection
from pipeline.validation.agreement import ScoreName
from pipeline.validation.detection import ALL, SiteDetection
from pipeline.validation.looking import Look, look_from
from pipeline.validation.site_findings import POINTS, Found
from pipeline.validation.surrogates import gathering
from pipeline.validation.surrogates.gathering import Surrogates
from pipeline.validation.unseen_record import UnseenRecord, prepare


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
    progress: Progress = silent,
    told: Callable[[str], None] = print,
) -> Record:
    """The record of a part, kept or made; milliseconds that scores took lie beside it, in ``NAME.costs.json``."""
    path = folder / f"{part.name}.json"
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as temporary:
        unseen = prepare(
            part.scenario, Path(temporary) / "unseen", part.frames, apart_s=part.apart_s, jobs=jobs, progress=progress
        )
        made = {name: {name: low_models.make(name)} if name != POINTS else {} for name in part.detectors}
        looks = {name: Look(unseen, its) for name, its in made.items()}
        key = _key(part, looks)
        if path.is_file() and (kept := Record.read(path)).key == key:
            told(f"{part.name}: kept")
            return kept
        found: dict[str, dict[str, Found]] = {site.name: {} for site in unseen.scene.sites}
        for name, look in looks.items():
            mine = [site for site in unseen.scene.sites if name == POINTS or site.name in part.detectors[name]]
            for site, its in look_from(mine, look, jobs=jobs, progress=progress).items():
                found[site] |= its
        rows, _ = detection.measured(list(unseen.read()), unseen.scene.roi, found)
        scored = gathering.surrogates_of(
            part.scenario, Path(temporary) / "scores", part.scores, jobs=jobs, progress=progress
        )
        record = _record(part, key, unseen, rows, scored)
    (folder / f"{part.name}.costs.json").write_text(json.dumps(scored.costs_ms(), indent=1) + "\n", encoding="utf-8")
    record.write(path)
    return record


def _key(part: Part, looks: Mapping[str, Look]) -> str:
    """Hash of everything that a record depends on."""
    looked = {
        name: [
            look.key(site, name)
            for site in look.record.scene.sites
            if name == POINTS or site.name in part.detectors[name]
        ]
        for name, look in looks.items()
    }
    source = code_digest.of(detection.__name__, gathering.__name__)
    about = {
        "part": [part.name, part.junction, part.role, part.sensor, sorted(part.given), part.frames, part.apart_s],
        "looked": looked,
        "scores": gathering.inputs_key(part.scenario, part.scores),
        "program": [
            source.digest,
            files.sha256_of(Path(__file__)),
            files.sha256_of(Path(__file__).with_name("record.py")),
        ],
        "libraries": code_digest.versions(source.libraries),
    }
    return files.hash_of(about)


def _record(part: Part, key: str, unseen: UnseenRecord, rows: Sequence[SiteDetection], scored: Surrogates) -> Record:
    sites = tuple(site.name for site in unseen.scene.sites)
    place = {name: number for number, name in enumerate(sites)}
    scores: dict[str, list[float]] = {}
    for row in scored.rows:
        name = str(ScoreName(row.score, row.parameters_json))
        scores.setdefault(name, [float("nan")] * len(sites))[place[row.site]] = row.sign * row.value
    all_rows = [row for row in rows if row.objects_of == ALL]
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


def _site(site: Site, part: Part, unseen: UnseenRecord, frames: Sequence[TrafficFrame]) -> StudySite:
    scene, pose = unseen.scene, site.pose
    ground_m = placing.ground_m(scene.world, pose) if scene.scenario.statics.ground else 0.0
    at = np.concatenate([frame.boxes[frame.wanted(scene.roi), :2] for frame in frames])
    away_m = float(np.hypot(*(at - np.array(pose.position_m[:2])).T).mean()) if len(at) else float("nan")
    return StudySite(site.name, site.pole, round(pose.z_m - ground_m, 3), away_m, site.name in part.given)
