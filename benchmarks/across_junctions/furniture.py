"""Street furniture and buildings beside the roads of a generated network, drawn at random.

Objects are footprints as in ``statics.geojson``. Each is drawn uniformly in the region of interest and its
surroundings, and kept where its distance from the roads is within the limits of its kind, and where it meets no earlier
object.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from shapely import affinity

from benchmarks.across_junctions.protocol import Furniture
from egvs.core.errors import InputError
from egvs.scenario.model import RoiConfig
from egvs.traffic.network import Network
from egvs.world.carriageway import Carriageway

FILE = "furniture.geojson"
MARGIN_M = 40.0
"""Objects stand up to here outside the region of interest."""

MAX_DRAWS = 20_000

FROM_ROAD_M = {"pole": (0.6, 3.0), "tree": (1.5, 6.0), "kiosk": (2.0, 6.0), "building": (7.0, 30.0)}
"""Distance of an object's edge from the nearest lane or junction."""

Draw = tuple[shapely.Polygon, list[dict[str, Any]]]


def draw(config: Furniture, roads: Network, roi: RoiConfig, seed: tuple[int, ...]) -> dict[str, Any]:
    """Return footprints of furniture as a GeoJSON collection.

    Raises
    ------
    InputError
        If there is no space for all of them.
    """
    rng = np.random.default_rng(seed)
    carriageway = shapely.union_all(Carriageway.of(roads).areas)
    low = np.array(roi.center_m[:2]) - np.array(roi.size_m[:2]) / 2 - MARGIN_M
    high = low + np.array(roi.size_m[:2]) + 2 * MARGIN_M
    taken: list[shapely.Polygon] = []
    features: list[dict[str, Any]] = []
    wanted = {"building": config.buildings, "kiosk": config.kiosks, "tree": config.trees, "pole": config.poles}
    for kind, count in wanted.items():
        for number in range(1, count + 1):
            for _ in range(MAX_DRAWS):
                outline, its_features = _one(kind, f"{kind}_{number}", rng, low, high)
                nearest, farthest = FROM_ROAD_M[kind]
                away_m = carriageway.distance(outline)
                if nearest <= away_m <= farthest and all(outline.distance(other) > 0.5 for other in taken):
                    taken.append(outline)
                    features += its_features
                    break
            else:
                problem = f"no space for {kind} {number} of {count} beside the roads"
                raise InputError("junctions.toml: furniture", problem, "Ask for fewer objects.")
    return {"type": "FeatureCollection", "crs": None, "features": features}


def _one(kind: str, name: str, rng: np.random.Generator, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> Draw:
    """Return the outline and the footprints of an object at a random place."""
    x_m, y_m = np.round(rng.uniform(low, high), 2).tolist()
    point = {"type": "Point", "coordinates": [x_m, y_m]}
    if kind == "pole":
        radius_m = round(float(rng.uniform(0.06, 0.15)), 2)
        height_m = round(float(rng.uniform(2.5, 9.0)), 1)
        properties = {"name": name, "kind": "pole", "height_m": height_m, "radius_m": radius_m}
        return shapely.Point(x_m, y_m).buffer(radius_m), [_feature(properties, point)]
    if kind == "tree":
        base_m, radius_m = round(float(rng.uniform(2.2, 3.5)), 1), round(float(rng.uniform(1.2, 3.0)), 1)
        height_m = round(base_m + float(rng.uniform(2.5, 6.0)), 1)
        trunk = {"name": f"{name}_trunk", "kind": "tree_trunk", "height_m": base_m, "radius_m": 0.18}
        crown = {"name": f"{name}_crown", "kind": "tree_crown", "height_m": height_m, "base_m": base_m,
                 "radius_m": radius_m}  # fmt: skip
        return shapely.Point(x_m, y_m).buffer(0.18), [_feature(trunk, point), _feature(crown, point)]
    limits = (2.0, 6.0, 2.2, 3.2) if kind == "kiosk" else (10.0, 28.0, 5.0, 22.0)
    size_m = np.round(rng.uniform(limits[0], limits[1], 2), 1).tolist()
    if kind == "kiosk":
        size_m[1] = round(min(size_m[1], 2.5), 1)
    outline = affinity.rotate(shapely.box(-size_m[0] / 2, -size_m[1] / 2, size_m[0] / 2, size_m[1] / 2),
                              float(rng.uniform(0.0, 180.0)))  # fmt: skip
    outline = shapely.transform(affinity.translate(outline, x_m, y_m), lambda xy: np.round(xy, 2))
    properties = {"name": name, "kind": kind, "height_m": round(float(rng.uniform(limits[2], limits[3])), 1)}
    ring = [list(corner) for corner in outline.exterior.coords]
    return outline, [_feature(properties, {"type": "Polygon", "coordinates": [ring]})]


def _feature(properties: dict[str, Any], geometry: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": geometry}
