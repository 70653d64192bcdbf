"""A study of what accuracy costs in time, and the cheapest setting within a tolerance.

Steps: run the scenario, then a reference whose traffic is watched many times as long, then one setting after another
(:mod:`egvs.studies.study_settings`), within a budget of seconds; repeat every stage of every setting, all settings in
turn, so that a drift of the machine hits all alike; compare (:mod:`egvs.studies.score_errors`); recommend; write
``accuracy.parquet`` and ``accuracy.png``. Errors are deterministic; seconds are measured.
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
from egvs.core import files
from egvs.core.errors import EgvsError, InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.effects.base import Expand
from egvs.runs.run import check_no_overwrite, lock_run_folder, refresh_report
from egvs.runs.stages import RANKING_STAGES
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario
from egvs.studies import measurement, pareto_figure, score_errors, study_settings
from egvs.studies.measurement import SettingListener, SettingRunner, SettingScores, scenario_dependencies
from egvs.studies.score_errors import SeedComparison, SettingResult, compare_seeds
from egvs.studies.study_settings import MEASURES, REFERENCE, SCENARIO, SCENARIO_AS_IS, Setting

REPEATS = 3
MAX_REFERENCE_FACTOR = 32
"""The reference watches traffic at most so many times as long as the scenario."""
BEYOND_BUDGET = "beyond the budget"
"""Why a setting was not run."""
REFERENCE_BUDGET_SHARE = 1 / 3
"""Of the budget: the most that the reference may take."""


@dataclass(frozen=True)
class AccuracyStudy:
    """What the study found.

    Attributes
    ----------
    rows
        Compared settings: the scenario, the reference, then the others by kind and seconds.
    skipped
        Setting -> why it was not run.
    best
        The recommended setting; None when none is within the tolerance.
    times
        How many times as long as the scenario the reference watches traffic.
    neighbours
        See :class:`egvs.studies.measurement.SettingScores`, of the longest traffic.
    files
        What was written.
    empty
        Whether every score is 0.
    """

    rows: list[SettingResult]
    skipped: dict[str, str]
    tolerance: float
    best: SettingResult | None
    times: int
    neighbours: list[tuple[str, str, float, float]]
    files: tuple[Path, ...]
    seeds: SeedComparison | None = None
    repeated: int = 0
    empty: bool = False


def _ignore_setting(_setting: str, _state: str, _details: dict[str, Any]) -> None:
    """A :data:`SettingListener` that says nothing."""


def run_accuracy_study(
    path: Path,
    sets: Sequence[str],
    out: Path,
    *,
    tolerance: float,
    budget_s: float,
    seeds: int = 0,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: SettingListener = _ignore_setting,
) -> AccuracyStudy:
    """Run the study, or go on with it.

    Parameters
    ----------
    path, sets
        The scenario, and what ``--set`` lays over it.
    out
        ``accuracy.parquet`` and ``accuracy.png`` are written there; results of settings are kept in ``out /
        "accuracy"``.
    tolerance
        The largest error that the recommended setting may have.
    budget_s
        No setting is begun that would not end within it. The scenario and the reference are always run.
    seeds
        So many independent runs of the scenario's own setting, to check the standard errors.
    """
    if not 1e-6 <= tolerance <= 1:
        raise InputError("--tolerance", f"{tolerance:g}", "a share from 1e-6 to 1, for example 0.02")
    check_no_overwrite(load(path, sets), out, (measurement.STUDY_FOLDER,))
    with lock_run_folder(out):
        runner = SettingRunner(path, sets, out, jobs, progress)
        scenario = runner.scenario(SCENARIO_AS_IS)
        _check(scenario, seeds)
        result = _StudyRun(runner, scenario, budget_s, progress, listener).study(out, float(tolerance))
        report = refresh_report(out)
        written = result.files if report is None else (*result.files, report)
        checked_seeds = compare_seeds(runner, scenario, seeds, listener) if seeds else None
        return replace(result, files=written, seeds=checked_seeds)


def _check(scenario: Scenario, seeds: int) -> None:
    if seeds and study_settings.is_finished(scenario):
        found = "the traffic is a finished file, the same for each seed"
        raise InputError("--seeds", found, "network or sumocfg in [traffic]")
    if seeds and scenario.score.rank_by != "egvs":
        found = (
            f"score.rank_by = {scenario.score.rank_by!r}: what all runs together say is worked out for the EGVS alone"
        )
        raise InputError("--seeds", found, "--set score.rank_by=egvs")
    if seeds == 1:
        raise InputError("--seeds", "1", "at least 2")
    if not study_settings.is_finished(scenario) and scenario.tpog.blocks == 1:
        found = "1, so that nothing tells how far a score may be off"
        raise InputError(f"{scenario.file}: tpog.blocks", found, "10, or another divisor of traffic.frames")


@dataclass
class _StudyRun:
    """A study at work: ``scores`` are those of the settings that were run, ``skipped`` says why others were not."""

    runner: SettingRunner
    scenario: Scenario
    budget_s: float
    progress: ProgressCallback
    listener: SettingListener
    scores: dict[str, SettingScores] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    start: float = field(default_factory=perf_counter)

    @property
    def left_s(self) -> float:
        """What is left of the budget."""
        return self.budget_s - (perf_counter() - self.start)

    def study(self, out: Path, tolerance: float) -> AccuracyStudy:
        """All of it but the seeds, written into ``out``."""
        runner, scenario, scores = self.runner, self.scenario, self.scores
        settings = []
        for setting in study_settings.list_settings(scenario):
            if (fault := _setting_error(runner, setting)) is None:
                settings.append(setting)
            else:
                self._skip(setting, fault)
        self._warm_up(settings)
        own = scores[SCENARIO] = runner.run(SCENARIO_AS_IS)
        times = _reference_factor(runner, scenario, own, self.budget_s)
        longest = [study_settings.reference_setting(scenario, times)] if times > 1 else []
        settings = [s for s in settings if not longest or _is_shorter(runner, s, longest[0])]
        compared = self._run_all([*longest, *settings])
        repeated = self._repeat(compared)
        could_last_longer = not study_settings.is_finished(scenario)
        rows = [score_errors.compare_setting(runner, s, scores, could_last_longer=could_last_longer) for s in compared]
        rows = score_errors.mark_pareto_front(rows, tolerance)
        best = next((row for row in rows if row.recommended), None)
        written = (RunFolder(out).accuracy, RunFolder(out).accuracy_figure)
        RunFolder(out).accuracy_checksums.unlink(missing_ok=True)
        times = times if REFERENCE in scores else 1
        _write_study(written[0], scenario, rows, own, times, tolerance)
        pareto_figure.draw_figure(rows, tolerance, scenario.name, written[1])
        checksums.write_checksums(RunFolder(out).accuracy_checksums, written)
        neighbours = scores.get(REFERENCE, own).neighbours
        empty = not any(own.shares)
        return AccuracyStudy(rows, self.skipped, tolerance, best, times, neighbours, written, None, repeated, empty)

    def _skip(self, setting: Setting, why: str) -> None:
        self.skipped[setting.name] = why
        self.listener(setting.name, "skipped", {"why": why})

    def _warm_up(self, settings: list[Setting]) -> None:
        """Compile what the settings still to be run need: on the shortest traffic, and with each effect switched on."""
        wanted = [setting for setting in settings if self.runner.known(setting) is None]
        if (own := self.runner.known(SCENARIO_AS_IS)) is not None:
            expected = _TimeEstimate(self.runner, own)
            wanted = [setting for setting in wanted if expected.seconds(setting) <= self.left_s]
        if not wanted:
            return
        shortest = min(
            (s for s in settings if s.kind != MEASURES), key=lambda s: _simulation_steps(self.runner.scenario(s))
        )
        switched_on = (s for s in wanted if s.name.startswith(study_settings.WITH_PREFIX))
        for setting in (shortest, *(replace(s, overrides=(*shortest.overrides, *s.overrides)) for s in switched_on)):
            with suppress(EgvsError):  # named when it is run
                self.runner.warm_up(setting)

    def _run_all(self, settings: list[Setting]) -> list[Setting]:
        """Run one setting after another as long as the budget lasts, and return those; what is known costs nothing.

        Cheap ones go first; of those that cost about the same (within a factor of two), approximations.
        """
        runner, compared, expected = self.runner, [], _TimeEstimate(self.runner, self.scores[SCENARIO])
        known = {s.name: runner.known(s) for s in settings}
        free = {SCENARIO, REFERENCE, *(name for name, scores in known.items() if scores)}
        needs_s = {s.name: 0.0 if s.name in free else expected.seconds(s) for s in settings}
        in_turn = sorted(settings, key=lambda s: (math.frexp(needs_s[s.name])[1], s.kind == MEASURES, needs_s[s.name]))
        for setting in in_turn:
            name = setting.name
            if needs_s[name] > max(self.left_s, 0.0):
                self.skipped[name] = BEYOND_BUDGET
                self.listener(name, "skipped", {"why": f"about {needs_s[name]:.0f} s, {BEYOND_BUDGET}", "beyond": True})
                continue
            try:
                self.scores[name] = known[name] or runner.run(setting)
            except EgvsError as error:
                self._skip(setting, str(error))
                continue
            compared.append(setting)
            seconds = sum(runner.medians(self.scores[name]).values())
            self.listener(name, "kept" if known[name] else "done", {"seconds": seconds})
        return compared

    def _repeat(self, settings: list[Setting]) -> int:
        """Time every stage again, all in turn, cheap ones first, while the budget lasts; returns how many were.

        One that was fetched has not been timed yet.
        """
        stages: dict[tuple[str, str], Setting] = {}
        for setting in settings:
            for name in RANKING_STAGES:
                stages.setdefault((name, self.scores[setting.name].stages[name]), setting)
        took = {task: min(self.runner.times(*task).seconds) for task in stages}
        done = 0
        for turn in range(1, REPEATS + 1):
            for (name, key), setting in sorted(stages.items(), key=lambda item: took[item[0]]):
                if self.runner.times(name, key).repeats < turn and 1.2 * took[name, key] + 0.2 < self.left_s:
                    self.runner.time_again(name, setting, self.scores[setting.name])
                    done += 1
                    self.progress("repeats", done, 0)
        return done


def _setting_error(runner: SettingRunner, setting: Setting) -> str | None:
    """Why a setting is no scenario; None where it is one."""
    try:
        runner.scenario(setting)
    except InputError as error:
        return str(error)
    return None


def _is_shorter(runner: SettingRunner, setting: Setting, longest: Setting) -> bool:
    """Whether a setting is worth comparing with the reference: not the same, and not watched for longer."""
    ours_s, its_s = (_traffic_duration_s(runner.scenario(s)) for s in (setting, longest))
    return setting.overrides != longest.overrides and ours_s <= its_s * (1 + 1e-9)


def _traffic_duration_s(scenario: Scenario) -> float:
    return study_settings.counted_frames(scenario) * scenario.traffic.frame_period_s


def _reference_factor(runner: SettingRunner, scenario: Scenario, base_scores: SettingScores, budget_s: float) -> int:
    """How long the reference watches: a power of two that fits a share of the budget; as before in a repeated study."""
    if study_settings.is_finished(scenario):
        return 1
    kept = runner.note("study")
    if (kept.get("scenario"), kept.get("budget_s")) == (base_scores.stages, budget_s):
        return int(kept["times"])
    once_s = sum(min(runner.times(name, base_scores.stages[name]).seconds) for name in ("traffic", "tpog"))
    times = MAX_REFERENCE_FACTOR
    while times > 1 and (
        times * once_s > REFERENCE_BUDGET_SHARE * budget_s
        or _setting_error(runner, study_settings.reference_setting(scenario, times))
    ):
        times //= 2
    runner.save_note("study", {"scenario": base_scores.stages, "budget_s": budget_s, "times": times})
    return times


class _TimeEstimate:
    """About how long a setting will take, from what the scenario took."""

    def __init__(self, runner: SettingRunner, base: SettingScores) -> None:
        self._runner = runner
        self._scenario = runner.scenario(SCENARIO_AS_IS)
        self._took = runner.medians(base)

    def seconds(self, setting: Setting) -> float:
        other, own, took = self._runner.scenario(setting), self._scenario, self._took
        finer = own.roi.voxel_m / other.roi.voxel_m
        stepped = _simulation_steps(other) / _simulation_steps(own) if _traffic_key(other) != _traffic_key(own) else 0.0
        frames, own_frames = (study_settings.counted_frames(scenario) for scenario in (other, own))
        watched = frames / own_frames * max(1.0, finer**3)
        counted = watched if stepped or finer != 1.0 else 0.0
        cast = 1.0 if other.sensors != own.sensors or other.effects != own.effects else 0.0
        beams = _sub_beams_per_beam(other) / _sub_beams_per_beam(own)
        score = took["score"] * beams * max(1.0, finer**2)
        return took["traffic"] * stepped + took["tpog"] * counted + took["scan"] * beams * cast + score


def _sub_beams_per_beam(scenario: Scenario) -> int:
    """Sub-beams of a beam."""
    return math.prod(
        effect.copies for effect in registry.scenario_effects(scenario, "scan") if isinstance(effect, Expand)
    )


def _traffic_key(scenario: Scenario) -> tuple[object, ...]:
    """What traffic depends on, as far as settings change it."""
    return scenario.traffic, *(effect.parameters for effect in registry.scenario_effects(scenario, "traffic"))


def _simulation_steps(scenario: Scenario) -> float:
    return (scenario.traffic.warmup_s + _traffic_duration_s(scenario)) / scenario.traffic.step_s


def _write_study(
    path: Path, scenario: Scenario, rows: list[SettingResult], base_scores: SettingScores, times: int, tolerance: float
) -> None:
    columns = {f.name: [getattr(row, f.name) for row in rows] for f in fields(SettingResult)}
    about = {
        "schema": parquet.SCHEMA_VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_json(scenario.model_dump(mode="json"))},
        "inputs": files.hash_json(scenario_dependencies(scenario)),
        "seed": scenario.seed,
        "reference_times": times,
        "tolerance": tolerance,
        "stages": base_scores.stages,
    }
    parquet.write_artefact(path, "accuracy", columns, about)
