"""Effects by name, and those that a scenario enables.

Effects are entry points of the group ``egvs.effects`` (``name = "module:Class"``), of this program or of any other
package. A module is imported only when its effect is named. ``docs/extending.md`` lists what a new effect needs (base
class, parameters, docs); an effect of this program also needs a field of ``EffectsConfig`` (``CONTRIBUTING.md``).

Effects on traffic and ground may also be enabled automatically, where leaving them out would be wrong. Built-in effects
are declared in ``pyproject.toml``, under ``egvs.effects``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, cast

from egvs.core import plugins
from egvs.effects import base
from egvs.scenario.effects_config import GROUP, EffectParameters, EffectsConfig, load_effect
from egvs.scenario.model import Scenario
from egvs.traffic import sumo_folder
from egvs.traffic.vehicle_boxes import VehicleSize

if TYPE_CHECKING:
    from egvs.world.terrain import GroundSource

_BASE_CLASSES = (base.Expand, base.TransmitScan, base.TransmitScore, base.Detect, base.Traffic, base.Echo)

AUTO_ENABLED: dict[str, Callable[[Scenario], bool]] = {"slope": sumo_folder.may_have_slopes}
"""Effects that are enabled automatically, each with a quick test of whether it may act."""

LOSSES = "range_limit"
"""The effect that is enabled automatically if a sensor needs it, see :mod:`egvs.sensors.return_model`."""


def effect_names() -> list[str]:
    """Return all installed effects: built-in ones in the order in which they are applied, then others."""
    names = list(EffectsConfig.BUILT_IN)
    names += [name for name in plugins.plugin_names(GROUP) if name not in names]
    return names


def load_effect_class(name: str) -> type[base.Effect[Any]]:
    """Import an effect.

    Raises
    ------
    InputError
        When there is no such effect.
    MissingBackendError
        When it cannot be imported, is not an effect, or has another name than its entry point: two effects of one name
        would overwrite each other's parameters in :func:`effect_settings`.
    """
    effect_class = load_effect(name)
    if not (isinstance(effect_class, type) and issubclass(effect_class, _BASE_CLASSES)):
        class_names = ", ".join(base_class.__name__ for base_class in _BASE_CLASSES)
        problem = f"expected a subclass of {class_names} of {base.Effect.__module__}, got {effect_class!r}"
        raise plugins.plugin_error(GROUP, name, problem)
    model = effect_class.Model
    if not (isinstance(model, type) and issubclass(model, EffectParameters)):
        expected = f"{EffectParameters.__module__}.{EffectParameters.__name__}"
        raise plugins.plugin_error(GROUP, name, f"expected a subclass of {expected} as its Model, got {model!r}")
    if name != effect_class.NAME:
        problem = f"expected NAME = {name!r}, the name of its entry point, got {effect_class.NAME!r}"
        raise plugins.plugin_error(GROUP, name, problem)
    return effect_class


def make_effect(name: str, parameters: EffectParameters) -> base.Effect[Any]:
    """Return an effect with its parameters."""
    return load_effect_class(name)(parameters)


def required_parameters(name: str) -> list[str]:
    """Return the parameters of an effect that have no default."""
    fields = load_effect_class(name).Model.model_fields
    return [key for key, field in fields.items() if field.is_required()]


def scenario_effects(scenario: Scenario, *stages: str) -> tuple[base.Effect[Any], ...]:
    """Return the effects of a scenario that act in some stages, in the order in which they are applied."""
    effects = [make_effect(name, parameters) for name, parameters in scenario.effects.named.items()]
    return tuple(effect for effect in effects if effect.STAGE in stages)


def make_losses() -> base.Effect[Any]:
    """Return the losses of all sensors with a rated range, with the sensors' values."""
    effect_class = load_effect_class(LOSSES)
    return effect_class(effect_class.Model(), skips_unrated=True)  # type: ignore[call-arg]


def effect_modules(effects: Iterable[base.Effect[Any]]) -> tuple[str, ...]:
    """Return the modules of effects; the results of a stage depend on their source."""
    return tuple(type(effect).__module__ for effect in effects)


def effect_settings(effects: Iterable[base.Effect[Any]]) -> dict[str, Any]:
    """Return the parameters of effects by name, for the cache key of a stage."""
    return {effect.NAME: effect.settings for effect in effects}


def active_traffic_effects(scenario: Scenario) -> tuple[tuple[base.Traffic[Any], ...], tuple[str, ...]]:
    """Return the active effects in order, and notes on those that are enabled automatically or skipped."""
    effects = []
    notes = []
    for effect in _candidate_effects(scenario):
        on, reason = effect.acts(scenario)
        if on:
            effects.append(effect)
            if effect.AUTO_ENABLED:
                notes.append(f"{effect.NAME}: on, {reason}")
        elif effect.NAME in scenario.effects.named:
            notes.append(f"{effect.NAME}: set, but {reason}: skipped, the result is the same")
        else:
            notes.append(f"{effect.NAME}: off, {reason}")
    return tuple(effects), tuple(notes)


def followed_types(scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
    """Return the vehicle types whose whole path the scenario's effects need."""
    types: set[str] = set()
    for effect in _candidate_effects(scenario):
        types |= effect.followed_types(scenario, sizes)
    return frozenset(types)


def ground_effect(scenario: Scenario) -> GroundSource | None:
    """Return the effect that provides the ground; None where it is flat."""
    for effect in _candidate_effects(scenario):
        if hasattr(effect, "ground") and effect.acts(scenario)[0]:
            return cast("GroundSource", effect)
    return None


def _candidate_effects(scenario: Scenario) -> Iterator[base.Traffic[Any]]:
    """The effects on traffic that are named or may be enabled automatically, in the order in which they are applied."""
    named = scenario.effects.named
    for name in effect_names():
        may_be_enabled = name in AUTO_ENABLED and name not in named and AUTO_ENABLED[name](scenario)
        if name not in named and not may_be_enabled:
            continue
        effect_class = load_effect_class(name)
        if issubclass(effect_class, base.Traffic):
            yield effect_class(named[name] if name in named else effect_class.Model())
