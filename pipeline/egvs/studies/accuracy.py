"""Study how the accuracy of scores depends on run time, and recommend the cheapest setting within a tolerance.

Steps: run the scenario, then a reference with much more traffic, then one setting after another
(:mod:`egvs.studies.study_settings`) until a budget of seconds is used up; repeat every stage of every setting, in
rounds over all settings, so that slow drifts of the machine affect all alike; compare
(:mod:`egvs.studies.score_errors`); recommend; write ``accuracy.parquet`` and ``accuracy.png``. Errors are
deterministic; seconds are measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from egvs.artefacts import checksums, parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files, plugins
from egvs.core.errors import EgvsError, InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.effects.base import Expand
from egvs.runs.run import check_no_overwrite, lock_run_folder, refresh_report
from egvs.runs.run_sources import SettingsSource
from egvs.runs.stage_registry import RANKING_STAGES
from egvs.scenario.model import Scenario
from egvs.studies import measurement, pareto_figure, score_errors, study_settings, traffic_options
from egvs.studies.measurement import Neighbours, SettingListener, SettingRunner, SettingScores, scenario_dependencies
from egvs.studies.score_errors import SeedComparison, SettingResult, compare_seeds
from egvs.studies.study_settings import (
    DEFAULT_VALUES,
    MEASURES,
    REFERENCE,
    SCENARIO,
    SCENARIO_AS_IS,
    SEED_KNOB,
    TRAFFIC,
    Setting,
    SettingValues,
)  # fmt: skip

BEYOND_BUDGET = "beyond the budget"
"""Why a setting was not run."""
REFERENCE_BUDGET_SHARE = 1 / 3
"""Largest share of the budget that the reference may take."""


@dataclass(frozen=True)
class StudyOptions:
    """Options of a study.

    Attributes
    ----------
    tolerance
        Largest error of the recommended setting, relative.
    budget_s
        Settings that would not end within this time are not started. The scenario and the reference always run.
    seeds
        Number of independent runs of the scenario, to check the standard errors.
    jobs
        Number of threads; None for all cores.
    repeats
        How often each stage is measured.
    max_reference_factor
        The reference's traffic is at most this many times as long as the scenario's.
    values
        Values that settings try.
    """

    tolerance: float
    budget_s: float
    seeds: int = 0
    jobs: int | None = None
    repeats: int = 3
    max_reference_factor: int = 32
    values: SettingValues = DEFAULT_VALUES


@dataclass(frozen=True)
class AccuracyStudy:
    """Results of a study.

    Attributes
    ----------
    rows
        Compared settings: the scenario, the reference, then the others by kind and seconds.
    skipped
        Why settings were not run, by name.
    tolerance
        Largest error of the recommended setting, relative.
    best
        The recommended setting; None if none is within the tolerance.
    reference_factor
        How many times as long as the scenario's traffic that of the reference is.
    neighbours
        See :class:`egvs.studies.measurement.SettingScores`, with the longest traffic.
    files
        Written files.
    seeds
        Comparison of independent runs, if requested.
    repeated
        Number of stages that were run again.
    all_zero
        Whether every score is 0.
    """

    rows: list[SettingResult]
    skipped: dict[str, str]
    tolerance: float
    best: SettingResult | None
    reference_factor: int
    neighbours: list[Neighbours]
    files: tuple[Path, ...]
    seeds: SeedComparison | None = None
    repeated: int = 0
    all_zero: bool = False


def ignore_setting(_setting: str, _state: str, _details: dict[str, Any]) -> None:
    """Do nothing; a :data:`SettingListener`."""


def run_accuracy_study(
    path: Path,
    overrides: Sequence[str],
    out: Path,
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
    """
    plugins.require_libraries("egvs accuracy", "figure", "matplotlib")
    if not 1e-6 <= options.tolerance <= 1:
        raise InputError("--tolerance", f"expected 1e-6 to 1, got {options.tolerance:g}", "Use 0.02, for example.")
    check_no_overwrite(SettingsSource(path, tuple(overrides)).load(), out, (measurement.STUDY_FOLDER,))
    with lock_run_folder(out):
        runner = SettingRunner(path, overrides, out, options.jobs, progress)
        scenario = runner.scenario(SCENARIO_AS_IS)
        _check_traffic(scenario, options.seeds)
        study = _StudyRun(runner, scenario, options, progress, listener).run(out)
        report = refresh_report(out)
        if report is not None:
            study = replace(study, files=(*study.files, report))
        if options.seeds:
            study = replace(study, seeds=compare_seeds(runner, scenario, options.seeds, listener))
        return study


