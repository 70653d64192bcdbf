"""Are periods of the day mixed by weight, exactly, and told apart?

Evidence: rational arithmetic from the definition; each period run alone, without the others; slow twins for leaving
groups out; and each wrong use with its message."""

from __future__ import annotations

import math
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.artefacts import parquet, tpog
from egvs.artefacts.readers import PeriodRanking, read_scores_by_period
from egvs.artefacts.tpog import read_periods, read_tpog
from egvs.core.errors import Diagnostic, InputError, collect_warnings
from egvs.core.grid import Grid
from egvs.runs.run_context import open_folder
from egvs.scoring.egvs import EntropyField, binary_entropy
from egvs.scoring.score_table import ScoreTable, SiteScores
from egvs.scoring.scorer import SiteScore
from egvs.scoring.standard_errors import BlockGroups, BlockJackknife, ScoreUncertainty
from egvs.stages import score, traffic
from egvs.studies.effect_study import effect_statuses

PERIODS = """
[[traffic.periods]]
name = "day"
weight = 2.5
length_s = 12

[[traffic.periods]]
name = "night"
begin_s = 12
length_s = 8
"""


@pytest.fixture
def split(mini: Path) -> Path:
    """The small scenario, its first 24 frames by day and its last 16 by night."""
    file = mini / "scenario.toml"
    file.write_text(file.read_text().replace("[[traffic.kinds]]", f"{PERIODS}\n[[traffic.kinds]]", 1))
    return mini


def of(table: object) -> list[dict[str, object]]:
    return table.to_pylist()  # type: ignore[attr-defined, no-any-return]


