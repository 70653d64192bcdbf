"""Which effects exist, which of them a scenario calls for, and what an accuracy study says that each costs.

Steps of :func:`called`: build the static world in memory; ask every named effect whether it can change the result; ask
every other one whether it could, what in the scene it is about, and try it on the traffic of the last run
(:mod:`pipeline.studies.effect_trials`); say for each effect whether it is on or called for, and why.
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
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry
from pipeline.effects.base import Detect, Effect, Traffic
from pipeline.effects.scene_building import build_scene
from pipeline.effects.traffic.articulated import Articulated
from pipeline.scenario.effects import GROUP
from pipeline.scenario.models import Scenario
from pipeline.sensing.scene import Scene
from pipeline.studies.effect_trials import Trials
from pipeline.studies.measuring import inputs_of
from pipeline.studies.variants import SCENARIO, WITH, WITHOUT

UNTRIED = "not known before a run"
SMALL, LEAST_SHOWN = 0.01, 0.001
"""An effect that changes no score by more than the first share, and no order, is of little effect; before a run, one by
whose formula less than the first share of returns is missed. What is below the second is not told apart."""


@dataclass(frozen=True)
class Call:
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


def called(scenario: Scenario, out: Path | None = None, progress: Progress = silent) -> list[Call]:
    """Every effect before ``scenario``, see :class:`Call`; tried on the traffic of the run in ``out``, where that is
    there."""
    scene = build_scene(scenario)
    return called_in(scene, None if out is None else Trials.of(scene, out), progress)


def called_in(scene: Scene, trials: Trials | None = None, progress: Progress = silent) -> list[Call]:
    """The same before a scene that is at hand."""
    calls, names = [], registry.names()
    for done, name in enumerate(names, start=1):
        calls.append(_unless_broken(name, lambda name: _call(name, scene, trials)))
        progress("effects", done, len(names))
    return calls


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


def _call(name: str, scene: Scene, trials: Trials | None) -> Call:
    kind, named = registry.effect_class(name), scene.scenario.effects.named

    def call(state: str, why: str) -> Call:
        return Call(name, kind.STAGE, kind.KIND, state, why, _source(kind))

    if issubclass(kind, Traffic) and kind.SELF_ACTING:
        on, why = kind(kind.Model()).acts(scene.scenario)
        return call("on" if on else "off", why)
    if name not in named:
        return _advised(kind, scene, trials)
    effect = kind(named[name])
    if (idle := effect.why_idle(scene)) is not None:
        return call("skipped", f"named, but {idle}: the result is the same without it")
    if (refusal := effect.refusal(scene)) is not None:
        return call("refused", str(refusal))
    values = ", ".join(f"{key} = {value}" for key, value in effect.parameters.model_dump(mode="json").items())
    return call("on", f"named, with {values}" if values else "named")


def _advised(kind: type[Effect[Any]], scene: Scene, trials: Trials | None) -> Call:
    """Whether the scene calls for an effect that it does not name, and what that would change."""

    def call(state: str, why: str, change: str = "") -> Call:
        return Call(kind.NAME, kind.STAGE, kind.KIND, state, why, _source(kind), change)

    if untold := [key for key in registry.needs(kind.NAME) if key not in kind.TRIAL]:
        return call("off", f"not named; it needs {', '.join(untold)}, which the scene does not tell")
    effect = kind(kind.Model.of(kind.TRIAL))
    if (idle := effect.why_idle(scene)) is not None:
        return call("off", f"not called for: {idle}")
    if (refusal := effect.refusal(scene)) is not None:
        return call("off", f"cannot act here: {refusal.found}" + (f"; {refusal.right}" if refusal.right else ""))
    seen, small, change = effect.seen(scene), False, UNTRIED
    if trials is not None:
        small, change = _tried(effect, trials)
    elif isinstance(effect, Detect):
        small = 1.0 - min(effect.noticed(scene)) < SMALL
    if kind.UNTOLD:
        values = ", ".join(f"{key} = {value:g}" for key, value in kind.TRIAL.items())
        tried = f"; tried with {values}" if trials is not None and not isinstance(effect, Traffic) else ""
        return call("your choice", "; ".join(filter(None, (f"{kind.UNTOLD} decides", seen))) + tried, change)
    unknown = trials is None and isinstance(effect, Articulated)  # which vehicles come
    state = "little" if small else "your choice" if unknown else "called for"
    return call(state, seen or "it can act here", change)


def _tried(effect: Effect[Any], trials: Trials) -> tuple[bool, str]:
    """Whether an effect changes next to nothing, and by how much it changes the scores, in words."""
    if isinstance(effect, Articulated):
        parts = effect.geometries({name: size for name, (size, _) in trials.sizes.items()}, effect.NAME)
        share = sum(share for name, (_, share) in trials.sizes.items() if name in parts)
        return share == 0, f"{share:.1%} of the boxes in the last run get parts; what that changes takes a run with it"
    found = trials.trial(effect)
    if found is None:
        return False, "takes a run with it: its traffic is another"
    few = abs(found.most) < LEAST_SHOWN
    spread = f"less than {LEAST_SHOWN:.1%}" if few else f"{found.least:+.1%} to {found.most:+.1%}"
    order = "" if found.same_order else ", and their order"
    where = f"measured on {found.sites} of {found.of_sites} sites, with the last run's traffic"
    return abs(found.most) < SMALL and found.same_order, f"scores by {spread}{order} ({where})"


def _source(kind: type[Effect[Any]]) -> str:
    """Where an effect's model is published; and which package brings it, where that is not this program."""
    package = plugins.package_of(GROUP, kind.NAME)
    return kind.SOURCE if package == plugins.OWN else f"{kind.SOURCE} (package {package})"


def _first_line(kind: type) -> str:
    """What an effect's module says of it."""
    return str(sys.modules[kind.__module__].__doc__).strip().splitlines()[0]
