"""Measure one part of the study: one junction with one detector, its scores, or what its candidates see of vehicles.

Detections of each candidate are cached (:mod:`egvs.extensions.validation.detector_runs`), so an interrupted part
continues where it stopped. A complete part is not measured again while nothing that it depends on has changed.

All parts of a junction use the same unseen traffic (:mod:`egvs.extensions.validation.held_out_traffic`): other
departures than those of the traffic behind the scores.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.across_junctions import detections, records
from benchmarks.across_junctions.candidates import with_sites
from benchmarks.across_junctions.models.additive_model import DIRECTIONS, target_features
from benchmarks.across_junctions.protocol import Junction, Protocol
from benchmarks.across_junctions.records import SCORES, VEHICLES, PartInfo, info_path, write_table
from benchmarks.records import Machine
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.resource_usage import measure_usage
from egvs.core.threads import map_ordered, thread_count
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation import surrogates
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.extensions.validation.results import ScoreName
from egvs.runs import stage_keys
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario
from egvs.scoring.targets import TargetRecord, VisibleTargets, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Site

FEWER_FRAMES = {"chongqing": 1000}
"""Frames of the traffic behind the scores, where the protocol's number does not fit: the recorded people of chongqing
last 1,120 s."""

MEAN_POINTS = "mean_points"
"""A baseline beside the installed scores: mean number of points on a vehicle of the traffic behind the scores."""


@dataclass(frozen=True)
class Extent:
    """How much of a junction is measured; less than the protocol says is a trial."""

    frames: int
    candidates: int

    @classmethod
    def of(cls, protocol: Protocol, junction: Junction) -> Extent:
        """Return what the protocol says."""
        return cls(protocol.frames_of(junction), protocol.candidates.count)


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
    again
        Why a part may be measured again that is not of a training junction; it is recorded.
    """

    protocol: Protocol
    protocol_digest: str
    junction: Junction
    part: str
    scenario_folder: Path
    candidates: dict[Site, float]
    extent: Extent
    folder: Path
    again: str = ""

    @property
    def name(self) -> str:
        """Name for progress and messages."""
        return f"{self.junction.name} {self.part}"

    def load_scenario(self) -> Scenario:
        """Load the scenario of the junction, with its own sites."""
        frames = FEWER_FRAMES.get(self.junction.name)
        return load(self.scenario_folder, () if frames is None else (f"traffic.frames={frames}",))

    @property
    def is_trial(self) -> bool:
        """Whether less is measured than the protocol says."""
        return self.extent != Extent.of(self.protocol, self.junction)


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
        If the junction's traffic is a finished file, or a sensor cannot stand at a candidate; if the part is not of a
        training junction and was measured before, from something else.
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
        scenario = with_sites(plan.load_scenario(), sites, work / "sites.csv")
        check_unseen(scenario)
        held_out = prepare_held_out_traffic(
            scenario, work / "unseen", plan.extent.frames, apart_s=plan.protocol.apart_s, jobs=jobs, progress=progress
        )
        key = _key(plan, held_out)
        path = info_path(plan.folder, plan.junction.name, plan.part)
        before = PartInfo.read(path) if path.is_file() else None
        if before is not None and before.key == key:
            return None
        was_measured = before is not None or _path(plan, plan.part).is_file()
        if was_measured and plan.junction.role != "training" and not plan.again:
            problem = f"{plan.name} was measured before, by another source or from other inputs"
            hint = 'It should be measured only once. If it must be measured again: --again "REASON", which is recorded.'
            raise InputError(path, problem, hint)
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
        reasons = (*(before.again if before else ()), *((plan.again,) if was_measured and plan.again else ()))
        return replace(_info(plan, scenario, held_out, key), skipped=skipped, site_s=round(site_s, 2), again=reasons)


def check_unseen(scenario: Scenario) -> None:
    """Reject traffic that scores and detectors would share.

    Raises
    ------
    InputError
        For traffic that is a finished file.
    """
    if scenario.is_recorded:
        problem = "the traffic is a finished file, so scores and detectors would use the same frames"
        raise InputError(
            f"{scenario.file}: traffic.fcd", problem, "Use a network, whose traffic can have another seed."
        )


def source_digest(part: str) -> str:
    """Return the digest of the source that a part depends on."""
    if part not in records.NOT_DETECTORS:
        return detections.source_digest(part)
    return stage_keys.source_digest(__name__).digest


def _key(plan: PartPlan, held_out: HeldOutTraffic) -> str:
    """Return a hash of everything that a part depends on."""
    depends: object
    sites = [[site.name, site.sensor, *site.pose.position_m, *site.pose.angles_deg] for site in held_out.scene.sites]
    if plan.part == SCORES:
        # of the scenario with its own sites: the file of the candidates has another path each time
        depends = [surrogates.surrogates_key(plan.load_scenario()), sites]
    elif plan.part == VEHICLES:
        depends = detections.dependencies(held_out)
    else:
        depends = detections.dependencies(held_out, plan.part)
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
        plan.junction.name, plan.junction.role, plan.part, key, source_digest(plan.part),
        "" if plan.part in records.NOT_DETECTORS else detections.settings_digest(plan.part), plan.protocol_digest,
        sample.frames, sample.apart_s, sample.vehicles, vehicle_frames, len(held_out.scene.sites),
        {"TPOG": scenario.seed, "unseen": held_out.scenario.seed}, plan.is_trial,
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
    return tuple(str(reason) for reason in scored.skipped)


def _mean_points(scenario: Scenario, work: Path, jobs: int | None) -> dict[str, float]:
    """Return the mean number of points on a vehicle of the traffic behind the scores, by site."""
    scene = open_folder(scenario, work).scene
    record = TargetRecord.read(work / "trajectories.parquet", scenario.roi.grid)
    return {
        site.name: float(visible.points.mean()) if len(visible) else float("nan")
        for site, _, visible in _visible(scene, record, jobs)
    }


def _visible(scene: Scene, record: TargetRecord, jobs: int | None) -> list[tuple[Site, Sensor, VisibleTargets]]:
    """Return each site, its sensor, and what it sees of the vehicle-frames of a record."""
    scanner = Scanner(scene)

    def of(site: Site) -> tuple[Site, Sensor, VisibleTargets]:
        beams = Beams.of(scanner.scan_site(site))
        return site, beams.sensor, visible_targets(record, beams, ReturnProbability.of(scene, beams.sensor))

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
    each = [
        (site, target_features(seen, sensor.azimuth_step_deg), seen.points)
        for site, sensor, seen in _visible(held_out.scene, record, jobs)
    ]
    columns: dict[str, object] = {
        "site": np.repeat([site.name for site, _, _ in each], len(record)),
        "row": np.tile(np.arange(len(record)), len(each)),
        "points": np.concatenate([points for _, _, points in each]).astype(np.float32),
        "vehicle_class": np.concatenate([features.vehicle_class for _, features, _ in each]).astype(np.int8),
    }
    for name in DIRECTIONS:
        columns[name] = np.concatenate([features.columns[name] for _, features, _ in each]).astype(np.float32)
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
    """Run a detector at every candidate, write its AP, its hits and its boxes; return the mean cost of a candidate."""
    part = detections.run(held_out, plan.part, jobs=jobs, progress=progress)
    write_table(_path(plan, plan.part), part.measures)
    write_table(_path(plan, f"{plan.part}.hits"), part.hits)
    write_table(_path(plan, f"{plan.part}.boxes"), part.boxes)
    return part.site_s
