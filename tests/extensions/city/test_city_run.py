"""City runs and city plans: equal to separate runs of the junctions, and the best of all choices of sites."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.core.errors import InputError, RunError
from egvs.extensions.city import city_run, model, results, traffic_split
from egvs.extensions.city.city_run import CityRunOptions, overlap_warnings
from egvs.extensions.city.model import City
from egvs.extensions.city.region_checks import RegionChecks
from egvs.extensions.city.tasks import Job
from egvs.placement.plan import JointScore
from egvs.runs import run
from egvs.traffic import recording
from tests.extensions.city.real_cluster import START_TIMEOUT_S, RealCluster, wait_until

pytestmark = pytest.mark.system
NOTICED_COLUMNS = ("noticed", "noticed_low", "noticed_high")
HAS_COSTS = ("report.html", "run.json", "costs.json", ".lock", ".digests.json")


def read_files(out: Path) -> dict[str, bytes]:
    """Return all files of a city run without costs in them."""
    paths = [path for path in out.rglob("*") if path.is_file() and path.name not in HAS_COSTS]
    return {str(path.relative_to(out)): path.read_bytes() for path in paths}


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_city_run_equals_separate_runs(city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = city_run.run_city(city, tmp_path / "out")
    assert [result.junction.id for result in ran.results] == ["west", "east"]
    for junction in city.junctions:
        with monkeypatch.context() as patch:
            patch.setenv("EGVS_STORE", str(tmp_path / "separate store"))
            run.run(egvs.load(junction.scenario_folder(city)), tmp_path / "separate" / junction.id)
        for path in (tmp_path / "separate" / junction.id).glob("*.p*"):
            assert path.read_bytes() == (results.junction_run_folder(ran.out, junction.id) / path.name).read_bytes()
    first = read_files(ran.out)
    monkeypatch.setenv("EGVS_STORE", str(tmp_path / "another store"))
    again = city_run.run_city(city, tmp_path / "again")
    assert read_files(again.out) == first


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_joins_scores_and_ranks_junctions(city: City, tmp_path: Path) -> None:
    sites = city.folder / "junctions" / "east" / "sites.csv"
    head, *rows = sites.read_text().splitlines()
    sites.write_text("\n".join([f"{head},owner", *(f"{row},city" for row in rows), ""]))  # a column of one junction
    ran = city_run.run_city(model.load_city(city.folder), tmp_path / "out")
    scores = results.read_city_scores(ran.out)
    assert scores.column("junction").to_pylist() == ["east", "east", "west", "west"]
    assert scores.column("owner").to_pylist() == ["city", "city", None, None]
    assert pq.read_table(ran.out / "scores" / "junction_west.parquet").num_rows == 2
    table, metadata = parquet.read_artefact(ran.out / "junctions.parquet", "city")
    assert metadata["rank_by"] == "egvs"
    best = {name: max(s["egvs"] for s in scores.to_pylist() if s["junction"] == name) for name in ("east", "west")}
    for row in table.to_pylist():
        assert row["egvs"] == row["score"] == best[row["junction"]]
    assert table.column("rank").to_pylist() == [1, 2]
    for row in table.to_pylist():  # both numbers of the best site
        (site,) = (s for s in scores.to_pylist() if (s["junction"], s["site"]) == (row["junction"], row["best"]))
        assert [row[name] for name in NOTICED_COLUMNS] == [site[name] for name in NOTICED_COLUMNS]
    html = (ran.out / "city.html").read_text()
    assert re.findall(r'href="(junctions/\w+/report\.html)"', html)[-2:] == [
        "junctions/west/report.html", "junctions/east/report.html",
    ]  # fmt: skip
    assert all((ran.out / link).is_file() for link in re.findall(r'href="(junctions/[^"]+)"', html))
    assert "http" not in re.sub(r"arXiv|http://www.w3.org/2000/svg", "", html)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_command_prints_junctions_and_files(city: City, tmp_path: Path, run_egvs: Any) -> None:
    out = tmp_path / "out"
    code, printed, _ = run_egvs("city", "run", city.folder, "--out", out)
    assert code == 0
    rows = [line.split() for line in printed.splitlines()]
    assert [row[1] for row in rows if row[0] in ("1", "2")] == ["west", "east"]
    assert rows[-2:] == [[str(out / "city.html")], [str(out / "costs.json")]]
    assert not list((tmp_path / "town").glob(".egvs*"))
    assert not list((tmp_path / "out").glob(".egvs*"))


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_verbose_prints_times_and_memory_of_every_process(city: City, tmp_path: Path, run_egvs: Any) -> None:
    code, printed, _ = run_egvs("city", "run", city.folder, "--out", tmp_path / "out", "--verbose")
    assert code == 0
    costs = json.loads((tmp_path / "out" / "costs.json").read_text())
    parts = [part for part in costs["parts"] if not part["within"]]
    assert [part["part"] for part in parts] == ["start of the workers", "traffic", "junctions", "tables", "page"]
    assert all(before["end_s"] <= after["start_s"] for before, after in pairwise(parts))
    (split,) = (part for part in costs["parts"] if part["part"] == "split")  # SUMO does not run for a finished file
    assert split["within"] == "traffic"
    assert parts[1]["start_s"] <= split["start_s"] <= split["end_s"] <= parts[1]["end_s"]
    assert {stage["stage"] for stage in costs["stages"]} >= {*STAGE_NAMES}
    assert [costs["size"][key] for key in ("city_junctions", "junctions", "sites", "frames")] == [2, 2, 4, 60]
    assert all(size > 0 for size in costs["size"].values())
    assert all(stage["peak_mb"] > 0 for stage in costs["stages"])
    names = [process["process"] for process in costs["processes"]]
    assert names[0] == "egvs"
    assert sum(name.startswith("worker inproc://") for name in names) == 2
    assert all(process["peak_mb"] > 50 for process in costs["processes"])
    assert all(name in printed for name in [*names, "tables", "peak MB"])


def test_rejects_overrides_of_traffic(city: City, tmp_path: Path) -> None:
    for override in ("traffic.frames=5", "traffic.periods.rush.weight=2", "traffic = {}"):
        with pytest.raises(InputError) as caught:
            city_run.run_city(city, tmp_path / "out", CityRunOptions(overrides=["score.gamma=2", override]))
        assert str(caught.value).startswith(f"--set {override}: the traffic of a city is simulated once")
        assert f" in {city.file} instead" in str(caught.value)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_runs_one_junction_with_overrides(city: City, tmp_path: Path) -> None:
    city_run.run_city(city, tmp_path / "out")
    options = CityRunOptions(junctions=["east"], overrides=["score.gamma=2"])
    ran = city_run.run_city(city, tmp_path / "out", options)
    assert [result.junction.id for result in ran.results] == ["east"]
    assert [path.name for path in (ran.out / "scores").iterdir()] == ["junction_east.parquet"]
    assert egvs.load(city.folder / "junctions" / "east").score.gamma == 4  # overridden, not written
    assert '"gamma": 2' in (results.junction_run_folder(ran.out, "east") / "run.json").read_text()
    with pytest.raises(InputError, match=r"--junction north: no such junction in .* Use one of west, east"):
        city_run.run_city(city, tmp_path / "out", CityRunOptions(junctions=["north"]))


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_overrides_have_a_folder_of_their_own(
    city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    for overrides in ([], ["score.gamma=2.0"], ["score.gamma = 2"]):
        city_run.run_city(city, None, CityRunOptions(overrides=overrides))
    names = {city.name, f"{city.name}@gamma=2"}
    assert {path.name for path in Path("runs").iterdir()} == names
    code, printed, _ = run_egvs("runs")
    assert code == 0
    assert {line.split()[0] for line in printed.splitlines() if "city run" in line} == names
    assert "complete" in run_egvs("runs", f"runs/{city.name}@gamma=2/junctions")[1]


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_losses_act_as_in_single_runs(city: City, tmp_path: Path) -> None:
    rated = ["sensors.small.rated_range_m=30", "sensors.small.rated_reflectivity=0.1"]
    scores = []
    for setting in ([], ["effects.range_limit={}"], ["effects.range_limit=false"]):
        ran = city_run.run_city(city, tmp_path / f"out{len(scores)}", CityRunOptions(overrides=[*rated, *setting]))
        folder = results.junction_run_folder(ran.out, "west")
        scores.append(egvs.read_scores(folder / "scores.parquet")["egvs"].to_pylist())
    assert scores[0] == scores[1]
    assert all(a < b for a, b in zip(scores[0], scores[2], strict=True))


def test_invalid_override_writes_nothing(city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(city.folder.rglob("*"))
    with pytest.raises(InputError, match=r"--set: score\.gama: unknown key"):
        city_run.run_city(city, None, CityRunOptions(overrides=["score.gama=2"]))
    assert not Path("runs").exists()
    assert sorted(city.folder.rglob("*")) == before


def test_checks_cluster_before_simulating(city: City, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--cluster: .* got 'nowhere'"):
        city_run.run_city(city, tmp_path / "out", CityRunOptions(cluster="nowhere"))
    assert not (city.folder / "traffic" / traffic_split.RECORD_FILE).exists()


def score_every_set(city: City, folder: Path) -> dict[tuple[str, str], float]:
    """Return the joint score of every set of sites of each junction, by junction and names."""
    scores = {}
    for junction in city.junctions:
        scenario = egvs.load(junction.scenario_folder(city))
        joint = JointScore.of(scenario, folder / junction.id)
        for count in range(len(joint.candidates) + 1):
            for names in combinations(joint.candidates, count):
                joint.remove(*joint.chosen)
                joint.add(*names)
                scores[junction.id, " ".join(sorted(names))] = joint.value
    return scores


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
@pytest.mark.parametrize("count", [1, 2, 3])
def test_plan_is_best_of_all_choices(city: City, tmp_path: Path, count: int) -> None:
    placed = city_run.place_city(city, tmp_path / "out", count=count)
    scores = score_every_set(city, tmp_path / "separate")
    best = max(
        a + b
        for (one, names), a in scores.items() if one == "west"
        for (other, others), b in scores.items() if other == "east"
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
@pytest.mark.usefixtures("in_process_cluster")
def test_page_keeps_plan_until_junctions_change(city: City, tmp_path: Path) -> None:
    city_run.place_city(city, tmp_path / "out", count=2)
    page = tmp_path / "out" / "city.html"
    with_plan = page.read_bytes()
    city_run.run_city(city, tmp_path / "out")
    assert page.read_bytes() == with_plan
    city_run.run_city(city, tmp_path / "out", CityRunOptions(overrides=["roi.voxel_m=1"]))
    assert "The plan:" not in page.read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_command_prints_phases_and_page_shows_curve(city: City, tmp_path: Path, run_egvs: Any) -> None:
    arguments = ("--set", 'score.rank_by="expected_detections"', "--out", tmp_path / "out")
    code, printed, _ = run_egvs("city", "place", city.folder, "--count", "3", "--phases", "1", *arguments)
    assert code == 0
    assert "standard error: " in printed
    assert "phase 1: " in printed and "phase 2: " in printed
    curve, metadata = parquet.read_artefact(tmp_path / "out" / "curve.parquet", "city_curve")
    rows, sensors = curve.to_pylist(), pq.read_table(tmp_path / "out" / "plan.parquet").to_pylist()
    assert [row["limit"] for row in rows] == [0.0, 1.0, 2.0, 3.0]
    assert [row["installed"] for row in rows[1:]] == pytest.approx([sensor["score"] for sensor in sensors])
    assert all(row["score"] >= row["installed"] * (1 - 1e-12) for row in rows)
    assert all(row["score_se"] > 0 for row in rows[1:])
    assert [sensor["phase"] for sensor in sensors] == [1, 2, 2]
    assert metadata["plan"]["phases"] == [1, 3]
    page_file = tmp_path / "out" / "city.html"
    html = page_file.read_text()
    assert "How many sensors are enough?" in html and "<h3>Phases</h3>" in html and "curve-band" in html

    read = results.read_plan(tmp_path / "out", [junction.id for junction in city.junctions])
    assert read is not None and read.has_errors and len(read.by_phase) == 2
    (tmp_path / "out" / "curve.parquet").unlink()
    assert results.read_plan(tmp_path / "out", [junction.id for junction in city.junctions]) is None


@pytest.mark.parametrize("phases", ["2,1", "0,3", "4", "1,1"])
def test_rejects_phases_that_do_not_ascend_to_the_count(city: City, tmp_path: Path, phases: str) -> None:
    numbers = [int(number) for number in phases.split(",")]
    with pytest.raises(InputError, match=rf"--phases {phases}: expected ascending numbers .* to the count of 3"):
        city_run.place_city(city, tmp_path / "out", count=3, phases=numbers)
    with pytest.raises(InputError, match="phases are numbers of sensors, so they need --count"):
        city_run.place_city(city, tmp_path / "out", budget=3.0, phases=numbers)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_plans_within_budget(city: City, tmp_path: Path) -> None:
    with pytest.raises(Exception, match="the cost of site pole_a is unknown"):
        city_run.place_city(city, tmp_path / "out", budget=20.0)
    with_costs = CityRunOptions(overrides=['costs.sensor={"small"=8}', "costs.pole=4"])
    placed = city_run.place_city(city, tmp_path / "out", with_costs, budget=25.0)
    assert [sensor.cost for sensor in placed.plan.sensors] == [12.0, 12.0]
    assert placed.plan.cost == 24.0
    assert not city_run.place_city(city, tmp_path / "out", with_costs, budget=11.0).plan.sensors


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
@pytest.mark.parametrize("score", ["expected_detections", "coverage"])
def test_gain_is_score_times_vehicles(city: City, tmp_path: Path, score: str) -> None:
    options = CityRunOptions(overrides=[f'score.rank_by="{score}"'])
    placed = city_run.place_city(city, tmp_path / "out", options, count=1)
    first, (sensor,) = placed.city_run.results[0], placed.plan.sensors
    assert first.gain == first.score * first.vehicles > 0
    assert (sensor.junction, sensor.site) == (first.junction.id, first.best.site)
    assert sensor.gain == pytest.approx(first.gain, rel=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
@pytest.mark.parametrize(
    ("request_", "overrides", "message"),
    [
        ({}, [], "--count, --budget: expected exactly one of the two, got neither"),
        ({"count": 1, "budget": 5.0}, [], "--count, --budget: expected exactly one of the two, got count and budget"),
        ({"budget": -1.0}, [], "--budget: expected a cost above 0, got -1"),
        ({"count": 1}, ["placement.survives=1"], "placement.survives: has no effect in a city"),
        ({"count": 1}, ['placement.forced=["pole_a", "pole_b"]'], "--count 1: 4 sensors are already installed"),
    ],
)
def test_rejects_impossible_request(
    city: City, tmp_path: Path, request_: dict[str, object], overrides: list[str], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        city_run.place_city(city, tmp_path / "out", CityRunOptions(overrides=overrides), **request_)  # type: ignore[arg-type]
    assert message in str(caught.value)


def test_warns_about_overlapping_regions(city: City) -> None:
    jobs = [Job(j.id, j.scenario_folder(city), Path("out")) for j in city.junctions]
    assert not list(overlap_warnings(jobs))
    path = city.folder / "junctions" / "east" / "scenario.toml"
    path.write_text(path.read_text().replace("center_m = [520,", "center_m = [50,"))
    (warning,) = overlap_warnings(jobs)
    assert "the regions of west and east overlap" in str(warning)
    assert model.load_city(city.folder).name == "town"


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_junction_with_locked_traffic_is_left_out(city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All others are ranked, and nothing is simulated again."""
    reasons = {"east": "a car stood there"}
    monkeypatch.setattr(RegionChecks, "check_teleports", lambda checks, _: checks.locked.update(reasons))
    first = city_run.run_city(city, tmp_path / "out")
    assert [result.junction.id for result in first.results] == ["west"]
    (warning,) = [warning for warning in first.warnings if warning.rule == "junctions left out"]
    assert warning.problem == "east is left out, because a car stood there"
    assert not city.junction("east").traffic_file(city).exists()
    assert not results.junction_run_folder(tmp_path / "out", "east").exists()
    assert "east is left out" in (tmp_path / "out" / "city.html").read_text()

    monkeypatch.setattr(recording, "record_traffic", None)
    again = city_run.place_city(city, tmp_path / "out", count=1)
    assert {sensor.junction for sensor in again.plan.sensors} == {"west"}
    assert again.plan.junctions == 1
    with pytest.raises(InputError, match="all junctions that were selected are left out"):
        city_run.run_city(city, tmp_path / "out", CityRunOptions(junctions=["east"]))


