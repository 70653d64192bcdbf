"""Measure one part of the study: one junction with one detector, its scores, or what its candidates see of vehicles.

Detections of each candidate are cached (:mod:`egvs.validation.detector_runs`), so an interrupted part continues where
it stopped. A complete part is not measured again while nothing that it depends on has changed.

All parts of a junction use the same unseen traffic (:mod:`egvs.validation.held_out_traffic`): other departures than
those of the traffic behind the scores.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean

import numpy as np

from benchmarks.across_junctions import records
from benchmarks.across_junctions.protocol import Junction, Protocol
from benchmarks.across_junctions.records import MEASURES, SCORES, VEHICLES, PartInfo, info_path, write_table
from benchmarks.detectability.examples import hits_of
from benchmarks.records import Machine
from benchmarks.validity.junctions import check_unseen, with_sites
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.resource_usage import ResourceUsage, measure_usage
from egvs.core.threads import map_ordered, thread_count
from egvs.runs import stage_keys
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario
from egvs.scoring.target_scores import FEATURES, detectability_features
from egvs.scoring.targets import TargetRecord, VisibleTargets, detection_probability, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Site
from egvs.stages.inputs import get_scene, open_folder
from egvs.validation import surrogates
from egvs.validation.detection_metrics import BLOCKS, EvaluationFrames, GroundTruth, evaluate, frame_blocks
from egvs.validation.detector_runs import DetectionListener, SiteDetectionTask, run_detectors
from egvs.validation.detectors import base
from egvs.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.results import ScoreName
from egvs.validation.sweeps import POINT_COUNTS_NAME, DetectedBoxes, DetectorResult, PointCounts

MEAN_POINTS = "mean_points"
"""A baseline beside the installed scores: mean number of points on a vehicle of the traffic behind the scores."""


@dataclass(frozen=True)
class Extent:
    """How much of a junction is measured; less than the protocol says is a trial."""

    frames: int
    candidates: int

    def is_trial(self, protocol: Protocol) -> bool:
        """Whether this is less than the protocol says."""
        return self != Extent(protocol.frames, protocol.candidates.count)


@dataclass(frozen=True)
class PartPlan:
    """A part, and where its files go.

    Attributes
    ----------
    part
        A detector, or ``scores`` or ``vehicles``.
    protocol_digest
        Hash of the protocol, for the record.
    candidates
        With their heights above the ground in metres.
    """

    protocol: Protocol
    protocol_digest: str
    junction: Junction
    part: str
    scenario_folder: Path
    candidates: dict[Site, float]
    extent: Extent
    folder: Path

    @property
    def name(self) -> str:
        """Name for progress and messages."""
        return f"{self.junction.name} {self.part}"


def measure(
    plan: PartPlan,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    report: Callable[[str], None] = print,
) -> PartInfo:
    """Measure a part, unless it is there, and return its description.

    Raises
    ------
    InputError
        If the junction's traffic is a finished file, or a sensor cannot stand at a candidate.
    """
    plan.folder.mkdir(parents=True, exist_ok=True)
    with measure_usage() as usage:
        info = _measure(plan, jobs, progress)
    if info is None:
        report(f"{plan.name}: measured before")
        return PartInfo.read(info_path(plan.folder, plan.junction.name, plan.part))
    info = replace(info, seconds=round(usage.seconds, 1), busy_s=round(usage.busy_s, 1))
    info.write(plan.folder)
    return info


def _measure(plan: PartPlan, jobs: int | None, progress: ProgressCallback) -> PartInfo | None:
    """Measure a part, and return its description without its cost; None if the part is there."""
    sites = list(plan.candidates)[: plan.extent.candidates]
    with tempfile.TemporaryDirectory(prefix=".work-", dir=plan.folder) as temporary:
        work = Path(temporary)
        scenario = with_sites(load(plan.scenario_folder), sites, work / "sites.csv")
        check_unseen(scenario)
        held_out = prepare_held_out_traffic(
            scenario, work / "unseen", plan.extent.frames, apart_s=plan.protocol.apart_s, jobs=jobs, progress=progress
        )
        key = _key(plan, held_out)
        path = info_path(plan.folder, plan.junction.name, plan.part)
        if path.is_file() and PartInfo.read(path).key == key:
            return None
        path.unlink(missing_ok=True)
        _write_candidates(plan, sites)
        skipped: tuple[str, ...] = ()
        site_s = 0.0
        if plan.part == SCORES:
            skipped = _measure_scores(plan, scenario, work / "scores", jobs, progress)
        elif plan.part == VEHICLES:
            _measure_vehicles(plan, held_out, jobs, progress)
        else:
            site_s = _measure_detector(plan, held_out, jobs, progress)
        return replace(_info(plan, scenario, held_out, key), skipped=skipped, site_s=round(site_s, 2))


class _SiteCosts(DetectionListener):
    """Collects the processor time of each candidate."""

    def __init__(self) -> None:
        self.busy_s: list[float] = []

    def site_done(self, site: str, detectors: Sequence[str], cost: ResourceUsage) -> None:
        """Add the cost of a candidate whose results were not cached."""
        if detectors:
            self.busy_s.append(cost.busy_s)


def source_digest(part: str) -> str:
    """Return the digest of the source that a part depends on."""
    modules = [__name__]
    if part not in records.NOT_DETECTORS:
        modules.append(type(base.make_detector(part)).__module__)
    return stage_keys.source_digest(*modules).digest


def _key(plan: PartPlan, held_out: HeldOutTraffic) -> str:
    """Return a hash of everything that a part depends on."""
    depends: object
    if plan.part == SCORES:
        # of the scenario with its own sites: the file of the candidates has another path each time
        sites = [
            [site.name, site.sensor, *site.pose.position_m, *site.pose.angles_deg] for site in held_out.scene.sites
        ]
        depends = [surrogates.surrogates_key(load(plan.scenario_folder)), sites]
    else:
        detectors = {} if plan.part == VEHICLES else {plan.part: base.make_detector(plan.part)}
        task = SiteDetectionTask(held_out, detectors)
        depends = [task.key(site, name) for site in held_out.scene.sites for name in (detectors or [POINT_COUNTS_NAME])]
    return files.hash_json(
        {
            "part": [plan.junction.name, plan.junction.role, plan.part, asdict(plan.extent)],
            "depends": depends,
            "heights": [plan.candidates[site] for site in list(plan.candidates)[: plan.extent.candidates]],
            "source": source_digest(plan.part),
        }
    )


def _info(plan: PartPlan, scenario: Scenario, held_out: HeldOutTraffic, key: str) -> PartInfo:
    frames = list(held_out.read())
    sample = held_out.sample(frames)
    vehicle_frames = sum(len(frame.target_rows(held_out.scene.roi)) for frame in frames)
    return PartInfo(
        plan.junction.name, plan.junction.role, plan.part, key, source_digest(plan.part), plan.protocol_digest,
        sample.frames, sample.apart_s, sample.vehicles, vehicle_frames, len(held_out.scene.sites),
        {"TPOG": scenario.seed, "unseen": held_out.scenario.seed}, plan.extent.is_trial(plan.protocol),
        seconds=0.0, busy_s=0.0, site_s=0.0, machine=Machine.current().model_dump(mode="json"),
    )  # fmt: skip


def _path(plan: PartPlan, name: str) -> Path:
    return plan.folder / f"{plan.junction.name}.{name}.parquet"


def _write_candidates(plan: PartPlan, sites: Sequence[Site]) -> None:
    columns: dict[str, list[str] | list[float]] = {
        "site": [site.name for site in sites],
        "sensor": [site.sensor for site in sites],
        "height_m": [plan.candidates[site] for site in sites],
    }
    for name in ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg"):
        columns[name] = [getattr(site.pose, name) for site in sites]
    write_table(_path(plan, "candidates"), columns)


# ---- scores


def _measure_scores(
    plan: PartPlan, scenario: Scenario, work: Path, jobs: int | None, progress: ProgressCallback
) -> tuple[str, ...]:
    """Write all installed scores, and the mean number of points; return what could not be computed."""
    scored = surrogates.compute_surrogates(scenario, work, jobs=jobs, progress=progress)
    rows: list[tuple[str, str, int, float]] = [
        (row.site, str(ScoreName(row.score, row.parameters_json)), row.sign, row.value) for row in scored.rows
    ]
    rows += [(site, MEAN_POINTS, 1, points) for site, points in _mean_points(scenario, work, jobs).items()]
    columns = {name: [row[number] for row in rows] for number, name in enumerate(("site", "score", "sign", "value"))}
    write_table(_path(plan, SCORES), columns)
    costs = files.to_json_text(scored.costs_ms(), indent=1)
    files.write_text(plan.folder / f"{plan.junction.name}.costs_ms", costs + "\n")
    return tuple(str(reason) for reason in scored.skipped)


def _mean_points(scenario: Scenario, work: Path, jobs: int | None) -> dict[str, float]:
    """Return the mean number of points on a vehicle of the traffic behind the scores, by site."""
    scene = get_scene(open_folder(scenario, work))
    record = TargetRecord.read(work / "trajectories.parquet", scenario.roi.grid)
    return {
        site.name: float(visible.points.mean()) if len(visible) else float("nan")
        for site, visible in _visible(scene, record, jobs)
    }


def _visible(scene: Scene, record: TargetRecord, jobs: int | None) -> list[tuple[Site, VisibleTargets]]:
    """Return what each site sees of the vehicle-frames of a record."""
    scanner = Scanner(scene)

    def of(site: Site) -> tuple[Site, VisibleTargets]:
        beams = Beams.of(scanner.scan_site(site))
        return site, visible_targets(record, beams, detection_probability(scene, beams.sensor))

    return list(map_ordered(of, scene.sites, thread_count(jobs)))


# ---- vehicles, and what is visible of them


def _measure_vehicles(plan: PartPlan, held_out: HeldOutTraffic, jobs: int | None, progress: ProgressCallback) -> None:
    record = _record(held_out)
    names = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    boxes = dict(zip(names, record.boxes.T, strict=True))
    vehicles = {
        "frame": record.frame,
        "vehicle": [record.vehicles[number] for number in record.vehicle],
        "class": [record.kinds[number] for number in record.kind],
        "gap_m": record.gap_m,
        **boxes,
    }
    write_table(_path(plan, VEHICLES), vehicles)
    each = _visible(held_out.scene, record, jobs)
    features = np.concatenate([detectability_features(visible) for _, visible in each])
    columns: dict[str, object] = {
        "site": np.repeat([site.name for site, _ in each], len(record)),
        "row": np.tile(np.arange(len(record)), len(each)),
        "points": np.concatenate([visible.points for _, visible in each]).astype(np.float32),
    }
    columns |= {name: features[:, number].astype(np.float32) for number, name in enumerate(FEATURES)}
    write_table(_path(plan, "features"), columns)
    progress("visibility of sites", len(each), len(each))


def _record(held_out: HeldOutTraffic) -> TargetRecord:
    record = TargetRecord.of(list(held_out.read()), held_out.scenario.roi.grid)
    if not len(record):
        problem = f"no vehicle in the region of interest in {held_out.frames} frames of unseen traffic"
        raise InputError(f"{held_out.scenario.file}: roi", problem, "Use traffic that passes the region.")
    return record


# ---- detectors


def _measure_detector(plan: PartPlan, held_out: HeldOutTraffic, jobs: int | None, progress: ProgressCallback) -> float:
    """Run a detector at every candidate, write its AP and its hits, and return the mean cost of a candidate."""
    task = SiteDetectionTask(held_out, {plan.part: base.make_detector(plan.part)})
    costs = _SiteCosts()
    results = run_detectors(held_out.scene.sites, task, jobs=jobs, progress=progress, listener=costs)
    record = _record(held_out)
    measured: dict[str, list[object]] = {
        name: [] for name in ("site", "measure", "value", "se", "left_out", "half_1", "half_2")
    }
    hits: list[FloatArray] = []
    for site, by_detector in results.items():
        boxes = by_detector[plan.part]
        assert isinstance(boxes, DetectedBoxes)
        for measure, values in measures_of(held_out, by_detector[POINT_COUNTS_NAME], boxes).items():
            for name, value in zip(measured, (site, measure, *values), strict=True):
                measured[name].append(value)
        hits.append(hits_of(record, [frame.boxes for frame in boxes.frames]))
    write_table(_path(plan, plan.part), measured)
    columns = {
        "site": np.repeat(list(results), len(record)),
        "row": np.tile(np.arange(len(record)), len(results)),
        "hits": np.concatenate(hits).astype(np.float32),
    }
    write_table(_path(plan, f"{plan.part}.hits"), columns)
    return mean(costs.busy_s) if costs.busy_s else 0.0


MeasuredValues = tuple[float, float, FloatArray, float, float]
"""Value, standard error, values without each block, and those of both halves."""


def measures_of(held_out: HeldOutTraffic, points: DetectorResult, boxes: DetectedBoxes) -> dict[str, MeasuredValues]:
    """Return every measure of a detector at one candidate, by name; see :data:`MeasuredValues`."""
    assert isinstance(points, PointCounts)
    objects = [
        GroundTruth.from_frame(frame, on_vehicles, held_out.scene.roi)
        for frame, on_vehicles in zip(held_out.read(), points.points, strict=True)
    ]
    whole = evaluate(EvaluationFrames.from_frames(objects, boxes.frames)).measures
    halves = []
    for half in half_frames(len(objects)):
        frames = EvaluationFrames.from_frames([objects[i] for i in half], [boxes.frames[i] for i in half])
        halves.append(evaluate(frames).measures)
    first, second = halves
    return {
        name: (whole[name].value, whole[name].se, whole[name].left_out, first[name].value, second[name].value)
        for name in MEASURES
    }


def half_frames(frames: int) -> tuple[list[int], list[int]]:
    """Return the frames of the even and of the odd blocks: both halves reach over the whole record."""
    block = frame_blocks(frames, BLOCKS)
    even, odd = (np.flatnonzero(block % 2 == parity).tolist() for parity in (0, 1))
    return even, odd
