r"""What does accuracy cost in time?

Steps: run the scenario, then a reference whose traffic is watched many times as long, then one setting after another
(:mod:`pipeline.studies.settings`), within a budget of seconds; repeat every stage of every setting, all settings in
turn, so that a drift of the machine hits all alike; compare; recommend; write ``accuracy.parquet`` and
``accuracy.png``.

Scores are compared as shares of ``egvs_limit``. With r_i of the reference and s_i of a setting, over the sites i,

.. math:: error = \max_i |s_i / r_i - 1|, \qquad regret = 1 - r_{b} / \max_i r_i

where b is the setting's best site. A setting of little traffic may be right by luck: it is *judged* by the larger of
its error and its own standard error (:mod:`pipeline.scoring.uncertainty`), and the recommendation is the cheapest
setting that is judged to be within the tolerance. Where the traffic is a finished file, nothing longer is to be had,
and the error alone is judged. A setting that measures something else (voxel, gamma, effects) has no error: it is
compared with the scenario itself, on the same traffic, by ranking and regret. Errors are deterministic; seconds are
measured."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.readers import read_tpog
from pipeline.core.errors import EgvsError, InputError
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry as effects
from pipeline.runs.locking import alone
from pipeline.runs.workflow import refresh_report
from pipeline.scenario.models import Scenario
from pipeline.scoring.egvs import EntropyField
from pipeline.stages.base import metadata
from pipeline.studies import front_figure
from pipeline.studies import settings as knobs
from pipeline.studies.settings import APPROXIMATES, MEASURES, REFERENCE, SCENARIO, Setting
from pipeline.studies.trials import STAGES, Bench, Trial, inputs_of

OWN = Setting(SCENARIO, SCENARIO, "")
"""The scenario as it is."""

REPEATS = 3
LONGEST = 32
"""The reference watches traffic at most so many times as long as the scenario."""
BEYOND = "beyond the budget"
"""Why a setting was not run."""
SHARE = 1 / 3
"""Of the budget: the most that the reference may take."""

Told = Callable[[str, str, dict[str, Any]], None]
"""Called with (setting, "done" | "kept" | "skipped", what is to be said) as a study goes on."""


@dataclass(frozen=True)
class Row:
    """One setting, compared; the columns of ``accuracy.parquet``, see its schema."""

    setting: str
    kind: str
    knob: str
    overrides: str
    seconds: float
    seconds_spread: float
    busy_s: float
    repeats: int
    statics_s: float
    scan_s: float
    traffic_s: float
    tpog_s: float
    score_s: float
    peak_mb: float
    bytes: int
    error: float
    error_se: float
    error_rms: float
    own_change: float
    judged: float
    tau: float
    rho: float
    best_kept: bool
    best_three_kept: bool
    regret: float
    default: bool
    front: bool = False
    recommended: bool = False


@dataclass(frozen=True)
class Seeds:
    """What independent runs of the same setting say of the standard errors; each (sites,)."""

    sites: list[str]
    seeds: int
    frames: int
    between: list[float]
    within: list[float]
    bias: list[float]
    expected_bias: list[float]
    covered: float


@dataclass(frozen=True)
class Study:
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
        See :class:`pipeline.studies.trials.Trial`, of the longest traffic.
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
class _Clock:
    """The budget."""

    budget_s: float
    start: float = field(default_factory=perf_counter)

    @property
    def left_s(self) -> float:
        return self.budget_s - (perf_counter() - self.start)


def _mute(_setting: str, _state: str, _said: dict[str, Any]) -> None:
    """A :data:`Told` that says nothing."""


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
    told: Told = _mute,
) -> Study:
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
        bench = Bench(path, sets, out, jobs, progress)
        scenario = bench.scenario(OWN)
        _check(scenario, seeds)
        found = _study(bench, scenario, out, float(tolerance), _Clock(budget_s), progress, told)
        report = refresh_report(out)
        files = found.files if report is None else (*found.files, report)
        return replace(found, files=files, seeds=_between_seeds(bench, scenario, seeds, told) if seeds else None)


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
    bench: Bench, scenario: Scenario, out: Path, tolerance: float, clock: _Clock, progress: Progress, told: Told
) -> Study:
    settings, skipped = _sound(bench, knobs.settings(scenario), told)
    _warm_up(bench, settings, clock)
    trials = {SCENARIO: bench.run(OWN)}
    times = _times(bench, scenario, trials[SCENARIO], clock.budget_s)
    longest = [knobs.reference(scenario, times)] if times > 1 else []
    settings = [s for s in settings if not longest or _is_shorter(bench, s, longest[0])]
    found, more = _run_all(bench, [*longest, *settings], trials, clock, told)
    repeated = _repeat(bench, found, trials, clock, progress)
    lasts = scenario.traffic.fcd is None
    rows = _judged([_row(bench, setting, trials, lasts) for setting in found], tolerance)
    best = next((row for row in rows if row.recommended), None)
    files = (out / "accuracy.parquet", out / "accuracy.png")
    if REFERENCE not in trials:
        times = 1
    _write(files[0], scenario, rows, trials[SCENARIO], times, tolerance)
    front_figure.draw_figure([_plotted(row) for row in rows], tolerance, scenario.name, files[1])
    neighbours = trials.get(REFERENCE, trials[SCENARIO]).neighbours
    empty = not any(trials[SCENARIO].shares)
    return Study(rows, skipped | more, tolerance, best, times, neighbours, files, repeated=repeated, empty=empty)


def _is_shorter(bench: Bench, setting: Setting, longest: Setting) -> bool:
    """Whether a setting is worth comparing with the reference: not the same, and not watched for longer."""
    ours_s, its_s = (
        traffic.frames * traffic.frame_period_s for traffic in (bench.scenario(s).traffic for s in (setting, longest))
    )
    return setting.overrides != longest.overrides and ours_s <= its_s * (1 + 1e-9)


def _sound(bench: Bench, settings: list[Setting], told: Told) -> tuple[list[Setting], dict[str, str]]:
    """The settings that are scenarios, and why others are none."""
    sound, skipped = [], {}
    for setting in settings:
        try:
            bench.scenario(setting)
        except InputError as error:
            skipped[setting.name] = str(error)
            told(setting.name, "skipped", {"why": str(error)})
        else:
            sound.append(setting)
    return sound, skipped


def _warm_up(bench: Bench, settings: list[Setting], clock: _Clock) -> None:
    """Compile what the settings still to be run need: once on the shortest traffic, and with each effect that they
    switch on."""
    wanted = [setting for setting in settings if bench.known(setting) is None]
    if (base := bench.known(OWN)) is not None:
        expected = _Expected(bench, base)
        wanted = [setting for setting in wanted if expected.seconds(setting) <= clock.left_s]
    if not wanted:
        return
    shortest = min((s for s in settings if s.kind != MEASURES), key=lambda s: _steps(bench.scenario(s)))
    switched_on = (s for s in wanted if s.name.startswith(knobs.WITH))
    for setting in (shortest, *(replace(s, overrides=(*shortest.overrides, *s.overrides)) for s in switched_on)):
        try:
            bench.warm_up(setting)
        except EgvsError:
            continue  # named when it is run


def _times(bench: Bench, scenario: Scenario, trial: Trial, budget_s: float) -> int:
    """How long the reference watches: a power of two that fits a share of the budget; as before, when a study is
    repeated."""
    if scenario.traffic.fcd is not None:
        return 1
    kept = bench.note("study")
    if (kept.get("scenario"), kept.get("budget_s")) == (trial.stages, budget_s):
        return int(kept["times"])
    once_s = sum(min(bench.spent(name, trial.stages[name]).seconds) for name in ("traffic", "tpog"))
    times = LONGEST
    while times > 1 and (
        times * once_s > SHARE * budget_s or _sound(bench, [knobs.reference(scenario, times)], _mute)[1]
    ):
        times //= 2
    bench.keep_note("study", {"scenario": trial.stages, "budget_s": budget_s, "times": times})
    return times


def _run_all(
    bench: Bench, settings: list[Setting], trials: dict[str, Trial], clock: _Clock, told: Told
) -> tuple[list[Setting], dict[str, str]]:
    """Run one setting after another as long as the budget lasts; those that are known cost nothing.

    Cheap ones go first; of those that cost about the same (within a factor of two), approximations.
    """
    found, skipped, expected = [], {}, _Expected(bench, trials[SCENARIO])
    known = {setting.name: bench.known(setting) for setting in settings}
    needs_s = {
        s.name: 0.0 if known[s.name] or s.name in (SCENARIO, REFERENCE) else expected.seconds(s) for s in settings
    }
    for setting in sorted(
        settings, key=lambda s: (math.frexp(needs_s[s.name])[1], s.kind == MEASURES, needs_s[s.name])
    ):
        if needs_s[setting.name] > max(clock.left_s, 0.0):
            skipped[setting.name] = BEYOND
            told(setting.name, "skipped", {"why": f"about {needs_s[setting.name]:.0f} s, {BEYOND}", "beyond": True})
            continue
        try:
            trial = known[setting.name] or bench.run(setting)
        except EgvsError as error:
            skipped[setting.name] = str(error)
            told(setting.name, "skipped", {"why": str(error)})
            continue
        trials[setting.name] = trial
        found.append(setting)
        told(setting.name, "kept" if known[setting.name] else "done", {"seconds": sum(_medians(bench, trial).values())})
    return found, skipped


class _Expected:
    """About how long a setting will take, from what the scenario took."""

    def __init__(self, bench: Bench, base: Trial) -> None:
        self._bench = bench
        self._scenario = bench.scenario(OWN)
        self._took = _medians(bench, base)

    def seconds(self, setting: Setting) -> float:
        other, own, took = self._bench.scenario(setting), self._scenario, self._took
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
    expanding = (effect for effect in effects.of(scenario, "scan") if isinstance(effect, effects.Expand))
    return math.prod(effect.copies for effect in expanding)


def _traffic(scenario: Scenario) -> tuple[object, ...]:
    """What traffic depends on, as far as settings change it."""
    return scenario.traffic, *(
        values for name, values in scenario.effects.items() if effects.KINDS[name][0] == "traffic"
    )


def _steps(scenario: Scenario) -> float:
    traffic = scenario.traffic
    return (traffic.warmup_s + traffic.frames * traffic.frame_period_s) / traffic.step_s


def _repeat(bench: Bench, settings: list[Setting], trials: dict[str, Trial], clock: _Clock, progress: Progress) -> int:
    """Time every stage again, all in turn, cheap ones first, while the budget lasts; returns how many were."""
    stages: dict[tuple[str, str], Setting] = {}
    for setting in settings:
        for name in STAGES:
            stages.setdefault((name, trials[setting.name].stages[name]), setting)
    took = {task: min(bench.spent(*task).seconds) for task in stages}
    done = 0
    for turn in range(2, REPEATS + 1):
        for (name, key), setting in sorted(stages.items(), key=lambda item: took[item[0]]):
            if len(bench.spent(name, key).seconds) < turn and 1.2 * took[name, key] + 0.2 < clock.left_s:
                bench.again(name, setting, trials[setting.name])
                done += 1
                progress("repeats", done, 0)
    return done


def _medians(bench: Bench, trial: Trial) -> dict[str, float]:
    return {name: median(bench.spent(name, trial.stages[name]).seconds) for name in STAGES}


def _row(bench: Bench, setting: Setting, trials: dict[str, Trial], lasts: bool) -> Row:
    """Compare one setting. ``lasts``: traffic could be longer, so that its shortness is an error that time can mend."""
    trial, own = trials[setting.name], trials[SCENARIO]
    against = own if setting.kind == MEASURES else trials.get(REFERENCE, own)
    beside = trials.get(setting.beside, own)
    spent = {name: bench.spent(name, trial.stages[name]) for name in STAGES}
    s, r = np.array(trial.shares), np.array(against.shares)
    changes = relative(s, r)
    error, error_se = float(changes.max(initial=0.0)), _largest_se(trial)
    return Row(
        setting=setting.name,
        kind=setting.kind,
        knob=setting.knob,
        overrides=" ".join(f"--set {shlex.quote(o)}" for o in setting.overrides),
        seconds=sum(median(cost.seconds) for cost in spent.values()),
        seconds_spread=sum(max(cost.seconds) - min(cost.seconds) for cost in spent.values()),
        busy_s=sum(median(cost.busy) for cost in spent.values()),
        repeats=min(len(cost.seconds) for cost in spent.values()),
        statics_s=median(spent["statics"].seconds),
        scan_s=median(spent["scan"].seconds),
        traffic_s=median(spent["traffic"].seconds),
        tpog_s=median(spent["tpog"].seconds),
        score_s=median(spent["score"].seconds),
        peak_mb=max(cost.peak_mb for cost in spent.values()),
        bytes=sum(cost.bytes for cost in spent.values()),
        error=error,
        error_se=error_se,
        error_rms=error * float(np.sqrt(np.mean((changes / error) ** 2))) if 0 < error < math.inf else error,
        own_change=float(relative(s, np.array(beside.shares)).max(initial=0.0)),
        judged=max(error, error_se) if lasts else error,
        tau=agreement(s, r, "tau"),
        rho=agreement(s, r, "rho"),
        best_kept=best(s, 1) == best(r, 1),
        best_three_kept=best(s, 3) == best(r, 3),
        regret=regret(s, r),
        default=knobs.is_default(bench.scenario(setting), bench.scenario(OWN)),
    )  # fmt: skip


def _largest_se(trial: Trial) -> float:
    """Largest standard error over the sites, as a share of the site's score; not a number where the TPOG has one
    block."""
    shares = np.array(trial.shares)
    return float((np.array(trial.share_ses) / np.where(shares > 0, shares, np.inf)).max(initial=0.0))


def relative(found: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """|found / reference - 1| of each site; infinite where the reference alone is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: NDArray[np.float64] = np.where(found == reference, 0.0, np.abs(found / reference - 1.0))
    return change


