"""Made-up towns as OpenStreetMap extracts: netgenerate's networks with road classes and signals drawn at random."""

import math
import random
from pathlib import Path

from egvs.traffic import network, sumo

FLAGS = {
    "grid": ["--grid", "--grid.number", "4", "--grid.length", "150", "--grid.attach-length", "150"],
    "spider": ["--spider", "--spider.arm-number", "5", "--spider.circle-number", "3", "--spider.space-radius", "130"],
    "random": [
        "--rand", "--rand.iterations", "60", "--rand.min-distance", "80", "--rand.max-distance", "220",
        "--rand.min-angle", "40", "--bidi-probability", "1",
    ],
}  # fmt: skip
LANES = {"primary": 4, "secondary": 2, "tertiary": 2, "residential": 2}

_EARTH_M = 6371008.8
_LAT_DEG, _LON_DEG = 52.0, 10.0


def write_town(path: Path, kind: str, seed: int) -> list[tuple[float, float]]:
    """Write an extract; return latitude, longitude of its signals, those in the middle first."""
    sumo.run_program("netgenerate", [*FLAGS[kind], "--seed", str(seed), "-o", "plain.net.xml"], path.parent)
    roads = network.read_net_xml(path.parent / "plain.net.xml")
    nodes = [node for node in roads.junctions if node.type != "internal"]
    numbers = {node.id: number for number, node in enumerate(nodes, 1)}
    streets = sorted({tuple(sorted((edge.from_node, edge.to_node))) for edge in roads.edges})
    ends = [end for street in streets for end in street]

    rng = random.Random(seed)
    middle = [sum(values) / len(nodes) for values in zip(*(node.at_m for node in nodes), strict=True)]
    signals = [node for node in nodes if ends.count(node.id) >= 3 and rng.random() < 0.6]

    def degrees(at_m: tuple[float, float]) -> tuple[float, float]:
        east_m, north_m = at_m[0] - middle[0], at_m[1] - middle[1]
        lat_deg = _LAT_DEG + math.degrees(north_m / _EARTH_M)
        return lat_deg, _LON_DEG + math.degrees(east_m / _EARTH_M / math.cos(math.radians(_LAT_DEG)))

    lines = ['<osm version="0.6" generator="hand">']
    for node in nodes:
        lat_deg, lon_deg = degrees(node.at_m)
        tag = '<tag k="highway" v="traffic_signals"/>' if node in signals else ""
        lines.append(f'<node id="{numbers[node.id]}" lat="{lat_deg:.7f}" lon="{lon_deg:.7f}">{tag}</node>')
    for number, (start, end) in enumerate(streets, 1):
        road_class = rng.choices(list(LANES), [2, 3, 3, 2])[0]
        tags = {"highway": road_class, "lanes": LANES[road_class], "name": f"Street {number}"}
        text = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        refs = "".join(f'<nd ref="{numbers[node]}"/>' for node in (start, end))
        lines.append(f'<way id="{number}">{refs}{text}</way>')
    path.write_text("\n".join([*lines, "</osm>", ""]), encoding="utf-8")
    signals.sort(key=lambda node: math.dist(node.at_m, middle))
    return [degrees(node.at_m) for node in signals]
