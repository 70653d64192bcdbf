"""Comparisons of runs: scores, ranks, agreement, differences, and messages.

The expected numbers are read from the artefacts of small runs.
"""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest
from rich.console import Console
from scipy.stats import kendalltau

import egvs
from egvs.artefacts.checksums import add_checksum
from egvs.artefacts.run_record import RunRecord
from egvs.cli import console as cli_console
from egvs.cli import study_tables
from egvs.core.errors import InputError
from egvs.report.sensor_text import describe_trust
from egvs.results.ranking import RankedSite, Ranking, ScoreValue, share_of_limit
from egvs.scenario.score_config import CostsConfig
from egvs.studies import run_comparison
from egvs.studies.paired_errors import ScoreDifferences
from egvs.studies.run_comparison import ComparedRun, compare_runs


@pytest.fixture
def two(mini: Path, tmp_path: Path) -> tuple[Path, Path]:
    """The small scenario, and the same with another gamma and a third site instead of the second."""
    first, second = tmp_path / "first", tmp_path / "second"
    egvs.run(egvs.load(mini), first)
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3.5\npole_c,12,12,3\n")
    egvs.run(egvs.load(mini, ["score.gamma=2", "seed=8"]), second)
    return first, second


@pytest.mark.slow
def test_compares_scores_shares_ranks_and_settings(two: tuple[Path, Path]) -> None:
    comparison = compare_runs(two, by="site")
    assert [run.label for run in comparison.runs] == ["A", "B"]
    assert set(comparison.sites) == {"pole_a", "pole_b", "pole_c"}
    for run, folder in zip(comparison.runs, two, strict=True):
        for row in egvs.read_scores(folder / "scores.parquet").to_pylist():
            site = run.sites[row["site"]]
            assert (site.egvs, site.rank, site.egvs_se) == (row["egvs"], row["rank"], row["egvs_se"])
            assert share_of_limit(site) == pytest.approx(row["egvs"] / row["egvs_limit"])
    differing = {difference.what: difference.values for difference in comparison.differences}
    assert differing["score.gamma"] == (4.0, 2.0)
    assert differing["seed"] == (7, 8)
    changed = differing.pop("content of sites.csv")
    assert changed[0] != changed[1]
    assert set(differing) == {"score.gamma", "seed"}
    (pair,) = comparison.agreements
    assert (pair.shared, pair.tau, pair.best_a, pair.regret_a) == (1, None, ("pole_a",), 0.0)
    assert comparison.notes == (
        "1 site has the same name in A and B but another position, angle or sensor: pole_a",
        "A and B differ in score.gamma: compare ranks and shares, not bits",
    )


@pytest.mark.slow
def test_run_compared_with_itself_has_no_differences(two: tuple[Path, Path]) -> None:
    comparison = compare_runs([two[0], two[0]])
    (pair,) = comparison.agreements
    assert (pair.tau, pair.rho, pair.regret_a) == pytest.approx((1.0, 1.0, 0.0))
    assert (comparison.differences, comparison.notes) == ((), ())


