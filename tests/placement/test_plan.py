"""``egvs place`` on a small scenario: every rule, the files that it writes, and messages about wrong input."""

from __future__ import annotations

import html
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.core.errors import InputError
from egvs.drawing import svg_figures
from egvs.placement import problem_builder
from egvs.placement.problem_builder import rules_from_config
from egvs.scoring.egvs import EntropyField
from egvs.sensors.sites import Pose, Site, candidate_sites

SITES = """site,x_m,y_m,z_m,cost
a,10,12,3,
b,30.5,-12,3,
b_high,30.5,-12,5,
c,2,-12,4,70
d,38,12,4,
"""
ZONE = "placement.zones.crossing={polygon_m=[[5,-8],[12,-8],[12,8],[5,8]],share=%s,by=%s}"
THREE_SITES = """site,x_m,y_m,z_m,cost
a,10,12,3,
b,30.5,-12,3,
c,2,-12,4,70
"""
HALVES = 'traffic.periods=[{name="a",length_s=12},{name="b",begin_s=12,length_s=8}]'
WEIGHTED_HALVES = 'traffic.periods=[{name="a", length_s=12, weight=3}, {name="b", begin_s=12, length_s=8}]'


@pytest.fixture
def five_candidates(mini: Path) -> Path:
    """The small scenario with five candidates at four poles."""
    (mini / "sites.csv").write_text(SITES)
    return mini


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """The run's folder."""
    return tmp_path / "out"


def test_forced_and_excluded_may_name_poles(mini: Path) -> None:
    """People know their poles; the names of candidates have heights and tilts."""
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\nLaterne Süd,10,12,5\n")
    scenario = egvs.load(mini, ["placement.forced=['Laterne Süd']"])
    mounts = [
        Site(f"{pole}@{z_m}m", Pose(x_m, 12.0, z_m), "small", pole=pole)
        for pole, x_m, heights_m in (("Laterne Süd", 10.0, (5,)), ("Mast West", 20.0, (3, 5)))
        for z_m in heights_m
    ]
    assert rules_from_config(scenario, mounts).forced == (0,)
    excluded = rules_from_config(egvs.load(mini, ["placement.excluded=['Mast West']"]), mounts).excluded
    assert excluded.tolist() == [False, True, True]
    for name, message in (
        ("Mast West", r"pole 'Mast West' has 2 candidates. Choose one of Mast West@3m, Mast West@5m\."),
        ("Mast Ost", r"no candidate or pole 'Mast Ost'. Choose one of Mast West, Laterne Süd\."),
    ):
        with pytest.raises(InputError, match=message):
            rules_from_config(egvs.load(mini, [f"placement.forced=['{name}']"]), mounts)


def joint_egvs(five_candidates: Path, out: Path, *names: str) -> float:
    """Return the joint EGVS by its definition, from the hits that a run writes for each site."""
    scenario = egvs.load(five_candidates, ["score.keep_visibility='all'"])
    if not (out / "single" / "visibility.parquet").exists():
        egvs.run(scenario, out / "single")
    tpog = read_tpog(out / "single" / "tpog.parquet")
    hits = np.zeros(tpog.grid.shape)
    table, _ = parquet.read_artefact(out / "single" / "visibility.parquet", "visibility")
    for row in table.to_pylist():
        if row["site"] in names:
            hits[row["ix"], row["iy"], row["iz"]] += row["hits"]
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    return field.score(hits.ravel().astype(np.uint32), scenario.gamma).egvs


def sentences(printed: str) -> list[str]:
    """The lines that ``egvs place`` printed, without the files at the end."""
    return [line for line in printed.splitlines() if not line.endswith((".parquet", "report.html"))]


def read_tables(out: Path) -> tuple[list[dict], list[dict], dict]:
    """Return the rows of the plan and of the curve, and the summary of the plan."""
    rows, metadata = parquet.read_artefact(out / "placement.parquet", "placement")
    curve, curve_metadata = parquet.read_artefact(out / "curve.parquet", "curve")
    assert metadata == curve_metadata
    return rows.to_pylist(), curve.to_pylist(), metadata["plan"]