def _check_traffic(scenario: Scenario, seeds: int) -> None:
    """Reject scenarios and numbers of seeds that tell nothing about standard errors."""
    if seeds and scenario.is_recorded:
        problem = "the traffic is a finished file, so it is the same for every seed"
        raise InputError("--seeds", problem, "Use network or sumocfg in [traffic].")
    if seeds and scenario.score.rank_by != "egvs":
        problem = f"seeds are compared by EGVS only, but score.rank_by is {scenario.score.rank_by!r}"
        raise InputError("--seeds", problem, "Use --set score.rank_by=egvs.")
    if seeds == 1:
        raise InputError("--seeds", "expected at least 2, got 1", "Use 2 or more.")
    if not scenario.is_recorded and scenario.tpog.blocks == 1:
        problem = "standard errors need at least 2 blocks, got 1"
        raise InputError(f"{scenario.file}: tpog.blocks", problem, "Use 10, or another divisor of traffic.frames.")


@dataclass
class _StudyRun:
    """A study in progress: scores of the settings that ran, and why others were skipped."""

    runner: SettingRunner
    scenario: Scenario
    options: StudyOptions
    progress: ProgressCallback
    listener: SettingListener
    scores: dict[str, SettingScores] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    start: float = field(default_factory=perf_counter)

    @property
    def left_s(self) -> float:
        """Rest of the budget."""
        return self.options.budget_s - (perf_counter() - self.start)

    def run(self, out: Path) -> AccuracyStudy:
        """Run all settings, compare them, and write the files of the study."""
        settings = self._valid_settings()
        self._warm_up(settings)
        base_scores = self.runner.run(SCENARIO_AS_IS)
        self.scores[SCENARIO] = base_scores
        factor = reference_factor(self.runner, base_scores, self.options)
        if factor > 1:
            reference = study_settings.reference_setting(self.scenario, factor)
            settings = [reference, *(setting for setting in settings if is_shorter(self.runner, setting, reference))]
        compared = self._run_all(settings)
        repeated = self._repeat([setting for setting in compared if setting.knob != SEED_KNOB])
        if REFERENCE not in self.scores:
            factor = 1

        rows, can_lengthen = [], not self.scenario.is_recorded
        changes = self._tpog_changes(compared)
        for setting in compared:
            rows.append(
                score_errors.compare_setting(
                    self.runner,
                    setting,
                    self.scores,
                    could_last_longer=can_lengthen,
                    tpog_change=changes.get(setting.name, math.nan),
                )
            )
        rows = score_errors.mark_pareto_front(rows, self.options.tolerance)
        written = self._write(RunFolder(out), rows, factor)
        return AccuracyStudy(
            rows=rows,
            skipped=self.skipped,
            tolerance=self.options.tolerance,
            best=next((row for row in rows if row.recommended), None),
            reference_factor=factor,
            neighbours=self.scores.get(REFERENCE, base_scores).neighbours,
            files=written,
            repeated=repeated,
            all_zero=not any(base_scores.shares),
        )

    def _valid_settings(self) -> list[Setting]:
        """Return the settings whose overrides give a valid scenario; skip the others."""
        settings = []
        self.skipped |= traffic_options.options_without_effect(self.scenario, self.options.values)
        for setting in (
            *study_settings.list_settings(self.scenario, self.options.values),
            *traffic_options.traffic_option_settings(self.scenario, self.options.values),
        ):
            error = _setting_error(self.runner, setting)
            if error is None:
                settings.append(setting)
            else:
                self._skip(setting, error)
        return settings

    def _tpog_changes(self, settings: list[Setting]) -> dict[str, float]:
        """Return the change of the TPOG by each option of the traffic, by the name of the setting."""
        options = [setting for setting in settings if setting.kind == TRAFFIC]
        if not options:
            return {}
        base = self.runner.tpog(SCENARIO_AS_IS)
        return {setting.name: traffic_options.tpog_change(self.runner.tpog(setting), base) for setting in options}

    def _skip(self, setting: Setting, reason: str) -> None:
        self.skipped[setting.name] = reason
        self.listener(setting.name, "skipped", {"why": reason})

    def _warm_up(self, settings: list[Setting]) -> None:
        """Compile everything that the settings need, with the shortest traffic and with each added effect."""
        pending = [setting for setting in settings if self.runner.saved_scores(setting) is None]
        base_scores = self.runner.saved_scores(SCENARIO_AS_IS)
        if base_scores is not None:
            estimate = _TimeEstimate(self.runner, base_scores)
            pending = [setting for setting in pending if estimate.seconds(setting) <= self.left_s]
        if not pending:
            return
        same_scores = (setting for setting in settings if setting.kind not in (MEASURES, TRAFFIC))
        shortest = min(same_scores, key=lambda setting: _simulation_steps(self.runner.scenario(setting)))
        trials = [shortest]
        for setting in pending:
            if setting.name.startswith(study_settings.WITH_PREFIX):
                trials.append(replace(setting, overrides=(*shortest.overrides, *setting.overrides)))
        for trial in trials:
            with suppress(EgvsError):  # reported when the setting itself runs
                self.runner.warm_up(trial)

    def _run_all(self, settings: list[Setting]) -> list[Setting]:
        """Run settings until the budget is used up, and return those that ran; saved results cost nothing.

        Cheap ones run first; among those of similar cost (within a factor of two), approximations run first.
        """
        estimate = _TimeEstimate(self.runner, self.scores[SCENARIO])
        saved = {setting.name: self.runner.saved_scores(setting) for setting in settings}
        needed_s = {}
        for setting in settings:
            is_free = setting.name in (SCENARIO, REFERENCE) or saved[setting.name] is not None
            needed_s[setting.name] = 0.0 if is_free else estimate.seconds(setting)

        def cost_order(setting: Setting) -> tuple[int, bool, float]:
            seconds = needed_s[setting.name]
            return math.frexp(seconds)[1], setting.kind in (MEASURES, TRAFFIC), seconds

        finished = []
        for setting in sorted(settings, key=cost_order):
            name = setting.name
            if needed_s[name] > max(self.left_s, 0.0):
                self.skipped[name] = BEYOND_BUDGET
                self.listener(name, "skipped", {"why": BEYOND_BUDGET, "beyond": True})
                continue
            scores = saved[name]
            try:
                self.scores[name] = scores or self.runner.run(setting)
            except EgvsError as error:
                self._skip(setting, str(error))
                continue
            finished.append(setting)
            seconds = sum(self.runner.median_seconds(self.scores[name]).values())
            self.listener(name, "kept" if scores else "done", {"seconds": seconds})
        return finished

    def _repeat(self, settings: list[Setting]) -> int:
        """Measure every stage again while the budget lasts, and return how many were run.

        Each round measures all stages once, cheap ones first. A stage from the cache has not been measured yet.
        """
        stages: dict[tuple[str, str], Setting] = {}
        for setting in settings:
            for name in RANKING_STAGES:
                stages.setdefault((name, self.scores[setting.name].stages[name]), setting)
        expected_s = {stage: min(self.runner.stage_times(*stage).seconds) for stage in stages}
        repeated = 0
        for round_number in range(1, self.options.repeats + 1):
            for stage in sorted(stages, key=lambda stage: expected_s[stage]):
                is_measured = self.runner.stage_times(*stage).repeats >= round_number
                if is_measured or 1.2 * expected_s[stage] + 0.2 >= self.left_s:
                    continue
                setting = stages[stage]
                self.runner.time_again(stage[0], setting, self.scores[setting.name])
                repeated += 1
                self.progress("repeats", repeated, 0)
        return repeated

    def _write(self, folder: RunFolder, rows: list[SettingResult], factor: int) -> tuple[Path, ...]:
        """Write the table and the figure, and return their paths."""
        scenario, tolerance = self.scenario, self.options.tolerance
        written = (folder.accuracy, folder.accuracy_figure)
        folder.accuracy_checksums.unlink(missing_ok=True)
        columns = {column.name: [getattr(row, column.name) for row in rows] for column in fields(SettingResult)}
        metadata = {
            "schema": parquet.SCHEMA_VERSION,
            "scenario": {"name": scenario.name, "hash": files.hash_json(scenario.model_dump(mode="json"))},
            "inputs": files.hash_json(scenario_dependencies(scenario)),
            "seed": scenario.seed,
            "reference_times": factor,
            "tolerance": tolerance,
            "stages": self.scores[SCENARIO].stages,
        }
        parquet.write_artefact(folder.accuracy, "accuracy", columns, metadata)
        drawn = [row for row in rows if row.kind != TRAFFIC]
        pareto_figure.write_figure(drawn, tolerance, scenario.name, folder.accuracy_figure)
        checksums.write_checksums(folder.accuracy_checksums, written)
        return written


