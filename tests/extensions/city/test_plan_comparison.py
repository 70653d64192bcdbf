"""Comparing plans for several traffic demands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.extensions.city import city_run, model
from egvs.extensions.city.model import City
from egvs.extensions.city.plan_comparison import CommonShares, PlanComparison, compare_plans
from egvs.extensions.city.results import CityPlan, junction_run_folder, mean_vehicles
from egvs.placement.plan import JointScore
from egvs.results.plans import PlannedSensor


def make_plan(*sensors: str) -> CityPlan:
    """Return a plan of sensors that are named JUNCTION/POLE/SITE."""
    rows = []
    for number, name in enumerate(sensors, start=1):
        junction, pole, site = name.split("/")
        pose = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
        rows.append(PlannedSensor(number, site, pole, *pose, "VLP-16", False, 1.0, 1.0, 0.0, junction=junction))
    return CityPlan(tuple(rows), "egvs", {"count": 4.0}, 4.0, 4.0, 4.0, 9, 2)


def test_shares_of_common_sensors() -> None:
    light = make_plan("a/p1/x", "a/p2/y", "b/p1/x", "b/p1/z")
    usual = make_plan("a/p1/x", "a/p2/w", "b/p1/x", "c/p1/x")
    heavy = make_plan("a/p1/v", "b/p1/x", "c/p1/x", "c/p2/x")
    values = np.array([[10.0, 18.0, 0.0], [9.0, 20.0, 0.0], [8.0, 10.0, 0.0]])
    comparison = PlanComparison((Path("l"), Path("u"), Path("h")), (light, usual, heavy), values)
    assert comparison.common(0, [1]) == CommonShares(0.5, 0.75, 0.75)  # one of two sensors at pole b/p1 is common
    assert comparison.common_to_all(0) == CommonShares(0.25, 0.5, 0.5)
    assert comparison.common_to_all(2) == CommonShares(0.25, 0.5, 0.5)
    expected = [[1.0, 0.9, np.nan], [0.9, 1.0, np.nan], [0.8, 0.5, np.nan]]
    np.testing.assert_allclose(comparison.relative_values, expected)


def set_traffic(city: City, cars: int) -> City:
    """Give the city other traffic: cars that stay in the east."""
    lines = (city.folder / "fcd.csv").read_text().splitlines()
    times = sorted({line.split(";")[0] for line in lines[1:]}, key=float)
    for time in times:
        for car in range(cars):
            x = 512 + 4 * car + 0.05 * float(time)
            lines.append(f"{time};more{car};{x:.6f};{-2 if car % 2 else 2};90.0;car;0.1")
    header, *rows = lines
    rows.sort(key=lambda line: float(line.split(";")[0]))
    (city.folder / "fcd.csv").write_text("\n".join([header, *rows, ""]))
    return model.load_city(city.folder)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_values_are_joint_scores_in_the_traffic_of_each_run(city: City, tmp_path: Path, run_egvs: Any) -> None:
    folders = [tmp_path / "usual", tmp_path / "heavy"]
    options = city_run.CityRunOptions(overrides=['score.rank_by="expected_detections"'])
    usual = city_run.place_city(city, folders[0], options, count=1).plan
    joint = {}
    for junction in ("west", "east"):  # while the city still has this traffic
        scenario = egvs.load(city.folder / "junctions" / junction, options.overrides)
        joint[junction] = JointScore.of(scenario, tmp_path / "separate" / junction)
    heavy = city_run.place_city(set_traffic(city, 3), folders[1], options, count=1).plan
    comparison = compare_plans(folders)
    assert np.diag(comparison.values) == pytest.approx([usual.joint, heavy.joint], rel=1e-12)
    assert (usual.sensors[0].junction, heavy.sensors[0].junction) == ("west", "east")
    assert comparison.common(0, [1]).junctions == 0.0
    (sensor,) = heavy.sensors
    joint["east"].add(sensor.site)
    vehicles = mean_vehicles(junction_run_folder(folders[0], "east"))
    assert comparison.values[1, 0] == pytest.approx(joint["east"].value * vehicles, rel=1e-12)

    code, printed, _ = run_egvs("city", "compare", *folders)
    assert code == 0
    assert "usual, heavy: 0 % of the sensors, 0 % of the poles and 0 % of the junctions in common" in printed
    assert f"({100 * (comparison.relative_values[1, 0]):.1f} %)" in printed

    with pytest.raises(InputError, match="expected two or more different folders"):
        compare_plans([folders[0], folders[0]])
    city_run.place_city(model.load_city(city.folder), folders[1], options, count=2)
    with pytest.raises(InputError, match=r"expected a plan for count 1 by expected_detections, as in .* got count 2"):
        compare_plans(folders)
    (folders[1] / "plan.parquet").unlink()
    with pytest.raises(InputError, match=r"plan.parquet: there is no plan"):
        compare_plans(folders)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_rejects_run_whose_sites_have_moved(city: City, tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        city_run.place_city(city, folder, city_run.CityRunOptions(overrides=["scan.keep=false"]), count=2)
    assert np.array_equal(compare_plans(folders).relative_values, np.ones((2, 2)))
    sites = city.folder / "junctions" / "west" / "sites.csv"
    header, *rows = sites.read_text().splitlines()
    moved = [",".join([name, x, str(float(y) - 3.0), z]) for name, x, y, z in (row.split(",") for row in rows)]
    sites.write_text("\n".join([header, *moved, ""]))
    with pytest.raises(InputError, match=r"a: the plan now scores .* instead of .*Run egvs city place again"):
        compare_plans(folders)


def test_rejects_folder_without_city_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="this is no folder of a city run"):
        compare_plans([tmp_path / "a", tmp_path / "b"])