@pytest.mark.slow
def test_exact_plan_is_best_of_all_subsets(five_candidates: Path, out: Path, run_egvs) -> None:
    for count in (1, 2, 3):
        code, text, error = run_egvs("place", five_candidates, "--out", out, "--count", count, "--exact")
        assert code == 0, error
        rows, curve, plan = read_tables(out)
        best = max(
            joint_egvs(five_candidates, out, *names)
            for names in itertools.combinations(("a", "b", "b_high", "c", "d"), count)
        )
        assert rows[-1]["score"] == plan["joint"] == curve[-1]["score"] == best
        assert plan["is_best"]
        assert "proved: no plan within the rules is better" in text
        assert [row["count"] for row in curve] == list(range(1, count + 1))


@pytest.mark.slow
def test_plan_of_one_sensor_is_best_site_by_every_score(five_candidates: Path, out: Path) -> None:
    for score in ("egvs", "entropy_seen", "coverage", "expected_visibility", "points_on_target", "seen_well",
                  "expected_detections"):  # fmt: skip
        scenario = egvs.load(five_candidates, [f"score.rank_by='{score}'", "placement.count=1"])
        egvs.run(scenario, out / score)
        scores = read_scores(out / score / "scores.parquet")
        best = [
            site for site, rank in zip(scores["site"].to_pylist(), scores["rank"].to_pylist(), strict=True) if rank == 1
        ]
        placed = egvs.place(scenario, out / score, exact=True)
        assert placed.sensors[0].site in best
        value = max(scores[score].to_pylist())
        assert placed.joint == (pytest.approx(value, rel=1e-9) if score == "expected_detections" else value)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["effects.rain.rate_mm_h=20", "effects.divergence={}"])
def test_weighted_beams_count_up_to_gamma(effect: str, five_candidates: Path, out: Path) -> None:
    """With effects that weight beams, one sensor has its score of the run, and two that of the definition."""
    sets = [effect, "placement.count=2", "score.keep_visibility='all'"]
    scenario = egvs.load(five_candidates, sets)
    egvs.run(scenario, out)
    scores = {row["site"]: row["egvs"] for row in read_scores(out / "scores.parquet").to_pylist()}
    joint = egvs.JointScore.of(scenario, out)
    for name, site_egvs in scores.items():
        joint.add(name)
        assert joint.value == site_egvs
        joint.remove(name)
    tpog = read_tpog(out / "tpog.parquet")
    p = tpog.p
    entropy = np.zeros_like(p)
    inner = (p > 0) & (p < 1)
    entropy[inner] = -p[inner] * np.log2(p[inner]) - (1 - p[inner]) * np.log2(1 - p[inner])
    hits = sum(egvs.read_visibility(out / "visibility.parquet", name) for name in ("a", "b"))
    assert hits.max() > 2 * scenario.gamma
    joint.add("a", "b")
    assert joint.value == pytest.approx(float((entropy * np.minimum(hits, scenario.gamma)).sum()), rel=1e-12)


@pytest.mark.slow
def test_tables_are_consistent(five_candidates: Path, out: Path, run_egvs) -> None:
    code, _, error = run_egvs("place", five_candidates, "--out", out, "--count", 3)
    assert code == 0, error
    rows, curve, plan = read_tables(out)
    assert [row["order"] for row in rows] == [1, 2, 3]
    score_before = 0.0
    for i, row in enumerate(rows):
        assert row["score"] == joint_egvs(five_candidates, out, *(other["site"] for other in rows[: i + 1]))
        assert row["gain"] == row["score"] - score_before
        rest = [other["site"] for other in rows if other is not row]
        assert row["loss"] == plan["joint"] - joint_egvs(five_candidates, out, *rest)
        assert row["bound"] == curve[i]["bound"] >= row["score"]
        score_before = row["score"]
    assert [row["gain"] for row in rows] == sorted((row["gain"] for row in rows), reverse=True)
    assert plan["together"] == joint_egvs(five_candidates, out, "a", "b", "b_high", "c", "d")
    assert set(json.loads(curve[-1]["sites"])) == {row["site"] for row in rows}


