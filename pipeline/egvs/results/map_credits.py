"""Who made the maps of a scenario, for the foot of the page: their licences require that results name them."""

from __future__ import annotations

import json
import re
from pathlib import Path

from egvs.core.digests import open_input
from egvs.scenario.model import Scenario

_HEAD_BYTES = 4096
_ATTRIBUTION = re.compile(r'"attribution"\s*:\s*("(?:[^"\\]|\\.)*")')


def read_map_credits(scenario: Scenario) -> tuple[str, ...]:
    """Return the ``attribution`` in the head of each GeoJSON file of static objects, without repetitions.

    Parameters
    ----------
    scenario
        A scenario whose files exist; ``egvs new`` writes the attribution of its maps there.

    Returns
    -------
    tuple of str
        E.g. ``("(c) OpenStreetMap contributors, ODbL",)``; empty if no file names anybody.
    """
    credits: dict[str, None] = {}
    for name in scenario.statics.footprints:
        path = scenario.find(name, "statics.footprints")
        if path.suffix in (".geojson", ".json"):
            credits |= dict.fromkeys(_read_attributions(path))
    return tuple(credits)


def _read_attributions(path: Path) -> list[str]:
    with open_input(path) as file:
        head = file.read(_HEAD_BYTES).decode("utf-8", "ignore").partition('"features"')[0]
    match = _ATTRIBUTION.search(head)
    if match is None:
        return []
    try:
        attribution: str = json.loads(match[1])
    except ValueError:  # the file is checked when its objects are read
        return []
    return [part for part in attribution.split("; ") if part]
