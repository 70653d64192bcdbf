"""`egvs place` on a small scenario: every demand, what it writes, and what it refuses."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.scoring.egvs import EntropyField

SITES = """site,x_m,y_m,z_m,cost
a,10,12,3,
b,30.5,-12,3,
b_high,30.5,-12,5,
c,2,-12,4,70
d,38,12,4,
"""
ZONE = "placement.zones.crossing={polygon_m=[[5,-8],[12,-8],[12,8],[5,8]],share=%s,by=%s}"


@pytest.fixture
def many(mini: Path) -> Path:
    """The small scenario with five candidates at four poles."""
    (mini / "sites.csv").write_text(SITES)
    return mini


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """The run's folder."""
    return tmp_path / "out"


def joint_egvs(many: Path, out: Path, *names: str) -> float:
    """E(S) by its definition, from the hits that the run itself writes for each site."""
    scenario = egvs.load(many, ["score.keep_visibility='all'"])
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


def read(out: Path) -> tuple[list[dict], list[dict], dict]:
    """Rows of the plan and of the curve, and what is said of the plan."""
    rows, about = parquet.read_artefact(out / "placement.parquet", "placement")
    curve, other = parquet.read_artefact(out / "curve.parquet", "curve")
    assert about == other
    return rows.to_pylist(), curve.to_pylist(), about["plan"]


@pytest.mark.slow
def test_the_exact_plan_is_the_best_of_all_subsets_to_the_last_bit(many: Path, out: Path, run_egvs) -> None:
    for count in (1, 2, 3):
        code, text, error = run_egvs("place", many, "--out", out, "--count", count, "--exact")
        assert code == 0, error
        rows, curve, plan = read(out)
        best = max(
            joint_egvs(many, out, *names) for names in itertools.combinations(("a", "b", "b_high", "c", "d"), count)
        )
        assert rows[-1]["score"] == plan["joint"] == curve[-1]["score"] == best
        assert plan["is_best"]
        assert "proved: no plan within the rules is better" in text
        assert [row["count"] for row in curve] == list(range(1, count + 1))


def test_one_sensor_is_the_winner_of_the_run_by_every_score(many: Path, out: Path) -> None:
    for score in ("egvs", "entropy_seen", "coverage", "expected_visibility", "points_on_target", "seen_well",
                  "expected_detections"):  # fmt: skip
        scenario = egvs.load(many, [f"score.rank_by='{score}'", "placement.count=1"])
        egvs.run(scenario, out / score)
        scores = read_scores(out / score / "scores.parquet")
        best = [
            site for site, rank in zip(scores["site"].to_pylist(), scores["rank"].to_pylist(), strict=True) if rank == 1
        ]
        placed = egvs.place(scenario, out / score, exact=True)
        assert placed.sensors[0].site.name in best
        value = max(scores[score].to_pylist())
        assert placed.joint == (pytest.approx(value, rel=1e-9) if score == "expected_detections" else value)


@pytest.mark.parametrize("effect", ["effects.rain.rate_mm_h=20", "effects.divergence={}"])
def test_shares_of_beams_count_up_to_gamma(effect: str, many: Path, out: Path) -> None:
    """Where effects weigh beams, one sensor is worth what the run says, and two are by the definition."""
    sets = [effect, "placement.count=2", "score.keep_visibility='all'"]
    scenario = egvs.load(many, sets)
    egvs.run(scenario, out)
    scores = {row["site"]: row["egvs"] for row in read_scores(out / "scores.parquet").to_pylist()}
    joint = egvs.JointScore.of(scenario, out)
    for name, run_egvs in scores.items():
        joint.add(name)
        assert joint.value == run_egvs
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
def test_what_is_written_adds_up(many: Path, out: Path, run_egvs) -> None:
    code, _, error = run_egvs("place", many, "--out", out, "--count", 3)
    assert code == 0, error
    rows, curve, plan = read(out)
    assert [row["order"] for row in rows] == [1, 2, 3]
    so_far = 0.0
    for i, row in enumerate(rows):
        assert row["score"] == joint_egvs(many, out, *(other["site"] for other in rows[: i + 1]))
        assert row["gain"] == row["score"] - so_far
        rest = [other["site"] for other in rows if other is not row]
        assert row["loss"] == plan["joint"] - joint_egvs(many, out, *rest)
        assert row["bound"] == curve[i]["bound"] >= row["score"]
        so_far = row["score"]
    assert [row["gain"] for row in rows] == sorted((row["gain"] for row in rows), reverse=True)
    assert plan["together"] == joint_egvs(many, out, "a", "b", "b_high", "c", "d")
    assert set(json.loads(curve[-1]["sites"])) == {row["site"] for row in rows}