@pytest.mark.slow
def test_mix_is_exact(split: Path, tmp_path: Path) -> None:
    record = egvs.run(egvs.load(split), tmp_path)
    path = tmp_path / "tpog.parquet"
    day, night, mix = read_tpog(path, "day"), read_tpog(path, "night"), read_tpog(path)
    assert (day.frames, night.frames) == (24, 16)
    assert [(p.name, p.weight, p.blocks, p.times) for p in read_periods(path)] == [
        ("day", 2.5, 4, 5),
        ("night", 1.0, 4, 3),
    ]
    assert mix.frames == 5 * 24 + 3 * 16
    boxes = [parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")[0].column("frame").to_numpy()]
    by_day, by_night = (np.count_nonzero(boxes[0] < 24) / 24, np.count_nonzero(boxes[0] >= 24) / 16)
    mean = record.stages["tpog"].summary["boxes_in_roi"]
    assert mean == pytest.approx((2.5 * by_day + by_night) / 3.5)
    wanted = {}
    for cell in zip(*np.nonzero(day.counts + night.counts), strict=True):
        shares = Fraction(int(day.counts[cell]), 24), Fraction(int(night.counts[cell]), 16)
        wanted[cell] = (Fraction("2.5") * shares[0] + shares[1]) / Fraction("3.5")
    found = {cell: Fraction(int(mix.counts[cell]), mix.frames) for cell in zip(*np.nonzero(mix.counts), strict=True)}
    assert found == wanted


@pytest.mark.slow
def test_period_scores_equal_those_of_separate_run(split: Path, tmp_path: Path) -> None:
    egvs.run(egvs.load(split), tmp_path / "both")
    by_period = of(read_scores_by_period(tmp_path / "both" / "scores_by_period.parquet"))
    text = (split / "scenario.toml").read_text().replace(PERIODS, "")
    for name, begin_s, frames in (("day", 0, 24), ("night", 12, 16)):
        (split / "scenario.toml").write_text(text)
        alone = tmp_path / name
        egvs.run(egvs.load(split, [f"traffic.frames={frames}", f"traffic.begin_s={begin_s}"]), alone)
        rows = of(egvs.read_scores(alone / "scores.parquet"))
        for row, its in zip(rows, (row for row in by_period if row["period"] == name), strict=True):
            assert {key: row[key] for key in its if key != "period"} == {k: v for k, v in its.items() if k != "period"}
        assert not (alone / "scores_by_period.parquet").exists()
        theirs, own = read_tpog(tmp_path / "both" / "tpog.parquet", name), read_tpog(alone / "tpog.parquet")
        assert (theirs.counts == own.counts).all()


@pytest.mark.slow
def test_changed_weights_need_no_new_traffic(split: Path, tmp_path: Path) -> None:
    egvs.run(egvs.load(split), tmp_path)
    table, about = parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")
    assert (about["frames"], about["periods"]) == (40, [{"name": "day", "frames": 24}, {"name": "night", "frames": 16}])
    assert np.unique(table.column("frame")).tolist() == list(range(40))
    file = split / "scenario.toml"
    file.write_text(file.read_text().replace("weight = 2.5", "weight = 1"))
    states: dict[str, str] = {}
    egvs.run(egvs.load(split), tmp_path, listener=lambda stage, state, _: states.update({stage: state}))
    assert states["traffic"] == "skipped"
    assert (states["tpog"], states["score"]) == ("done", "done")
    assert read_tpog(tmp_path / "tpog.parquet").frames == 2 * 24 + 3 * 16


@pytest.mark.slow
def test_run_with_periods_is_reproducible_and_reported(split: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    code, printed, told = run_egvs("run", split, "--out", tmp_path / "out", "--verbose")
    assert code == 0
    (night,) = (line for line in told.splitlines() if line.split()[:1] == ["night"])
    assert night.split("   ")[-1].startswith("16 frames; 2 vehicles at a time, 2 in all;")
    assert "standard errors from day: 4 blocks of 6 frames" in told
    (head,) = (line for line in printed.splitlines() if "pole  " in line)
    assert "in day" in head and "in night" in head
    page = (tmp_path / "out" / "report.html").read_text()
    assert "By period" in page
    assert "night<br>(28.6\u00a0%)" in page
    assert ">40 frames<small>one every 0.5 s, 20 s in total, in 2 periods" in page
    assert "<dt>day</dt><dd>24 frames; 2 vehicles at a time, 2 in total;" in page
    assert page.index("<h2>Where the sites are") < page.index("<h2>By period")
    ranking = PeriodRanking.read(tmp_path / "out")
    assert ranking is not None
    assert (ranking.periods, ranking.frames) == (("day", "night"), 40)
    assert run_egvs("verify", tmp_path / "out")[0] == 0


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(1, 999), st.integers(1, 5000)), min_size=1, max_size=4),
    st.sampled_from([1.0, 0.1, 0.01]),
)
def test_frames_count_in_the_ratio_of_the_weights(rows: list[tuple[int, int]], unit: float) -> None:
    weights, frames = [round(n * unit, 2) for n, _ in rows], [t for _, t in rows]
    try:
        found = tpog.frame_multiplicities(weights, frames, "scenario.toml: traffic")
    except InputError:
        return  # too many frames for this mix
    total = sum(m * t for m, t in zip(found, frames, strict=True))
    whole = sum(Fraction(str(w)) for w in weights)
    for weight, count, number in zip(weights, frames, found, strict=True):
        assert Fraction(number * count, total) == Fraction(str(weight)) / whole
    assert np.gcd.reduce(found) == 1


