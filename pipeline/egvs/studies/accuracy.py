"""Study what the decision for a pole costs, and recommend the cheapest setting with a small expected loss.

Steps: warm up; measure the stages of the scenario; simulate further seeds and score their traffic
(:mod:`egvs.studies.traffic_scores`); do the same for one setting after another (:mod:`egvs.studies.study_settings`)
until a budget of seconds is used up; price what each setting chooses (:mod:`egvs.studies.study_draws`,
:mod:`egvs.studies.decision`); recommend; write ``accuracy.parquet`` and ``accuracy.png``. Probabilities and losses are
deterministic for the same settings and seeds; seconds are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from egvs.artefacts import checksums, parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files, plugins
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.results.studies import SCENARIO, SettingResult, Tolerance
from egvs.runs.run import check_no_overwrite, lock_run_folder, refresh_report
from egvs.runs.run_sources import SettingsSource
from egvs.scenario.model import Scenario
from egvs.studies import decision_figure, measurement
from egvs.studies.decision import MIN_UNITS
from egvs.studies.measurement import SettingListener, SettingRunner, scenario_dependencies
from egvs.studies.pricing import BestPole, Pricing
from egvs.studies.recommendation import NeededTraffic, mark_rows
from egvs.studies.study_runs import MAX_SEEDS, StudyRuns
from egvs.studies.study_settings import DEFAULT_VALUES, SettingValues


@dataclass(frozen=True)
class StudyOptions:
    """Options of a study.

    Attributes
    ----------
    tolerance
        What the recommended setting must meet.
    budget_s
        Settings that would not end within this time are not started. The scenario always runs, with
        :data:`egvs.studies.decision.MIN_UNITS` seeds.
    seeds
        Number of seeds of the scenario; None for as many as the budget allows, at most
        :data:`egvs.studies.study_runs.MAX_SEEDS`.
    jobs
        Number of threads; None for all cores.
    values
        Values that settings try.
    """

    tolerance: Tolerance
    budget_s: float
    seeds: int | None = None
    jobs: int | None = None
    values: SettingValues = DEFAULT_VALUES


@dataclass(frozen=True)
class AccuracyStudy:
    """Results of a study.

    Attributes
    ----------
    rows
        Priced settings: the scenario, then the others by kind and seconds.
    skipped
        Why settings were not run, by name.
    tolerance
        What the recommended setting must meet.
    rank_by
        Name of the score that ranks.
    units
        Number of independent units of the scenario's traffic.
    is_recorded
        Whether the traffic is a finished file, whose parts are the units.
    best_pole
        The pole that all traffic together prefers.
    needed
        Traffic that the tolerance needs, if no setting is within it; else None.
    files
        Written files.
    all_zero
        Whether every score is 0.
    """

    rows: list[SettingResult]
    skipped: dict[str, str]
    tolerance: Tolerance
    rank_by: str
    units: int
    is_recorded: bool
    best_pole: BestPole
    needed: NeededTraffic | None
    files: tuple[Path, ...]
    all_zero: bool = False

    @property
    def recommended(self) -> SettingResult:
        """The recommended setting."""
        return next(row for row in self.rows if row.recommended)

    @property
    def scenario(self) -> SettingResult:
        """The row of the scenario."""
        return next(row for row in self.rows if row.kind == SCENARIO)

    @property
    def is_within(self) -> bool:
        """Whether the recommended setting is within the tolerance."""
        return self.tolerance.admits(self.recommended)


def ignore_setting(_setting: str, _state: str, _details: dict[str, Any]) -> None:
    """Do nothing; a :data:`SettingListener`."""


def run_accuracy_study(
    path: str | Path,
    overrides: Sequence[str],
    out: str | Path,
    options: StudyOptions,
    *,
    progress: ProgressCallback = no_progress,
    listener: SettingListener = ignore_setting,
) -> AccuracyStudy:
    """Run a study, or continue one that was interrupted.

    Parameters
    ----------
    path, overrides
        The scenario and arguments of ``--set``, or a run folder.
    out
        Run folder for ``accuracy.parquet`` and ``accuracy.png``; intermediate results go to ``out / "accuracy"``.
    options
        Options of the study.
    progress
        Called as stages proceed.
    listener
        Called after each setting.

    Raises
    ------
    InputError
        If the options do not fit the scenario, or intermediate results were altered.
    RunError
        If too many seeds fail.
    """
    plugins.require_libraries("egvs accuracy", "figure", "matplotlib")
    path, out = Path(path), Path(out)
    scenario = SettingsSource(path, tuple(overrides)).load()
    _check_options(scenario, options)
    check_no_overwrite(scenario, out, (measurement.STUDY_FOLDER,))
    with lock_run_folder(out):
        runner = SettingRunner(path, overrides, out, options.jobs, progress)
        runs = StudyRuns(runner, options.values, options.budget_s, listener)
        variants = runs.run(options.seeds)
        pricing = Pricing(runs, options.values)
        rows = mark_rows(pricing.rows(variants), options.tolerance)
        written = _write(RunFolder(out), runs, rows, options.tolerance)
        report = refresh_report(out)
        if report is not None:
            written = (*written, report)
        study = AccuracyStudy(
            rows=rows,
            skipped=runs.skipped,
            tolerance=options.tolerance,
            rank_by=runs.scenario.score.rank_by,
            units=pricing.reference.units,
            is_recorded=runs.scenario.is_recorded,
            best_pole=pricing.best_pole,
            needed=None,
            files=written,
            all_zero=pricing.is_all_zero,
        )
        if study.is_within or options.tolerance.score is not None:
            return study
        needed = pricing.needed_traffic(study.scenario, options.tolerance.loss_points)
        return replace(study, needed=needed)


def _check_options(scenario: Scenario, options: StudyOptions) -> None:
    """Reject tolerances and numbers of seeds that no study can meet."""
    tolerance = options.tolerance
    if not 0 <= tolerance.loss_points <= 100:
        problem = f"expected 0 to 100 percentage points, got {tolerance.loss_points:g}"
        raise InputError("--tolerance", problem, "Use 1, for example.")
    if tolerance.score is not None and not 1e-6 <= tolerance.score <= 1:
        raise InputError("--score-tolerance", f"expected 1e-6 to 1, got {tolerance.score:g}", "Use 0.02, for example.")
    if options.seeds is not None and scenario.is_recorded:
        problem = "the traffic is a finished file, so it is the same for every seed"
        raise InputError("--seeds", problem, "Use network or sumocfg in [traffic].")
    if options.seeds is not None and options.seeds < MIN_UNITS:
        raise InputError("--seeds", f"expected at least {MIN_UNITS}, got {options.seeds}", f"Use {MAX_SEEDS}.")


def _write(folder: RunFolder, runs: StudyRuns, rows: Sequence[SettingResult], tolerance: Tolerance) -> tuple[Path, ...]:
    """Write the table and the figure, and return their paths."""
    scenario = runs.scenario
    written = (folder.accuracy, folder.accuracy_figure)
    folder.accuracy_checksums.unlink(missing_ok=True)
    columns = {column.name: [getattr(row, column.name) for row in rows] for column in fields(SettingResult)}
    metadata = {
        "schema": parquet.SCHEMA_VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_json(scenario.model_dump(mode="json"))},
        "inputs": files.hash_json(scenario_dependencies(scenario)),
        "seed": scenario.seed,
        "seeds": runs.seeds,
        "tolerance": tolerance.loss_points,
        "score_tolerance": tolerance.score,
        "stages": runs.stage_keys,
    }
    parquet.write_artefact(folder.accuracy, "accuracy", columns, metadata)
    decision_figure.write_figure(rows, tolerance, scenario.name, folder.accuracy_figure)
    checksums.write_checksums(folder.accuracy_checksums, written)
    return written