def test_city_with_locked_traffic_everywhere_is_rejected(city: City, monkeypatch: pytest.MonkeyPatch) -> None:
    reasons = {"west": "a car stood there", "east": "a bus stood there"}
    monkeypatch.setattr(RegionChecks, "check_teleports", lambda checks, _: checks.locked.update(reasons))
    with pytest.raises(RunError, match="no junction can be ranked: west: a car stood there; east: a bus stood there"):
        traffic_split.make_city_traffic(city)
    assert not (city.folder / "traffic" / traffic_split.RECORD_FILE).exists()


def test_quiet_period_leaves_no_junction_out(city: City) -> None:
    """No vehicle is near the eastern junction at night, but there are some in the day."""
    without_far = [line for line in (city.folder / "fcd.csv").read_text().splitlines() if ";far;" not in line]
    (city.folder / "night.csv").write_text("\n".join([*without_far, ""]))
    periods = "".join(
        f'\n[[traffic.periods]]\nname = "{name}"\nfcd = "{file}.csv"\nlength_s = 30.0\n'
        for name, file in (("day", "fcd"), ("night", "night"))
    )
    toml = city.folder / "city.toml"
    without_record = toml.read_text().replace('fcd = "fcd.csv"\n', "").replace("frames = 60\n", "")
    toml.write_text(without_record.replace("\n[[traffic.kinds]]", periods + "\n[[traffic.kinds]]", 1))
    assert not traffic_split.make_city_traffic(model.load_city(city.folder)).left_out


