"""Which effects exist, which of them a scenario calls for, and what an accuracy study says that each costs.

Steps of :func:`called`: build the static world in memory; ask every named effect whether it can change the result; say
for each effect whether it is on, and why."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import read_accuracy
from pipeline.core import files
from pipeline.effects import registry as effects
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.stages import statics
from pipeline.studies.measuring import inputs_of
from pipeline.studies.settings import SCENARIO, WITH, WITHOUT


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


def catalogue() -> list[Call]:
    """Every effect that exists."""
    return [Call(name, *effects.KINDS[name], "", _summary(name), _source(name)) for name in effects.KINDS]


def called(scenario: Scenario) -> list[Call]:
    """Every effect before ``scenario``: on, off, skipped because it provably changes nothing, or refused; and why."""
    scene = effects.Scene(scenario, statics.build(scenario, statics.Tally.empty()), sites.of(scenario))
    return [_call(name, scene) for name in effects.KINDS]


def prices(scenario: Scenario, out: Path) -> dict[str, Price] | None:
    """What ``egvs accuracy`` found of each effect, from ``out / "accuracy.parquet"``; None when it was not run on this
    scenario."""
    study = read_accuracy(out / "accuracy.parquet")
    if study is None or study[1]["inputs"] != files.hash_of(inputs_of(scenario)):
        return None
    rows = {row["setting"]: row for row in study[0]}
    priced, own = {}, rows[SCENARIO]["seconds"]
    for name in effects.KINDS:
        for beginning, sign in ((WITH, 1.0), (WITHOUT, -1.0)):
            if (row := rows.get(f"{beginning}{name}")) is not None:
                priced[name] = Price(sign * (row["seconds"] - own), row["error"], row["tau"], row["regret"])
    return priced


def _call(name: str, scene: effects.Scene) -> Call:
    stage, kind = effects.KINDS[name]
    if name == effects.SELF_ACTING:
        on, why = _module(name).decide(scene.scenario)
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
