"""Hand-made OpenStreetMap extracts, from positions in metres."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

_EARTH_M = 6371008.8
_LAT_DEG, _LON_DEG = 52.0, 10.0

XY = tuple[float, float]


@dataclass(frozen=True)
class MapWay:
    """A way through nodes, with its tags."""

    nodes: Sequence[int]
    tags: Mapping[str, str] = field(default_factory=dict)


def degrees(at_m: XY) -> tuple[float, float]:
    """Latitude, longitude of a position east and north of the middle, in metres."""
    lat_deg = _LAT_DEG + math.degrees(at_m[1] / _EARTH_M)
    return lat_deg, _LON_DEG + math.degrees(at_m[0] / _EARTH_M / math.cos(math.radians(_LAT_DEG)))


def street(name: str, *nodes: int, road_class: str = "tertiary", **tags: str) -> MapWay:
    """A street for vehicles."""
    return MapWay(nodes, {"highway": road_class, "name": name, **tags})


def write_map(
    path: Path,
    nodes: Mapping[int, XY],
    ways: Sequence[MapWay],
    node_tags: Mapping[int, Mapping[str, str]] | None = None,
) -> Path:
    """Write an extract and return its path."""
    lines = ['<osm version="0.6" generator="hand">']
    for number, at_m in nodes.items():
        lat_deg, lon_deg = degrees(at_m)
        tags = _tags((node_tags or {}).get(number, {}))
        lines.append(f'<node id="{number}" lat="{lat_deg:.7f}" lon="{lon_deg:.7f}">{tags}</node>')
    for number, way in enumerate(ways, 1):
        refs = "".join(f'<nd ref="{node}"/>' for node in way.nodes)
        lines.append(f'<way id="{number}">{refs}{_tags(way.tags)}</way>')
    path.write_text("\n".join([*lines, "</osm>", ""]), encoding="utf-8")
    return path


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
