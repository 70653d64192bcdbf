"""Plans of a whole city, against every choice of sites and against plans of single junctions."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.city import city_run, model
from egvs.city.city_run import overlap_warnings
from egvs.city.model import City
from egvs.city.tasks import Job
from egvs.core.errors import InputError
from egvs.placement.plan import JointScore

pytestmark = pytest.mark.usefixtures("here")


def every_set(city: City, folder: Path) -> dict[tuple[str, str], float]:
    """The joint score of every set of sites of each junction, as (junction, names)."""
    worth = {}
    for junction in city.junctions:
        scenario = egvs.load(junction.scenario_folder(city))
        joint = JointScore.of(scenario, folder / junction.id)
        for count in range(len(joint.candidates) + 1):
            for names in combinations(joint.candidates, count):
                joint.remove(*joint.chosen)
                joint.add(*names)
                worth[junction.id, " ".join(sorted(names))] = joint.value
    return worth


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3])
def test_no_choice_of_sites_is_better(city: City, tmp_path: Path, count: int) -> None:
    placed = city_run.place_city(city, tmp_path / "out", count=count)
    worth = every_set(city, tmp_path / "alone")
    best = max(
        a + b
        for (one, names), a in worth.items() if one == "west"
        for (other, others), b in worth.items() if other == "east"
        if len(names.split()) + len(others.split()) <= count
    )  # fmt: skip
    assert placed.plan.joint == pytest.approx(best, rel=1e-12)
    assert placed.plan.bound >= best
    assert len(placed.plan.sensors) <= count
    rows = pq.read_table(tmp_path / "out" / "plan.parquet").to_pylist()
    assert [row["order"] for row in rows] == list(range(1, len(rows) + 1))
    assert rows[-1]["score"] == pytest.approx(best, rel=1e-12)
    gains = [row["gain"] for row in rows]
    assert gains == sorted(gains, reverse=True)
    html = (tmp_path / "out" / "city.html").read_text()
    assert f"The plan: {len(rows)} sensors" in html


@pytest.mark.slow
def test_a_plan_stands_on_the_page_until_its_junctions_change(city: City, tmp_path: Path) -> None:
    city_run.place_city(city, tmp_path / "out", count=2)
    page = tmp_path / "out" / "city.html"
    planned = page.read_bytes()
    city_run.run_city(city, tmp_path / "out")
    assert page.read_bytes() == planned
    city_run.run_city(city, tmp_path / "out", sets=["roi.voxel_m=1"])
    assert "The plan:" not in page.read_text()


@pytest.mark.slow
def test_a_budget_needs_costs_and_is_kept(city: City, tmp_path: Path) -> None:
    with pytest.raises(Exception, match="the cost of site pole_a is unknown"):
        city_run.place_city(city, tmp_path / "out", budget=20.0)
    costs = ['costs.sensor={"small"=8}', "costs.pole=4"]
    placed = city_run.place_city(city, tmp_path / "out", budget=25.0, sets=costs)
    assert [sensor.cost for sensor in placed.plan.sensors] == [12.0, 12.0]
    assert placed.plan.cost == 24.0
    assert not city_run.place_city(city, tmp_path / "out", budget=11.0, sets=costs).plan.sensors


@pytest.mark.slow
@pytest.mark.parametrize("score", ["expected_detections", "coverage"])
def test_shares_count_by_the_vehicles_that_are_there(city: City, tmp_path: Path, score: str) -> None:
    placed = city_run.place_city(city, tmp_path / "out", count=1, sets=[f'score.rank_by="{score}"'])
    first, (sensor,) = placed.city_run.results[0], placed.plan.sensors
    assert first.gain == first.score * first.vehicles > 0
    assert (sensor.junction, sensor.site) == (first.junction.id, first.best.site)
    assert sensor.gain == pytest.approx(first.gain, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "--count, --budget: neither is given"),
        ({"count": 1, "budget": 5.0}, "--count, --budget: both are given"),
        ({"budget": -1.0}, "--budget: -1; a cost above 0"),
        ({"count": 1, "sets": ["placement.survives=1"]}, "placement.survives: a plan of the whole city adds up"),
        ({"count": 1, "sets": ['placement.forced=["pole_a", "pole_b"]']}, "--count 1: 4 sensors are there already"),
    ],
)
def test_what_cannot_be_asked(city: City, tmp_path: Path, asked: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as refused:
        city_run.place_city(city, tmp_path / "out", **asked)  # type: ignore[arg-type]
    assert message in str(refused.value)


def test_regions_that_overlap_are_told(city: City) -> None:
    jobs = [Job(j.id, j.scenario_folder(city), Path("out")) for j in city.junctions]
    assert not list(overlap_warnings(jobs))
    path = city.folder / "junctions" / "east" / "scenario.toml"
    path.write_text(path.read_text().replace("center_m = [520,", "center_m = [50,"))
    (found,) = overlap_warnings(jobs)
    assert "the regions of west and east overlap" in str(found)
    assert model.load_city(city.folder).name == "town"