def test_jackknife_of_mix_leaves_groups_out_by_period() -> None:
    rng, grid = np.random.default_rng(2), Grid.from_json({"origin_m": [0.0] * 3, "voxel_m": 1.0, "shape": [5, 4, 1]})
    records = (BlockGroups(np.array([10, 20]), 0.0), BlockGroups(np.array([8, 8, 8]), 0.0))
    counts = [rng.integers(0, 8, size=(k, 20)).astype(np.uint32) for k in (2, 3)]
    hits, times = rng.integers(0, 9, size=20).astype(np.uint32), (4, 3)
    leave_out = BlockJackknife.from_mix(np.vstack(counts), np.arange(20), records, times, grid)
    found = leave_out.scores(hits, 5.0)
    weight = [m * its.total for m, its in zip(times, records, strict=True)]
    columns = [(None, None), *((q, g) for q in (0, 1) for g in range(len(counts[q])))]
    p_left: list[list[float]] = []
    for column, (record, group) in enumerate(columns):
        total = 0.0
        p_left.append([])
        for cell in range(20):
            p = 0.0
            for q in (0, 1):
                kept = [g for g in range(len(counts[q])) if (q, g) != (record, group)]
                there, frames = sum(int(counts[q][g, cell]) for g in kept), sum(int(records[q].frames[g]) for g in kept)
                p += weight[q] / sum(weight) * there / frames
            p_left[-1].append(p)
            total += min(5, int(hits[cell])) * (-(p * np.log2(p) + (1 - p) * np.log2(1 - p)) if 0 < p < 1 else 0.0)
        assert found[column] == pytest.approx(total, rel=1e-12)
    assert pytest.approx(np.array(p_left)) == leave_out.p[leave_out.classes].T
    crossed = (np.array(p_left) * (hits > 0)).sum(axis=1) / np.array(p_left).sum(axis=1)
    assert leave_out.voxel_shares(hits, "expected_visibility") == pytest.approx(crossed)
    mixed = (4 * counts[0].sum(axis=0) + 3 * counts[1].sum(axis=0)).astype(np.int64)
    assert found[0] == pytest.approx(EntropyField.of(mixed, sum(weight), grid).score(hits, 5.0).egvs, rel=1e-13)
    assert len(ScoreUncertainty.of(found[None], leave_out.groups).strata) == 2


def test_variances_and_biases_of_a_mix_add_up_by_hand() -> None:
    """One site, 100 bit. By day two equal groups, without which it has 98 and 100; by night groups of 10 and 20
    frames, without which it has 97 and 99."""
    records = (BlockGroups(np.array([10, 10]), 0.0), BlockGroups(np.array([10, 20]), 0.0))
    estimate = ScoreUncertainty.of(np.array([[100.0, 98.0, 100.0, 97.0, 99.0]]), records)
    # day: h = 2, so S~ = 200 - (98 + 100) / 2 = 101; pseudo-values 102 and 100; se^2 = ((1 + 1) / 1) / 2 = 1
    # night: h = 3 and 1.5, so S~ = 200 - (2/3 97 + 1/3 99) = 307/3; pseudo-values 300 - 194 = 106, 150 - 49.5 = 100.5;
    #        se^2 = ((11/3)^2 / 2 + (11/6)^2 / 0.5) / 2 = (121/18 + 121/18) / 2 = 121/18
    assert estimate.se[0] == pytest.approx((1 + 121 / 18) ** 0.5)
    assert estimate.bias[0] == pytest.approx((100 - 101) + (100 - 307 / 3))
    assert estimate.freedom == pytest.approx((1 + 121 / 18) ** 2 / (1 + (121 / 18) ** 2))  # one degree each


@pytest.mark.slow
def test_standard_errors_of_mix_and_periods_are_reported(split: Path, tmp_path: Path) -> None:
    record = egvs.run(egvs.load(split), tmp_path)
    rows = of(egvs.read_scores(tmp_path / "scores.parquet"))
    assert all(row["egvs_se"] > 0 for row in rows)  # type: ignore[operator]
    assert all(row["egvs_se"] > 0 for row in of(read_scores_by_period(tmp_path / "scores_by_period.parquet")))  # type: ignore[operator]
    summary = record.stages["score"].summary
    day, night = summary["standard_errors_from"].split("; ")
    assert day.startswith("day: 4 blocks of 6 frames")
    assert night.startswith("night: 4 blocks of 4 frames")
    doubts = [finding for finding in collect_warnings([summary]) if finding.rule == "traffic autocorrelation"]
    assert doubts
    assert {finding.where for finding in doubts} <= {
        f"scenario.toml: traffic.periods ({name}).length_s" for name in ("day", "night")
    }
    assert all(finding.hint.startswith("Set length_s to at least ") for finding in doubts)


