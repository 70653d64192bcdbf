"""Asks what detectors find in the fused clouds of a plan, sensor after sensor; the whole of ``egvs validate --plan``.

Steps: check the scenario; read the plan; bring traffic that the TPOG never saw, the same frames that single sites are
judged by; look from the first sensor, the first two, and so on; measure what was found, as for single sites.
``fused.parquet`` goes into the run's folder, the same bytes whenever scenario, plan and program are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import schemas
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.findings import WARNINGS, Finding, seen_from
from pipeline.core.progress import Progress, silent
from pipeline.runs.guarding import keep_inputs
from pipeline.runs.locking import alone
from pipeline.scenario.models import Scenario
from pipeline.validation import detection, unseen_traffic
from pipeline.validation.agreement import main_measure
from pipeline.validation.detectors import registry
from pipeline.validation.detectors.base import JointDetector, is_joint
from pipeline.validation.fused import plans, writing
from pipeline.validation.fused.gains import FusedDetection, with_gains
from pipeline.validation.fused.looking import FusedLook
from pipeline.validation.fused.plans import Plan
from pipeline.validation.looking import LookListener, look_from
from pipeline.validation.preparing import checked, not_unseen, refuse_empty, workshop
from pipeline.validation.site_findings import POINTS
from pipeline.validation.unseen_record import UnseenRecord, prepare


@dataclass(frozen=True)
class PlanValidation:
    """What detectors find in the fused clouds of a plan.

    Attributes
    ----------
    rows
        For each number of sensors, detector and set of objects, in this order.
    doubts
        What to know before trusting them.
    path
        What was written.
    """

    plan: Plan
    rows: tuple[FusedDetection, ...]
    doubts: tuple[Finding, ...]
    path: Path


def validate(
    scenario: Scenario,
    out: Path,
    plan_folder: Path,
    *,
    frames: int,
    detectors: Sequence[str] = (POINTS,),
    jobs: int | None = None,
    progress: Progress = silent,
    listener: LookListener | None = None,
) -> PlanValidation:
    """What detectors find in the fused clouds of a plan's first sensor, its first two, and so on.

    Parameters
    ----------
    out
        The run's folder.
    plan_folder
        Where the plan's ``placement.parquet`` is.
    frames
        Of unseen traffic.
    detectors
        Names; points on vehicles are always counted.
    listener
        Hears how far the looking is.

    Raises
    ------
    InputError
        What the check refuses; no plan, or one of another scenario; an unknown detector, or one that cannot look at
        fused clouds; more frames than traffic has; no vehicle in the region of interest.
    """
    chosen, plan = joint_detectors(detectors), plans.read(plan_folder, scenario)
    keep_inputs(scenario, out)
    with alone(out), workshop(out) as folder:
        doubts = checked(scenario, folder / "check", progress)
        record = prepare(scenario, folder / "unseen", frames, jobs=jobs, progress=progress)
        watched = list(record.read())
        refuse_empty(scenario, record, watched)
        found = look_from(plan.groups, FusedLook(record, chosen), jobs=jobs, progress=progress, listener=listener)
        rows, undefined = detection.measured(watched, record.scene.roi, found)
        told = (*doubts, *not_unseen(scenario), *_other_world(plan, record), *undefined)
        done = PlanValidation(plan, with_gains(plan.groups, rows), told, out / writing.ARTEFACT)
        writing.write(done.path, done.rows, _about(scenario, record, done))
        return done


def joint_detectors(names: Sequence[str]) -> Mapping[str, JointDetector]:
    """Detectors by name, those that can look at fused clouds; points are none.

    Raises
    ------
    InputError
        For one that is unknown, or that looks at sweeps of single sensors alone.
    """
    found = {}
    for name in dict.fromkeys(names):
        if name == POINTS:
            continue
        detector = registry.make(name)
        if not is_joint(detector):
            raise InputError("--detector", f"{name!r}, which looks at sweeps of single sensors", "one with 'together'")
        found[name] = detector
    return found


def _other_world(plan: Plan, record: UnseenRecord) -> list[Finding]:
    """A warning where the plan was made in another static world than the one that is looked at."""
    if plan.statics == record.keys["statics"]:
        return []
    what = "the plan was made in another static world than the one that is looked at"
    return [Finding("plan", plan.path.name, what, "egvs place makes it anew")]


def _about(scenario: Scenario, record: UnseenRecord, done: PlanValidation) -> dict[str, Any]:
    """Metadata."""
    detectors = list(dict.fromkeys(row.detection.detector for row in done.rows))
    plan = [{"site": its.name, "sensor": its.sensor, **asdict(its.pose)} for its in done.plan.sites]
    warnings = {WARNINGS: [doubt.to_json() for doubt in done.doubts]}
    return {
        "schema": schemas.VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_of(scenario.model_dump(mode="json"))},
        "seed": scenario.seed,
        "unseen_seed": record.scenario.seed,
        "frames": record.frames,
        "apart_s": unseen_traffic.APART_S,
        "inputs": files.hash_of([record.keys, np.asarray(record.numbers).tolist(), detectors, plan]),
        "plan": {"score": done.plan.score, "inputs": done.plan.inputs, "sensors": plan},
        "shown": {detector: main_measure(detector) for detector in detectors},
        **seen_from(scenario.folder, warnings),
    }