def test_a_budget_pays_a_pole_once_and_forced_ones_never(many: Path, out: Path, run_egvs) -> None:
    """A sensor costs 20, a pole 50, a metre 1: a, b and d cost 73, 73 and 74, b_high 75, or 25 beside b; c is 70."""
    costs = ["--set", "costs.sensor.small=20", "--set", "costs.pole=50", "--set", "costs.metre=1"]
    code, _, error = run_egvs("place", many, "--out", out, "--budget", 98, "--exact", *costs)
    assert code == 0, error
    rows, _, plan = read(out)
    assert {row["site"] for row in rows} == {"b", "b_high"}
    assert [row["cost"] for row in rows] in ([73.0, 25.0], [75.0, 23.0])
    assert plan["cost"] == 98.0
    code, _, error = run_egvs(
        "place", many, "--out", out, "--budget", 70, "--exact", *costs, "--set", "placement.forced=['a']"
    )
    assert code == 0, error
    rows, _, plan = read(out)
    assert (rows[0]["site"], rows[0]["forced"], rows[0]["cost"]) == ("a", True, 0.0)
    assert rows[1]["site"] == "c"
    assert plan["cost"] == 70.0


@pytest.mark.slow
def test_the_fewest_that_reach_a_share(many: Path, out: Path, run_egvs) -> None:
    code, text, error = run_egvs("place", many, "--out", out, "--reach", 0.9)
    assert code == 0, error
    rows, _, plan = read(out)
    assert plan["joint"] >= 0.9 * plan["together"]
    assert f"proved: {len(rows) - 1} sensors are not enough" in text
    fewer = itertools.combinations(("a", "b", "b_high", "c", "d"), len(rows) - 1)
    assert max(joint_egvs(many, out, *names) for names in fewer) < 0.9 * plan["together"]


def test_rules_and_zones_hold(many: Path, out: Path, run_egvs) -> None:
    sets = ["placement.most_per_pole=1", "placement.excluded=['d']", "placement.least_distance_m=25"]
    arguments = [word for one in sets for word in ("--set", one)]
    code, _, error = run_egvs("place", many, "--out", out, "--count", 3, "--exact", *arguments)
    assert code == 0, error
    rows, _, _ = read(out)
    names = {row["site"] for row in rows}
    assert not names & {"d"}
    assert len(names & {"b", "b_high"}) <= 1
    for one, other in itertools.combinations(rows, 2):
        assert math.dist(*([row[key] for key in ("x_m", "y_m", "z_m")] for row in (one, other))) >= 25
    code, text, error = run_egvs("place", many, "--out", out, "--count", 2, "--exact", "--set", ZONE % (0.5, 2))
    assert code == 0, error
    _, _, plan = read(out)
    (zone,) = plan["zones"]
    assert zone["seen"] >= zone["share"] == 0.5
    assert "zone crossing:" in text
    assert "by 2 sensors, 50.0% required" in text


@pytest.mark.slow
def test_what_is_left_when_the_sensor_that_is_missed_most_fails(many: Path, out: Path, run_egvs) -> None:
    code, _, error = run_egvs("place", many, "--out", out, "--count", 3, "--exact", "--set", "placement.survives=1")
    assert code == 0, error
    rows, curve, plan = read(out)

    def left(names: tuple[str, ...]) -> float:
        return min(joint_egvs(many, out, *(other for other in names if other != one)) for one in names)

    best = max(left(names) for names in itertools.combinations(("a", "b", "b_high", "c", "d"), 3))
    assert plan["value"] == curve[-1]["value"] == best == left(tuple(row["site"] for row in rows))


HALVES = 'traffic.periods=[{name="a",length_s=12},{name="b",begin_s=12,length_s=8}]'


def test_the_worst_of_the_periods_that_are_named(many: Path, out: Path, run_egvs) -> None:
    """Of one period alone, the worst is what it has: a share of what all candidates would have in it."""
    worst = {}
    for periods in ("a", "b", "a,b"):
        names = [f"'{name}'" for name in periods.split(",")]
        sets = [HALVES, "placement.objective='worst'", f"placement.periods=[{','.join(names)}]"]
        arguments = [word for one in sets for word in ("--set", one)]
        code, _, error = run_egvs("place", many, "--out", out, "--count", 2, "--exact", *arguments)
        assert code == 0, error
        worst[periods] = read(out)[2]["value"]
    assert 0.0 < worst["a,b"] <= min(worst["a"], worst["b"]) <= 1.0