def score_table_of(**sites: tuple[float, ...]) -> ScoreTable:
    """The EGVS of each site: of the mix, then of the periods ``morning`` and ``night``."""
    scores = []
    for name, (mix, *by_period) in sites.items():
        periods = tuple(SiteScore(value, 0.0) for value in by_period)
        scores.append(SiteScores(name, SiteScore(mix, 0.0, by_period=periods), None))
    return ScoreTable.of(scores, {}, periods=("morning", "night"))


def test_warns_of_period_with_other_best_site() -> None:
    table = score_table_of(a=(9.0, 9.0, 3.0), b=(7.0, 6.0, 4.0))
    (warning,) = score.warn_period_disagreements(table, "egvs")
    assert warning.where == "scenario.toml: traffic.periods (night)"
    assert warning.problem == "the best site is b; a, the best of the mix, has rank 2 and scores 25.0 % less"
    assert not list(score.warn_period_disagreements(score_table_of(a=(9, 9, 4), b=(7, 6, 4)), "egvs"))
    assert not list(score.warn_period_disagreements(score_table_of(a=(9, 0, math.nan)), "egvs"))


def test_period_with_slightly_better_site_is_no_warning_where_errors_are_unknown() -> None:
    def count(night: float) -> int:
        return len(list(score.warn_period_disagreements(score_table_of(a=(9, 9, night), b=(7, 6, 4)), "egvs")))

    assert (count(3.95), count(3.97)) == (1, 0)


def shares_at_night(a: float, b: float) -> ScoreTable:
    """Two sites by their entropy seen, a share: a is the best of the mix and has these shares at night."""
    sites = []
    for name, mix, night in (("a", 0.9, a), ("b", 0.7, b)):
        by_period = (SiteScore(1.0, mix), SiteScore(1.0, night))
        sites.append(SiteScores(name, SiteScore(1.0, mix, by_period=by_period), None))
    return ScoreTable.of(sites, {}, periods=("morning", "night"))


def test_loss_of_shares_is_in_percentage_points() -> None:
    (warning,) = score.warn_period_disagreements(shares_at_night(0.40, 0.412), "entropy_seen")
    assert warning.problem.endswith("has rank 2 and scores 1.2 percentage points less")
    assert not list(score.warn_period_disagreements(shares_at_night(0.40, 0.408), "entropy_seen"))  # 2 % less


