"""What is wrong with a scenario, in words: key, value, what would be right."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario
from pipeline.scenario.types import NAME_IN_WORDS

_ALTERNATIVE = re.compile(r"\.(?:(?:constrained-)?(?:float|int|str)|(?:literal|tuple)\[.*\])$")
"""How pydantic's place of an error ends in a value that may be of several types."""

_SHOULD = "input should be "


def explain(error: ValidationError, place: str, model: type[BaseModel] = Scenario) -> InputError:
    """One line for each thing that is wrong with a ``model``: key, value, what would be right."""
    lines = list(_joined(_lines(error, model, ())))
    key, found, right = lines[0]
    more = "".join(f"\n{place}: {k}: {f}" + (f"; {r}" if r else "") for k, f, r in lines[1:])
    return InputError(f"{place}: {key}", found, right + more)


def _joined(lines: Iterator[tuple[str, str, str]]) -> Iterator[tuple[str, str, str]]:
    """What every alternative of a value says, in one line: "a valid number or 'auto'"."""
    said: dict[tuple[str, str], list[str]] = {}
    for key, found, right in lines:
        said.setdefault((_ALTERNATIVE.sub("", key), found), []).append(right)
    for (key, found), rights in said.items():
        first, *others = dict.fromkeys(rights)
        yield key, found, " or ".join([first, *(other.removeprefix(_SHOULD) for other in others)])


def _lines(error: ValidationError, model: type[BaseModel], above: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Key, what stands there, and what would be right, of all that is wrong in ``model``, found under ``above``."""
    for item in error.errors():
        key = ".".join(str(part) for part in (*above, *item["loc"]) if part != "[key]")
        context = item.get("ctx", {})
        if item["type"] == "default_factory_not_called":
            continue  # follows from another key that is wrong, which is told
        if item["type"] == "extra_forbidden":
            yield key, "unknown key", nearest_key(item["loc"], model)
        elif item["type"] == "missing":
            yield key, "missing", "this key is needed"
        elif item["type"] == "string_pattern_mismatch":
            yield key, f"{item['input']!r}", NAME_IN_WORDS
        elif item["type"] == "value_error":
            yield key or "scenario", str(context["error"]), ""
        elif item["type"] == "unknown_effect":
            yield f"{key}.{context['name']}", "unknown effect", context["right"]
        elif item["type"] == "of_an_effect":
            yield from _lines(context["error"], context["model"], (key, context["name"]))
        else:
            yield key, f"{item['input']!r}", item["msg"][0].lower() + item["msg"][1:]


def nearest_key(loc: Sequence[str | int], top: type[BaseModel]) -> str:
    """What the user may have meant by an unknown key of ``top``."""
    model: type[BaseModel] | None = top
    if len(loc) == 1 and (inner := _tables_with(str(loc[0]), top)):
        return f"did you mean {' or '.join(f'{table}.{loc[0]}' for table in inner)}?"
    for part in loc[:-1]:
        if model is not None and part in model.model_fields:
            model = _model_of(model.model_fields[str(part)].annotation)
    known = sorted(model.model_fields) if model is not None else []
    near = difflib.get_close_matches(str(loc[-1]), known, 1, 0.5)
    return f"did you mean {near[0]}?" if near else f"known here are {', '.join(known)}"


def _tables_with(key: str, top: type[BaseModel]) -> list[str]:
    """The tables of ``top`` that know a key."""
    models = {name: _model_of(field.annotation) for name, field in top.model_fields.items()}
    return [name for name, model in models.items() if model is not None and key in model.model_fields]


def _model_of(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as ``tuple[SiteLine, ...]`` or ``SiteGrid | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        if found := _model_of(inner):
            return found
    return None