@pytest.mark.slow
def test_budget_pays_each_pole_once_and_forced_sensors_never(five_candidates: Path, out: Path, run_egvs) -> None:
    """A sensor costs 20, a pole 50, a metre 1: a, b and d cost 73, 73 and 74, b_high 75, or 25 beside b; c is 70."""
    costs = ["--set", "costs.sensor.small=20", "--set", "costs.pole=50", "--set", "costs.metre=1"]
    code, _, error = run_egvs("place", five_candidates, "--out", out, "--budget", 98, "--exact", *costs)
    assert code == 0, error
    rows, _, plan = read_tables(out)
    assert {row["site"] for row in rows} == {"b", "b_high"}
    assert [row["cost"] for row in rows] in ([73.0, 25.0], [75.0, 23.0])
    assert plan["cost"] == 98.0
    code, _, error = run_egvs(
        "place", five_candidates, "--out", out, "--budget", 70, "--exact", *costs, "--set", "placement.forced=['a']"
    )
    assert code == 0, error
    rows, _, plan = read_tables(out)
    assert (rows[0]["site"], rows[0]["forced"], rows[0]["cost"]) == ("a", True, 0.0)
    assert rows[1]["site"] == "c"
    assert plan["cost"] == 70.0


def test_poles_that_exist_are_free_and_have_known_names(five_candidates: Path) -> None:
    costs = ["costs.sensor.small=20", "costs.pole=50", "costs.metre=1", "sites.existing_poles=['a', 'b']"]
    scenario = egvs.load(five_candidates, costs)
    cost, pole_cost = problem_builder.candidate_costs(scenario, candidate_sites(scenario))
    assert cost.tolist() == [23.0, 23.0, 25.0, 70.0, 74.0]
    assert pole_cost.tolist() == [0.0, 0.0, 0.0, 0.0, 50.0]
    with pytest.raises(egvs.InputError, match=r"sites\.existing_poles: there is no site 'b_high'"):
        candidate_sites(egvs.load(five_candidates, ["sites.existing_poles=['b_high']"]))


@pytest.mark.slow
def test_smallest_plan_that_reaches_share(five_candidates: Path, out: Path, run_egvs) -> None:
    code, text, error = run_egvs("place", five_candidates, "--out", out, "--reach", 0.9)
    assert code == 0, error
    rows, _, plan = read_tables(out)
    assert plan["joint"] >= 0.9 * plan["together"]
    assert f"proved: {len(rows) - 1} sensors are not enough" in text
    assert "sensor is needed to meet the requirements; it adds " in sentences(text)[-1]
    fewer = itertools.combinations(("a", "b", "b_high", "c", "d"), len(rows) - 1)
    assert max(joint_egvs(five_candidates, out, *names) for names in fewer) < 0.9 * plan["together"]


@pytest.mark.slow
def test_keeps_rules_and_zones(five_candidates: Path, out: Path, run_egvs) -> None:
    sets = ["placement.most_per_pole=1", "placement.excluded=['d']", "placement.least_distance_m=25"]
    arguments = [word for one in sets for word in ("--set", one)]
    code, _, error = run_egvs("place", five_candidates, "--out", out, "--count", 3, "--exact", *arguments)
    assert code == 0, error
    rows, _, _ = read_tables(out)
    names = {row["site"] for row in rows}
    assert not names & {"d"}
    assert len(names & {"b", "b_high"}) <= 1
    for one, other in itertools.combinations(rows, 2):
        assert math.dist(*([row[key] for key in ("x_m", "y_m", "z_m")] for row in (one, other))) >= 25
    code, text, error = run_egvs(
        "place", five_candidates, "--out", out, "--count", 2, "--exact", "--set", ZONE % (0.5, 2)
    )
    assert code == 0, error
    _, _, plan = read_tables(out)
    (zone,) = plan["zones"]
    assert zone["seen"] >= zone["share"] == 0.5
    assert "zone crossing:" in text
    assert "by 2 sensors, 50.0 % required" in text


@pytest.mark.slow
def test_survives_failure_of_one_sensor(five_candidates: Path, out: Path, run_egvs) -> None:
    code, _, error = run_egvs(
        "place", five_candidates, "--out", out, "--count", 3, "--exact", "--set", "placement.survives=1"
    )
    assert code == 0, error
    rows, curve, plan = read_tables(out)

    def value_after_failure(names: tuple[str, ...]) -> float:
        return min(joint_egvs(five_candidates, out, *(other for other in names if other != one)) for one in names)

    best = max(value_after_failure(names) for names in itertools.combinations(("a", "b", "b_high", "c", "d"), 3))
    assert plan["value"] == curve[-1]["value"] == best == value_after_failure(tuple(row["site"] for row in rows))


