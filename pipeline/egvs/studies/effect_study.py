"""Egvs effects: which a scenario calls for, what each changes.

The plain scene, the scene with one named effect at a time, and with all of them: what each changes, and costs.

Each is a run like any other, in a folder of its own; stages that an effect does not touch come from the store.

Tries effects that a scenario does not name: by how much each would change the scores of some sites.

Steps: take the traffic that the scenario's last run has recorded and counted, where it is still the scenario's; scan
and score a few sites, spread over the list, with the scenario's own effects; then again with one more effect. Nothing
is written, and no traffic is simulated, so effects on traffic cannot be tried.

Which effects exist, which of them a scenario calls for, and what an accuracy study says that each costs.

Steps of :func:`effect_statuses`: build the static world in memory; ask every named effect whether it can change the
result; ask
every other one whether it could, what in the scene it is about, and try it on the traffic of the last run
(:mod:`egvs.studies.effect_study`); say for each effect whether it is on or called for, and why.
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
from egvs.artefacts.run_folder import RunFolder, RunRecord
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files, plugins
from egvs.core.errors import InputError, MissingBackendError, format_problem
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.effects.articulated import Articulated
from egvs.effects.base import Detect, Effect, Traffic
from egvs.runs import run, stages
from egvs.runs.stages import RANKING_STAGES
from egvs.scenario.effects_config import GROUP, EffectParameters
from egvs.scenario.model import Scenario
from egvs.scoring.scorer import Scorer
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.stages import inputs
from egvs.stages.inputs import build_scene, open_folder
from egvs.studies.measurement import scenario_dependencies
from egvs.studies.study_settings import SCENARIO, WITH_PREFIX, WITHOUT_PREFIX
from egvs.traffic.vehicle_boxes import VehicleSize


@dataclass(frozen=True)
class EffectChange:
    """What one effect (or all) does to the scores.

    Attributes
    ----------
    effect
        Its name; "all" for all that the scenario names together; "none" for the plain scene.
    seconds
        Time of all stages but the report; a stage that came from the store counts with what it took to make it.
    sites, scores, ranks
        Of each site, in the order of the sites.
    """

    effect: str
    seconds: float
    sites: tuple[str, ...]
    scores: tuple[float, ...]
    ranks: tuple[int, ...]


def run_ablation(
    scenario: Scenario, out: Path, *, jobs: int | None = None, progress: ProgressCallback = no_progress
) -> list[EffectChange]:
    """Run the plain scene, each effect alone, and all together, under ``out / "ablation"``; resumed as any run."""
    every = scenario.effects
    variants = {"none": every.only(), **{name: every.only(name) for name in every.named}}
    if len(every.named) > 1:
        variants["all"] = every
    changes = []
    for name, effects in variants.items():
        folder = out / "ablation" / name
        record = run.run(scenario.with_effects(effects), folder, jobs=jobs, progress=progress)
        seconds = sum(record.stages[stage].cost.seconds for stage in RANKING_STAGES)
        scores = read_scores(RunFolder(folder).scores)
        sites, egvs, ranks = (tuple(scores[column].to_pylist()) for column in ("site", "egvs", "rank"))
        changes.append(EffectChange(name, seconds, sites, egvs, ranks))
    return changes


MAX_TRIAL_SITES = 6
"""Sites that are scored at most."""

_TRAJECTORIES, _TPOG = RunFolder.trajectories.name, RunFolder.tpog.name


@dataclass(frozen=True)
class EffectTrial:
    """What one effect does to the scores of a few sites.

    Attributes
    ----------
    least, most
        Relative changes of the scores, the one that is nearest to 0 and the one farthest from it.
    sites, of_sites
        How many were scored, of how many there are.
    same_order
        Whether they rank as before.
    """

    least: float
    most: float
    sites: int
    of_sites: int
    same_order: bool


class EffectTrials:
    """Tries one effect after another before a scene, on the traffic of the run in a folder; see :meth:`of`."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene, self._folder = scene, folder
        every = len(scene.sites)
        picked = np.unique(np.linspace(0, every - 1, min(MAX_TRIAL_SITES, every)).round().astype(int))
        self._sites = tuple(scene.sites[i] for i in picked)

    @classmethod
    def of(cls, scene: Scene, folder: Path) -> EffectTrials | None:
        """None where the folder holds no traffic of this scenario as it is now."""
        if not RunFolder(folder).run_record.is_file():
            return None
        record = RunRecord.read(folder)
        work = open_folder(scene.scenario, folder, recorded=stages.recorded_digests(record))
        try:
            current = all(
                name in record.stages and record.stages[name].inputs == stages.stage_key(name, work).key
                for name in ("traffic", "statics", "tpog")
            )
            work.digests(_TRAJECTORIES, _TPOG)
        except InputError:  # an artefact is gone, or another one
            return None
        return cls(scene, folder) if current else None

    def trial(self, effect: Effect[EffectParameters]) -> EffectTrial | None:
        """What the effect changes; None where that takes other traffic, or every score is 0."""
        if isinstance(effect, Traffic) or not self._plain.any():
            return None
        own = self._scene.scenario.effects
        named = own.model_validate({**own.named, effect.NAME: effect.parameters})
        changed = self._scores(inputs.resolve_scene(self._scene.scenario.with_effects(named), self._scene.world))
        seen = self._plain > 0
        changes = changed[seen] / self._plain[seen] - 1
        least, most = (float(changes[pick(np.abs(changes))]) for pick in (np.argmin, np.argmax))
        order = np.array_equal(np.argsort(-changed, kind="stable"), np.argsort(-self._plain, kind="stable"))
        return EffectTrial(least, most, len(self._sites), len(self._scene.sites), bool(order))

    @cached_property
    def sizes(self) -> dict[str, tuple[VehicleSize, float]]:
        """Sizes of the recorded vehicles by a name of their own, each with its share of all boxes."""
        table = parquet.read_artefact(self._folder / _TRAJECTORIES, "trajectories", ["kind", "length_m"])[0]
        counted = table.group_by(["kind", "length_m"]).aggregate([("length_m", "count")]).to_pylist()
        rows = max(len(table), 1)
        return {
            f"{row['kind']} of {row['length_m']:g} m": (
                VehicleSize(row["length_m"], 1.0, 1.0, row["kind"]),
                row["length_m_count"] / rows,
            )
            for row in counted
        }

    @cached_property
    def _tpog(self) -> Tpog:
        return read_tpog(self._folder / _TPOG)

    @cached_property
    def _plain(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return self._scores(self._scene)

    def _scores(self, scene: Scene) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        scanner, scorer = Scanner(scene), Scorer(scene, self._tpog, self._folder / _TRAJECTORIES)
        return np.array([scorer.score(scanner.scan_site(site)).egvs for site in self._sites])


UNTRIED = "not known before a run"
SMALL_CHANGE, MIN_DISPLAYED_CHANGE = 0.01, 0.001
"""An effect that changes no score by more than the first share, and no order, is of little effect; before a run, one by
whose formula less than the first share of returns is missed. What is below the second is not told apart."""


@dataclass(frozen=True)
class EffectStatus:
    """One effect, before one scene, and why: named, it is "on", "skipped", or "refused" because something is missing;
    not named, it is "called for", of "little" effect, "your choice" where the scene cannot tell, or "off"; it is
    "broken" where it cannot be loaded.
    """

    name: str
    stage: str
    kind: str
    state: str
    why: str
    source: str
    change: str = ""
    """What it would change, and where the number comes from; of an effect that is not named."""


@dataclass(frozen=True)
class EffectCost:
    """What one effect costs and changes, as an accuracy study found.

    Attributes
    ----------
    seconds
        Of all stages: with the effect less without it.
    change
        Largest relative change of a site's share of the limit, against the scenario as it is.
    tau
        Kendall's tau of the rankings with and without it.
    regret
        Share of the best score that is lost by trusting the other ranking's best site.
    """

    seconds: float
    change: float
    tau: float
    regret: float


def effect_catalogue() -> list[EffectStatus]:
    """Every effect that exists."""
    return [_status_or_error(name, _describe_effect) for name in registry.effect_names()]


def effect_statuses(
    scenario: Scenario, out: Path | None = None, progress: ProgressCallback = no_progress
) -> list[EffectStatus]:
    """Every effect before ``scenario``, see :class:`EffectStatus`; tried on the traffic of the run in ``out``, where
    that is
    there."""
    scene = build_scene(scenario)
    return effect_statuses_in_scene(scene, None if out is None else EffectTrials.of(scene, out), progress)


def effect_statuses_in_scene(
    scene: Scene, trials: EffectTrials | None = None, progress: ProgressCallback = no_progress
) -> list[EffectStatus]:
    """The same before a scene that is at hand."""
    calls, names = [], registry.effect_names()
    for done, name in enumerate(names, start=1):
        calls.append(_status_or_error(name, lambda name: _effect_status(name, scene, trials)))
        progress("effects", done, len(names))
    return calls


def effect_costs(scenario: Scenario, out: Path) -> dict[str, EffectCost] | None:
    """What ``egvs accuracy`` left in ``out`` of each effect; None where it was not run on this scenario."""
    study = read_accuracy(RunFolder(out).accuracy)
    if study is None or study[1]["inputs"] != files.hash_json(scenario_dependencies(scenario)):
        return None
    rows = {row["setting"]: row for row in study[0]}
    priced, own = {}, rows[SCENARIO]["seconds"]
    for name in registry.effect_names():
        for beginning, sign in ((WITH_PREFIX, 1.0), (WITHOUT_PREFIX, -1.0)):
            if (row := rows.get(f"{beginning}{name}")) is not None:
                priced[name] = EffectCost(sign * (row["seconds"] - own), row["error"], row["tau"], row["regret"])
    return priced


def _status_or_error(name: str, describe: Callable[[str], EffectStatus]) -> EffectStatus:
    """What is told of an effect; of one that cannot be loaded, why: nobody may have named it."""
    try:
        return describe(name)
    except MissingBackendError as error:
        return EffectStatus(name, "", "", "broken", str(error), "")


def _describe_effect(name: str) -> EffectStatus:
    kind = registry.find_effect_class(name)
    return EffectStatus(name, kind.STAGE, kind.KIND, "", _effect_summary(kind), _model_source(kind))


def _effect_status(name: str, scene: Scene, trials: EffectTrials | None) -> EffectStatus:
    kind, named = registry.find_effect_class(name), scene.scenario.effects.named

    def call(state: str, why: str) -> EffectStatus:
        return EffectStatus(name, kind.STAGE, kind.KIND, state, why, _model_source(kind))

    if issubclass(kind, Traffic) and kind.SELF_ACTING:
        on, why = kind(kind.Model()).acts(scene.scenario)
        return call("on" if on else "off", why)
    if name not in named:
        return _unnamed_effect_status(kind, scene, trials)
    effect = kind(named[name])
    if (idle := effect.why_idle(scene)) is not None:
        return call("skipped", f"named, but {idle}: the result is the same without it")
    if (refusal := effect.refusal(scene)) is not None:
        return call("refused", str(refusal))
    values = ", ".join(f"{key} = {value}" for key, value in effect.parameters.model_dump(mode="json").items())
    return call("on", f"named, with {values}" if values else "named")


def _unnamed_effect_status(kind: type[Effect[Any]], scene: Scene, trials: EffectTrials | None) -> EffectStatus:
    """Whether the scene calls for an effect that it does not name, and what that would change."""

    def call(state: str, why: str, change: str = "") -> EffectStatus:
        return EffectStatus(kind.NAME, kind.STAGE, kind.KIND, state, why, _model_source(kind), change)

    if untold := [key for key in registry.required_parameters(kind.NAME) if key not in kind.TRIAL]:
        return call("off", f"not named; it needs {', '.join(untold)}, which the scene does not tell")
    effect = kind(kind.Model.of(kind.TRIAL))
    if (idle := effect.why_idle(scene)) is not None:
        return call("off", f"not called for: {idle}")
    if (refusal := effect.refusal(scene)) is not None:
        return call("off", format_problem("cannot act here", refusal.problem, refusal.hint))
    seen, small, change = effect.summary(scene), False, UNTRIED
    if trials is not None:
        small, change = _try_effect(effect, trials)
    elif isinstance(effect, Detect):
        small = 1.0 - min(effect.noticed_shares(scene)) < SMALL_CHANGE
    if kind.DECIDED_BY:
        values = ", ".join(f"{key} = {value:g}" for key, value in kind.TRIAL.items())
        tried = f"; tried with {values}" if trials is not None and not isinstance(effect, Traffic) else ""
        return call("your choice", "; ".join(filter(None, (f"{kind.DECIDED_BY} decides", seen))) + tried, change)
    unknown = trials is None and isinstance(effect, Articulated)  # which vehicles come
    state = "little" if small else "your choice" if unknown else "called for"
    return call(state, seen or "it can act here", change)


def _try_effect(effect: Effect[Any], trials: EffectTrials) -> tuple[bool, str]:
    """Whether an effect changes next to nothing, and by how much it changes the scores, in words."""
    if isinstance(effect, Articulated):
        parts = effect.geometries({name: size for name, (size, _) in trials.sizes.items()}, effect.NAME)
        share = sum(share for name, (_, share) in trials.sizes.items() if name in parts)
        return share == 0, f"{share:.1%} of the boxes in the last run get parts; what that changes takes a run with it"
    found = trials.trial(effect)
    if found is None:
        return False, "takes a run with it: its traffic is another"
    few = abs(found.most) < MIN_DISPLAYED_CHANGE
    spread = f"less than {MIN_DISPLAYED_CHANGE:.1%}" if few else f"{found.least:+.1%} to {found.most:+.1%}"
    order = "" if found.same_order else ", and their order"
    where = f"measured on {found.sites} of {found.of_sites} sites, with the last run's traffic"
    return abs(found.most) < SMALL_CHANGE and found.same_order, f"scores by {spread}{order} ({where})"


def _model_source(kind: type[Effect[Any]]) -> str:
    """Where an effect's model is published; and which package brings it, where that is not this program."""
    package = plugins.plugin_package(GROUP, kind.NAME)
    return kind.SOURCE if package == plugins.PACKAGE_NAME else f"{kind.SOURCE} (package {package})"


def _effect_summary(kind: type) -> str:
    """What an effect's module says of it."""
    return str(sys.modules[kind.__module__].__doc__).strip().splitlines()[0]
