"""The steps that validation of single sites and of a plan have in common.

Both lock the folder of the run, check the scenario, and prepare held-out traffic with at least one vehicle in the
region of interest. Their artefacts start with the same metadata.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts import parquet
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core import files
from egvs.core.errors import WARNINGS_KEY, Diagnostic, InputError, collect_warnings, with_relative_paths
from egvs.core.progress import ProgressCallback
from egvs.core.wording import format_percent
from egvs.extensions.validation import held_out_traffic
from egvs.extensions.validation.held_out_traffic import FrameSampling, HeldOutTraffic, TrafficSample
from egvs.extensions.validation.results import main_measure
from egvs.runs import stage_keys, stage_registry
from egvs.runs.run import lock_run_folder
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.traffic import departures, sumo_folder, user_files

_WORK_PREFIX = ".validate-"


@dataclass(frozen=True)
class ValidationRun:
    """A validation in progress: its folder is locked, its traffic is ready.

    Attributes
    ----------
    folder
        Temporary folder within the run's folder.
    record
        The held-out traffic.
    frames
        Its frames.
    warnings
        Warnings of the check and about the traffic.
    sample
        The size of the traffic.
    """

    folder: Path
    record: HeldOutTraffic
    frames: list[TrafficFrame]
    warnings: tuple[Diagnostic, ...]
    sample: TrafficSample


@contextmanager
def validation_run(
    scenario: Scenario, out: Path, sampling: FrameSampling, *, jobs: int | None, progress: ProgressCallback
) -> Iterator[ValidationRun]:
    """Lock the folder of a run, check its scenario, and prepare held-out traffic.

    Parameters
    ----------
    out
        The run's folder.
    sampling
        Frames of held-out traffic.

    Raises
    ------
    InputError
        If the check finds an error, the traffic has too few frames, or no vehicle enters the region of interest.
    """
    with lock_run_folder(out), _temporary_work_folder(out) as folder:
        warnings = _check_scenario(scenario, folder / "check", progress)
        record = held_out_traffic.prepare_held_out_traffic(
            scenario, folder / "unseen", sampling.frames, apart_s=sampling.spacing_s, jobs=jobs, progress=progress
        )
        traffic_frames = list(record.read())
        _check_any_vehicle(scenario, record, traffic_frames)
        warnings += [*_same_traffic_warnings(scenario, record, traffic_frames), *_fixed_departure_warnings(scenario)]
        yield ValidationRun(folder, record, traffic_frames, tuple(warnings), record.sample(traffic_frames))


@contextmanager
def _temporary_work_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder within the locked folder of a run; remove those of killed processes."""
    for leftover in out.glob(f"{_WORK_PREFIX}*"):
        shutil.rmtree(leftover)
    with tempfile.TemporaryDirectory(prefix=_WORK_PREFIX, dir=out) as folder:
        yield Path(folder)


def _check_scenario(scenario: Scenario, folder: Path, progress: ProgressCallback) -> list[Diagnostic]:
    """Run the check stage and return its warnings; its errors are raised."""
    folder.mkdir()
    context = open_folder(scenario, folder, progress=progress)
    result = stage_registry.run_stage("check", context, stage_keys.stage_key("check", context).dependencies)
    return collect_warnings([result.summary])


def _same_traffic_warnings(
    scenario: Scenario, record: HeldOutTraffic, frames: Sequence[TrafficFrame]
) -> Iterator[Diagnostic]:
    """Warn if vehicles of the held-out frames are also in the traffic of the TPOG: recorded traffic."""
    periods = list(scenario.by_period().values())
    vehicles = record.vehicles_in_region(frames)
    n_shared = sum(periods[period].traffic.is_finished for period, _ in vehicles)
    if n_shared:
        yield Diagnostic(
            "traffic not held out",
            f"{scenario.file}: traffic",
            "the traffic was recorded, so sites are evaluated with the frames that the TPOG was computed from: "
            f"{n_shared:,} of {len(vehicles):,} vehicles ({format_percent(n_shared / len(vehicles), 0)}) are in both",
            "Use a network or a sumocfg to simulate held-out traffic.",
        )


def _fixed_departure_warnings(scenario: Scenario) -> Iterator[Diagnostic]:
    """Warn about vehicles of a user's demand that depart at the same time with any seed."""
    for period in scenario.by_period().values():
        if not period.traffic.has_user_demand:
            continue
        demand = sumo_folder.demand_files(period).files
        paths = [path for option in user_files.DEMAND_OPTIONS for path in demand.get(option, ())]
        counts = departures.count_departures(paths)
        total = counts.redrawn + counts.fixed
        if counts.fixed:
            yield Diagnostic(
                "departures not redrawn",
                sumo_folder.traffic_location(period),
                f"{counts.fixed:,} of {total:,} vehicles and flows "
                f"({format_percent(counts.fixed / total, 0)}) have departures that"
                " cannot be redrawn, so the held-out traffic and that of the TPOG have them in common",
                "Use departure times in seconds, or flows.",
            )


def _check_any_vehicle(scenario: Scenario, record: HeldOutTraffic, frames: Sequence[TrafficFrame]) -> None:
    """Raise an InputError if no vehicle is in the region of interest in any frame."""
    roi = record.scene.roi
    if not any(len(frame.target_rows(roi)) for frame in frames):
        raise InputError(
            f"{scenario.file}: roi",
            f"no vehicle's centre is in the region in any of {record.frames} frames of held-out traffic",
            "Choose a region with traffic, or more --frames.",
        )


def validation_metadata(
    scenario: Scenario,
    record: HeldOutTraffic,
    sample: TrafficSample,
    detectors: Sequence[str],
    warnings: Sequence[Diagnostic],
) -> dict[str, Any]:
    """Return the metadata that all artefacts of a validation contain."""
    warnings_json = {WARNINGS_KEY: [warning.to_json() for warning in warnings]}
    return {
        "schema": parquet.SCHEMA_VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_json(scenario.model_dump(mode="json"))},
        "seed": scenario.seed,
        "unseen_seed": record.scenario.seed,
        "frames": sample.frames,
        "apart_s": sample.apart_s,
        "vehicles": sample.vehicles,
        "shown": {detector: main_measure(detector) for detector in detectors},
        **with_relative_paths(scenario.folder, warnings_json),
    }