def agreement(found: NDArray[np.float64], reference: NDArray[np.float64], kind: str) -> float:
    """Kendall's tau-b or Spearman's rho with ties shared; 1 where both tell nothing apart, 0 where one alone does
    not."""
    from scipy.stats import kendalltau, spearmanr

    flat = [len(np.unique(values)) < 2 for values in (found, reference)]
    if any(flat):
        return float(all(flat))
    return float((kendalltau if kind == "tau" else spearmanr)(found, reference).statistic)


def best(scores: NDArray[np.float64], count: int) -> set[int]:
    """The ``count`` best sites, and all that tie with the last of them."""
    if not len(scores):
        return set()
    last = np.sort(scores)[::-1][min(count, len(scores)) - 1]
    return set(np.flatnonzero(scores >= last).tolist())


def regret(found: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Share of the reference's best score that is lost by trusting the setting's best site (of several, the worst)."""
    most = reference.max(initial=0.0)
    return float(1.0 - min(reference[site] for site in best(found, 1)) / most) if most > 0 else 0.0


def _judged(rows: list[Row], tolerance: float) -> list[Row]:
    """Mark the front and the recommended setting; sort."""
    rivals = [row for row in rows if row.kind in (APPROXIMATES, SCENARIO)]
    front = {row.setting for row in rivals if not any(_beats(other, row) for other in rivals)}
    within = [row for row in rivals if row.judged <= tolerance]
    chosen = min(within, key=lambda row: (row.seconds, row.setting)).setting if within else None
    marked = [replace(row, front=row.setting in front, recommended=row.setting == chosen) for row in rows]
    places = {SCENARIO: 0, REFERENCE: 1, APPROXIMATES: 2, MEASURES: 3}
    return sorted(marked, key=lambda row: (places[row.kind], row.seconds, row.setting))


def _beats(one: Row, other: Row) -> bool:
    """Whether ``one`` is as good in time and in error, and better in one of them."""
    return (
        (one.seconds, one.judged) != (other.seconds, other.judged)
        and one.seconds <= other.seconds
        and one.judged <= other.judged
    )


def _plotted(r: Row) -> front_figure.PlottedSetting:
    return front_figure.PlottedSetting(
        r.setting, r.kind, r.knob, r.seconds, r.judged, r.tau, r.regret, r.front, r.recommended, r.default
    )


def _write(path: Path, scenario: Scenario, rows: list[Row], own: Trial, times: int, tolerance: float) -> None:
    columns = {f.name: [getattr(row, f.name) for row in rows] for f in fields(Row)}
    about = metadata(scenario, inputs_of(scenario), reference_times=times, tolerance=tolerance, stages=own.stages)
    tables.write(path, "accuracy", columns, about)


def _between_seeds(bench: Bench, scenario: Scenario, count: int, told: Told) -> Seeds | None:
    """Independent runs: how far scores scatter, what the standard errors said, and how often the intervals held the
    truth.

    None where fewer than two of them succeed.
    """
    trials: list[Trial] = []
    counts: list[NDArray[np.int64]] = []
    for number in range(1, count + 1):
        setting = Setting(f"seed {scenario.seed + number}", "seed", "seed", (f"seed={scenario.seed + number}",))
        try:
            known = bench.known(setting)
            trials.append(known or bench.run(setting))
        except EgvsError as error:
            told(setting.name, "skipped", {"why": str(error)})
            continue
        tpog = read_tpog(bench.artefact(trials[-1], "tpog", "tpog.parquet"))
        counts = [tpog.counts + sum(counts)]
        told(setting.name, "kept" if known else "done", {"seconds": sum(_medians(bench, trials[-1]).values())})
    if len(trials) < 2:
        return None
    merged = EntropyField.of(counts[0], tpog.frames * len(trials), tpog.grid)
    truth = np.array([merged.score(hits, scenario.score.gamma, unit).egvs for hits, unit in bench.hits(OWN, trials[0])])
    scores, ses, biases = (np.array([getattr(trial, name) for trial in trials]) for name in ("scores", "ses", "biases"))
    reach = np.array([[trial.quantile] for trial in trials]) * ses
    return Seeds(
        sites=trials[0].sites,
        seeds=len(trials),
        frames=tpog.frames,
        between=scores.std(axis=0, ddof=1).tolist(),
        within=np.sqrt((ses**2).mean(axis=0)).tolist(),
        bias=(scores.mean(axis=0) - truth).tolist(),
        expected_bias=biases.mean(axis=0).tolist(),
        covered=float((np.abs(scores - biases - truth) <= reach).mean()),
    )
