"""The table of the straight road: beams that end on the road, cars that nothing hides, and the file of the docs."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from benchmarks import straight_road

from egvs.scoring.target_scores import DETECTORS


def test_beams_end_on_the_road_or_at_their_range() -> None:
    sensor = straight_road.stand_in(16)
    ends_m = straight_road.road_beams(sensor).ends_m
    length_m = np.linalg.norm(ends_m, axis=1)
    on_road = length_m < sensor.range_m * (1.0 - 1e-12)
    assert ends_m[on_road, 2] == pytest.approx(-straight_road.HEIGHT_M)
    # -1 degree meets the road after 86 m, as do all lower rings; upper rings reach the range of 100 m
    assert np.unique(length_m[on_road].round(1)).tolist() == pytest.approx(
        [round(1.5 / np.sin(np.radians(angle)), 1) for angle in (15, 13, 11, 9, 7, 5, 3, 1)]
    )
    assert on_road.mean() == 0.5


def test_cars_stand_on_both_lanes_and_hide_one_another_nowhere() -> None:
    record = straight_road.cars()
    assert len(record) == 2 * 321 and sorted(set(record.boxes[:, 1].tolist())) == list(straight_road.LANES_M)
    assert (np.diff(record.all_boxes.starts) == 1).all()  # one in each frame
    assert np.isinf(record.gap_m).all()


def test_the_file_of_the_docs_is_what_the_command_writes(tmp_path: Path) -> None:
    """The rows of the sensor with 16 beams."""
    table = straight_road.rows((16,))
    straight_road.write_table(tmp_path / "table.csv", table)
    written = (tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()
    committed = straight_road.TABLE.read_text(encoding="utf-8").splitlines()
    assert written == [line for line in committed if not line.startswith(("32,", "80,", "128,"))]
    assert written[0].split(",")[5:8] == [*DETECTORS, "noticed"]
    assert [(row.centerpoint, row.second) for row in table] == [(0.89, 0.85), (0.17, 0.05), (None, None), (None, None)]


def test_the_page_says_how_far_levels_are_from_published_recall() -> None:
    noticed: dict[tuple[int, int], float] = {}
    missed: dict[str, list[float]] = {detector: [] for detector in DETECTORS}
    with straight_road.TABLE.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if not row["published_second"]:
                continue
            beams, start_m = int(row["beams"]), int(row["from_m"])
            published = (float(row["published_centerpoint"]) + float(row["published_second"])) / 2
            noticed[beams, start_m] = 100 * (float(row["noticed"]) - published)
            if beams in (32, 128) and start_m >= 40:
                for detector in DETECTORS:
                    missed[detector].append(100 * (published - float(row[detector])))
    too_high = noticed.pop((16, 20))
    limit = math.ceil(max(abs(points) for (beams, _), points in noticed.items() if beams > 16))
    ranges = [f"{min(points):.0f} to {max(points):.0f} (`{name}`)" for name, points in missed.items()]
    page = (straight_road.ROOT / "docs" / "validity.md").read_text(encoding="utf-8")
    assert f"within {limit} points with 32 to 128 beams, and {too_high:.0f} too high with 16 beams" in page
    assert f"the models expect {ranges[0]} and {ranges[1]} points less" in page
