"""A zone has no height: it contains the road users of all levels in the region of interest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.planted.outcome import outcome
from tests.planted.scenes import Scene, network, street
from tests.planted.times_and_sizes import BRIDGE_M, zones
from tests.planted.truth import STREET, drive, traffic

CAR = drive("a", "car", -20.13, -1.63, 2.03)
TRUCK = [replace(box, z_m=box.z_m + BRIDGE_M) for box in drive("b", "truck", 58.77, 1.57, -1.97)]
"""The car below a bridge, and the truck on it."""

CROSSING = [[5.0, -4.0], [15.0, -4.0], [15.0, 4.0], [5.0, 4.0]]


def crossing(low_m: float, high_m: float) -> Scene:
    """The street and a bridge above it, a zone across both, and a region of interest between two heights."""
    region = {"region_m": (20.0, 0.0, 0.5 * (low_m + high_m)), "size_m": (40.0, 20.0, high_m - low_m)}
    scene = street(replace(STREET, periods=((1.0, traffic(CAR, TRUCK)),), **region))
    scene.files["net.net.xml"] = network(lanes={"_up": BRIDGE_M})
    scene.files["zones.geojson"] = zones(CROSSING)
    scene.config["score.zones"] = "zones.geojson"
    return scene


@pytest.mark.parametrize(
    ("heights_m", "expected"),
    [((0.0, 12.0), {"car", "truck"}), ((0.0, 5.0), {"car"}), ((6.0, 12.0), {"truck"})],
    ids=["both levels", "below", "on the bridge"],
)
def test_zone_contains_all_levels_of_the_region(
    tmp_path: Path, heights_m: tuple[float, float], expected: set[str]
) -> None:
    folder = crossing(*heights_m).write(tmp_path / "crossing")
    outcome(folder)
    rows = pq.read_table(folder / "out" / "zones.parquet").to_pylist()
    assert {row["class"] for row in rows if row["road_users"]} - {"all"} == expected
