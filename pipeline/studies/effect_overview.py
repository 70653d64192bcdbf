"""Which effects exist, which of them a scenario calls for, and what an accuracy study says that each costs.

Steps of :func:`called`: build the static world in memory; ask every named effect whether it can change the result; say
for each effect whether it is on, and why.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import read_accuracy
from pipeline.core import files, plugins
from pipeline.core.errors import MissingBackendError
from pipeline.effects import registry
from pipeline.effects.base import Effect, Traffic
from pipeline.effects.scene_building import build_scene
from pipeline.scenario.effects import GROUP
from pipeline.scenario.models import Scenario
from pipeline.sensing.scene import Scene
from pipeline.studies.measuring import inputs_of
from pipeline.studies.variants import SCENARIO, WITH, WITHOUT


@dataclass(frozen=True)
class Call:
    """One effect, before one scene: "on", "off", "skipped", "refused" because something is missing, or "broken"
    because it cannot be loaded; and why."""

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
    return [_unless_broken(name, _described) for name in registry.names()]


def called(scenario: Scenario) -> list[Call]:
    """Every effect before ``scenario``: on, off, skipped because it provably changes nothing, refused or broken; and
    why."""
    scene = build_scene(scenario)
    return [_unless_broken(name, lambda name: _call(name, scene)) for name in registry.names()]


def prices(scenario: Scenario, out: Path) -> dict[str, Price] | None:
    """What ``egvs accuracy`` left in ``out`` of each effect; None where it was not run on this scenario."""
    study = read_accuracy(out / "accuracy.parquet")
    if study is None or study[1]["inputs"] != files.hash_of(inputs_of(scenario)):
        return None
    rows = {row["setting"]: row for row in study[0]}
    priced, own = {}, rows[SCENARIO]["seconds"]
    for name in registry.names():
        for beginning, sign in ((WITH, 1.0), (WITHOUT, -1.0)):
            if (row := rows.get(f"{beginning}{name}")) is not None:
                priced[name] = Price(sign * (row["seconds"] - own), row["error"], row["tau"], row["regret"])
    return priced


def _unless_broken(name: str, told: Callable[[str], Call]) -> Call:
    """What is told of an effect; of one that cannot be loaded, why: nobody may have named it."""
    try:
        return told(name)
    except MissingBackendError as error:
        return Call(name, "", "", "broken", str(error), "")


def _described(name: str) -> Call:
    kind = registry.effect_class(name)
    return Call(name, kind.STAGE, kind.KIND, "", _first_line(kind), _source(kind))


def _call(name: str, scene: Scene) -> Call:
    kind, named = registry.effect_class(name), scene.scenario.effects.named

    def call(state: str, why: str) -> Call:
        return Call(name, kind.STAGE, kind.KIND, state, why, _source(kind))

    if issubclass(kind, Traffic) and kind.SELF_ACTING:
        on, why = kind(kind.Model()).acts(scene.scenario)
        return call("on" if on else "off", why)
    if name not in named:
        return call("off", "not named")
    effect = kind(named[name])
    if (idle := effect.why_idle(scene)) is not None:
        return call("skipped", f"named, but {idle}: the result is the same without it")
    if (refusal := effect.refusal(scene)) is not None:
        return call("refused", str(refusal))
    values = ", ".join(f"{key} = {value}" for key, value in effect.parameters.model_dump(mode="json").items())
    return call("on", f"named, with {values}" if values else "named")


def _source(kind: type[Effect[Any]]) -> str:
    """Where an effect's model is published; and which package brings it, where that is not this program."""
    package = plugins.package_of(GROUP, kind.NAME)
    return kind.SOURCE if package == plugins.OWN else f"{kind.SOURCE} (package {package})"


def _first_line(kind: type) -> str:
    """What an effect's module says of it."""
    return str(sys.modules[kind.__module__].__doc__).strip().splitlines()[0]
