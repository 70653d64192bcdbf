"""The map of approaches: letters, streets and numbers of a crossing, and labels that keep clear of each other."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from egvs.creation import junctions
from egvs.creation.openstreetmap import street_network
from egvs.drawing.svg_figures import Box, MapFrame
from egvs.formats import osm
from egvs.report import approach_map
from egvs.report.approach_map import ApproachLabel
from egvs.scenario.traffic_config import CountConfig
from tests.creation.overpass_server import SMALL

COUNTS = (
    CountConfig(from_edge="-1002#1", to_edge="1001#1", per_hour=80),
    CountConfig(from_edge="-1002#1", to_edge="1001#1", per_hour=7, kind="truck"),
    CountConfig(from_edge="-1002#1", to_edge="-1002#0", per_hour=30.4),
    CountConfig(edge="1001#0", per_hour=120),
)


@pytest.mark.slow
@pytest.mark.system
def test_labels_name_side_street_and_vehicles_per_hour(tmp_path: Path) -> None:
    extract = osm.read_osm(SMALL)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    network, streets, _ = street_network.build_network(extract, SMALL, flags)
    (tmp_path / "network.net.xml").write_text(network)
    junction = junctions.largest_junctions(streets)[0]
    assert junction is not None
    labels = approach_map.approach_labels(COUNTS, tmp_path / "network.net.xml", junction.at_m)
    assert [label.lines for label in labels] == [
        ("North Street (north)", "left 87", "straight 30"),
        ("East Street (west)", "all 120"),
    ]
    north, west = (label.at_m - np.array(junction.at_m) for label in labels)
    assert north[1] > 25 and abs(north[0]) < 5
    assert west[0] < -25 and abs(west[1]) < 5


def test_labels_cover_no_other_label_and_stay_on_the_map() -> None:
    plan = MapFrame((0.0, 0.0, 100.0, 100.0), "approaches", width=420.0, north=True)
    covered: list[Box] = []
    drawing = []
    for number, at_m in enumerate([(50, 50), (52, 50), (50, 52), (99, 99), (1, 1), (99, 1)]):
        label = ApproachLabel(
            np.array(at_m, dtype=np.float64), f"Street <{number}> (north)", {"left": 10.0, "right": 5.0}
        )
        drawing += approach_map._draw_label(plan, label, covered)
    assert len(covered) == 6
    for a, b in itertools.combinations(covered, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
    for left, top, right, bottom in covered:
        assert plan.left <= left and right <= plan.left + plan.frame_width
        assert plan.top <= top and bottom <= plan.top + plan.frame_height
    assert "Street &lt;3&gt;" in "".join(drawing)
    assert sum("<path" in part for part in drawing) >= 1  # a line to a label that is far away


def test_long_name_in_the_middle_stays_on_the_map() -> None:
    """A name of more than half the map fits on neither side of its disc in the middle: it goes above or below."""
    plan = MapFrame((0.0, 0.0, 100.0, 100.0), "approaches", width=420.0, north=True)
    covered: list[Box] = []
    label = ApproachLabel(np.array([50.0, 50.0]), "Wehneberger Straße (north)", {"left": 299.0, "right": 76.0})
    list(approach_map._draw_label(plan, label, covered))
    ((left, top, right, bottom),) = covered
    assert plan.left <= left and right <= plan.left + plan.frame_width
    assert not top < plan.y(50.0) < bottom
