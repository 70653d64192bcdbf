"""A study of what accuracy costs in time, and the cheapest setting within a tolerance.

Steps: run the scenario, then a reference whose traffic is watched many times as long, then one setting after another
(:mod:`pipeline.studies.settings`), within a budget of seconds; repeat every stage of every setting, all settings in
turn, so that a drift of the machine hits all alike; compare (:mod:`pipeline.studies.comparison`); recommend; write
``accuracy.parquet`` and ``accuracy.png``. Errors are deterministic; seconds are measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from pipeline.artefacts import schemas, tables
from pipeline.core import files
from pipeline.core.errors import EgvsError, InputError
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry
from pipeline.effects.base import Expand
from pipeline.runs.locking import alone
from pipeline.runs.stages import RANKING
from pipeline.runs.workflow import refresh_report
from pipeline.scenario.models import Scenario
from pipeline.studies import comparison, front_figure
from pipeline.studies import settings as study_settings
from pipeline.studies.comparison import Row
from pipeline.studies.measuring import SettingListener, SettingRunner, SettingScores, inputs_of
from pipeline.studies.seeds import Seeds, between_seeds
from pipeline.studies.settings import MEASURES, OWN, REFERENCE, SCENARIO, Setting

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


@dataclass
class _Budget:
    """The budget."""

    budget_s: float
    start: float = field(default_factory=perf_counter)

    @property
    def left_s(self) -> float:
        return self.budget_s - (perf_counter() - self.start)


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
    with alone(out):
        runner = SettingRunner(path, sets, out, jobs, progress)
        scenario = runner.scenario(OWN)
        _check(scenario, seeds)
        result = _study(runner, scenario, out, float(tolerance), _Budget(budget_s), progress, listener)
        report = refresh_report(out)
        written = result.files if report is None else (*result.files, report)
        checked = between_seeds(runner, scenario, seeds, listener) if seeds else None
        return replace(result, files=written, seeds=checked)


def _check(scenario: Scenario, seeds: int) -> None:
    if seeds and scenario.traffic.fcd is not None:
        raise InputError(
            "--seeds", "the traffic is a finished file, the same for each seed", "network or sumocfg in [traffic]"
        )
    if seeds == 1:
        raise InputError("--seeds", "1", "at least 2")
    if scenario.traffic.fcd is None and scenario.tpog.blocks == 1:
        place = f"{scenario.file}: tpog.blocks"
        raise InputError(
            place, "1, so that nothing tells how far a score may be off", "10, or another divisor of traffic.frames"
        )


def _study(
    runner: SettingRunner,
    scenario: Scenario,
    out: Path,
    tolerance: float,
    budget: _Budget,
    progress: Progress,
    listener: SettingListener,
) -> AccuracyStudy:
    settings, skipped = _sound(runner, study_settings.settings(scenario), listener)
    _warm_up(runner, settings, budget)
    scores = {SCENARIO: runner.run(OWN)}
    times = _times(runner, scenario, scores[SCENARIO], budget.budget_s)
    longest = [study_settings.reference(scenario, times)] if times > 1 else []
    settings = [s for s in settings if not longest or _is_shorter(runner, s, longest[0])]
    compared, more = _run_all(runner, [*longest, *settings], scores, budget, listener)
    repeated = _repeat(runner, compared, scores, budget, progress)
    could_last_longer = scenario.traffic.fcd is None
    rows = comparison.judge(
        [comparison.compare(runner, s, scores, could_last_longer=could_last_longer) for s in compared], tolerance
    )
    best = next((row for row in rows if row.recommended), None)
    written = (out / "accuracy.parquet", out / "accuracy.png")
    if REFERENCE not in scores:
        times = 1
    _write(written[0], scenario, rows, scores[SCENARIO], times, tolerance)
    front_figure.draw_figure(rows, tolerance, scenario.name, written[1])
    neighbours = scores.get(REFERENCE, scores[SCENARIO]).neighbours
    empty = not any(scores[SCENARIO].shares)
    return AccuracyStudy(
        rows, skipped | more, tolerance, best, times, neighbours, written, repeated=repeated, empty=empty
    )


def _is_shorter(runner: SettingRunner, setting: Setting, longest: Setting) -> bool:
    """Whether a setting is worth comparing with the reference: not the same, and not watched for longer."""
    ours_s, its_s = (
        traffic.frames * traffic.frame_period_s for traffic in (runner.scenario(s).traffic for s in (setting, longest))
    )
    return setting.overrides != longest.overrides and ours_s <= its_s * (1 + 1e-9)


def _sound(
    runner: SettingRunner, settings: list[Setting], listener: SettingListener
) -> tuple[list[Setting], dict[str, str]]:
    """The settings that are scenarios, and why others are none."""
    sound, skipped = [], {}
    for setting in settings:
        try:
            runner.scenario(setting)
        except InputError as error:
            skipped[setting.name] = str(error)
            listener(setting.name, "skipped", {"why": str(error)})
        else:
            sound.append(setting)
    return sound, skipped


def _warm_up(runner: SettingRunner, settings: list[Setting], budget: _Budget) -> None:
    """Compile what the settings still to be run need: once on the shortest traffic, and with each effect that they
    switch on."""
    wanted = [setting for setting in settings if runner.known(setting) is None]
    if (base := runner.known(OWN)) is not None:
        expected = _Expected(runner, base)
        wanted = [setting for setting in wanted if expected.seconds(setting) <= budget.left_s]
    if not wanted:
        return
    shortest = min((s for s in settings if s.kind != MEASURES), key=lambda s: _steps(runner.scenario(s)))
    switched_on = (s for s in wanted if s.name.startswith(study_settings.WITH))
    for setting in (shortest, *(replace(s, overrides=(*shortest.overrides, *s.overrides)) for s in switched_on)):
        try:
            runner.warm_up(setting)
        except EgvsError:
            continue  # named when it is run


def _times(runner: SettingRunner, scenario: Scenario, own: SettingScores, budget_s: float) -> int:
    """How long the reference watches: a power of two that fits a share of the budget; as before, when a study is
    repeated."""
    if scenario.traffic.fcd is not None:
        return 1
    kept = runner.note("study")
    if (kept.get("scenario"), kept.get("budget_s")) == (own.stages, budget_s):
        return int(kept["times"])
    once_s = sum(min(runner.times(name, own.stages[name]).seconds) for name in ("traffic", "tpog"))
    times = LONGEST
    while times > 1 and (
        times * once_s > SHARE * budget_s or _sound(runner, [study_settings.reference(scenario, times)], _unheard)[1]
    ):
        times //= 2
    runner.keep_note("study", {"scenario": own.stages, "budget_s": budget_s, "times": times})
    return times


def _run_all(
    runner: SettingRunner,
    settings: list[Setting],
    scores: dict[str, SettingScores],
    budget: _Budget,
    listener: SettingListener,
) -> tuple[list[Setting], dict[str, str]]:
    """Run one setting after another as long as the budget lasts; those that are known cost nothing.

    Cheap ones go first; of those that cost about the same (within a factor of two), approximations.
    """
    compared, skipped, expected = [], {}, _Expected(runner, scores[SCENARIO])
    known = {setting.name: runner.known(setting) for setting in settings}
    needs_s = {
        s.name: 0.0 if known[s.name] or s.name in (SCENARIO, REFERENCE) else expected.seconds(s) for s in settings
    }
    for setting in sorted(
        settings, key=lambda s: (math.frexp(needs_s[s.name])[1], s.kind == MEASURES, needs_s[s.name])
    ):
        if needs_s[setting.name] > max(budget.left_s, 0.0):
            skipped[setting.name] = BEYOND
            listener(setting.name, "skipped", {"why": f"about {needs_s[setting.name]:.0f} s, {BEYOND}", "beyond": True})
            continue
        try:
            scores[setting.name] = known[setting.name] or runner.run(setting)
        except EgvsError as error:
            skipped[setting.name] = str(error)
            listener(setting.name, "skipped", {"why": str(error)})
            continue
        compared.append(setting)
        seconds = sum(runner.medians(scores[setting.name]).values())
        listener(setting.name, "kept" if known[setting.name] else "done", {"seconds": seconds})
    return compared, skipped


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
        watched = other.traffic.frames / own.traffic.frames * max(1.0, finer**3)
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
    traffic = scenario.traffic
    return (traffic.warmup_s + traffic.frames * traffic.frame_period_s) / traffic.step_s


def _repeat(
    runner: SettingRunner,
    settings: list[Setting],
    scores: dict[str, SettingScores],
    budget: _Budget,
    progress: Progress,
) -> int:
    """Time every stage again, all in turn, cheap ones first, while the budget lasts; returns how many were. One that
    was fetched has not been timed yet."""
    stages: dict[tuple[str, str], Setting] = {}
    for setting in settings:
        for name in RANKING:
            stages.setdefault((name, scores[setting.name].stages[name]), setting)
    took = {task: min(runner.times(*task).seconds) for task in stages}
    done = 0
    for turn in range(1, REPEATS + 1):
        for (name, key), setting in sorted(stages.items(), key=lambda item: took[item[0]]):
            if runner.times(name, key).repeats < turn and 1.2 * took[name, key] + 0.2 < budget.left_s:
                runner.again(name, setting, scores[setting.name])
                done += 1
                progress("repeats", done, 0)
    return done


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
