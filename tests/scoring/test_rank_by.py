"""Do sites rank by the score that the scenario names, and is each score its definition?

Evidence: means over vehicle-frames from the slow twin that puts every beam to every box; entropies voxel by voxel; each
wrong use with its message."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet, readers
from egvs.artefacts.readers import PeriodRanking, read_scores, read_scores_by_period, read_visibility
from egvs.artefacts.tpog import read_tpog
from egvs.artefacts.traffic_frames import read_frames
from egvs.core.errors import InputError, collect_warnings
from egvs.scenario import loading
from egvs.scenario.score_config import SCORES_GROUP, VEHICLE_SCORES, RankingScore, ScoreConfig
from egvs.scoring.egvs import binary_entropy
from egvs.scoring.target_scores import TARGET_SCORES, expected_detections
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.stages import score
from tests.core.test_plugins import clear_caches, install
from tests.installed import needs
from tests.scoring import target_scenes as scenes
from tests.stage_runner import inputs_of, run_stage

DEMO = Path(__file__).parents[2] / "scenarios" / "demo"
ALL = 'score.others=["expected_detections", "seen_well", "points_on_target", "entropy_seen"]'
SITES = "site,x_m,y_m,z_m\n" + "".join(f"s{n},{5 + 6 * n},{11 - 22 * (n % 2)},{2 + n}\n" for n in range(5))


def run(folder: Path, out: Path, *overrides: str) -> dict[str, dict[str, float]]:
    egvs.run(loading.load(folder, overrides), out, jobs=2)
    return {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}


def by_rank(rows: dict[str, dict[str, float]], name: str) -> bool:
    """Whether the ranks are those of a score."""
    return all(row["rank"] == 1 + sum(other[name] > row[name] for other in rows.values()) for row in rows.values())


@pytest.mark.slow
def test_target_scores_match_slow_reference(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = run(mini, tmp_path / "run", ALL)
    scenario = loading.load(mini)
    frames = list(read_frames(tmp_path / "run" / "trajectories.parquet", np.arange(40)))
    monkeypatch.setattr(scenes, "GRID", scenario.roi.grid)
    scanner = Scanner(egvs.build_scene(scenario))
    blocks = np.repeat([one.number // 10 for one in frames], [len(one.target_rows(scenes.GRID.roi)) for one in frames])
    widened = []
    for site in scanner.scene.sites:
        points = np.array(scenes.seen_slowly(frames, Beams.of(scanner.scan_site(site)))["points"])
        assert len(points) == len(blocks) == 76
        for name, worth in (("points_on_target", np.log(1 + points)), ("seen_well", 1 - np.exp(-points / 20))):
            assert rows[site.name][name] == pytest.approx(worth.mean(), rel=1e-12)
            left = np.array([worth[blocks != block].mean() for block in range(4)])
            widened.append(rows[site.name][f"{name}_se"] / np.sqrt(3 / 4 * ((left - left.mean()) ** 2).sum()))
    assert widened == pytest.approx([widened[0]] * 4)  # for the traffic's memory
    assert 1.0 <= widened[0] < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("name", get_args(RankingScore))
def test_sites_rank_by_named_score(mini: Path, tmp_path: Path, name: str) -> None:
    (mini / "sites.csv").write_text(SITES)
    rows = run(mini, tmp_path / "run", f"score.rank_by={name}", "score.others=[]")
    assert by_rank(rows, name)
    columns = set(next(iter(rows.values())))
    assert {name, f"{name}_se", "egvs_se", "beats_next"} <= columns
    computed = {name, "noticed"} if name == "expected_detections" else {name}
    assert columns.isdisjoint(set(TARGET_SCORES) - computed)
    assert parquet.read_metadata(tmp_path / "run" / "scores.parquet", "scores")["rank_by"] == name
    ranked = sorted(rows.values(), key=lambda row: row["rank"])
    assert ranked[-1]["beats_next"] == 1.0
    assert (ranked[0]["behind_best_se"], ranked[0]["best_beats"]) == (0.0, 0.5)
    assert ranked[1]["best_beats"] == ranked[0]["beats_next"]
    assert all(0.5 <= row["beats_next"] <= 1.0 for row in ranked)


@pytest.mark.slow
def test_rank_by_changes_no_score(mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text(SITES)
    plain, other = run(mini, tmp_path / "a"), run(mini, tmp_path / "b", "score.rank_by=points_on_target", ALL)
    shared = set(plain["s0"]) - {"rank", "beats_next", "behind_best_se", "best_beats"}
    assert {"egvs", "egvs_se", "expected_detections", "expected_detections_se"} <= shared
    assert all(other[site][key] == row[key] for site, row in plain.items() for key in shared)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["entropy_seen", "coverage", "expected_visibility"])
def test_standard_error_of_voxel_share_matches_groups(mini: Path, tmp_path: Path, name: str) -> None:
    """With two blocks a group left out is the other block: its share by hand, voxel by voxel."""
    more = ("tpog.blocks=2", "score.keep_visibility=all")
    rows = run(mini, tmp_path / "run", f'score.others=["{name}"]', *more)
    worth = {
        "entropy_seen": binary_entropy,
        "coverage": lambda count, _: float(count > 0),
        "expected_visibility": lambda count, frames: count / frames,
    }[name]
    path = tmp_path / "run" / "tpog.parquet"
    counts = {}
    for row in parquet.read_artefact(path, "tpog")[0].to_pylist():
        counts.setdefault((row["ix"], row["iy"], row["iz"]), [0, 0])[row["block"]] += row["count"]
    for site, row in rows.items():
        hits = read_visibility(tmp_path / "run" / "visibility.parquet", site)
        shares = []
        for kept in ((0,), (1,), (0, 1)):
            each = {cell: worth(sum(its[b] for b in kept), 20 * len(kept)) for cell, its in counts.items()}
            shares.append(sum(w for cell, w in each.items() if hits[cell]) / sum(each.values()))
        assert row[name] == pytest.approx(shares[2])
        # two equal groups: the pseudo-values are 2 S - S_(g), so their halved squared distances from their mean
        scatter = abs(shares[0] - shares[1]) / 2
        assert row[f"{name}_se"] >= scatter * (1 - 1e-9)
        assert row[f"{name}_se"] < 3 * scatter


@pytest.mark.slow
def test_no_standard_errors_when_disabled(mini: Path, tmp_path: Path) -> None:
    for number, override in enumerate(("score.standard_error=false", "tpog.blocks=1")):
        rows = run(mini, tmp_path / str(number), ALL, override, "score.rank_by=seen_well")
        assert by_rank(rows, "seen_well")
        assert not [name for name in rows["pole_a"] if name.endswith(("_se", "beats_next", "best_beats"))]


@pytest.mark.slow
def test_a_mix_of_periods_weighs_vehicles_with_and_without_errors(mini: Path, tmp_path: Path) -> None:
    periods = 'traffic.periods=[{name="a", length_s=12, weight=3}, {name="b", begin_s=12, length_s=8}]'
    rank = ("score.rank_by=seen_well", periods)
    rows, plain = run(mini, tmp_path / "a", *rank), run(mini, tmp_path / "b", *rank, "score.standard_error=false")
    apart = read_scores_by_period(tmp_path / "a" / "scores_by_period.parquet").to_pylist()
    frames = read_frames(tmp_path / "a" / "trajectories.parquet", np.arange(40))
    vehicles = np.array([len(one.target_rows(loading.load(mini).roi.box)) for one in frames])
    share = [3 * vehicles[:24].sum() / 24, vehicles[24:].sum() / 16]
    for site, row in rows.items():
        assert plain[site]["seen_well"] == row["seen_well"]
        a, b = (next(its for its in apart if (its["site"], its["period"]) == (site, name)) for name in "ab")
        wanted = (share[0] * a["seen_well"] + share[1] * b["seen_well"]) / sum(share)
        assert row["seen_well"] == pytest.approx(wanted, rel=1e-12)
    for name in "ab":
        assert by_rank({its["site"]: its for its in apart if its["period"] == name}, "seen_well")
    shown = PeriodRanking.read(tmp_path / "a")
    assert shown is not None
    best = {name: max(its["seen_well"] for its in apart if its["period"] == name) for name in "ab"}
    for site, _, periods in shown.sites:
        own = [next(its for its in apart if (its["site"], its["period"]) == (site, name)) for name in "ab"]
        assert [its.of_best for its in periods] == [its["seen_well"] / best[its["period"]] for its in own]
        assert [its.rank for its in periods] == [its["rank"] for its in own]


def test_rejects_region_without_vehicles_for_target_ranking(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    away = ("--set", "roi.center_m=[20, 60, 2.5]", "--set", "sites.file=far.csv")
    (mini / "far.csv").write_text("site,x_m,y_m,z_m\nfar,20,72,3\n")
    code, _, told = run_egvs("run", mini, "--out", tmp_path / "a", *away, "--set", "score.rank_by=seen_well")
    assert code == 2
    assert "scenario.toml: score.rank_by = 'seen_well': no vehicle has its centre in the region of interest" in told
    assert 'set rank_by = "egvs"' in told
    assert not (tmp_path / "a" / "scores.parquet").exists()
    record = egvs.run(loading.load(mini, away[1::2]), tmp_path / "b", jobs=1)
    assert [it.rule for it in collect_warnings(stage.summary for stage in record.stages.values())] == [
        "traffic in the region",
        "no ranking",
    ]
    assert math.isnan(read_scores(tmp_path / "b" / "scores.parquet")["expected_detections"][0].as_py())


@pytest.mark.slow
def test_warns_of_unknown_standard_errors(mini: Path, tmp_path: Path) -> None:
    """All vehicles are in one block of frames: without it there are none."""
    lines = (mini / "fcd.csv").read_text().splitlines()
    late = [line.replace(";-2.0;", ";40.0;") if float(line.split(";")[0]) >= 5.0 else line for line in lines[1:]]
    kept = [line for line in late if not (";west;" in line and float(line.split(";")[0]) >= 5.0)]
    (mini / "fcd.csv").write_text("\n".join([lines[0], *kept]) + "\n")
    rows = run(mini, tmp_path / "run", "score.rank_by=seen_well", "score.others=[]")
    assert by_rank(rows, "seen_well")
    assert all(math.isnan(row["seen_well_se"]) and math.isnan(row["beats_next"]) for row in rows.values())
    sets = ["score.rank_by=seen_well", "score.others=[]"]
    assert all(math.isnan(row["behind_best_se"]) and math.isnan(row["best_beats"]) for row in rows.values())
    record = egvs.run(loading.load(mini, sets), tmp_path / "run", jobs=1)
    (doubt,) = (it for it in collect_warnings([record.stages["score"].summary]) if it.rule == "no standard error")
    assert "all vehicles in the region are in one of 4 blocks of frames" in doubt.problem


@pytest.mark.slow
def test_only_scores_over_vehicles_read_trajectories(mini: Path, tmp_path: Path) -> None:
    plain = ["score.others=[]", "score.blindspots=false"]
    egvs.run(loading.load(mini, plain), tmp_path, jobs=1)
    assert "trajectories.parquet" not in inputs_of(score, loading.load(mini, plain), tmp_path).files
    assert "trajectories.parquet" in inputs_of(score, loading.load(mini), tmp_path).files
    (tmp_path / "trajectories.parquet").unlink()
    run_stage(score, loading.load(mini, plain), tmp_path)
    assert "expected_detections" not in read_scores(tmp_path / "scores.parquet").column_names
    assert not (tmp_path / "blindspots.parquet").exists()
    assert read_tpog(tmp_path / "tpog.parquet").frames == 40


@pytest.mark.slow
def test_more_sampled_frames_reduce_the_error_of_the_lead(tmp_path: Path) -> None:
    """The demo has 1,000 recorded frames; 100 of them have a larger paired error than all."""
    one = "score.detector='cluster'"  # so that errors are those of the traffic alone
    few, many = (run(DEMO, tmp_path / str(n), f"score.sampled_frames={n}", one) for n in (100, 1000))
    assert all(row["egvs"] == many[site]["egvs"] for site, row in few.items())
    assert any(row["expected_detections"] != many[site]["expected_detections"] for site, row in few.items())
    errors = [[row["behind_best_se"] for row in rows.values() if row["rank"] > 1] for rows in (few, many)]
    assert np.mean(errors[1]) < 0.8 * np.mean(errors[0])
    blindspots = [readers.read_blindspots(tmp_path / str(n) / "blindspots.parquet", ["kerb_NE"]) for n in (100, 1000)]
    observed = [next(iter(sites)).overall.vehicle_frames for sites in blindspots]
    assert observed[1] > 9 * observed[0]


def test_sampled_frames_are_recorded_only_where_set() -> None:
    assert "sampled_frames" not in ScoreConfig().model_dump(mode="json")
    dumped = ScoreConfig(sampled_frames=250, gamma=math.inf).model_dump(mode="json")
    assert (dumped["sampled_frames"], dumped["gamma"]) == (250, math.inf)


def test_scores_over_vehicles_are_the_target_scores() -> None:
    assert set(VEHICLE_SCORES) == set(TARGET_SCORES)


@pytest.mark.parametrize("other", [name for name in VEHICLE_SCORES if name in get_args(RankingScore)])
def test_sampled_frames_need_a_score_over_vehicles_or_blind_spots(mini: Path, other: str) -> None:
    without = ["score.blindspots=false", "score.others=['coverage']", "score.sampled_frames=20"]
    with pytest.raises(InputError, match="score: sampled_frames has no effect without blind spots"):
        loading.load(mini, without)
    for needed in ("score.blindspots=true", f"score.others=['{other}']", f"score.rank_by='{other}'"):
        changed = [setting for setting in without if setting.split("=")[0] != needed.split("=")[0]]
        assert loading.load(mini, [*changed, needed]).score.sampled_frames == 20


def test_additional_scores_are_unique() -> None:
    model = ScoreConfig(rank_by="seen_well", others=("entropy_seen", "seen_well"))
    assert model.additional == ("seen_well", "entropy_seen")
    assert ScoreConfig(others=()).additional == ()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("score.rank_by=detections", "score.rank_by: expected one of egvs"),
        ('score.others=["egvs"]', "score.others.0: expected 'expected_detections'"),
        ('score.others=["seen_well","seen_well"]', "seen_well is listed twice"),
    ],
)
def test_rejects_unknown_scores(mini: Path, tmp_path: Path, run_egvs, override: str, message: str) -> None:  # type: ignore[no-untyped-def]
    code, _, told = run_egvs("run", mini, "--out", tmp_path / "run", "--set", override)
    assert code == 2
    assert message in told, told


def test_warns_of_undefined_target_scores(mini: Path, tmp_path: Path) -> None:
    """Cars reach into a narrow region, but none has its centre there."""
    (mini / "near.csv").write_text("site,x_m,y_m,z_m\nnear,20,12,3\n")
    edge = ["roi.center_m=[20, 12.9, 2.5]", "roi.size_m=[40, 20, 5]", "sites.file=near.csv"]
    record = egvs.run(loading.load(mini, edge), tmp_path / "run", jobs=1)
    told = [it for it in collect_warnings([record.stages["score"].summary]) if it.rule == "no vehicles"]
    values = read_scores(tmp_path / "run" / "scores.parquet")["expected_detections"].to_pylist()
    assert read_tpog(tmp_path / "run" / "tpog.parquet").counts.any()
    nobody = "no vehicle has its centre in the region of interest in the 40 frames examined"
    assert [it.problem for it in told] == [f"{nobody}: no value for expected_detections and noticed"]
    assert math.isnan(values[0])


@pytest.mark.slow
def test_terminal_and_report_show_the_score_that_ranks(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    code, printed, _ = run_egvs("run", mini, "--out", tmp_path, "--set", "score.rank_by=seen_well")
    assert code == 0
    best = next(row for row in read_scores(tmp_path / "scores.parquet").to_pylist() if row["rank"] == 1)
    says = f"sees {100 * best['seen_well']:.1f} % of vehicles well"
    assert f" is the best of 2 sites: it {says}" in " ".join(printed.split())
    page = (tmp_path / "report.html").read_text(encoding="utf-8").replace("\u00a0", " ")
    assert f" is the best of 2 sites: it {says}" in page
    assert "Sites are ranked by the share of vehicles that they see well" in page
    assert 'data-label="Seen well"' in page
    assert 'data-label="EGVS bit"' in page
    assert run_egvs("verify", tmp_path)[0] == 0


@pytest.mark.slow
def test_the_expected_detections_are_those_of_the_calibration(mini: Path, tmp_path: Path) -> None:
    rows, scenario = run(mini, tmp_path / "run"), loading.load(mini)
    record = TargetRecord.read(tmp_path / "run" / "trajectories.parquet", scenario.roi.grid)
    scanner = Scanner(egvs.build_scene(scenario))
    for site in scanner.scene.sites:
        seen = visible_targets(record, Beams.of(scanner.scan_site(site)))
        assert rows[site.name]["expected_detections"] == expected_detections(seen)


VEHICLE_SCORE = """
from egvs.scoring.target_scores import VehicleScore

