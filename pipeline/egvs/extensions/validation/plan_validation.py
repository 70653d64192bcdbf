r"""Validates a plan of several sensors: ``egvs validate --plan``.

Reads a plan that ``egvs place`` wrote, and runs detectors on the fused point clouds of its first sensor, of its first
two, and so on. The frames are those that single sites are validated with. Writes ``fused.parquet`` into the folder of
the run; its bytes depend on scenario, plan and program only.

Steps for a frame: each sensor of the group makes the same sweep as when it works alone. The points on vehicles are
those of all sensors. A joint detector receives all sweeps, knows which sensor each point belongs to, and returns one
list of boxes.

The *gain* of a sensor is the difference of a measure with and without it. Both values come from the same frames, so
their difference has a smaller standard error than either. It is jackknifed itself, with each block of frames left out
of both values (:mod:`egvs.extensions.validation.detection_metrics`):

.. math:: g_k = m_k - m_{k-1}, \qquad g_{k(b)} = m_{k(b)} - m_{k-1(b)}

All sensors are assumed to be synchronised and perfectly calibrated. Real sensors are neither.
"""

from __future__ import annotations

import itertools
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import checksums, parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.clouds import simulation as cloud_simulation
from egvs.core import files
from egvs.core.errors import Diagnostic, InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.extensions.validation import detection_metrics
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS, UNDEFINED, JackknifeEstimate, SiteDetection
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME, DetectorResult
from egvs.extensions.validation.detector_runs import (
    DetectionListener,
    DetectionTaskBase,
    SiteDetectionTask,
    run_detectors,
)
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.detectors.base import JointDetector
from egvs.extensions.validation.files import FUSED
from egvs.extensions.validation.held_out_traffic import FrameSampling, HeldOutTraffic, TrafficSample
from egvs.extensions.validation.results import main_measure
from egvs.extensions.validation.validation_run import validation_metadata, validation_run
from egvs.runs import run as runs
from egvs.runs import stage_keys
from egvs.scenario.model import Scenario
from egvs.sensors import sensor, sites
from egvs.sensors.sites import Pose, Site

_FIXED_SUBSETS = (ALL_OBJECTS, "cars")
"""Sets of objects that do not depend on the number of sensors."""


@dataclass(frozen=True)
class SensorGroup:
    """Sensors whose point clouds are fused."""

    sites: tuple[Site, ...]

    @property
    def name(self) -> str:
        """The names of all sites, joined by plus signs."""
        return " + ".join(site.name for site in self.sites)


@dataclass(frozen=True)
class FusedPlan:
    """A plan of several sensors.

    Attributes
    ----------
    path
        The file that it was read from.
    sites
        Its sensors, in the order of the plan.
    score
        The score that they were chosen by.
    inputs
        Hash of everything that the plan was computed from.
    statics
        Key of the static world that it was computed in; empty if the file does not contain it.
    """

    path: Path
    sites: tuple[Site, ...]
    score: str
    inputs: str
    statics: str

    @property
    def groups(self) -> tuple[SensorGroup, ...]:
        """The first sensor, the first two, and so on."""
        return tuple(SensorGroup(self.sites[:count]) for count in range(1, len(self.sites) + 1))


@dataclass(frozen=True)
class FusedDetection:
    """Detection by one detector with the first sensors of a plan, for one set of objects.

    Attributes
    ----------
    sites
        Names of the sensors.
    detection
        The measures.
    gain
        Increase of the detector's main measure over one sensor less; of the first sensor, the measure itself. NaN for
        sets of objects that depend on the sensors.
    """

    sites: tuple[str, ...]
    detection: SiteDetection
    gain: JackknifeEstimate


@dataclass(frozen=True)
class PlanValidation:
    """The result of validating a plan.

    Attributes
    ----------
    plan
        The plan.
    rows
        By number of sensors, detector and set of objects.
    warnings
        What to know before trusting the rows.
    path
        The file that was written.
    sample
        The size of the held-out traffic.
    """

    plan: FusedPlan
    rows: tuple[FusedDetection, ...]
    warnings: tuple[Diagnostic, ...]
    path: Path
    sample: TrafficSample


