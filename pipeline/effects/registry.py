"""Finds effects by name and makes those that a scenario names.

Effects are entry points of the group ``egvs.effects`` (``name = "module:Class"``): this program's own, declared in its
``pyproject.toml``, and those of any other package. A module is imported only when its effect is named. What belongs to
a new one (base class, parameters in :mod:`pipeline.scenario.effects`, docs) is listed in ``docs/extending.md``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pipeline.core import plugins
from pipeline.effects.base import Detect, Effect, Expand, Traffic, TransmitScan, TransmitScore
from pipeline.scenario.effects import GROUP, EffectParameters, EffectsModel
from pipeline.scenario.models import Scenario

_KINDS = (Expand, TransmitScan, TransmitScore, Detect, Traffic)


def names() -> list[str]:
    """Every effect that is installed: this program's own in the order in which they are composed, then others."""
    return [*EffectsModel.OWN, *(name for name in plugins.names(GROUP) if name not in EffectsModel.OWN)]


def effect_class(name: str) -> type[Effect[Any]]:
    """Import one effect.

    Raises
    ------
    InputError
        When there is no such effect.
    MissingBackendError
        When it cannot be imported, is no effect, or has another name than its entry point: two effects of one name
        would overwrite each other's parameters in :func:`settings`.
    """
    found = plugins.load(GROUP, name)
    if not (isinstance(found, type) and issubclass(found, _KINDS)):
        right = f"a subclass of {', '.join(kind.__name__ for kind in _KINDS)} of {Effect.__module__}"
        raise plugins.unusable(GROUP, name, f"it is no effect; right is {right}")
    if not (isinstance(found.Model, type) and issubclass(found.Model, EffectParameters)):
        right = f"a subclass of {EffectParameters.__module__}.{EffectParameters.__name__}"
        raise plugins.unusable(GROUP, name, f"its Model is {found.Model!r}; right is {right}")
    if name != found.NAME:
        raise plugins.unusable(GROUP, name, f"its NAME is {found.NAME!r}; right is {name!r}, as its entry point has it")
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