@pytest.mark.slow
def test_worst_of_named_periods(five_candidates: Path, out: Path, run_egvs) -> None:
    """The value of one period is its share of the score of all candidates; two periods have at most the lower one."""
    worst = {}
    for periods in ("a", "b", "a,b"):
        names = [f"'{name}'" for name in periods.split(",")]
        sets = [HALVES, "placement.objective='worst'", f"placement.periods=[{','.join(names)}]"]
        arguments = [word for one in sets for word in ("--set", one)]
        code, text, error = run_egvs("place", five_candidates, "--out", out, "--count", 2, "--exact", *arguments)
        assert code == 0, error
        worst[periods] = read_tables(out)[2]["value"]
        assert "; the plan maximises the score in the period with the lowest share." in sentences(text)[-1]
        assert "± is one standard error, from a: 4 blocks of 6 frames" in text
    assert 0.0 < worst["a,b"] <= min(worst["a"], worst["b"]) <= 1.0


REJECTED = {
    "nothing asked": (
        [],
        "placement: the number of sensors is not limited. Give --count 3, --budget 120000 or --reach 0.95",
    ),
    "count above candidates": (
        ["--count", "6"],
        "placement.count: expected at most 5, the number of candidates, got 6",
    ),
    "forced and excluded": (
        ["--count", "2", "--set", "placement.forced=['a']", "--set", "placement.excluded=['a']"],
        "a is both forced and excluded",
    ),
    "no such candidate": (
        ["--count", "2", "--set", "placement.forced=['nobody']"],
        "placement.forced: no candidate or pole 'nobody'. Choose one of b, d, a, c.",
    ),
    "budget below the cheapest": (
        ["--budget", "50", "--set", "costs.pole=60"],
        "placement.budget: expected at least 60, the cost of a, got 50",
    ),
    "none left": (
        ["--reach", "0.5", "--set", "placement.excluded=['a','b','b_high','c','d']"],
        "placement.excluded: every candidate is excluded",
    ),
    "a zone in the way of a reach": (
        ["--count", "1", "--reach", "0.01", "--set", ZONE % (0.5, 2)],
        "placement.zones: found no plan of 1 sensor that meets the requirements of all zones",
    ),
    "no costs": (
        ["--budget", "50"],
        'the cost of site a is unknown. Add a [costs] table, or a column "cost" to sites.csv.',
    ),
    "a sensor without a price": (
        ["--budget", "50", "--set", "costs.sensor.VLP-16=1"],
        "costs.sensor: the cost of sensor small (site a) is unknown",
    ),
    "forced ones too near": (
        ["--count", "2", "--set", "placement.forced=['b','b_high']", "--set", "placement.least_distance_m=5"],
        "placement.forced: b, b_high break most_per_pole or least_distance_m",
    ),
    "fewer than forced": (
        ["--count", "1", "--set", "placement.forced=['a','b']"],
        "placement.count: expected at least 2, the number of forced sensors, got 1",
    ),
    "a zone that nobody sees": (
        ["--count", "2", "--set", "placement.zones.far={polygon_m=[[1,8.5],[3,8.5],[3,9.5]],share=0.5}"],
        "placement.zones.far: no voxel in this zone has entropy",
    ),
    "the worst of no periods": (
        ["--count", "2", "--set", "placement.objective='worst'"],
        'placement.objective: expected "mean", since the traffic has no periods, got "worst"',
    ),
    "a period that is not there": (
        ["--count", "2", "--set", "placement.periods=['noon']"],
        "placement.periods: no period 'noon'",
    ),
    "a period of the mix": (
        ["--count", "2", "--set", "placement.periods=['a']", "--set", HALVES],
        'placement.periods: the key has no effect with objective = "mean"',
    ),
    "too much of a zone": (
        ["--count", "2", "--set", ZONE % (1.0, 5)],
        "placement.zones.crossing.share: expected a share that the candidates can reach, got 1",
    ),
    "a reach beyond the count": (
        ["--count", "1", "--reach", "0.99"],
        "placement.reach: no plan within the count, the budget and the other rules reaches 0.99. "
        "Lower it to at most 0.",
    ),
    "a zone beyond the count": (
        ["--count", "1", "--set", ZONE % (0.5, 2)],
        "placement.zones: found no plan of 1 sensor that meets the requirements of all zones",
    ),
}


