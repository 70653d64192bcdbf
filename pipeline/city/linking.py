"""Makes the scenarios of junctions name the city's traffic: one file each, or one for each period of ``city.toml``.

Only ``[traffic]`` is written, and only where it names other files of the city's, other periods, or other weights than
``city.toml`` has now; comments and all other keys stay.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from pipeline.city.model import TRAFFIC, City, CityJunction
from pipeline.core import files
from pipeline.core.reading import documents
from pipeline.scenario.models import FILE

_UP = "../../"
_SOURCES = ("fcd", "periods")


def link(city: City) -> tuple[str, ...]:
    """Write what has to be; the junctions whose scenarios were changed.

    A scenario whose traffic comes from elsewhere is left as it is, and refused when the traffic is made.
    """
    return tuple(junction.id for junction in city.junctions if _link(city, junction))


def _link(city: City, junction: CityJunction) -> bool:
    path = junction.scenario_folder(city) / FILE
    values = documents.read_toml(path)
    own = values.get("traffic", {})
    its = {key: own[key] for key in _SOURCES if key in own} if isinstance(own, dict) else {}
    wanted = _wanted(city, junction)
    if its == wanted or not its or not all(str(name).startswith(f"{_UP}{TRAFFIC}/") for name in _named(its)):
        return False
    try:
        document = tomlkit.parse(path.read_text(encoding="utf-8"))
    except (TOMLKitError, UnicodeDecodeError):  # what one reader takes and the other does not
        return False
    table: Any = document["traffic"]
    for key in its:
        del table[key]
    if "fcd" in wanted:
        table["fcd"] = wanted["fcd"]
    else:
        periods = tomlkit.aot()
        for period in wanted["periods"]:
            periods.append(tomlkit.item(period))
        periods[-1].add(tomlkit.nl())
        table["periods"] = periods
    files.write_text(path, tomlkit.dumps(document))
    return True


def _wanted(city: City, junction: CityJunction) -> dict[str, Any]:
    """What of ``[traffic]`` follows from the city."""
    if not city.traffic.periods:
        return {"fcd": _name(city, junction, "")}
    return {
        "periods": [
            {"name": period.name, "weight": period.weight, "fcd": _name(city, junction, period.name)}
            for period in city.traffic.periods
        ]
    }


def _name(city: City, junction: CityJunction, period: str) -> str:
    return _UP + junction.traffic_file(city, period).relative_to(city.folder).as_posix()


def _named(sources: dict[str, Any]) -> Iterator[Any]:
    """The files that a scenario's traffic comes from."""
    if "fcd" in sources:
        yield sources["fcd"]
    periods = sources.get("periods", [])
    for period in periods if isinstance(periods, list) else [periods]:
        yield period.get("fcd", "") if isinstance(period, dict) else ""
