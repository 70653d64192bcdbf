"""Are towns cut into districts without gaps, and vehicles neither lost nor counted twice?"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from benchmarks import town_districts
from benchmarks.town_districts import JunctionTraffic, Settings

from egvs.traffic.network import Junction


def vehicle(edges: str, exit_times: str) -> ElementTree.Element:
    text = f'<vehicle id="1" arrivalPos="9"><route edges="{edges}" exitTimes="{exit_times}"/></vehicle>'
    return ElementTree.fromstring(text)


@pytest.mark.parametrize(
    ("exit_times", "edges_left", "times_left", "arrives"),
    [
        pytest.param("10.00 25.00 -1 -1", "a b c", "10.00 25.00 -1", False, id="on c at the end"),
        pytest.param("10.00 25.00 30.00 41.00", "a b c d", "10.00 25.00 30.00 41.00", True, id="arrived"),
        pytest.param("10.00 25.00 30.00 -1", "a b c d", "10.00 25.00 30.00 -1", False, id="on the last edge"),
    ],
)
def test_edges_that_a_vehicle_did_not_reach_are_removed(exit_times, edges_left, times_left, arrives):
    cut = vehicle("a b c d", exit_times)
    town_districts.end_at_last_edge(cut)
    (route,) = cut
    assert (route.get("edges"), route.get("exitTimes")) == (edges_left, times_left)
    assert ("arrivalPos" in cut.attrib) == arrives


def test_each_junction_is_in_one_district():
    districts = Settings(side=6, district_side=3, rim_m=300.0, frames=1).districts()
    assert len(districts) == 4
    for x in range(1, 7):
        for y in range(1, 7):
            assert sum(district.contains((200.0 * x, 200.0 * y)) for district in districts) == 1


def test_counts_vehicles_around_a_junction_and_parts_of_a_route_once(tmp_path: Path):
    rows = [
        "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed",
        "0.00;7_part0;95;100;90;car;5", "0.00;8;139;61;90;car;5", "0.00;9;141;100;90;car;5",
        "1.00;7_part1;100;100;90;car;5", "1.00;9;145;100;90;car;5",
    ]  # fmt: skip
    path = tmp_path / "fcd.csv"
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")
    node = Junction(text="", where="", id="J", type="traffic_light", at_m=(100.0, 100.0), incoming_lanes=())
    counts = town_districts.count_vehicles(path, [node], frames=2, frame_period_s=1.0)
    assert counts == {"J": JunctionTraffic(flow_per_h=2 * 1800.0, vehicles=1.5)}