@dataclass(frozen=True)
class FusedDetectionTask(DetectionTaskBase[JointDetector]):
    """Detection from groups of sites."""

    def at(self, group: SensorGroup, names: Sequence[str]) -> dict[str, DetectorResult]:
        """Return the results of some of the detectors for a group, by name."""
        simulators = self.simulators(group.sites)
        views = [simulator.view for simulator in simulators]
        detectors = {}
        for name in names:
            if name != POINT_COUNTS_NAME:
                detectors[name] = self.detectors[name].at_sites(views, self.record.scene.roi).detect
        return self.detect(simulators, detectors, with_points=POINT_COUNTS_NAME in names)

    def key(self, group: SensorGroup, name: str) -> str:
        """Return a hash of everything that a detector's result for a group depends on."""
        site_task = SiteDetectionTask(self.record, self.detectors)
        site_keys = [site_task.key(site, name) for site in group.sites]
        return files.hash_json({"fused": site_keys, "program": stage_keys.source_digest(__name__).digest})


def validate_plan(
    scenario: Scenario,
    out: Path,
    plan_folder: Path,
    *,
    sampling: FrameSampling,
    detectors: Sequence[str] = (POINT_COUNTS_NAME,),
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: DetectionListener | None = None,
) -> PlanValidation:
    """Run detectors on the fused point clouds of a plan's first sensor, its first two, and so on.

    Parameters
    ----------
    out
        The run's folder.
    plan_folder
        Folder of the plan's ``placement.parquet``.
    sampling
        Frames of held-out traffic.
    detectors
        Names of detectors; points on vehicles are always counted.
    jobs
        Number of processes; one per core when None.
    listener
        Receives the progress of the detectors.

    Raises
    ------
    InputError
        If the check finds an error, the plan is missing or belongs to another scenario, a detector is unknown or cannot
        process fused clouds, or the traffic has too few frames or no vehicle in the region of interest.
    """
    chosen = joint_detectors(detectors)
    plan = read_fused_plan(plan_folder, scenario)
    runs.check_no_overwrite(scenario, out)

    with validation_run(scenario, out, sampling, jobs=jobs, progress=progress) as run:
        record = run.record
        task = FusedDetectionTask(record, chosen)
        results = run_detectors(plan.groups, task, jobs=jobs, progress=progress, listener=listener)
        rows, undefined = detection_metrics.measure_detection(run.frames, record.scene.roi, results)
        warnings = (*run.warnings, *_other_world_warnings(plan, record), *undefined)
        validation = PlanValidation(plan, with_gains(plan.groups, rows), warnings, out / FUSED.name, run.sample)
        write_fused(validation.path, validation.rows, _plan_metadata(scenario, record, validation))
        return validation


def joint_detectors(names: Sequence[str]) -> Mapping[str, JointDetector]:
    """Return detectors that can process fused clouds, by name, without the counting of points.

    Raises
    ------
    InputError
        If a detector is unknown, or can only process the sweeps of single sensors.
    """
    detectors = {}
    for name in dict.fromkeys(names):
        if name == POINT_COUNTS_NAME:
            continue
        detector = base.make_detector(name)
        if not base.is_joint(detector):
            raise InputError(
                "--detector",
                f"{name!r} can only process sweeps of single sensors",
                "Use a detector with a method 'together'.",
            )
        detectors[name] = detector
    return detectors


def read_fused_plan(folder: Path, scenario: Scenario) -> FusedPlan:
    """Read the plan in the folder of a run.

    Raises
    ------
    InputError
        If there is no plan, it was altered, belongs to another scenario, has an unknown sensor, or a site with a
        measured scan, from which no traffic can be simulated.
    """
    path = RunFolder(folder).placement
    if not path.is_file():
        raise InputError(
            path,
            "no such file: the folder contains no plan",
            f"Run egvs place {shlex.quote(scenario.name)} --count 3, or name another run's folder with --plan-from.",
        )
    checksums.verify_checksums(path.with_name(RunFolder.placement_checksums.name), "Run egvs place again.")
    table, metadata = parquet.read_artefact(path, "placement")
    _check_plan_scenario(path, metadata.get("scenario"), scenario)

    rows = sorted(table.to_pylist(), key=lambda row: row["order"])
    orders = [row["order"] for row in rows]
    if not rows or orders != list(range(1, len(rows) + 1)):
        raise InputError(path, f"expected sensors in the order 1, 2, ..., got {orders}", "Run egvs place again.")

    measured_scans = {site.name: site.points for site in sites.candidate_sites(scenario)}
    planned = tuple(_site_from_row(path, row, measured_scans.get(row["site"])) for row in rows)
    for site in planned:
        sensor.scenario_sensor(site.sensor, scenario, f"{path}: {site.name}")
        cloud_simulation.check_no_measured_scan(site)

    score = str(metadata["plan"].get("score"))
    statics = str(metadata["stages"].get("statics", ""))
    return FusedPlan(path, planned, score, str(metadata["inputs"]), statics)