def test_score_decides_whether_empty_junction_is_left_out(city: City) -> None:
    """The traffic is the same, so nothing is simulated again, and the files are kept."""
    fcd = city.folder / "fcd.csv"
    without_far = [line for line in fcd.read_text().splitlines() if ";far;" not in line]
    fcd.write_text("\n".join([*without_far, ""]))
    by_detections = traffic_split.make_city_traffic(city, overrides=["score.rank_by=expected_detections"])
    assert by_detections.is_new
    assert by_detections.left_out == {"east": "only 0 vehicles are in its region of interest at a time (at least 0.02)"}
    (warning,) = [warning for warning in by_detections.summary["warnings"] if warning["rule"].startswith("junctions")]
    assert warning["problem"].startswith("east is left out, because only 0 vehicles")

    by_entropy = traffic_split.make_city_traffic(city, overrides=["score.rank_by=egvs"])
    assert not by_entropy.is_new
    assert not by_entropy.left_out
    rules = [warning["rule"] for warning in by_entropy.summary["warnings"]]
    assert "junctions without traffic" in rules
    assert "junctions left out" not in rules


@pytest.mark.slow
def test_killed_scheduler_leaves_a_run_that_continues_with_same_bytes(
    city: City, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    first = RealCluster(tmp_path_factory.mktemp("first"))
    out = tmp_path / "out"
    try:
        first.start_worker("one")
        command = start_city_run(city, out, first)
        wait_until(lambda: any(out.glob("junctions/*/statics.ply")))
        first.kill_scheduler()
        _, errors = command.communicate(timeout=START_TIMEOUT_S)
    finally:
        first.close()
    assert command.returncode == 1
    message = "the connection to the scheduler at tcp://.* was lost. Run the same command again to continue"
    assert re.search(message, errors)
    assert "Traceback" not in errors
    assert not any((out / name).exists() for name in ("city.html", "junctions.parquet", "scores", "costs.json"))
    hidden = {path.name for path in out.rglob(".*")}
    assert hidden <= {".lock", ".digests.json"}

    second = RealCluster(tmp_path_factory.mktemp("second"))
    try:
        second.start_worker("two")
        command = start_city_run(city, out, second)
        _, errors = command.communicate(timeout=START_TIMEOUT_S)
        assert command.returncode == 0, errors
        undisturbed = start_city_run(city, tmp_path / "undisturbed", second, store=tmp_path / "another store")
        _, errors = undisturbed.communicate(timeout=START_TIMEOUT_S)
        assert undisturbed.returncode == 0, errors
    finally:
        second.close()
    assert read_files(out) == read_files(tmp_path / "undisturbed")


def start_city_run(city: City, out: Path, cluster: RealCluster, store: Path | None = None) -> subprocess.Popen[str]:
    """Start ``egvs city run`` on a cluster, with the store of the tests or another one."""
    words = ["city", "run", city.folder, "--out", out, "--cluster", cluster.client.scheduler.address]
    environment = dict(os.environ) if store is None else {**os.environ, "EGVS_STORE": str(store)}
    command = [sys.executable, "-m", "egvs", *map(str, words)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
