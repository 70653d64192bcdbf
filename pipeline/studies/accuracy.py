"""A study of what accuracy costs in time, and the cheapest setting within a tolerance.

Steps: run the scenario, then a reference whose traffic is watched many times as long, then one setting after another
(:mod:`pipeline.studies.variants`), within a budget of seconds; repeat every stage of every setting, all settings in
turn, so that a drift of the machine hits all alike; compare (:mod:`pipeline.studies.comparison`); recommend; write
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

from pipeline.artefacts import checksums, schemas, tables
from pipeline.artefacts.readers import ACCURACY_SUMS
from pipeline.core import files
from pipeline.core.errors import EgvsError, InputError
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry
from pipeline.effects.base import Expand
from pipeline.runs.guarding import keep_inputs
from pipeline.runs.locking import alone
from pipeline.runs.stages import RANKING
from pipeline.runs.workflow import refresh_report
from pipeline.scenario.loading import load
from pipeline.scenario.models import Scenario
from pipeline.studies import comparison, lengths, measuring, pareto_figure
from pipeline.studies import variants as study_settings
from pipeline.studies.comparison import Row
from pipeline.studies.measuring import SettingListener, SettingRunner, SettingScores, inputs_of
from pipeline.studies.seeds import Seeds, between_seeds
from pipeline.studies.variants import MEASURES, OWN, REFERENCE, SCENARIO, Setting

REPEATS = 3
LONGEST = 32
"""The reference watches traffic at most so many times as long as the scenario."""
BEYOND = "beyond the budget"
"""Why a setting was not run."""
SHARE = 1 / 3
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
        See :class:`pipeline.studies.measuring.SettingScores`, of the longest traffic.
    files
        What was written.
    empty
        Whether every score is 0.
    """

    rows: list[Row]
    skipped: dict[str, str]
    tolerance: float
    best: Row | None
    times: int
    neighbours: list[tuple[str, str, float, float]]
    files: tuple[Path, ...]
    seeds: Seeds | None = None
    repeated: int = 0
    empty: bool = False


def _unheard(_setting: str, _state: str, _about: dict[str, Any]) -> None:
    """A :data:`SettingListener` that says nothing."""