def _check_plan_scenario(path: Path, plan_scenario: object, scenario: Scenario) -> None:
    name = plan_scenario.get("name") if isinstance(plan_scenario, dict) else plan_scenario
    if not isinstance(plan_scenario, dict) or name != scenario.name:
        raise InputError(
            path,
            f"expected a plan for {scenario.name}, got a plan for {name!r}",
            "Give the folder of another run with --plan-from.",
        )


def _site_from_row(path: Path, row: dict[str, Any], points: str | None) -> Site:
    pose = Pose(**{field.name: row[field.name] for field in fields(Pose)})
    if not np.isfinite([*pose.position_m, *pose.angles_deg]).all():
        raise InputError(
            f"{path}: {row['site']}", f"expected a pose of finite numbers, got {pose}", "Run egvs place again."
        )
    return Site(row["site"], pose, row["sensor"], points, row["pole"])


def _other_world_warnings(plan: FusedPlan, record: HeldOutTraffic) -> list[Diagnostic]:
    """Return a warning if the plan was computed in another static world than the present one."""
    if plan.statics == record.keys["statics"]:
        return []
    problem = "the plan was computed with a different static world"
    return [Diagnostic("plan", plan.path.name, problem, "Run egvs place again.")]


def with_gains(groups: Sequence[SensorGroup], rows: Sequence[SiteDetection]) -> tuple[FusedDetection, ...]:
    """Return the rows of groups, each of which has one sensor more than the one before, with their gains."""
    row_by_key = {(row.site, row.detector, row.objects_of): row for row in rows}
    previous_group = {group.name: previous.name for previous, group in itertools.pairwise(groups)}
    site_names = {group.name: tuple(site.name for site in group.sites) for group in groups}

    fused = []
    for row in rows:
        gain = UNDEFINED
        if row.objects_of in _FIXED_SUBSETS:
            measure = main_measure(row.detector)
            gain = row.measures[measure]
            if row.site in previous_group:
                previous = row_by_key[previous_group[row.site], row.detector, row.objects_of]
                gain = detection_metrics.estimate_difference(gain, previous.measures[measure], row.frames)
        fused.append(FusedDetection(site_names[row.site], row, gain))
    return tuple(fused)


def write_fused(path: Path, rows: Sequence[FusedDetection], metadata: Mapping[str, Any]) -> None:
    """Write ``fused.parquet``."""
    columns: dict[str, Any] = {
        "sensors": np.array([len(row.sites) for row in rows], dtype=np.uint32),
        "sites": [json.dumps(list(row.sites), ensure_ascii=False) for row in rows],
        **detection_metrics.detection_columns([row.detection for row in rows]),
        "gain": [row.gain.value for row in rows],
        "gain_se": [row.gain.se for row in rows],
    }
    parquet.write_artefact(path, "fused", columns, dict(metadata))


def _plan_metadata(scenario: Scenario, record: HeldOutTraffic, validation: PlanValidation) -> dict[str, Any]:
    detectors = list(dict.fromkeys(row.detection.detector for row in validation.rows))
    plan = validation.plan
    sensors = [{"site": site.name, "sensor": site.sensor, **asdict(site.pose)} for site in plan.sites]
    return {
        **validation_metadata(scenario, record, validation.sample, detectors, validation.warnings),
        "inputs": files.hash_json([record.keys, record.numbers.tolist(), detectors, sensors]),
        "plan": {"score": plan.score, "inputs": plan.inputs, "sensors": sensors},
    }
