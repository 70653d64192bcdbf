"""Which effects exist, which does a scene call for, and what do they change?

Steps of :func:`called`: build the static world in memory; ask every named effect whether it can change the result; say
for each effect whether it is on, and why. Steps of :func:`ablation`: run the plain scene, then the scene with one named
effect at a time, and all of them; stages that an effect does not touch are not run again."""

from __future__ import annotations

import importlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import read_accuracy, read_scores
from pipeline.core import files
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry as effects
from pipeline.runs import workflow
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.stages import statics
from pipeline.studies import settings as knobs
from pipeline.studies import trials


@dataclass(frozen=True)
class Call:
    """One effect, before one scene: "on", "off", "skipped", or "refused" because something is missing; and why."""

    name: str
    stage: str
    kind: str
    state: str
    why: str
    source: str


@dataclass(frozen=True)
class Price:
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


@dataclass(frozen=True)
class Change:
    """What one effect (or all) does to the scores.

    Attributes
    ----------
    effect
        Its name; "all" for all that the scenario names together; "none" for the plain scene.
    seconds
        Time of all stages but the report; a stage that the effect does not touch counts with what it took in the plain
        scene.
    sites, scores, ranks
        Of each site, in the order of the sites.
    """

    effect: str
    seconds: float
    sites: tuple[str, ...]
    scores: tuple[float, ...]
    ranks: tuple[int, ...]


def catalogue() -> list[Call]:
    """Every effect that exists."""
    return [Call(name, *effects.KINDS[name], "", _summary(name), _source(name)) for name in effects.KINDS]


def called(scenario: Scenario) -> list[Call]:
    """Every effect before ``scenario``: on, off, skipped because it provably changes nothing, or refused; and why."""
    scene = effects.Scene(scenario, statics.build(scenario)[0], sites.of(scenario))
    return [_call(name, scene) for name in effects.KINDS]


def prices(scenario: Scenario, out: Path) -> dict[str, Price] | None:
    """What ``egvs accuracy`` found of each effect, from ``out / "accuracy.parquet"``; None when it was not run on this
    scenario."""
    study = read_accuracy(out / "accuracy.parquet")
    if study is None or study[1]["inputs"] != files.hash_of(trials.inputs_of(scenario)):
        return None
    rows = {row["setting"]: row for row in study[0]}
    found, own = {}, rows[knobs.SCENARIO]["seconds"]
    for name in effects.KINDS:
        for beginning, sign in ((knobs.WITH, 1.0), (knobs.WITHOUT, -1.0)):
            if (row := rows.get(f"{beginning}{name}")) is not None:
                found[name] = Price(sign * (row["seconds"] - own), row["error"], row["tau"], row["regret"])
    return found


def _call(name: str, scene: effects.Scene) -> Call:
    stage, kind = effects.KINDS[name]
    if name in effects.SELF_ACTING:
        on, why = _module(name).EFFECT(effects.Parameters()).acts(scene.scenario)
        return Call(name, stage, kind, "on" if on else "off", why, _source(name))
    if name not in scene.scenario.effects:
        return Call(name, stage, kind, "off", "not named", _source(name))
    effect = effects.make(name, dict(scene.scenario.effects[name]), f"{scene.scenario.file}: effects")
    reason = effect.idle(scene)
    if reason is not None:
        return Call(
            name, stage, kind, "skipped", f"named, but {reason}: the result is the same without it", effect.SOURCE
        )
    lacking = effect.lacks(scene)
    if lacking is not None:
        return Call(name, stage, kind, "refused", str(lacking), effect.SOURCE)
    set_ = ", ".join(f"{key} = {value}" for key, value in effect.parameters.model_dump(mode="json").items())
    return Call(name, stage, kind, "on", f"named, with {set_}" if set_ else "named", effect.SOURCE)


def _module(name: str) -> Any:
    return importlib.import_module(f"pipeline.effects.{effects.KINDS[name][0]}.{name}")


def _source(name: str) -> str:
    return effects.kind_of(name).SOURCE


def _summary(name: str) -> str:
    return str(_module(name).__doc__).strip().splitlines()[0]


def ablation(scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent) -> list[Change]:
    """Run the plain scene, each named effect alone, and all together, under ``out / "ablation"``; a run is resumed as
    any other."""
    alone = {name: {name: parameters} for name, parameters in scenario.effects.items()}
    variants: dict[str, dict[str, Any]] = {"none": {}, **alone}
    if len(alone) > 1:
        variants["all"] = dict(scenario.effects)
    plain, changes = out / "ablation" / "none", []
    for name, named in variants.items():
        folder = out / "ablation" / name
        if not folder.exists() and plain.exists():
            shutil.copytree(plain, folder, ignore=shutil.ignore_patterns(".lock"))
        record = workflow.run(scenario.with_effects(named), folder, jobs=jobs, progress=progress)
        seconds = sum(done.cost.seconds for stage, done in record.stages.items() if stage != "report")
        scores = read_scores(folder / "scores.parquet")
        names = tuple(scores["site"].to_pylist())
        changes.append(
            Change(name, seconds, names, tuple(scores["egvs"].to_pylist()), tuple(scores["rank"].to_pylist()))
        )
    return changes