def _setting_error(runner: SettingRunner, setting: Setting) -> str | None:
    """Return why a setting gives no valid scenario; None if it does."""
    try:
        runner.scenario(setting)
    except InputError as error:
        return str(error)
    return None


def is_shorter(runner: SettingRunner, setting: Setting, reference: Setting) -> bool:
    """Whether a setting differs from the reference, and its traffic is not longer; others cannot be compared with it.

    Parameters
    ----------
    runner
        Loads scenarios.
    setting, reference
        Settings of the study.
    """
    duration_s = _traffic_duration_s(runner.scenario(setting))
    reference_s = _traffic_duration_s(runner.scenario(reference))
    return setting.overrides != reference.overrides and duration_s <= reference_s * (1 + 1e-9)


def _traffic_duration_s(scenario: Scenario) -> float:
    return study_settings.counted_frames(scenario) * scenario.traffic.frame_period_s


def reference_factor(runner: SettingRunner, base_scores: SettingScores, options: StudyOptions) -> int:
    """Choose the length of the reference's traffic; a repeated study keeps it.

    Parameters
    ----------
    runner
        Knows times of stages.
    base_scores
        Scores of the scenario as it is.
    options
        The budget, and the largest factor.

    Returns
    -------
    int
        A multiple of the scenario's traffic: the largest power of two that is a valid scenario and fits a share of the
        budget.
    """
    scenario = runner.scenario(SCENARIO_AS_IS)
    if scenario.is_recorded:
        return 1
    note = runner.read_note("study")
    if note.get("scenario") == base_scores.stages and note.get("budget_s") == options.budget_s:
        return int(note["times"])

    seconds = sum(min(runner.stage_times(name, base_scores.stages[name]).seconds) for name in ("traffic", "tpog"))
    factor = options.max_reference_factor
    while factor > 1:
        is_affordable = factor * seconds <= REFERENCE_BUDGET_SHARE * options.budget_s
        if is_affordable and not _setting_error(runner, study_settings.reference_setting(scenario, factor)):
            break
        factor //= 2
    runner.save_note("study", {"scenario": base_scores.stages, "budget_s": options.budget_s, "times": factor})
    return factor


