"""The frame of every page: one environment of templates, and numbers that stay on one line with their units.

A page is one file that loads nothing from elsewhere. Its template has the folder of its module; the style sheet that
pages share (``style.css.j2``) is beside this module.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs._version import __version__
from egvs.core.wording import format_percent
from egvs.drawing.colours import STYLE_SHEET
from egvs.results import labels

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).parent / "templates"

_NOT_TEXT = re.compile(r"(<(script|style)\b.*?</\2>)", re.DOTALL)
_TEXT = re.compile(r">[^<>]+")
_SPACE_BEFORE_UNIT = re.compile(r"(?<=\d) (?=%|m\b)")


def page_environment(folder: Path, **filters: Callable[..., Any]) -> Environment:
    """Return the templates in a folder, with the filters and values that all pages use.

    Parameters
    ----------
    folder
        The folder.
    **filters
        Further filters.
    """
    # imported only when a page is written
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    from egvs.drawing.template_cache import open_template_cache

    environment = Environment(
        loader=FileSystemLoader([folder, TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=open_template_cache(Path(__file__)),
    )
    environment.filters |= {
        "svg": Markup,
        "share": format_percent,
        "probability": labels.format_probability,
        "whole": labels.format_count,
        "plain": labels.format_number,
        "degrees": labels.format_degrees,
        **filters,
    }
    environment.globals |= {"style": Markup(STYLE_SHEET), "version": __version__}
    return environment


def render(environment: Environment, template: str, **values: Any) -> str:
    """Return a page, HTML text, from its template and the values in it."""
    return keep_units_together(environment.get_template(template).render(values))


def keep_units_together(html: str) -> str:
    """Return a page on which no line begins with the sign of a percentage or "m": its space does not break.

    Attributes, scripts and style sheets stay as they are.

    >>> keep_units_together('<p title="5 %">5 %</p>').replace("\\u00a0", "_")
    '<p title="5 %">5_%</p>'
    """
    parts = _NOT_TEXT.split(html)
    for number in range(0, len(parts), 3):  # text, then the two groups of a script or style sheet
        parts[number] = _TEXT.sub(lambda match: _SPACE_BEFORE_UNIT.sub("\u00a0", match[0]), parts[number])
        if number + 2 < len(parts):
            parts[number + 2] = ""
    return "".join(parts)
