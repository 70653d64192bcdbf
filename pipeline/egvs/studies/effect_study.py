"""Study effects: which ones a scenario calls for, and what each changes.

- :func:`effect_statuses`: whether each effect is on or called for in a scene, and why. Effects that the scenario does
  not name are tried on a few sites with the traffic of the last run (:class:`EffectTrials`).
- :func:`run_ablation`: runs without effects, with each effect alone, and with all; each run has its own folder, and
  stages that an effect does not change come from the cache.
- :func:`effect_costs`: costs and changes as measured by an accuracy study.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.readers import read_accuracy, read_scores
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core import files, plugins
from egvs.core.errors import InputError, MissingBackendError, format_problem
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import format_percent
from egvs.effects import registry
from egvs.effects.articulated import Articulated
from egvs.effects.base import Detect, Echo, Effect, Traffic
from egvs.results.labels import SCORE_LABELS, ScoreLabel
from egvs.results.studies import SCENARIO
from egvs.runs import run, stage_keys, stage_registry
from egvs.runs.run_context import open_folder
from egvs.runs.stage_registry import RANKING_STAGES
from egvs.scenario.effects_config import GROUP, EffectParameters
from egvs.scenario.loading import check_is_scenario
from egvs.scenario.model import Scenario
from egvs.sensors.scene import Scene
from egvs.stages.inputs import build_scene
from egvs.stages.site_scoring import SiteScoring
from egvs.studies.measurement import scenario_dependencies
from egvs.studies.study_settings import WITH_PREFIX, WITHOUT_PREFIX
from egvs.traffic.vehicle_boxes import VehicleSize

MAX_TRIAL_SITES = 6

UNTRIED = "not known before a run"
ONLY_CLOUDS = "no score; egvs validate shows the change of detection"
SMALL_CHANGE, MIN_DISPLAYED_CHANGE = 0.01, 0.001
"""An effect that changes all scores by less than the first value, and keeps their order, has little effect. Before a
run, the same holds for an effect whose formula loses less than the first share of returns. Changes below the second
value are displayed as "less than". Changes of scores that are shares are differences, others are relative."""

_TRAJECTORIES, _TPOG = RunFolder.trajectories.name, RunFolder.tpog.name


@dataclass(frozen=True)
class EffectChange:
    """Scores with one effect.

    Attributes
    ----------
    effect
        Its name; "all" for all effects of the scenario, "none" for no effect.
    seconds
        Time of all stages except the report; stages from the cache count with their original time.
    sites, scores, ranks
        Names, values of the score that ranks, and ranks, in the order of the sites.
    rank_by
        Name of the score that ranks.
    """

    effect: str
    seconds: float
    sites: tuple[str, ...]
    scores: tuple[float, ...]
    ranks: tuple[int, ...]
    rank_by: str


def run_ablation(
    scenario: Scenario, out: str | Path, *, jobs: int | None = None, progress: ProgressCallback = no_progress
) -> list[EffectChange]:
    """Run a scenario without effects, with each effect alone, and with all of them, under ``out / "ablation"``.

    Parameters
    ----------
    scenario
        Names the effects.
    out
        The run folder.
    jobs
        Number of threads; None for all cores.
    progress
        Called as stages proceed.
    """
    check_is_scenario(scenario)
    effects = scenario.effects
    variants = {"none": effects.only()}
    for name in effects.named:
        variants[name] = effects.only(name)
    if len(effects.named) > 1:
        variants["all"] = effects
    changes = []
    for name, variant in variants.items():
        folder = Path(out) / "ablation" / name
        record = run.run(scenario.with_effects(variant), folder, jobs=jobs, progress=progress)
        seconds = sum(record.stages[stage].cost.seconds for stage in RANKING_STAGES)
        scores = read_scores(RunFolder(folder).scores)
        rank_by = scenario.score.rank_by
        sites, values, ranks = (tuple(scores[column].to_pylist()) for column in ("site", rank_by, "rank"))
        changes.append(EffectChange(name, seconds, sites, values, ranks, rank_by))
    return changes


@dataclass(frozen=True)
class EffectTrial:
    """What one effect does to the score that ranks, at a few sites.

    Attributes
    ----------
    by
        Label of the score.
    least, most
        Changes of the score: the one nearest to 0, and the one farthest from it. Differences if the score is a share,
        else relative changes.
    sites, of_sites
        Number of sites that were scored, and of all sites.
    same_order
        Whether the ranking stays the same.
    """

    by: ScoreLabel
    least: float
    most: float
    sites: int
    of_sites: int
    same_order: bool

    @property
    def is_small(self) -> bool:
        """Whether the effect changes little."""
        return abs(self.most) < SMALL_CHANGE and self.same_order

    @property
    def in_words(self) -> str:
        """The change, e.g. "EGVS by -12.1 to -24.9 %"."""
        unit = " percentage points" if self.by.is_share else " %"
        amount = f"{100 * self.least:+z.1f} to {100 * self.most:+z.1f}{unit}"
        if abs(self.most) < MIN_DISPLAYED_CHANGE:
            amount = f"less than {100 * MIN_DISPLAYED_CHANGE:.1f}{unit}"
        order = "" if self.same_order else ", and their order"
        return f"{self.by.noun} by {amount}{order}"


class EffectTrials:
    """Scores a few sites of a scene with one effect after another, with the traffic of a run.

    Parameters
    ----------
    scene
        The scene without the effects.
    folder
        A run folder with trajectories and a TPOG.
    """

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene, self._folder = scene, folder
        count = len(scene.sites)
        indices = np.unique(np.linspace(0, count - 1, min(MAX_TRIAL_SITES, count)).round().astype(int))
        self._sites = tuple(scene.sites[index] for index in indices)

    @classmethod
    def from_run(cls, scene: Scene, folder: Path) -> EffectTrials | None:
        """Use the traffic in a run folder; None if it contains no traffic of the scenario as it is now."""
        if not RunFolder(folder).run_record.is_file():
            return None
        record = RunRecord.read(folder)
        work = open_folder(scene.scenario, folder, recorded=stage_registry.recorded_digests(record))
        try:
            for name in ("traffic", "statics", "tpog"):
                if name not in record.stages or record.stages[name].inputs != stage_keys.stage_key(name, work).key:
                    return None
            work.digests(_TRAJECTORIES, _TPOG)
        except InputError:  # an artefact is missing or was altered
            return None
        return cls(scene, folder)

    def trial(self, effect: Effect[EffectParameters]) -> EffectTrial | None:
        """Score the sites with an effect; None if it needs other traffic, or every score is 0."""
        if isinstance(effect, Traffic) or not self._plain.any():
            return None
        effects = self._scene.scenario.effects
        with_effect = effects.model_validate({**effects.named, effect.NAME: effect.parameters})
        scores = self._scores(self._scene.scenario.with_effects(with_effect))
        by = SCORE_LABELS[self._scene.scenario.score.rank_by]
        is_scored = self._plain > 0
        changes = scores[is_scored] - self._plain[is_scored]
        if not by.is_share:
            changes = changes / self._plain[is_scored]
        least = float(changes[np.argmin(np.abs(changes))])
        most = float(changes[np.argmax(np.abs(changes))])
        order = np.argsort(-scores, kind="stable")
        same_order = np.array_equal(order, np.argsort(-self._plain, kind="stable"))
        return EffectTrial(by, least, most, len(self._sites), len(self._scene.sites), same_order)

    @cached_property
    def vehicle_shares(self) -> dict[str, tuple[VehicleSize, float]]:
        """Kinds and lengths of recorded vehicles: size, and share of all boxes, by a unique name."""
        table = parquet.read_artefact(self._folder / _TRAJECTORIES, "trajectories", ["kind", "length_m"])[0]
        shares = {}
        for row in table.group_by(["kind", "length_m"]).aggregate([("length_m", "count")]).to_pylist():
            size = VehicleSize(row["length_m"], 1.0, 1.0, row["kind"])
            shares[f"{row['kind']} of {row['length_m']:g} m"] = (size, row["length_m_count"] / len(table))
        return shares

    @cached_property
    def _plain(self) -> FloatArray:
        """Scores without the effect."""
        return self._scores(self._scene.scenario)

    def _scores(self, scenario: Scenario) -> FloatArray:
        """The score that ranks, at each of the sites; the sites are scanned again."""
        only_score = {"others": (), "blindspots": False, "standard_error": False, "keep_visibility": ()}
        score = scenario.score.model_copy(update=only_score)
        scan = scenario.scan.model_copy(update={"keep": False})
        context = open_folder(scenario.model_copy(update={"score": score, "scan": scan}), self._folder)
        scoring = SiteScoring(context)
        table = scoring.score_table(scoring.all_sites([site.name for site in self._sites]))
        return table.column(score.rank_by).values


@dataclass(frozen=True)
class EffectStatus:
    """An effect in a scene.

    Attributes
    ----------
    name, stage, kind
        The effect.
    state
        If the scenario names the effect: "on", "skipped" (it changes nothing), or "refused" (something is missing).
        Otherwise: "called for", "little" (it changes little), "your choice" (the scene cannot tell), or "off".
        "broken" if it cannot be loaded.
    why
        The reason.
    source
        Where the model is published.
    change
        What it would change, and where the number comes from; for effects that the scenario does not name.
    """

    name: str
    stage: str
    kind: str
    state: str
    why: str
    source: str
    change: str = ""


@dataclass(frozen=True)
class EffectCost:
    """What one effect costs and changes, according to an accuracy study.

    Attributes
    ----------
    seconds
        Additional processor seconds of all stages.
    change
        Largest relative change of a site's score, of EGVS as a share of its limit.
    tau
        Kendall's tau of the rankings with and without it.
    loss_points
        Expected loss in percentage points of vehicles found by choosing with the other ranking, judged by the
        scenario's own setting.
    """

    seconds: float
    change: float
    tau: float
    loss_points: float


def effect_catalogue() -> list[EffectStatus]:
    """Return all installed effects, without a state."""
    return [_status_or_error(name, _describe_effect) for name in registry.effect_names()]


def effect_statuses(
    scenario: Scenario, out: str | Path | None = None, progress: ProgressCallback = no_progress
) -> list[EffectStatus]:
    """Return the status of each effect in a scenario.

    Parameters
    ----------
    scenario
        The scenario.
    out
        Effects are tried with the traffic in this run folder, if there is any.
    progress
        Called after each effect.
    """
    scene = build_scene(scenario)
    trials = None if out is None else EffectTrials.from_run(scene, Path(out))
    return effect_statuses_in_scene(scene, trials, progress)


def effect_statuses_in_scene(
    scene: Scene, trials: EffectTrials | None = None, progress: ProgressCallback = no_progress
) -> list[EffectStatus]:
    """Return the status of each effect in a scene.

    Parameters
    ----------
    scene
        The scene.
    trials
        Tries effects; without it, changes are unknown.
    progress
        Called after each effect.
    """
    statuses: list[EffectStatus] = []
    names = registry.effect_names()
    for name in names:
        statuses.append(_status_or_error(name, lambda name: _effect_status(name, scene, trials)))
        progress("effects", len(statuses), len(names))
    return statuses


def effect_costs(scenario: Scenario, out: Path) -> dict[str, EffectCost] | None:
    """Return costs of effects from an accuracy study, by name; None if there is no study of this scenario in ``out``.

    Parameters
    ----------
    scenario
        The scenario.
    out
        The run folder.
    """
    study = read_accuracy(RunFolder(out).accuracy)
    if study is None or study[1]["inputs"] != files.hash_json(scenario_dependencies(scenario)):
        return None
    rows = {row["setting"]: row for row in study[0]}
    scenario_s = rows[SCENARIO]["seconds"]
    costs = {}
    for name in registry.effect_names():
        for prefix, sign in ((WITH_PREFIX, 1.0), (WITHOUT_PREFIX, -1.0)):
            row = rows.get(f"{prefix}{name}")
            if row is not None:
                seconds = sign * (row["seconds"] - scenario_s)
                costs[name] = EffectCost(seconds, row["error"], row["tau"], row["loss_points"])
    return costs


def _status_or_error(name: str, describe: Callable[[str], EffectStatus]) -> EffectStatus:
    """Describe an effect; for one that cannot be loaded, say why."""
    try:
        return describe(name)
    except MissingBackendError as error:
        return EffectStatus(name, "", "", "broken", str(error), "")


def _describe_effect(name: str) -> EffectStatus:
    kind = registry.load_effect_class(name)
    summary = str(sys.modules[kind.__module__].__doc__).strip().splitlines()[0]
    return _status(kind, "", summary)


def _status(kind: type[Effect[Any]], state: str, why: str, change: str = "") -> EffectStatus:
    source = kind.SOURCE
    package = plugins.plugin_package(GROUP, kind.NAME)
    if package != plugins.PACKAGE_NAME:
        source += f" (package {package})"
    return EffectStatus(kind.NAME, kind.STAGE, kind.KIND, state, why, source, change)


def _effect_status(name: str, scene: Scene, trials: EffectTrials | None) -> EffectStatus:
    kind = registry.load_effect_class(name)
    named = scene.scenario.effects.named
    if issubclass(kind, Traffic) and kind.AUTO_ENABLED:
        is_on, why = kind(kind.Model()).acts(scene.scenario)
        return _status(kind, "on" if is_on else "off", why)
    if name == registry.LOSSES and name not in named:
        return _losses_status(kind, scene)
    if name not in named:
        return _unnamed_effect_status(kind, scene, trials)
    effect = kind(named[name])
    idle = effect.why_idle(scene)
    if idle is not None:
        return _status(kind, "skipped", f"set in the scenario, but {idle}: the result is the same without it")
    refusal = effect.refusal(scene)
    if refusal is not None:
        return _status(kind, "refused", str(refusal))
    parameters = effect.parameters.model_dump(mode="json")
    if not parameters:
        return _status(kind, "on", "named")
    return _status(
        kind, "on", "set in the scenario, with " + ", ".join(f"{key} = {value}" for key, value in parameters.items())
    )


def _losses_status(kind: type[Effect[Any]], scene: Scene) -> EffectStatus:
    """Say for which sensors losses of returns are on, and why."""
    losses = scene.losses
    if losses is None:
        return _status(kind, "off", "effects.range_limit = false")
    acting = [effect for effect in scene.effects if isinstance(effect, kind)]
    why = list(losses.notes)
    if losses.negligible:
        why.append(losses.negligible_note)
    return _status(kind, "on" if acting else "off", "; ".join([*why, *(effect.summary(scene) for effect in acting)]))


def _unnamed_effect_status(kind: type[Effect[Any]], scene: Scene, trials: EffectTrials | None) -> EffectStatus:
    """Say whether the scene calls for an effect that the scenario does not name, and what it would change."""
    missing = [key for key in registry.required_parameters(kind.NAME) if key not in kind.TRIAL]
    if missing:
        return _status(kind, "off", f"not set; it needs {', '.join(missing)}, which the scene does not provide")
    effect = kind(kind.Model.from_dict(kind.TRIAL))
    idle = effect.why_idle(scene)
    if idle is not None:
        return _status(kind, "off", f"not called for: {idle}")
    refusal = effect.refusal(scene)
    if refusal is not None:
        return _status(kind, "off", format_problem("cannot act here", refusal.problem, refusal.hint))

    if isinstance(effect, Echo):
        return _status(kind, "your choice", f"{kind.USER_KNOWLEDGE} decides", ONLY_CLOUDS)
    summary = effect.summary(scene)
    is_small, change = False, UNTRIED
    if trials is not None:
        is_small, change = _try_effect(effect, trials)
    elif isinstance(effect, Detect):
        is_small = 1.0 - min(effect.detection_shares(scene)) < SMALL_CHANGE

    if kind.USER_KNOWLEDGE:
        why = "; ".join(filter(None, (f"{kind.USER_KNOWLEDGE} decides", summary)))
        if trials is not None and not isinstance(effect, Traffic):
            why += "; tried with " + ", ".join(f"{key} = {value:g}" for key, value in kind.TRIAL.items())
        return _status(kind, "your choice", why, change)
    state = "called for"
    if is_small:
        state = "little"
    elif trials is None and isinstance(effect, Articulated):  # depends on the vehicles that will come
        state = "your choice"
    return _status(kind, state, summary or "applicable here", change)


def _try_effect(effect: Effect[Any], trials: EffectTrials) -> tuple[bool, str]:
    """Return whether an effect changes little, and a description of how much it changes the scores."""
    if isinstance(effect, Articulated):
        sizes = {name: size for name, (size, _) in trials.vehicle_shares.items()}
        parts = effect.geometries(sizes, effect.NAME)
        share = sum(share for name, (_, share) in trials.vehicle_shares.items() if name in parts)
        return (
            share == 0,
            f"{format_percent(share)} of the boxes in the last run would be split into parts; only a run "
            "with it shows the change",
        )
    trial = trials.trial(effect)
    if trial is None:
        return False, "only a run with it shows the change, because it changes the traffic"
    where = f"measured on {trial.sites} of {trial.of_sites} sites, with the last run's traffic"
    return trial.is_small, f"{trial.in_words} ({where})"