@pytest.mark.parametrize("case", REJECTED)
def test_rejects_impossible_request(case: str, five_candidates: Path, out: Path, run_egvs) -> None:
    arguments, message = REJECTED[case]
    code, _, error = run_egvs("place", five_candidates, "--out", out, *arguments)
    assert code == 2, error
    assert message in error
    assert not (out / "placement.parquet").exists()


def test_rejects_cost_of_unknown_sensor(five_candidates: Path, out: Path, run_egvs) -> None:
    costs = "costs.sensor={small=4, VLP16=3}"
    code, _, error = run_egvs("place", five_candidates, "--out", out, "--count", 1, "--set", costs)
    assert code == 2
    assert "costs.sensor: unknown sensor 'VLP16'. Did you mean VLP-16?" in error


def test_rejects_cost_that_is_no_number(five_candidates: Path, out: Path, run_egvs) -> None:
    (five_candidates / "sites.csv").write_text(SITES.replace("4,70", "4,dear"))
    code, _, error = run_egvs("place", five_candidates, "--out", out, "--budget", 50, "--set", "costs.pole=1")
    assert code == 2
    assert "sites.csv: site c: cost: expected a number, 0 or above, got 'dear'" in error


@pytest.mark.slow
def test_report_shows_plan_until_inputs_change(five_candidates: Path, out: Path, run_egvs) -> None:
    run_egvs("run", five_candidates, "--out", out)
    before = (out / "report.html").read_text()
    code, text, _ = run_egvs("place", five_candidates, "--out", out, "--count", 2)
    assert code == 0
    assert str(out / "report.html") in text
    page = (out / "report.html").read_text()
    assert "Which sites together?" in page
    assert "Which sites together?" not in before
    rows, _, _ = read_tables(out)
    assert all(f'<th scope="row">{row["site"]}</th>' in page for row in rows)
    answer = sentences(text)[-1]
    assert answer.startswith(("A second sensor adds ", "One is enough: "))
    assert answer in html.unescape(page).replace("\u00a0", " ")
    assert "± is one standard error, from 4 blocks of 10 frames" in page
    run_egvs("run", five_candidates, "--out", out, "--set", "score.gamma=2")
    run_egvs("run", five_candidates, "--out", out, "--set", "seed=8", "--set", "roi.voxel_m=1")
    assert "Which sites together?" not in (out / "report.html").read_text()


@pytest.mark.slow
def test_rejects_altered_plan(five_candidates: Path, out: Path, run_egvs) -> None:
    run_egvs("run", five_candidates, "--out", out)
    run_egvs("place", five_candidates, "--out", out, "--count", 2)
    data = bytearray((out / "placement.parquet").read_bytes())
    data[100] ^= 1
    (out / "placement.parquet").write_bytes(data)
    code, _, error = run_egvs("report", five_candidates, "--out", out)
    assert code == 2
    assert "placement.parquet" in error
    assert "egvs place again" in error


@pytest.mark.slow
def test_threads_and_stored_scans_change_no_byte(five_candidates: Path, out: Path, run_egvs) -> None:
    plans = []
    for name, more in (("one", ["--jobs", "1"]), ("two", ["--jobs", "2"]), ("cast", ["--set", "scan.keep=false"])):
        code, _, error = run_egvs("place", five_candidates, "--out", out / name, "--count", 3, *more)
        assert code == 0, error
        plans.append(
            [parquet.read_artefact(out / name / f"{kind}.parquet", kind)[0] for kind in ("placement", "curve")]
        )
    assert plans[0] == plans[1] == plans[2]
    assert (out / "one" / "placement.parquet").read_bytes() == (out / "two" / "placement.parquet").read_bytes()


