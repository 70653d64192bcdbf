"""Are runs put side by side as they are: scores, ranks, agreement, and what differs?

Evidence: small runs of known settings, numbers taken from their artefacts, and each wrong use with its message."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from scipy.stats import kendalltau

import egvs
from egvs.cli import study_tables
from egvs.core.errors import InputError
from egvs.core.files import add_checksum
from egvs.studies import run_comparison
from egvs.studies.run_comparison import SiteResult, compare_runs


@pytest.fixture
def two(mini: Path, tmp_path: Path) -> tuple[Path, Path]:
    """The small scenario, and the same with another gamma and a third site in the place of the second."""
    first, second = tmp_path / "first", tmp_path / "second"
    egvs.run(egvs.load(mini), first)
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3.5\npole_c,12,12,3\n")
    egvs.run(egvs.load(mini, ["score.gamma=2", "seed=8"]), second)
    return first, second


def test_scores_shares_ranks_and_settings_are_those_of_the_runs(two: tuple[Path, Path]) -> None:
    found = compare_runs(two)
    assert [run.label for run in found.runs] == ["A", "B"]
    assert set(found.sites) == {"pole_a", "pole_b", "pole_c"}
    for run, folder in zip(found.runs, two, strict=True):
        for row in egvs.read_scores(folder / "scores.parquet").to_pylist():
            site = run.sites[row["site"]]
            assert (site.egvs, site.rank, site.egvs_se) == (row["egvs"], row["rank"], row["egvs_se"])
            assert site.share == pytest.approx(row["egvs"] / row["egvs_limit"])
    differing = {difference.what: difference.values for difference in found.differences}
    assert differing["score.gamma"] == (4.0, 2.0)
    assert differing["seed"] == (7, 8)
    changed = differing.pop("content of sites.csv")
    assert changed[0] != changed[1]
    assert set(differing) == {"score.gamma", "seed"}
    (pair,) = found.agreements
    assert (pair.shared, pair.tau, pair.best_a, pair.regret_a) == (1, None, ("pole_a",), 0.0)
    assert found.notes == (
        "1 site has the same name in A and B but another place, angle or sensor: pole_a",
        "A and B differ in score.gamma: compare ranks and shares, not bits",
    )


def test_a_run_beside_itself_agrees_and_differs_in_nothing(two: tuple[Path, Path]) -> None:
    found = compare_runs([two[0], two[0]])
    (pair,) = found.agreements
    assert (pair.tau, pair.rho, pair.regret_a) == pytest.approx((1.0, 1.0, 0.0))
    assert (found.differences, found.notes) == ((), ())


@pytest.mark.slow
def test_runs_agree_by_the_scores_that_rank_them(mini: Path, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    rows = "".join(f"p{n},{4 + 7 * n},{12 - 24 * (n % 2)},{2 + n}\n" for n in range(5))
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m\n{rows}")
    for name, by in (("a", "egvs"), ("b", "seen_well"), ("c", "seen_well")):
        egvs.run(egvs.load(mini, [f"score.rank_by={by}"]), tmp_path / name)
    found = compare_runs([tmp_path / name for name in "abc"])
    scores = [egvs.read_scores(tmp_path / name / "scores.parquet").to_pydict() for name in "ab"]
    assert found.agreements[0].tau == pytest.approx(kendalltau(scores[0]["egvs"], scores[1]["seen_well"]).statistic)
    assert found.agreements[2].tau == pytest.approx(1.0)
    assert found.notes == tuple(f"A ranks by egvs, {other} by seen_well: compare ranks alone" for other in "BC")
    study_tables.print_comparison(found)
    told = capsys.readouterr().out
    assert "B seen well" in told
    assert all(f"{value:.1%}" in told for value in scores[1]["seen_well"])


def row(site: str, run_egvs: float, rank: int) -> SiteResult:
    return SiteResult(site, (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, "s"), 135.5, 34.6, run_egvs, None, rank, run_egvs / 100)


def test_agreement_by_hand() -> None:
    """Three sites of four in common; two of their three pairs in the same order: tau = (2 - 1) / 3."""
    a = run_comparison.ComparedRun(
        "A", Path("a"), {s: row(s, v, 0) for s, v in (("p", 9.0), ("q", 8.0), ("r", 4.0), ("x", 99.0))}, {}, {}
    )
    b = run_comparison.ComparedRun(
        "B", Path("b"), {s: row(s, v, 0) for s, v in zip("pqr", (6, 8, 2), strict=True)}, {}, {}
    )
    pair = run_comparison._agreement(a, b)
    assert (pair.shared, pair.best_a, pair.best_b) == (3, ("p",), ("q",))
    assert pair.tau == pytest.approx(1 / 3)
    assert pair.rho == pytest.approx(0.5)
    assert pair.regret_a == pytest.approx(0.25)


def test_runs_that_share_no_site_are_told(two: tuple[Path, Path], mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\nlamp,10,12,3\n")
    egvs.run(egvs.load(mini), tmp_path / "third")
    code, printed, _ = run_egvs("compare", two[0], tmp_path / "third")
    assert code == 0
    assert "note: A and B share no site: their rankings cannot be held against each other" in printed


def test_the_command_line_prints_it(two: tuple[Path, Path], run_egvs) -> None:
    code, printed, _ = run_egvs("compare", *two)
    assert code == 0
    for part in ("A bit", "B rank", "score.gamma", "note: 1 site has the same name", str(two[0])):
        assert part in printed
    code, printed, _ = run_egvs("compare", two[0], two[0], "--top", 1)
    assert "their settings and files are the same" in printed
    assert "pole_a" not in printed or "pole_b" not in printed.split("runs")[0]


@pytest.mark.parametrize("width", [80, 190])
@pytest.mark.parametrize("runs", [2, 5])
def test_tables_fit_the_terminal(width: int, runs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sites = {f"site_{n:02}": row(f"site_{n:02}", 123456.7 - n, n + 1) for n in range(3)}
    one = run_comparison.ComparedRun("A", Path("runs/base"), sites, {"seed": 1}, {})
    all_runs = tuple(
        replace(one, label=run_comparison._letter(n), settings={"traffic.kinds[car].length_m": n}) for n in range(runs)
    )
    found = run_comparison.Comparison(
        all_runs,
        tuple(sites),
        (run_comparison._agreement(one, all_runs[1]),),
        tuple(run_comparison._differences(all_runs)),
        (),
    )
    console = Console(width=width, record=True)
    monkeypatch.setattr(study_tables, "console", lambda *_, **__: console)
    study_tables.print_comparison(found)
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    assert sum("123456.7" in line for line in lines) >= 1  # no number is cut
    header = [line for line in lines if line.startswith("site")]
    assert {f"{run.label} rank" for run in all_runs} <= {cell.strip() for line in header for cell in line.split("  ")}
    assert any("longitude" in line for line in header) == (width == 190)


@pytest.mark.slow
def test_a_row_that_a_run_lacks_is_told_once_and_by_its_name(
    mini: Path,
    tmp_path: Path,
    run_egvs,  # type: ignore[no-untyped-def]
) -> None:
    egvs.run(egvs.load(mini), tmp_path / "first")
    file = mini / "scenario.toml"
    van = '[[traffic.kinds]]\nname = "van"\nlength_m = 5\nwidth_m = 2\nheight_m = 2\n'
    file.write_text(
        file.read_text().replace("[statics]", f"{van}\n[statics]").replace("length_m = 4.5", "length_m = 4.4")
    )
    egvs.run(egvs.load(mini), tmp_path / "second")
    found = {d.what: d.values for d in compare_runs([tmp_path / "first", tmp_path / "second"]).differences}
    assert found == {"traffic.kinds[car].length_m": (4.5, 4.4), "traffic.kinds[van]": (None, "there")}
    _, printed, _ = run_egvs("compare", tmp_path / "first", tmp_path / "second")
    assert "traffic.kinds[car].length_m" in printed


@pytest.mark.slow
def test_an_effect_that_a_run_lacks_is_told_by_its_parameters_alone(mini: Path, tmp_path: Path) -> None:
    folders = tmp_path / "plain", tmp_path / "rain"
    for folder, named in zip(folders, ([], ["effects.rain.rate_mm_h=30"]), strict=True):
        egvs.run(egvs.load(mini, named), folder)
    assert [(one.what, one.values) for one in compare_runs(folders).differences] == [
        ("effects.rain.rate_mm_h", (None, 30.0))
    ]


def test_a_table_that_is_empty_in_one_run_is_told_by_the_others_rows() -> None:
    runs = [
        run_comparison.ComparedRun(label, Path(), {}, settings, {})
        for label, settings in (
            ("A", {"traffic.periods": [], "seed": 1}),
            ("B", {"traffic.periods[day].weight": 1.0, "seed": 1}),
        )
    ]
    found = [(d.what, d.values) for d in run_comparison._differences(runs)]
    assert found == [("traffic.periods[day]", (None, "there"))]


def test_letters_go_on_after_z() -> None:
    assert [run_comparison._letter(n) for n in (0, 25, 26, 27, 52)] == ["A", "Z", "AA", "AB", "BA"]


def test_what_is_no_finished_run_is_refused(two: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 run; two or more folders of finished runs"):
        compare_runs(two[:1])
    with pytest.raises(InputError, match=r"run\.json: no such file. Name a folder that egvs run has written."):
        compare_runs([two[0], tmp_path / "nowhere"])
    record = json.loads((two[1] / "run.json").read_text())
    (two[1] / "scores.parquet").write_bytes((two[0] / "scores.parquet").read_bytes())
    with pytest.raises(InputError, match="is not what the run in its folder made"):
        compare_runs(two)
    del record["stages"]["score"]
    (two[1] / "run.json").write_text(json.dumps(add_checksum(record)))
    with pytest.raises(InputError, match="the stage score is not done; a finished run"):
        compare_runs(two)
