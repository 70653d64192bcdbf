"""Finds effects by name and makes those that a scenario names.

Effects are entry points of the group ``egvs.effects`` (``name = "module:Class"``): this program's own, declared in its
``pyproject.toml``, and those of any other package. A module is imported only when its effect is named.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pipeline.core import plugins
from pipeline.effects.base import Effect
from pipeline.scenario.effects import GROUP, EffectParameters, EffectsModel
from pipeline.scenario.models import Scenario


def names() -> list[str]:
    """Every effect that is installed: this program's own in the order in which they are composed, then others."""
    return [*EffectsModel.OWN, *(name for name in plugins.names(GROUP) if name not in EffectsModel.OWN)]


def effect_class(name: str) -> type[Effect[Any]]:
    """Import one effect; InputError for one that does not exist."""
    found: type[Effect[Any]] = plugins.load(GROUP, name)
    return found


def make(name: str, parameters: EffectParameters) -> Effect[Any]:
    """One effect with its parameters."""
    return effect_class(name)(parameters)


def needs(name: str) -> list[str]:
    """The parameters of an effect that have no default."""
    return [key for key, field in effect_class(name).Model.model_fields.items() if field.is_required()]


def named(scenario: Scenario, *stages: str) -> tuple[Effect[Any], ...]:
    """The effects that a scenario names and that act in these stages, in the order in which they are composed."""
    effects = (make(name, parameters) for name, parameters in scenario.effects.named.items())
    return tuple(effect for effect in effects if effect.STAGE in stages)


def modules(effects: Iterable[Effect[Any]]) -> tuple[str, ...]:
    """The modules of effects, whose source a stage depends on."""
    return tuple(type(effect).__module__ for effect in effects)


def settings(effects: Iterable[Effect[Any]]) -> dict[str, Any]:
    """What a stage's inputs say of its effects: empty when there is none."""
    return {effect.NAME: effect.parameters.model_dump(mode="json") for effect in effects}