@pytest.mark.slow
def test_joint_score_in_python(five_candidates: Path, out: Path) -> None:
    scenario = egvs.load(five_candidates)
    joint = egvs.JointScore.of(scenario, out)
    assert joint.candidates == ("a", "b", "b_high", "c", "d")
    joint.add("c", "a")
    assert joint.value == joint_egvs(five_candidates, out, "a", "c")
    assert joint.gain("a") == 0.0
    gain = joint.gain("b")
    assert gain == joint.gains()["b"] == pytest.approx(joint_egvs(five_candidates, out, "a", "b", "c") - joint.value)
    scene = egvs.build_scene(scenario)
    site = scene.site("b")
    scan = egvs.Scanner(scene).scan(site.pose, scene.sensor(site.sensor))
    assert joint.gain(scan) == pytest.approx(gain)
    joint.remove("c")
    assert (joint.chosen, joint.value) == (("a",), joint_egvs(five_candidates, out, "a"))
    with pytest.raises(egvs.InputError, match=r"candidate 'x': no such candidate. Choose one of a, b"):
        joint.add("x")


@pytest.mark.slow
def test_says_that_one_sensor_is_enough(five_candidates: Path, out: Path, run_egvs) -> None:
    code, text, error = run_egvs("place", five_candidates, "--out", out, "--reach", 0.01)
    assert code == 0, error
    assert "one sensor is enough" in text
    assert "0 cannot" not in text


@pytest.fixture
def three_candidates(mini: Path) -> Path:
    """The small scenario with three candidates."""
    (mini / "sites.csv").write_text(THREE_SITES)
    return mini


def test_help_names_tables_of_scenario(run_egvs) -> None:
    code, text, _ = run_egvs("place", "--help")
    assert code == 0
    assert "[costs]" in text
    assert "[placement.refine]" in " ".join(text.replace("│", " ").split())