@pytest.mark.slow
def test_agreement_uses_the_scores_that_rank(mini: Path, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    rows = "".join(f"p{n},{4 + 7 * n},{12 - 24 * (n % 2)},{2 + n}\n" for n in range(5))
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m\n{rows}")
    for name, by in (("a", "egvs"), ("b", "seen_well"), ("c", "seen_well")):
        egvs.run(egvs.load(mini, [f"score.rank_by={by}"]), tmp_path / name)
    comparison = compare_runs([tmp_path / name for name in "abc"])
    scores = [egvs.read_scores(tmp_path / name / "scores.parquet").to_pydict() for name in "ab"]
    assert comparison.agreements[0].tau == pytest.approx(
        kendalltau(scores[0]["egvs"], scores[1]["seen_well"]).statistic
    )
    assert comparison.agreements[2].tau == pytest.approx(1.0)
    assert comparison.notes == tuple(f"A ranks by egvs, {other} by seen_well: compare ranks only" for other in "BC")
    study_tables.print_comparison(comparison)
    printed = capsys.readouterr().out
    assert "B seen well" in printed
    assert all(f"{100 * value:.1f} %" in printed for value in scores[1]["seen_well"])


def row(site: str, score: float, rank: int = 1, **values: object) -> RankedSite:
    """A site at (1, 2), 3 m up, upright, with the sensor s, ranked by EGVS."""
    base = RankedSite(site, 1.0, 2.0, 3.0, score, rank, site, 0.0, 0.0, 0.0, "s", 100.0, 1, 1, 0.5)
    return replace(replace(base, longitude_deg=135.5, latitude_deg=34.6), **values)


def found(site: str, share: float, rank: int = 1, **values: object) -> RankedSite:
    """The same, ranked by the share of vehicles found, with a standard error of 0.3 points."""
    score = ScoreValue("expected_detections", share, 0.003)
    return row(site, 1000.0 * share, rank, rank_by="expected_detections", others=(score,), **values)


def made_run(label: str, *sites: RankedSite, **settings: object) -> ComparedRun:
    return ComparedRun(label, Path(label.lower()), Ranking.of(sites), settings, {})


def test_losses_act_unless_they_are_off_or_a_sensor_has_no_rated_range() -> None:
    def has_losses(*unrated: str, **settings: object) -> bool:
        return replace(made_run("A", row("p", 9.0), **settings), unrated=unrated).has_losses

    for settings in ({}, {"effects.range_limit": None}, {"effects.rain.rate_mm_h": 5.0}):
        assert has_losses(**settings)
        assert not has_losses("s", **settings)
    assert has_losses("s", **{"effects.range_limit": {}})
    assert has_losses("s", **{"effects.range_limit.softness": 0.2})
    assert not has_losses(**{"effects.range_limit": False})


def test_rank_agreement_computed_by_hand() -> None:
    """Three sites of four in common; two of their three pairs in the same order: tau = (2 - 1) / 3."""
    a = made_run("A", *(row(s, v) for s, v in (("p", 9.0), ("q", 8.0), ("r", 4.0), ("x", 99.0))))
    b = made_run("B", *(row(s, v) for s, v in zip("pqr", (6, 8, 2), strict=True)))
    pair = run_comparison.compare_rankings(a, b)
    assert (pair.shared, pair.best_a, pair.best_b) == (3, ("p",), ("q",))
    assert pair.tau == pytest.approx(1 / 3)
    assert pair.rho == pytest.approx(0.5)
    assert pair.regret_a == pytest.approx(0.25)


def test_agreement_by_pole_uses_the_best_mount_of_each() -> None:
    """The best mounts score 9 > 8 in A and 6 < 7 in B; the other sites would give the opposite order."""
    here, there = {"x_m": 0.0, "pole": "p"}, {"x_m": 5.0, "pole": "q"}
    a = made_run("A", row("p@3m", 9.0, 1, **here), row("q@3m", 8.0, 2, **there), row("p@6m", 1.0, 3, **here))
    b = made_run("B", row("q@4m", 7.0, 1, **there), row("lamp", 6.0, 2, **here | {"pole": "lamp"}))
    pair = run_comparison.compare_rankings(a, b, "pole")
    assert (pair.shared, pair.tau, pair.best_a, pair.best_b) == (2, -1.0, ("p",), ("q",))
    assert pair.regret_a == pytest.approx(1 / 7)


@pytest.mark.slow
def test_same_pole_with_another_name_or_height_is_matched(two: tuple[Path, Path], mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\nlamp,10,12,4.5\nlamp low,10,12,2.5\n")
    egvs.run(egvs.load(mini), tmp_path / "third")
    comparison = compare_runs([two[0], tmp_path / "third"])
    assert comparison.by == "pole"
    pole = next(pole for pole in comparison.poles if pole.name == "pole_a")
    first, second = pole.mounts
    assert first is not None
    assert second is not None
    assert (first.site, first.z_m) == ("pole_a", 3.0)
    scores = dict(
        zip(
            *(egvs.read_scores(tmp_path / "third" / "scores.parquet").to_pydict()[k] for k in ("site", "egvs")),
            strict=True,
        )
    )
    assert second.egvs == max(scores.values()) == scores[second.site]
    assert [pole.mounts[1] for pole in comparison.poles if pole.name == "pole_b"] == [None]
    assert comparison.agreements[0].shared == 1


@pytest.mark.slow
def test_pole_that_was_moved_is_another_pole(two: tuple[Path, Path], mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12.5,3\npole_b,30.5,-12,3\n")
    egvs.run(egvs.load(mini), tmp_path / "third")
    comparison = compare_runs([two[0], tmp_path / "third"], by="pole")
    assert len(comparison.poles) == 3
    assert comparison.notes == (
        "poles of the same name at different positions in A and B count as different poles: pole_a is 0.50 m away",
    )
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12.5,3\n")
    egvs.run(egvs.load(mini), tmp_path / "fourth")
    assert compare_runs([two[0], tmp_path / "fourth"]).by == "site"  # only the names agree
    code, _, message = run_egvs("compare", two[0], tmp_path / "fourth", "--by", "pole")
    assert code == 2
    assert f"{two[0]}: no pole in common with {tmp_path / 'fourth'}" in message
    assert "pole_a is 0.50 m away" in message


@pytest.mark.slow
def test_runs_without_common_pole_are_refused(two: tuple[Path, Path], mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\nlamp,11,12,3\n")
    egvs.run(egvs.load(mini), tmp_path / "third")
    code, printed, message = run_egvs("compare", two[0], tmp_path / "third")
    assert (code, printed) == (2, "")
    assert "no pole in common" in message
    assert "Compare runs with the same poles" in message
    code, printed, _ = run_egvs("compare", two[0], tmp_path / "third", "--by", "site")
    assert code == 0
    assert "note: A and B have no site name in common, so their rankings cannot be compared" in printed


@pytest.mark.slow
def test_sensors_of_one_run_on_different_poles_are_compared(mini: Path, run_egvs) -> None:
    file = mini / "scenario.toml"
    other = (
        "[sensors.other]\nelevations_deg = [-20, -3]\nchannels = 10\nazimuth_step_deg = 1.5\nrange_m = 90\n\n[score]"
    )
    file.write_text(file.read_text().replace("[score]", other))
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\none,10,12,3,small\ntwo,30.5,-12,3,other\n")
    egvs.run(egvs.load(mini), mini / "run")
    comparison = compare_runs([mini / "run"])
    assert [pole.differences for pole in comparison.poles] == [(None, None)] * 2
    assert comparison.notes == ("A and B have no pole in common, so their rankings cannot be compared",)
    assert comparison.sensors is not None
    gain = comparison.sensors.results[1].gain
    assert gain is not None
    assert gain.is_paired
    code, printed, _ = run_egvs("compare", mini / "run")
    assert code == 0
    assert "the best mount of each sensor" in printed
    code, _, message = run_egvs("compare", mini / "run", "--by", "site")
    assert code == 2
    assert "--by site: expected a second run" in message


@pytest.mark.slow
def test_default_view_is_by_site_where_mounts_are_the_same(two: tuple[Path, Path], mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\npole_b,30.5,-12,3\n")
    egvs.run(egvs.load(mini, ["score.gamma=2"]), tmp_path / "gamma")
    assert compare_runs([two[0], tmp_path / "gamma"]).by == "site"
    assert compare_runs(two).by == "pole"  # pole_a is higher in the second run


@pytest.mark.slow
def test_scores_that_cannot_be_subtracted_have_no_difference(two: tuple[Path, Path]) -> None:
    comparison = compare_runs(two)
    assert [pole.differences for pole in comparison.poles] == [(None, None)] * 3
    assert "A and B differ in score.gamma: compare ranks and shares, not bits" in comparison.notes


@pytest.mark.slow
def test_compare_command_prints_tables_and_notes(two: tuple[Path, Path], run_egvs) -> None:
    code, printed, _ = run_egvs("compare", *two, "--by", "site")
    assert code == 0
    for part in ("A bit", "B rank", "score.gamma", "note: 1 site has the same name", str(two[0])):
        assert part in printed
    copy = shutil.copytree(two[0], two[0].with_name("copy"))
    code, printed, _ = run_egvs("compare", two[0], copy, "--top", 1)
    assert "their settings and files are the same" in printed
    assert "pole_a" not in printed or "pole_b" not in printed.split("runs")[0]
    code, printed, _ = run_egvs("compare", *two)
    assert code == 0
    for part in ("A mount", "B EGVS bit", "common poles"):
        assert part in printed


@pytest.mark.parametrize("width", [80, 190])
@pytest.mark.parametrize("runs", [2, 5])
def test_tables_fit_the_terminal(width: int, runs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    one = made_run("A", *(row(f"site_{n:02}", 123456.7 - n, n + 1) for n in range(3)), seed=1)
    all_runs = tuple(
        replace(one, label=run_comparison.run_label(n), settings={"traffic.kinds[car].length_m": n})
        for n in range(runs)
    )
    comparison = run_comparison.Comparison(
        all_runs,
        "site",
        (),
        tuple(one.sites),
        (run_comparison.compare_rankings(one, all_runs[1]),),
        None,
        tuple(run_comparison.find_differences(all_runs)),
        (),
    )
    console = Console(width=width, record=True)
    monkeypatch.setattr(study_tables, "console", lambda *_, **__: console)
    study_tables.print_comparison(comparison)
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    assert sum("123456.7" in line for line in lines) >= 1  # no number is cut
    header = [line for line in lines if line.startswith("site")]
    assert {f"{run.label} rank" for run in all_runs} <= {cell.strip() for line in header for cell in line.split("  ")}
    assert any("longitude" in line for line in header) == (width == 190)


def by_pole(*runs: ComparedRun) -> run_comparison.Comparison:
    """A comparison of made-up runs: errors of differences as if independent."""
    independent = ScoreDifferences({})
    locations = dict.fromkeys(location for run in runs for location in run.poles)
    return run_comparison.Comparison(
        runs,
        "pole",
        tuple(run_comparison._compare_pole(location, runs, independent) for location in locations),
        (),
        tuple(run_comparison.compare_rankings(runs[0], run, "pole") for run in runs[1:]),
        run_comparison._compare_sensors(runs, run_comparison._sensor_mounts(runs), independent),
        (),
        (),
    )


def printed_text(comparison: run_comparison.Comparison, width: int, monkeypatch: pytest.MonkeyPatch) -> str:
    console = Console(width=width, record=True, markup=False, highlight=False)
    monkeypatch.setattr(study_tables, "console", lambda *_, **__: console)
    monkeypatch.setattr(cli_console, "console", lambda *_, **__: console)
    study_tables.print_comparison(comparison)
    return console.export_text()


def mounts(sensor: str, *shares: float) -> list[RankedSite]:
    """Sites on poles 10 m apart, 4.5 m up, tilted by 10 degrees."""
    pose = {"z_m": 4.5, "pitch_deg": -10.0, "sensor": sensor}
    sites = []
    for number, share in enumerate(shares):
        pole = f"kerb_{number}"
        sites.append(found(f"{pole}@4.5m-10deg", share, number + 1, pole=pole, x_m=10.0 * number, **pose))
    return sites


@pytest.mark.parametrize("width", [80, 160])
@pytest.mark.parametrize("runs", [2, 5])
def test_tables_of_poles_fit_the_terminal(width: int, runs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    compared = [
        made_run(run_comparison.run_label(number), *mounts(f"OS{number}-128", 0.8 + 0.01 * number, 0.7))
        for number in range(runs)
    ]
    text = printed_text(by_pole(*compared), width, monkeypatch)
    tables = text.split("best mount of each sensor")[0].splitlines()
    assert max(len(line) for line in tables if line.startswith(("pole", "kerb"))) <= width
    first_rows = [line for line in tables if line.startswith("kerb_0")]
    for number in range(runs):
        assert any(f"{100 * (0.8 + 0.01 * number):.1f} %" in line for line in first_rows)
    assert all("80.0 %" in line for line in first_rows)  # the first run is in each table
    assert "+1.0 ± 0.4" in text
    if width == 80:
        assert "4.5 m, -10°" in first_rows[0]
    else:
        assert "kerb_0@4.5m-10deg" in first_rows[0]


def test_upright_and_inverted_mounts_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    upright = mounts("s", 0.9)
    hung = [replace(site, roll_deg=180.0, sensor="t") for site in mounts("s", 0.8)]
    row = next(
        line
        for line in printed_text(by_pole(made_run("A", *upright), made_run("B", *hung)), 90, monkeypatch).splitlines()
        if line.startswith("kerb_0")
    )
    assert row.count("4.5 m, -10°") == 2 and row.count("upside down") == 1


def test_says_at_how_many_poles_a_run_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """By +3, +0.2 and -2 percentage points, each with a standard error of 0.4."""
    a, b = made_run("A", *mounts("s", 0.9, 0.8, 0.7)), made_run("B", *mounts("t", 0.93, 0.802, 0.68))
    text = printed_text(by_pole(a, b), 160, monkeypatch)
    assert "B is better than A at 2 of 3 poles (clearly at 1), worse at 1 (clearly at 1)." in text
    for difference in ("  +3.0 ± 0.4", "~ +0.2 ± 0.4", "  -2.0 ± 0.4"):
        assert difference in text


def test_prints_how_to_set_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = made_run("A", *mounts("s", 0.9)), made_run("B", *mounts("t", 0.95))
    text = printed_text(by_pole(a, b), 160, monkeypatch)
    assert """With costs: --set 'costs.sensor={"s" = PRICE, "t" = PRICE}', or [costs] in scenario.toml""" in text
    costs = CostsConfig(sensor={"s": 1000.0, "t": 6000.0})
    text = printed_text(by_pole(replace(a, costs=costs), replace(b, costs=costs)), 160, monkeypatch)
    assert "6,000" in text
    assert "PRICE" not in text
    text = printed_text(by_pole(replace(a, costs=costs), made_run("B", *mounts("u", 0.95))), 160, monkeypatch)
    assert """'costs.sensor={"s" = PRICE, "u" = PRICE}'""" in text
    assert "Do not choose between real sensors by less than about 10 points." in " ".join(text.split())


@pytest.mark.parametrize("width", [80, 160])
def test_sentences_are_broken_between_words(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = made_run("A", *mounts("s", 0.9)), made_run("B", *mounts("t", 0.95))
    comparison = by_pole(a, b)
    lines = printed_text(comparison, width, monkeypatch).splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("Do not choose between real"))
    paragraph = lines[first : lines.index("", first)]
    assert len(paragraph) >= 2
    assert max(map(len, paragraph)) <= width
    assert " ".join(line.rstrip() for line in paragraph) == describe_trust(comparison.sensors)


@pytest.mark.parametrize(("width", "is_table"), [(80, False), (160, True)])
def test_settings_that_differ_are_sentences_where_the_table_is_too_wide(
    width: int, is_table: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"a sensor with a long name {number}" for number in range(4)]
    runs = [
        made_run(run_comparison.run_label(number), *mounts("s", 0.9), **{"sites.replace_sensor": name})
        for number, name in enumerate(names)
    ]
    comparison = replace(by_pole(*runs), differences=tuple(run_comparison.find_differences(runs)))
    text = printed_text(comparison, width, monkeypatch).split("what differs")[1]
    assert max(map(len, text.splitlines())) <= width
    for name in names:
        assert name in " ".join(text.split())
    assert ("sites.replace_sensor: A a sensor" in text) != is_table


def test_a_comparison_takes_at_most_250_words_of_100_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sensors at twelve poles, with costs, of which the first five are listed."""
    shares = [0.9 - 0.01 * number for number in range(12)]
    costs = CostsConfig(sensor={"OS1-128": 4000.0, "VLP-32C": 2000.0})
    a, b = made_run("A", *mounts("OS1-128", *shares)), made_run("B", *mounts("VLP-32C", *shares[::-1]))
    comparison = by_pole(replace(a, costs=costs), replace(b, costs=costs))
    text = printed_text(comparison, 100, monkeypatch)
    assert max(map(len, text.splitlines())) <= 100
    assert len(text.split()) <= 250
    assert "7 more poles: --top 12 lists all" in text


@pytest.mark.parametrize(("poles", "has_correlation"), [(4, False), (5, True)])
def test_no_rank_correlation_of_a_few_poles(poles: int, has_correlation: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    shares = [0.9 - 0.01 * number for number in range(poles)]
    runs = [made_run(label, *mounts("s", *shares)) for label in "AB"]
    agreement = run_comparison.compare_rankings(*runs, "pole")
    text = printed_text(replace(by_pole(*runs), agreements=(agreement,)), 100, monkeypatch)
    assert ("tau" in text) == ("1.00" in text) == has_correlation
    assert "the same: " in text


def test_many_runs_agree_or_not_with_the_first_one_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def pairs(number_of_runs: int) -> set[str]:
        runs = [made_run(run_comparison.run_label(n), *mounts("s", 0.9, 0.8)) for n in range(number_of_runs)]
        comparison = by_pole(*runs)
        agreements = [run_comparison.compare_rankings(a, b, "pole") for a, b in combinations(runs, 2)]
        text = printed_text(replace(comparison, agreements=tuple(agreements)), 160, monkeypatch)
        assert ("only pairs with A" in text) == (number_of_runs > 5)
        return set(re.findall(r"^(\w, \w) ", text, re.MULTILINE))

    assert pairs(5) == {f"{a}, {b}" for a, b in combinations("ABCDE", 2)}
    assert pairs(6) == {f"A, {other}" for other in "BCDEF"}


def test_tables_name_the_reference_of_their_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first run for poles; the sensor that finds least, or the cheapest, for sensors."""
    a, b = made_run("A", *mounts("s", 0.9)), made_run("B", *mounts("t", 0.95))
    text = printed_text(by_pole(a, b), 160, monkeypatch)
    assert "B - A" in text
    assert "from s" in next(line for line in text.splitlines() if line.startswith("sensor"))
    costs = CostsConfig(sensor={"s": 6000.0, "t": 1000.0})
    text = printed_text(by_pole(replace(a, costs=costs), replace(b, costs=costs)), 160, monkeypatch)
    assert "from t" in next(line for line in text.splitlines() if line.startswith("sensor"))


@pytest.mark.slow
def test_costs_of_the_command_line_replace_those_of_the_run(mini: Path, tmp_path: Path, run_egvs) -> None:
    egvs.run(egvs.load(mini, ["costs.pole=5", "costs.sensor={small=7}"]), tmp_path / "run")
    both = [tmp_path / "run", tmp_path / "run"]
    assert compare_runs(both).runs[0].costs == CostsConfig(pole=5, sensor={"small": 7})
    overridden = compare_runs(both, costs=["costs.sensor={small=9, VLP-16=3}", "costs.metre=2"]).runs[1].costs
    assert overridden == CostsConfig(pole=5, metre=2, sensor={"small": 9, "VLP-16": 3})
    for override, message in (
        ("traffic.frames=3", "--set traffic.frames=3: expected a key of [costs]"),
        ("costs.pole=-1", "--set: costs.pole: expected a value greater than or equal to 0, got -1"),
        ("costs.lamp=1", "costs.lamp"),
        ("costs.sensor={smal=9}", "--set: costs.sensor: unknown sensor 'smal'. Did you mean small?"),
    ):
        code, printed, error = run_egvs("compare", both[0], "--set", override)
        assert (code, printed) == (2, "")
        assert message in error


@pytest.mark.slow
def test_missing_table_row_is_one_difference(
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
    comparison = {d.what: d.values for d in compare_runs([tmp_path / "first", tmp_path / "second"]).differences}
    assert comparison == {"traffic.kinds[car].length_m": (4.5, 4.4), "traffic.kinds[van]": (None, "present")}
    _, printed, _ = run_egvs("compare", tmp_path / "first", tmp_path / "second")
    assert "traffic.kinds[car].length_m" in printed


@pytest.mark.slow
def test_missing_effect_is_listed_by_its_parameters(mini: Path, tmp_path: Path) -> None:
    folders = tmp_path / "plain", tmp_path / "rain"
    for folder, named in zip(folders, ([], ["effects.rain.rate_mm_h=30"]), strict=True):
        egvs.run(egvs.load(mini, named), folder)
    assert [(one.what, one.values) for one in compare_runs(folders).differences] == [
        ("effects.rain.rate_mm_h", (None, 30.0))
    ]


def test_empty_table_is_listed_by_rows_of_other_run() -> None:
    runs = [
        made_run(label, row("p", 1.0), **settings)
        for label, settings in (
            ("A", {"traffic.periods": [], "seed": 1}),
            ("B", {"traffic.periods[day].weight": 1.0, "seed": 1}),
        )
    ]
    comparison = [(d.what, d.values) for d in run_comparison.find_differences(runs)]
    assert comparison == [("traffic.periods[day]", (None, "present"))]


def test_labels_continue_after_z() -> None:
    assert [run_comparison.run_label(n) for n in (0, 25, 26, 27, 52)] == ["A", "Z", "AA", "AB", "BA"]


@pytest.mark.slow
def test_rejects_the_same_run_twice(two: tuple[Path, Path], tmp_path: Path, run_egvs) -> None:
    (tmp_path / "link").symlink_to(two[0])
    for again in (two[0], f"{two[0]}/", tmp_path / "link"):
        code, _, message = run_egvs("compare", two[0], again)
        assert code == 2
        assert message.startswith(f"egvs: compare: the same run twice, {two[0]}")


@pytest.mark.slow
def test_plan_request_is_no_difference(two: tuple[Path, Path]) -> None:
    record = RunRecord.read(two[1])
    record.scenario["placement"] |= {"count": 2, "least_distance_m": 4.0}
    record.write(two[1])
    differences = [difference.what for difference in compare_runs(two).differences]
    assert "placement.least_distance_m" in differences
    assert "placement.count" not in differences


@pytest.mark.slow
def test_rejects_folders_without_finished_run(two: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a second run, because all sites of this one have the sensor small"):
        compare_runs(two[:1])
    with pytest.raises(InputError, match="expected at least one run, got none"):
        compare_runs([])
    with pytest.raises(InputError, match=r"nowhere: no such folder. Give a folder written by egvs run."):
        compare_runs([two[0], tmp_path / "nowhere"])
    record = json.loads((two[1] / "run.json").read_text())
    (two[1] / "scores.parquet").write_bytes((two[0] / "scores.parquet").read_bytes())
    with pytest.raises(InputError, match="was changed after the run"):
        compare_runs(two)
    del record["stages"]["score"]
    (two[1] / "run.json").write_text(json.dumps(add_checksum(record)))
    with pytest.raises(InputError, match="the stage score was not run"):
        compare_runs(two)