REFUSED = {
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
        "placement.forced: no candidate 'nobody'. Use one of a, b, b_high, c, d",
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
        "placement.zones: no plan of 1 sensors that meets them was found",
    ),
    "no costs": (["--budget", "50"], "placement.budget: the cost of site a is unknown"),
    "a sensor without a price": (
        ["--budget", "50", "--set", "costs.sensor.other=1"],
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
        'placement.periods: a has no effect with objective = "mean"',
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
        "placement.zones: no plan of 1 sensors that meets them was found",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_with_what_can(case: str, many: Path, out: Path, run_egvs) -> None:
    arguments, message = REFUSED[case]
    code, _, error = run_egvs("place", many, "--out", out, *arguments)
    assert code == 2, error
    assert message in error
    assert not (out / "placement.parquet").exists()


def test_a_cost_that_is_no_number_is_refused(many: Path, out: Path, run_egvs) -> None:
    (many / "sites.csv").write_text(SITES.replace("4,70", "4,dear"))
    code, _, error = run_egvs("place", many, "--out", out, "--budget", 50, "--set", "costs.pole=1")
    assert code == 2
    assert "sites.csv: site c: cost: expected a number, 0 or above, got 'dear'" in error


@pytest.mark.slow
def test_the_report_shows_the_plan_until_something_changes(many: Path, out: Path, run_egvs) -> None:
    run_egvs("run", many, "--out", out)
    before = (out / "report.html").read_text()
    code, text, _ = run_egvs("place", many, "--out", out, "--count", 2)
    assert code == 0
    assert str(out / "report.html") in text
    page = (out / "report.html").read_text()
    assert "Which poles together?" in page
    assert "Which poles together?" not in before
    rows, _, _ = read(out)
    assert all(f'<th scope="row">{row["site"]}</th>' in page for row in rows)
    run_egvs("run", many, "--out", out, "--set", "score.gamma=2")
    run_egvs("run", many, "--out", out, "--set", "seed=8", "--set", "roi.voxel_m=1")
    assert "Which poles together?" not in (out / "report.html").read_text()


@pytest.mark.slow
def test_a_plan_that_was_altered_is_told(many: Path, out: Path, run_egvs) -> None:
    run_egvs("run", many, "--out", out)
    run_egvs("place", many, "--out", out, "--count", 2)
    data = bytearray((out / "placement.parquet").read_bytes())
    data[100] ^= 1
    (out / "placement.parquet").write_bytes(data)
    code, _, error = run_egvs("report", many, "--out", out)
    assert code == 2
    assert "placement.parquet" in error
    assert "egvs place again" in error


def test_threads_and_kept_scans_change_no_byte(many: Path, out: Path, run_egvs) -> None:
    plans = []
    for name, more in (("one", ["--jobs", "1"]), ("two", ["--jobs", "2"]), ("cast", ["--set", "scan.keep=false"])):
        code, _, error = run_egvs("place", many, "--out", out / name, "--count", 3, *more)
        assert code == 0, error
        plans.append(
            [parquet.read_artefact(out / name / f"{kind}.parquet", kind)[0] for kind in ("placement", "curve")]
        )
    assert plans[0] == plans[1] == plans[2]
    assert (out / "one" / "placement.parquet").read_bytes() == (out / "two" / "placement.parquet").read_bytes()


@pytest.mark.slow
def test_the_joint_score_from_python(many: Path, out: Path) -> None:
    scenario = egvs.load(many)
    joint = egvs.JointScore.of(scenario, out)
    assert joint.candidates == ("a", "b", "b_high", "c", "d")
    joint.add("c", "a")
    assert joint.value == joint_egvs(many, out, "a", "c")
    assert joint.gain("a") == 0.0
    gain = joint.gain("b")
    assert gain == joint.gains()["b"] == pytest.approx(joint_egvs(many, out, "a", "b", "c") - joint.value)
    scene = egvs.build_scene(scenario)
    site = scene.site("b")
    scan = egvs.Scanner(scene).scan(site.pose, scene.sensor(site.sensor))
    assert joint.gain(scan) == pytest.approx(gain)
    joint.remove("c")
    assert (joint.chosen, joint.value) == (("a",), joint_egvs(many, out, "a"))
    with pytest.raises(egvs.InputError, match=r"candidate 'x': no such candidate. Use one of a, b"):
        joint.add("x")


def test_one_sensor_that_is_enough_is_told_so(many: Path, out: Path, run_egvs) -> None:
    code, text, error = run_egvs("place", many, "--out", out, "--reach", 0.01)
    assert code == 0, error
    assert "one sensor is enough" in text
    assert "0 cannot" not in text
