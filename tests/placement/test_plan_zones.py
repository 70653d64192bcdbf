"""What a plan finds in zones: against a loop over road users, and beside what each sensor finds alone."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely

import egvs
from egvs.artefacts import readers
from egvs.cli import place as place_cli
from egvs.core.errors import InputError
from egvs.placement import plan
from egvs.runs.run_context import open_folder
from egvs.scenario import loading
from egvs.scoring.target_scores import detection_chances
from egvs.stages import site_scoring
from egvs.stages.site_scans import empty_scans
from tests.conftest import collection, feature

BOXES = {"west": (0.0, -10.0, 20.0, 10.0), "lane": (0.0, -4.0, 40.0, 0.0)}
KEYS = ("score.zones='zones.geojson'", "score.rank_by='expected_detections'", "placement.count=2")


@pytest.fixture
def scenario(mini: Path) -> egvs.Scenario:
    features = []
    for name, (west, south, east, north) in BOXES.items():
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        features.append(feature({"type": "Polygon", "coordinates": [ring]}, name=name))
    (mini / "zones.geojson").write_text(collection(*features))
    return loading.load(mini, KEYS)


@pytest.mark.slow
def test_plan_finds_what_any_of_its_sensors_finds(
    scenario: egvs.Scenario, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    egvs.run(scenario, tmp_path, jobs=1)
    placed = plan.place(scenario, tmp_path, jobs=1)
    assert len(placed.sensors) == 2

    context = open_folder(scenario, tmp_path, jobs=1)
    targets = site_scoring.SiteScoring(context).targets
    assert targets is not None
    chances = [detection_chances(targets.visible(scan.beams)) for scan in empty_scans(context)]
    expected = defaultdict(list)
    for row, (x_m, y_m) in enumerate(targets.record.boxes[:, :2].tolist()):
        missed = math.prod(1.0 - of_site[row] for of_site in chances)
        for name, corners in BOXES.items():
            if shapely.box(*corners).covers(shapely.Point(x_m, y_m)):
                expected[name].append(1.0 - missed)

    alone = pq.read_table(tmp_path / "zones.parquet").to_pylist()
    rows = pq.read_table(tmp_path / "plan_zones.parquet").to_pylist()
    assert [row["zone"] for row in rows if row["class"] == "all"] == list(BOXES)
    for row in rows:
        assert row["share_found"] == pytest.approx(np.mean(expected[row["zone"]]), abs=1e-12)
        of_sites = [s["share_found"] for s in alone if (s["zone"], s["class"]) == (row["zone"], row["class"])]
        assert row["best_single"] == max(of_sites)
        assert row["share_found"] > row["best_single"]
    assert tmp_path / "plan_zones.parquet" in placed.files
    read = readers.read_plan_zones(tmp_path / "plan_zones.parquet")
    assert repr(list(placed.zone_results)) == repr(read)  # NaN equals NaN here

    place_cli.print_placement(placed, scenario.placement)
    assert "plan_zones.parquet" in capsys.readouterr().out
    (tmp_path / "plan_zones.parquet").write_bytes(b"")
    with pytest.raises(InputError, match="plan_zones"):
        readers.read_placement(tmp_path / "placement.parquet", tmp_path / "curve.parquet")


@pytest.mark.slow
def test_refined_plan_is_scanned_anew(scenario: egvs.Scenario, tmp_path: Path) -> None:
    still = plan.place(scenario, tmp_path, jobs=1)
    keys = (*KEYS, "placement.refine={radius_m=1, evaluations=20}")
    moved = plan.place(loading.load(scenario.folder, keys), tmp_path, jobs=1)
    assert moved.refinement is not None
    assert moved.joint >= still.joint
    assert [row.zone for row in moved.zone_results] == [row.zone for row in still.zone_results]
    assert [row.share for row in moved.zone_results] != [row.share for row in still.zone_results]


def test_plan_without_zones_leaves_no_table(scenario: egvs.Scenario, tmp_path: Path) -> None:
    plan.place(scenario, tmp_path, jobs=1)
    without = loading.load(scenario.folder, KEYS[1:])
    assert plan.place(without, tmp_path, jobs=1).zone_results == ()
    assert not (tmp_path / "plan_zones.parquet").exists()