@pytest.mark.parametrize(("scatter", "warnings"), [(0.001, 1), (0.1, 0)])
def test_known_errors_decide_whether_a_period_disagrees(scatter: float, warnings: int) -> None:
    """At night b leads by 0.5 %, with left-out scores that scatter little or much against those of a."""
    groups = {period: (BlockGroups(np.full(6, 5), 0.0),) for period in ("", "morning", "night")}
    swing = scatter * np.array([0.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    flat = np.zeros(7)
    sites = []
    for name, mix, night, change in (("a", 9.0, 3.98, flat), ("b", 7.0, 4.0, swing)):
        by_period = (SiteScore(mix, 0.0, mix + flat), SiteScore(night, 0.0, night + change))
        sites.append(SiteScores(name, SiteScore(mix, 0.0, mix + flat, by_period=by_period), None))
    table = ScoreTable.of(sites, groups, periods=("morning", "night"))
    assert len(list(score.warn_period_disagreements(table, "egvs"))) == warnings


def test_score_table_is_long_and_labelled() -> None:
    table = score_table_of(a=(9.0, 9.0, 3.0), b=(7.0, 6.0, 4.0))
    assert table.table.column_names == ["site", "period", "replicate", "score", "value"]
    rows = [tuple(row.values()) for row in table.table.to_pylist() if row["score"] == "egvs"]
    assert rows[:3] == [("a", "", 0, "egvs", 9.0), ("a", "morning", 0, "egvs", 9.0), ("a", "night", 0, "egvs", 3.0)]
    assert table.column("egvs", "night").values.tolist() == [3.0, 4.0]
    assert [column.best for column in table.by_period("egvs").values()] == [{0}, {1}]
    assert table.column("egvs", "night").rank.tolist() == [2, 1]


def test_score_table_keeps_replicates_of_each_period() -> None:
    groups = {"": (BlockGroups(np.array([5, 5]), 0.0),)}
    scores = SiteScore(9.0, 0.5, np.array([9.1, 8.0, 10.0]), {"coverage": np.array([0.5, 0.4, 0.6])})
    table = ScoreTable.of([SiteScores("a", scores, None)], groups)
    egvs = table.column("egvs")
    assert egvs.values.tolist() == [9.0]
    assert egvs.replicates is not None and egvs.replicates.tolist() == [[9.1, 8.0, 10.0]]
    coverage = table.column("coverage")
    assert coverage.replicates is not None and coverage.replicates.tolist() == [[0.5, 0.4, 0.6]]
    assert table.column("entropy_seen").replicates is None
    assert math.isnan(table.column("entropy_seen").se[0])


@pytest.mark.slow
def test_periods_disagree_without_standard_errors_too(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Diagnostic("periods disagree", "scenario.toml: traffic.periods (night)", "b is the best site, not a", "")
    monkeypatch.setattr(score, "warn_period_disagreements", lambda *_: [told])
    for override in ("score.standard_error=true", "score.standard_error=false", "tpog.blocks=1"):
        record = egvs.run(egvs.load(split, [override]), tmp_path / override)
        assert told in collect_warnings([record.stages["score"].summary]), override


@pytest.mark.slow
def test_report_counts_rows_that_are_not_shown(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = "".join(f"p{n},{10 + n},12,3\n" for n in range(4))
    (split / "sites.csv").write_text(f"site,x_m,y_m,z_m\n{rows}")
    for name, count in (("LISTED", 2), ("FIRST", 1), ("LAST", 1)):
        monkeypatch.setattr(f"egvs.report.page.{name}", count)
    egvs.run(egvs.load(split), tmp_path)
    html = (tmp_path / "report.html").read_text()
    assert "2 more are not shown; scores_by_period.parquet has all sites" in html
    assert "Choose any site here" in html
    assert re.search(r"Vehicles at a time</dt><dd>2<small>", html)


def test_effect_that_periods_forbid_is_not_recommended(split: Path) -> None:
    """Replaying the frames of all periods alike is refused in a scenario; it must not be recommended for one."""
    (found,) = (call for call in effect_statuses(egvs.load(split)) if call.name == "moving_occlusion")
    assert (found.state, found.why) == (
        "off",
        'cannot act here: method = "frames" ignores the weights of the periods.'
        ' Use method = "independent", which weights the periods.',
    )


def test_the_world_frame_counts_where_a_period_alone_is_a_finished_file(
    split: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Degrees in a recorded file are brought into the world frame, whichever period names it."""
    file, fcd = split / "scenario.toml", 'fcd = "fcd.csv"\n'
    each = file.read_text().replace(fcd, "").replace("length_s", f"{fcd}length_s")
    file.write_text(each.replace("[traffic]", '[traffic]\nnetwork = "n.net.xml"'))
    (split / "n.net.xml").write_text("<net/>")
    scenario = egvs.load(split)
    assert scenario.traffic.fcd is None
    assert scenario.is_recorded
    monkeypatch.setattr("egvs.world.geolocation.world_frame_settings", lambda _: {"world_frame": "here"})
    assert traffic.dependencies(open_folder(scenario, split)).settings["world_frame"] == "here"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "night"', 'name = "day"', "two periods have the same name: day"),
        ('name = "night"', 'name = "Day"', "two periods have the same name: day"),
        (
            'name = "night"',
            'name = ".."',
            r"traffic\.periods\.1\.name: expected a name, got '\.\.'. Use a name .*not only dots",
        ),
        ('name = "night"', f'name = "{"n" * 81}"', r"traffic\.periods\.1\.name: .*at most 80 characters, got 'n+'"),
        ('name = "night"', 'name = "a\\u0000b"', r"traffic\.periods\.1\.name: expected a name, got 'a.*b'"),
        ("length_s = 8", "length_s = 8.1", "period 'night': length_s = 8.1 is not a multiple of 0.5 s"),
        ("length_s = 8", "length_s = 9", "tpog.blocks = 4 does not divide traffic.frames = 18 of the period 'night'"),
        ("weight = 2.5", "weight = 0", r"traffic\.periods\.0\.weight: expected a value greater than 0, got 0\n$"),
        ("weight = 2.5", "weight = 2.123456789", "need a mix of more than .* frames\\. Use weights with fewer digits"),
        ("begin_s = 12", "begin = 12", "begin"),
        ("blocks = 4", "blocks = 40000", "blocks = 40000 gives 80000 blocks in all periods, more than 65535"),
        ("length_s = 8", "length_s = 80", "frames"),
        ("length_s = 8", 'fcd = "a"\nsumocfg = "b"', "expected one of sumocfg, fcd, tracks, got sumocfg and fcd"),
        (
            "length_s = 8",
            "vehicles = 5",
            r"traffic.periods \(night\): vehicles has no effect with fcd. Remove vehicles",
        ),
        ("length_s = 8", 'counts = [{edge = "e", per_hour = 5}]', r"\(night\): counts has no effect with fcd"),
        ("frames = 40", "step_s = 1.0", "traffic: step_s has no effect with fcd"),
        ("[score]", "[effects.moving_occlusion]\n[score]", 'method = "frames" cannot weight the periods'),
    ],
)
def test_rejects_invalid_periods(
    split: Path,
    tmp_path: Path,
    old: str,
    new: str,
    message: str,
    run_egvs,  # type: ignore[no-untyped-def]
) -> None:
    file = split / "scenario.toml"
    file.write_text(file.read_text().replace(old, new))
    code, _, complaint = run_egvs("run", split, "--out", tmp_path / "out")
    assert code == 2
    assert re.search(message, complaint)


def test_a_key_that_acts_in_one_period_may_stand_for_all(split: Path) -> None:
    """Of the first period, a finished file, SUMO's step is none of its business."""
    file = split / "scenario.toml"
    text = file.read_text().replace('fcd = "fcd.csv"', "step_s = 0.5").replace("length_s = 12", 'fcd = "fcd.csv"')
    file.write_text(text.replace("begin_s = 12", 'sumocfg = "night.sumocfg"'))
    day, night = (scenario.traffic for scenario in egvs.load(split).by_period().values())
    assert (day.fcd, night.sumocfg, night.step_s) == ("fcd.csv", "night.sumocfg", 0.5)


@pytest.mark.slow
def test_rejects_unknown_period(split: Path, tmp_path: Path) -> None:
    egvs.run(egvs.load(split), tmp_path)
    with pytest.raises(InputError, match=r"there is no period 'noon'\. The periods are day, night"):
        read_tpog(tmp_path / "tpog.parquet", "noon")
    path = tmp_path / "tpog.parquet"
    table, about = parquet.read_artefact(path, "tpog")
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    for broken in ([], [{}], [about["periods"][0] | {"times": 0}], "day"):
        parquet.write_artefact(path, "tpog", columns, about | {"periods": broken})
        with pytest.raises(InputError, match="invalid metadata: periods = "):
            read_tpog(path)


def test_entropy_of_a_mix_is_that_of_its_share() -> None:
    assert binary_entropy(3, 8) == binary_entropy(15, 40)


def test_rejects_missing_file_of_period(split: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    file = split / "scenario.toml"
    file.write_text(file.read_text().replace("begin_s = 12", 'fcd = "nacht.csv"'))
    code, _, complaint = run_egvs("run", split, "--out", tmp_path / "out")
    assert code == 2
    assert re.search(r"scenario\.toml: traffic\.periods \(night\)\.fcd.*nacht\.csv", complaint)
    assert not (tmp_path / "out" / "statics.ply").exists()