MY_SCORE = VehicleScore("my_score", "n / (n + 5)", "an example", lambda seen: seen.points / (seen.points + 5.0))
WRONG = VehicleScore("wrong", "", "", lambda seen: seen.points + 2.0)
OF_SITES = "a score of sites"
RAISING = VehicleScore("raising", "", "", lambda seen: 1 / 0)
"""
PERIODS = 'traffic.periods=[{name="a", length_s=12}, {name="b", begin_s=12, length_s=8}]'


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package of somebody else with scores."""
    entries = "my_score = plug_score:MY_SCORE\nwrong = plug_score:WRONG\nof_sites = plug_score:OF_SITES"
    entries += "\nraising = plug_score:RAISING\nbroken = plug_score:NOTHING"
    install(tmp_path / "site", "somebody-elses", entries, {"plug_score": VEHICLE_SCORE}, SCORES_GROUP)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    clear_caches()
    yield
    clear_caches()
    sys.modules.pop("plug_score", None)


def test_broken_score_is_reported_first(mini: Path, tmp_path: Path, plugin: None, run_egvs) -> None:
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "out", "--set", "score.rank_by=broken")
    assert code == 1 and "'broken' of egvs.scores cannot be loaded" in error
    assert not (tmp_path / "out").exists()


def test_misspelt_score_names_the_meant_one(mini: Path, plugin: None) -> None:
    with pytest.raises(InputError, match=r"got 'my_scroe'; did you mean 'my_score'\?"):
        loading.load(mini, ["score.rank_by=my_scroe"])