def study(
    path: Path,
    sets: Sequence[str],
    out: Path,
    *,
    tolerance: float,
    budget_s: float,
    seeds: int = 0,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: SettingListener = _unheard,
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
    keep_inputs(load(path, sets), out, (measuring.FOLDER,))
    with alone(out):
        runner = SettingRunner(path, sets, out, jobs, progress)
        scenario = runner.scenario(OWN)
        _check(scenario, seeds)
        result = _Work(runner, scenario, budget_s, progress, listener).study(out, float(tolerance))
        report = refresh_report(out)
        written = result.files if report is None else (*result.files, report)
        checked_seeds = between_seeds(runner, scenario, seeds, listener) if seeds else None
        return replace(result, files=written, seeds=checked_seeds)


def _check(scenario: Scenario, seeds: int) -> None:
    if seeds and lengths.is_finished(scenario):
        found = "the traffic is a finished file, the same for each seed"
        raise InputError("--seeds", found, "network or sumocfg in [traffic]")
    if seeds and scenario.score.rank_by != "egvs":
        found = (
            f"score.rank_by = {scenario.score.rank_by!r}: what all runs together say is worked out for the EGVS alone"
        )
        raise InputError("--seeds", found, "--set score.rank_by=egvs")
    if seeds == 1:
        raise InputError("--seeds", "1", "at least 2")
    if not lengths.is_finished(scenario) and scenario.tpog.blocks == 1:
        found = "1, so that nothing tells how far a score may be off"
        raise InputError(f"{scenario.file}: tpog.blocks", found, "10, or another divisor of traffic.frames")


@dataclass
class _Work:
    """A study at work: ``scores`` are those of the settings that were run, ``skipped`` says why others were not."""

    runner: SettingRunner
    scenario: Scenario
    budget_s: float
    progress: Progress
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
        for setting in study_settings.settings(scenario):
            if (fault := _fault(runner, setting)) is None:
                settings.append(setting)
            else:
                self._skip(setting, fault)
        self._warm_up(settings)
        own = scores[SCENARIO] = runner.run(OWN)
        times = _times(runner, scenario, own, self.budget_s)
        longest = [study_settings.reference(scenario, times)] if times > 1 else []
        settings = [s for s in settings if not longest or _is_shorter(runner, s, longest[0])]
        compared = self._run_all([*longest, *settings])
        repeated = self._repeat(compared)
        could_last_longer = not lengths.is_finished(scenario)
        rows = [comparison.compare(runner, s, scores, could_last_longer=could_last_longer) for s in compared]
        rows = comparison.judge(rows, tolerance)
        best = next((row for row in rows if row.recommended), None)
        written = (out / "accuracy.parquet", out / "accuracy.png")
        (out / ACCURACY_SUMS).unlink(missing_ok=True)
        times = times if REFERENCE in scores else 1
        _write(written[0], scenario, rows, own, times, tolerance)
        pareto_figure.draw_figure(rows, tolerance, scenario.name, written[1])
        checksums.write(out / ACCURACY_SUMS, written)
        neighbours = scores.get(REFERENCE, own).neighbours
        empty = not any(own.shares)
        return AccuracyStudy(rows, self.skipped, tolerance, best, times, neighbours, written, None, repeated, empty)

    def _skip(self, setting: Setting, why: str) -> None:
        self.skipped[setting.name] = why
        self.listener(setting.name, "skipped", {"why": why})

    def _warm_up(self, settings: list[Setting]) -> None:
        """Compile what the settings still to be run need: on the shortest traffic, and with each effect switched on."""
        wanted = [setting for setting in settings if self.runner.known(setting) is None]
        if (own := self.runner.known(OWN)) is not None:
            expected = _Expected(self.runner, own)
            wanted = [setting for setting in wanted if expected.seconds(setting) <= self.left_s]
        if not wanted:
            return
        shortest = min((s for s in settings if s.kind != MEASURES), key=lambda s: _steps(self.runner.scenario(s)))
        switched_on = (s for s in wanted if s.name.startswith(study_settings.WITH))
        for setting in (shortest, *(replace(s, overrides=(*shortest.overrides, *s.overrides)) for s in switched_on)):
            with suppress(EgvsError):  # named when it is run
                self.runner.warm_up(setting)

    def _run_all(self, settings: list[Setting]) -> list[Setting]:
        """Run one setting after another as long as the budget lasts, and return those; what is known costs nothing.

        Cheap ones go first; of those that cost about the same (within a factor of two), approximations.
        """
        runner, compared, expected = self.runner, [], _Expected(self.runner, self.scores[SCENARIO])
        known = {s.name: runner.known(s) for s in settings}
        free = {SCENARIO, REFERENCE, *(name for name, scores in known.items() if scores)}
        needs_s = {s.name: 0.0 if s.name in free else expected.seconds(s) for s in settings}
        in_turn = sorted(settings, key=lambda s: (math.frexp(needs_s[s.name])[1], s.kind == MEASURES, needs_s[s.name]))
        for setting in in_turn:
            name = setting.name
            if needs_s[name] > max(self.left_s, 0.0):
                self.skipped[name] = BEYOND
                self.listener(name, "skipped", {"why": f"about {needs_s[name]:.0f} s, {BEYOND}", "beyond": True})
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
            for name in RANKING:
                stages.setdefault((name, self.scores[setting.name].stages[name]), setting)
        took = {task: min(self.runner.times(*task).seconds) for task in stages}
        done = 0
        for turn in range(1, REPEATS + 1):
            for (name, key), setting in sorted(stages.items(), key=lambda item: took[item[0]]):
                if self.runner.times(name, key).repeats < turn and 1.2 * took[name, key] + 0.2 < self.left_s:
                    self.runner.again(name, setting, self.scores[setting.name])
                    done += 1
                    self.progress("repeats", done, 0)
        return done


def _fault(runner: SettingRunner, setting: Setting) -> str | None:
    """Why a setting is no scenario; None where it is one."""
    try:
        runner.scenario(setting)
    except InputError as error:
        return str(error)
    return None


def _is_shorter(runner: SettingRunner, setting: Setting, longest: Setting) -> bool:
    """Whether a setting is worth comparing with the reference: not the same, and not watched for longer."""
    ours_s, its_s = (_watched_s(runner.scenario(s)) for s in (setting, longest))
    return setting.overrides != longest.overrides and ours_s <= its_s * (1 + 1e-9)


def _watched_s(scenario: Scenario) -> float:
    return lengths.counted_frames(scenario) * scenario.traffic.frame_period_s


def _times(runner: SettingRunner, scenario: Scenario, own: SettingScores, budget_s: float) -> int:
    """How long the reference watches: a power of two that fits a share of the budget; as before in a repeated study."""
    if lengths.is_finished(scenario):
        return 1
    kept = runner.note("study")
    if (kept.get("scenario"), kept.get("budget_s")) == (own.stages, budget_s):
        return int(kept["times"])
    once_s = sum(min(runner.times(name, own.stages[name]).seconds) for name in ("traffic", "tpog"))
    times = LONGEST
    while times > 1 and (
        times * once_s > SHARE * budget_s or _fault(runner, study_settings.reference(scenario, times))
    ):
        times //= 2
    runner.keep_note("study", {"scenario": own.stages, "budget_s": budget_s, "times": times})
    return times


class _Expected:
    """About how long a setting will take, from what the scenario took."""

    def __init__(self, runner: SettingRunner, base: SettingScores) -> None:
        self._runner = runner
        self._scenario = runner.scenario(OWN)
        self._took = runner.medians(base)

    def seconds(self, setting: Setting) -> float:
        other, own, took = self._runner.scenario(setting), self._scenario, self._took
        finer = own.roi.voxel_m / other.roi.voxel_m
        stepped = _steps(other) / _steps(own) if _traffic(other) != _traffic(own) else 0.0
        frames, own_frames = (lengths.counted_frames(scenario) for scenario in (other, own))
        watched = frames / own_frames * max(1.0, finer**3)
        counted = watched if stepped or finer != 1.0 else 0.0
        cast = 1.0 if other.sensors != own.sensors or other.effects != own.effects else 0.0
        beams = _copies(other) / _copies(own)
        score = took["score"] * beams * max(1.0, finer**2)
        return took["traffic"] * stepped + took["tpog"] * counted + took["scan"] * beams * cast + score


def _copies(scenario: Scenario) -> int:
    """Sub-beams of a beam."""
    return math.prod(effect.copies for effect in registry.named(scenario, "scan") if isinstance(effect, Expand))


def _traffic(scenario: Scenario) -> tuple[object, ...]:
    """What traffic depends on, as far as settings change it."""
    return scenario.traffic, *(effect.parameters for effect in registry.named(scenario, "traffic"))


def _steps(scenario: Scenario) -> float:
    return (scenario.traffic.warmup_s + _watched_s(scenario)) / scenario.traffic.step_s


def _write(path: Path, scenario: Scenario, rows: list[Row], own: SettingScores, times: int, tolerance: float) -> None:
    columns = {f.name: [getattr(row, f.name) for row in rows] for f in fields(Row)}
    about = {
        "schema": schemas.VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_of(scenario.model_dump(mode="json"))},
        "inputs": files.hash_of(inputs_of(scenario)),
        "seed": scenario.seed,
        "reference_times": times,
        "tolerance": tolerance,
        "stages": own.stages,
    }
    tables.write(path, "accuracy", columns, about)
