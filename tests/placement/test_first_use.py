"""What a first user of `egvs place`, and one who means it ill, met: each is told, and nothing is lost."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

import egvs
from egvs.artefacts import parquet
from egvs.report import svg_figures

SITES = """site,x_m,y_m,z_m,cost
a,10,12,3,
b,30.5,-12,3,
c,2,-12,4,70
"""


@pytest.fixture
def few(mini: Path) -> Path:
    """The small scenario with three candidates."""
    (mini / "sites.csv").write_text(SITES)
    return mini


def test_help_names_the_tables_of_the_scenario(run_egvs) -> None:
    code, text, _ = run_egvs("place", "--help")
    assert code == 0
    assert "[costs]" in text
    assert "[placement.refine]" in " ".join(text.replace("│", " ").split())


@pytest.mark.slow
def test_a_plan_asked_for_by_options_stays_in_the_report_of_the_next_run(few: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    run_egvs("run", few, "--out", out)
    run_egvs("place", few, "--out", out, "--count", 2, "--set", "costs.pole=5")
    page = (out / "report.html").read_bytes()
    assert b"Which poles together?" in page
    run_egvs("run", few, "--out", out)
    assert (out / "report.html").read_bytes() == page


REFUSED_BEFORE_ANYTHING_RUNS = {
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


@pytest.mark.parametrize("case", REFUSED_BEFORE_ANYTHING_RUNS)
def test_what_can_be_told_before_a_run_is(few: Path, tmp_path: Path, run_egvs, case: str) -> None:
    sets, message = REFUSED_BEFORE_ANYTHING_RUNS[case]
    code, _, error = run_egvs(
        "place", few, "--out", tmp_path / "out", "--count", 2, *(x for s in sets for x in ("--set", s))
    )
    assert code == 2
    assert message in error
    assert not (tmp_path / "out").exists()


def test_a_score_that_nothing_raises_is_refused(few: Path, tmp_path: Path, run_egvs) -> None:
    code, _, error = run_egvs("place", few, "--out", tmp_path / "out", "--count", 2, "--set", "score.gamma=0")
    assert code == 2
    assert "placement: the joint score (egvs) of all candidates is 0" in error
    assert "score.gamma above 0" in error
    assert not (tmp_path / "out" / "placement.parquet").exists()


@pytest.mark.parametrize("gamma", ["inf", "1e300", "1e10"])
def test_a_gamma_that_no_voxel_reaches_counts_every_beam(few: Path, tmp_path: Path, gamma: str) -> None:
    plans = [
        egvs.place(egvs.load(few, ["placement.count=2", f"score.gamma={of}"]), tmp_path / of)
        for of in (gamma, "100000")
    ]
    assert plans[0].joint == plans[1].joint > 0.0
    assert [pick.site.name for pick in plans[0].sensors] == [pick.site.name for pick in plans[1].sensors]


def test_costs_stand_beside_each_number_of_sensors(few: Path, tmp_path: Path, run_egvs) -> None:
    arguments = ("place", few, "--out", tmp_path / "out", "--count", 2)
    _, text, _ = run_egvs(*arguments, "--set", "costs.pole=7")
    header, first, second = _curve(text)
    assert header[-2:] == ["cost", "sites"]
    curve, _ = parquet.read_artefact(tmp_path / "out" / "curve.parquet", "curve")
    for row, line in zip(curve.to_pylist(), (first, second), strict=True):
        names = ", ".join(json.loads(row["sites"])).split()
        assert line[-len(names) - 1 :] == [f"{row['cost']:g}", *names]


def _curve(text: str) -> list[list[str]]:
    lines = [line.split() for line in text.splitlines()]
    at = next(i for i, line in enumerate(lines) if line[:1] == ["sensors"])
    return lines[at : at + 3]


HALVES = 'traffic.periods=[{name="a", length_s=12, weight=3}, {name="b", begin_s=12, length_s=8}]'


@pytest.mark.slow
def test_bars_of_the_worst_period_are_shares_already(few: Path, tmp_path: Path, run_egvs, monkeypatch) -> None:
    steps = []
    draw = svg_figures.sensor_count_chart
    monkeypatch.setattr(svg_figures, "sensor_count_chart", lambda its, alt: (steps.extend(its), draw(its, alt))[1])
    out, worst = tmp_path / "out", ("--set", HALVES, "--set", "placement.objective='worst'")
    run_egvs("run", few, "--out", out, *worst)
    code, _, error = run_egvs("place", few, "--out", out, "--count", 2, *worst)
    assert code == 0, error
    curve, about = parquet.read_artefact(out / "curve.parquet", "curve")
    assert about["plan"]["together"] > 100.0
    assert [step.share for step in steps] == [row["value"] for row in curve.to_pylist()]
    assert 0.1 < steps[0].share < steps[1].share <= 1.0
    page = (out / "report.html").read_text()
    assert ", by the score in the period with the lowest share, as a share" in page


def test_a_folder_in_the_place_of_a_file_costs_no_plan(few: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    run_egvs("place", few, "--out", out, "--count", 2)
    (out / "curve.parquet").unlink()
    (out / "curve.parquet").mkdir()
    before = (out / "placement.parquet").read_bytes(), (out / "placement.sha256").read_bytes()
    code, _, error = run_egvs("place", few, "--out", out, "--count", 3)
    assert code == 2
    assert "curve.parquet: is a folder" in error
    assert ((out / "placement.parquet").read_bytes(), (out / "placement.sha256").read_bytes()) == before


def test_a_search_that_time_ended_says_so(few: Path, tmp_path: Path, run_egvs, monkeypatch) -> None:
    scenario = egvs.load(few, ["placement.count=2"])
    placed = egvs.place(scenario, tmp_path / "out")
    ended = replace(placed, solution=replace(placed.solution, is_best=False, fewest_is_proved=None))
    for its, is_told in ((ended, True), (replace(ended, solution=replace(ended.solution, is_best=True)), False)):
        monkeypatch.setattr("egvs.placement.plan.place", lambda *_, its=its, **__: its)
        _, text, _ = run_egvs("place", few, "--out", tmp_path / "out", "--count", 2, "--exact", "--time-limit", "9s")
        assert ("--exact reached its --time-limit of 9s" in text) is is_told