def test_raising_score_is_one_message(mini: Path, tmp_path: Path, plugin: None, run_egvs) -> None:
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "out", "--set", "score.rank_by=raising")
    assert code == 1 and "Traceback" not in error
    assert "score raising: its function raised ZeroDivisionError('division by zero')" in error


@needs("validation")
def test_list_of_scores_ends_with_those_that_rank(plugin: None, run_egvs) -> None:
    code, printed, _ = run_egvs("scores")
    last = printed[printed.index("[score] rank_by chooses") :]
    assert code == 0 and "my_score" in last and "broken" not in last and "of_sites" not in last


@pytest.mark.slow
@pytest.mark.parametrize("periods", [(), (PERIODS,)], ids=["no periods", "periods"])
def test_ranks_and_plans_by_the_score_of_a_plugin(
    mini: Path, tmp_path: Path, plugin: None, periods: tuple[str, ...], run_egvs
) -> None:
    (mini / "sites.csv").write_text(SITES)
    words = [word for setting in ("score.rank_by=my_score", *periods) for word in ("--set", setting)]
    out = tmp_path / "out"
    code, printed, error = run_egvs("run", mini, "--out", out, *words)
    assert code == 0, error
    assert "my_score" in printed and "the score my_score" in (out / "report.html").read_text()

    scenario = loading.load(mini, ["score.rank_by=my_score", *periods])
    record = TargetRecord.read(out / "trajectories.parquet", scenario.roi.grid, 40)
    scanner = Scanner(egvs.build_scene(scenario))
    chances = {}
    for candidate in scanner.scene.sites:
        points = visible_targets(record, Beams.of(scanner.scan_site(candidate))).points
        chances[candidate.name] = points / (points + 5.0)
    rows = {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}
    assert by_rank(rows, "my_score") and all(row["my_score_se"] > 0 for row in rows.values())
    if periods:  # the mix is between the periods
        by_period = read_scores_by_period(out / "scores_by_period.parquet").to_pylist()
        for name, row in rows.items():
            of_site = [other["my_score"] for other in by_period if other["site"] == name]
            assert len(of_site) == 2 and min(of_site) <= row["my_score"] <= max(of_site)
    else:
        for name, chance in chances.items():
            assert rows[name]["my_score"] == pytest.approx(chance.mean(), rel=1e-12)
        joint = egvs.JointScore.of(scenario, out)
        joint.add("s1", "s2")
        assert joint.value == pytest.approx((1 - (1 - chances["s1"]) * (1 - chances["s2"])).mean(), rel=1e-9)
    code, printed, error = run_egvs("place", out, "--count", "2")
    assert code == 0, error
    assert "independent detector" in printed
    assert run_egvs("verify", out)[0] == 0
    rated = egvs.open_session(out).rate("s1", scanner.scene.sites[1].pose)
    assert rated.scores["my_score"] == pytest.approx(rows["s1"]["my_score"], rel=1e-12)
    compared = egvs.compare_runs([out, out])
    assert compared is not None


def test_wrong_scores_of_plugins_are_named(mini: Path, tmp_path: Path, plugin: None, run_egvs) -> None:
    message = r"score\.rank_by: expected one of egvs, .*my_score, .*wrong, got 'my_scor'; did you mean 'my_score'"
    with pytest.raises(InputError, match=message):
        loading.load(mini, ["score.rank_by=my_scor"])
    with pytest.raises(
        InputError, match=r"score\.rank_by.*'density'"
    ):  # it gives a number for a site, none for vehicles
        loading.load(mini, ["score.rank_by=density"])
    for name, expected, text in (
        (
            "of_sites",
            2,
            "score.rank_by: 'of_sites' is a str, which cannot rank sites. Use an egvs.scoring.target_scores",
        ),
        ("wrong", 1, "score wrong: expected 76 numbers from 0 to 1, got values from"),
    ):
        code, _, error = run_egvs("run", mini, "--out", tmp_path / name, "--set", f"score.rank_by={name}")
        assert (code, text in error) == (expected, True), error
        assert not (tmp_path / name / "scores.parquet").exists()