@pytest.mark.slow
def test_next_run_keeps_plan_in_report(three_candidates: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    run_egvs("run", three_candidates, "--out", out)
    run_egvs("place", three_candidates, "--out", out, "--count", 2, "--set", "costs.pole=5")
    page = (out / "report.html").read_bytes()
    assert b"Which sites together?" in page
    run_egvs("run", three_candidates, "--out", out)
    assert (out / "report.html").read_bytes() == page


REJECTED_BEFORE_RUNNING = {
    "the worst of no periods": (
        ["placement.objective='worst'"],
        'placement.objective: expected "mean", since the traffic has no periods, got "worst"',
    ),
    "a zone elsewhere": (
        ["placement.zones.far={polygon_m=[[200,0],[201,0],[201,1]],share=0.5}"],
        "placement.zones.far.polygon_m: zone far is outside the region of interest. Use corners within x",
    ),
    "a price that overflows": (["costs.metre=1e308"], "costs (a): expected at most 1e+12, got inf"),
    "a price that swallows others": (["costs.pole=1e300"], "costs (a): expected at most 1e+12, got 1e+300"),
}


@pytest.mark.parametrize("case", REJECTED_BEFORE_RUNNING)
def test_rejects_before_running(three_candidates: Path, tmp_path: Path, run_egvs, case: str) -> None:
    sets, message = REJECTED_BEFORE_RUNNING[case]
    code, _, error = run_egvs(
        "place", three_candidates, "--out", tmp_path / "out", "--count", 2, *(x for s in sets for x in ("--set", s))
    )
    assert code == 2
    assert message in error
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_rejects_joint_score_of_zero(three_candidates: Path, tmp_path: Path, run_egvs) -> None:
    code, _, error = run_egvs(
        "place", three_candidates, "--out", tmp_path / "out", "--count", 2, "--set", "score.gamma=0"
    )
    assert code == 2
    assert "placement: the joint score (egvs) of all candidates is 0" in error
    assert "score.gamma above 0" in error
    assert not (tmp_path / "out" / "placement.parquet").exists()


@pytest.mark.parametrize("gamma", ["inf", "1e300", "1e10"])
def test_very_large_gamma_counts_every_beam(three_candidates: Path, tmp_path: Path, gamma: str) -> None:
    plans = [
        egvs.place(egvs.load(three_candidates, ["placement.count=2", f"score.gamma={value}"]), tmp_path / value)
        for value in (gamma, "100000")
    ]
    assert plans[0].joint == plans[1].joint > 0.0
    assert [sensor.site for sensor in plans[0].sensors] == [sensor.site for sensor in plans[1].sensors]


def test_plan_shows_costs(three_candidates: Path, tmp_path: Path, run_egvs) -> None:
    arguments = ("place", three_candidates, "--out", tmp_path / "out", "--count", 2)
    _, text, _ = run_egvs(*arguments, "--set", "costs.pole=7")
    lines = [line.split() for line in text.splitlines()]
    header = next(number for number, line in enumerate(lines) if line[:1] == ["site"])
    assert lines[header][-1] == "cost"
    placement, _ = parquet.read_artefact(tmp_path / "out" / "placement.parquet", "placement")
    costs = [(row["site"], f"{row['cost']:g}") for row in placement.to_pylist()]
    assert [(line[1], line[-1]) for line in lines[header + 1 : header + 3]] == costs


@pytest.mark.slow
def test_bars_of_worst_period_are_shares(three_candidates: Path, tmp_path: Path, run_egvs, monkeypatch) -> None:
    steps = []
    draw = svg_figures.sensor_count_chart

    def record_steps(chart_steps, alt):
        steps.extend(chart_steps)
        return draw(chart_steps, alt)

    monkeypatch.setattr(svg_figures, "sensor_count_chart", record_steps)
    out, worst = tmp_path / "out", ("--set", WEIGHTED_HALVES, "--set", "placement.objective='worst'")
    run_egvs("run", three_candidates, "--out", out, *worst)
    code, _, error = run_egvs("place", three_candidates, "--out", out, "--count", 2, *worst)
    assert code == 0, error
    curve, metadata = parquet.read_artefact(out / "curve.parquet", "curve")
    assert metadata["plan"]["together"] > 100.0
    assert [step.share for step in steps] == [row["value"] for row in curve.to_pylist()]
    assert 0.1 < steps[0].share < steps[1].share <= 1.0
    page = (out / "report.html").read_text()
    assert ", by the score in the period with the lowest share, as a share" in page


@pytest.mark.slow
def test_folder_instead_of_file_keeps_old_plan(three_candidates: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    run_egvs("place", three_candidates, "--out", out, "--count", 2)
    (out / "curve.parquet").unlink()
    (out / "curve.parquet").mkdir()
    before = (out / "placement.parquet").read_bytes(), (out / "placement.sha256").read_bytes()
    code, _, error = run_egvs("place", three_candidates, "--out", out, "--count", 3)
    assert code == 2
    assert "curve.parquet: is a folder" in error
    assert ((out / "placement.parquet").read_bytes(), (out / "placement.sha256").read_bytes()) == before


@pytest.mark.slow
def test_says_that_time_limit_was_reached(three_candidates: Path, tmp_path: Path, run_egvs, monkeypatch) -> None:
    scenario = egvs.load(three_candidates, ["placement.count=2"])
    placed = egvs.place(scenario, tmp_path / "out")
    interrupted = replace(placed, is_best=False, fewest_is_proved=None)
    proved = replace(placed, is_best=True, fewest_is_proved=None)
    for result, has_note in ((interrupted, True), (proved, False)):
        monkeypatch.setattr("egvs.placement.plan.place", lambda *_, result=result, **__: result)
        _, text, _ = run_egvs(
            "place", three_candidates, "--out", tmp_path / "out", "--count", 2, "--exact", "--time-limit", "9s"
        )
        assert ("--exact reached its --time-limit of 9s" in text) is has_note


@pytest.mark.slow
def test_rule_that_forbids_one_more_is_named(five_candidates: Path, out: Path, run_egvs) -> None:
    """Three candidates at two poles, one sensor for each pole: the explorer recommends no third one either."""
    rules = ("--set", "placement.most_per_pole=1", "--set", "placement.excluded=['c', 'd']")
    assert run_egvs("run", five_candidates, "--out", out, *rules)[0] == 0
    code, text, error = run_egvs("place", five_candidates, "--out", out, "--count", 3, *rules)
    assert code == 0, error
    sentence = "The limit of 1 sensor per pole (most_per_pole) forbids a third sensor beside them."
    assert sentence in text and "adds nothing" not in text
    assert sentence in (out / "report.html").read_text()
    plan = egvs.open_session(out).plan
    assert plan is not None and len(plan.sites) == 2
    assert (plan.best_next, plan.forbids_more) == (None, "the limit of 1 sensor per pole (most_per_pole)")

    apart = ("--set", "placement.least_distance_m=1000")
    _, text, _ = run_egvs("place", five_candidates, "--out", out / "apart", "--count", 3, *apart)
    assert "The distance of 1000 m (least_distance_m) forbids a second sensor beside it." in text