class _TimeEstimate:
    """Estimates the time of settings from that of the scenario."""

    def __init__(self, runner: SettingRunner, base_scores: SettingScores) -> None:
        self._runner = runner
        self._base = runner.scenario(SCENARIO_AS_IS)
        self._base_s = runner.median_seconds(base_scores)

    def seconds(self, setting: Setting) -> float:
        """Estimate the time of the stages that a setting runs again."""
        scenario, base = self._runner.scenario(setting), self._base
        finer = base.roi.voxel_m / scenario.roi.voxel_m
        simulation, counting, casting = 0.0, 0.0, 0.0
        if _traffic_key(scenario) != _traffic_key(base):
            simulation = _simulation_steps(scenario) / _simulation_steps(base)
        if simulation or finer != 1.0:
            frames = study_settings.counted_frames(scenario) / study_settings.counted_frames(base)
            counting = frames * max(1.0, finer**3)
        if scenario.sensors != base.sensors or scenario.effects != base.effects:
            casting = 1.0
        beams = _sub_beams_per_beam(scenario) / _sub_beams_per_beam(base)
        score_s = self._base_s["score"] * beams * max(1.0, finer**2)
        traffic_s = self._base_s["traffic"] * simulation + self._base_s["tpog"] * counting
        return traffic_s + self._base_s["scan"] * beams * casting + score_s


def _sub_beams_per_beam(scenario: Scenario) -> int:
    effects = registry.scenario_effects(scenario, "scan")
    return math.prod(effect.copies for effect in effects if isinstance(effect, Expand))


def _traffic_key(scenario: Scenario) -> tuple[object, ...]:
    """Return what traffic depends on, among the values that settings change."""
    return (
        scenario.seed,
        scenario.traffic,
        *(effect.parameters for effect in registry.scenario_effects(scenario, "traffic")),
    )


def _simulation_steps(scenario: Scenario) -> float:
    return (scenario.traffic.warmup_s + _traffic_duration_s(scenario)) / scenario.traffic.step_s
