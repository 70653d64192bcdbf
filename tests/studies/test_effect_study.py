"""``egvs effects`` says which effects a scene calls for, and what each changes."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.artefacts import readers
from egvs.core import files
from egvs.effects import registry
from egvs.scenario.effects_config import RainParameters
from egvs.studies import effect_study
from egvs.studies.effect_study import run_ablation
from egvs.studies.measurement import scenario_dependencies
from tests.conftest import collection, feature


def states(mini: Path, *overrides: str) -> dict[str, tuple[str, str]]:
    return {call.name: (call.state, call.why) for call in effect_study.effect_statuses(egvs.load(mini, overrides))}


def test_all_effects_are_listed_with_their_source(run_egvs) -> None:
    code, printed, _ = run_egvs("effects")
    assert code == 0
    for call in effect_study.effect_catalogue():
        assert call.name in printed
        assert call.source
        assert call.why.endswith((".", "?"))  # the first sentence of its module


def tried_statuses(folder: Path, out: Path, *overrides: str) -> dict[str, effect_study.EffectStatus]:
    """Return the status of each effect, tried with the run in ``out``."""
    return {call.name: call for call in effect_study.effect_statuses(egvs.load(folder, overrides), out)}


def test_statuses_of_effects_in_plain_scene(mini: Path) -> None:
    statuses = states(mini)
    assert set(statuses) == set(registry.effect_names())
    assert {name: state for name, (state, _) in statuses.items() if state != "off"} == {
        "rain": "your choice",
        "fog": "your choice",
        "dropout": "your choice",
        "surface_losses": "your choice",
        "range_noise": "your choice",
        "mount_sway": "your choice",
        "mixed_returns": "your choice",
        "moving_occlusion": "called for",
        "divergence": "called for",
    }
    assert statuses["rain"][1].startswith("the weather decides; by its formula, ")
    assert statuses["foliage"][1] == "not called for: there is no closed tree crown"
    assert "not simulated for small, which has no rated range" in statuses["range_limit"][1]
    assert "pedestrians and bicycles cannot be added to recorded traffic" in statuses["pedestrians_bicycles"][1]
    assert "no vehicle type has more than one part" in statuses["articulated"][1]
    assert "flat" in statuses["slope"][1] or "no network" in statuses["slope"][1] or "relief" in statuses["slope"][1]


def test_losses_are_on_where_the_region_reaches_beyond_their_range(mini: Path) -> None:
    """Ranges of 3000 m and 30 m; the region is 50 m wide."""
    for rated_m, state, why in (
        (3000, "off", "not called for: small lose at most 5 % of returns from the region"),
        (30, "on", "losses of returns are simulated for small"),
    ):
        statuses = states(mini, f"sensors.small.rated_range_m={rated_m}")["range_limit"]
        assert statuses[0] == state
        assert why in statuses[1]
    rated = "sensors.small.rated_range_m=30"
    assert states(mini, rated, "effects.range_limit=false")["range_limit"] == ("off", "effects.range_limit = false")


def changes_of_runs(before: Path, after: Path, score: str) -> list[float]:
    """Return relative changes of a score in units, or differences of shares in percentage points, the least first."""
    old, new = (readers.read_scores(out / "scores.parquet").to_pylist() for out in (before, after))
    whole = [row[score] if score == "egvs" else 1.0 for row in old]
    changes = [100 * (b[score] - a[score]) / of for a, b, of in zip(old, new, whole, strict=True)]
    return sorted(changes, key=abs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rank_by", "noun", "unit"),
    [("egvs", "EGVS", " %"), ("expected_detections", "the share of vehicles found", " percentage points")],
)
def test_expected_changes_equal_those_of_runs(mini: Path, tmp_path: Path, rank_by: str, noun: str, unit: str) -> None:
    plain, ranked = tmp_path / "plain", f"score.rank_by='{rank_by}'"
    egvs.run(egvs.load(mini, [ranked]), plain)
    statuses = tried_statuses(mini, plain, ranked)
    for name, words in (
        ("dropout", "share=0.1"),
        ("moving_occlusion", "method='frames'"),
        ("divergence", "sub_beams=7"),
    ):
        egvs.run(egvs.load(mini, [ranked, f"effects.{name}.{words}"]), tmp_path / name)
        changes = changes_of_runs(plain, tmp_path / name, rank_by)
        expected = f"{noun} by {changes[0]:+.1f} to {changes[-1]:+.1f}{unit}"
        if abs(changes[-1]) < 0.1:
            expected = f"{noun} by less than 0.1{unit}"
        assert expected in statuses[name].change, name
        assert "measured on 2 of 2 sites, with the last run's traffic" in statuses[name].change
    assert statuses["dropout"].why.endswith("; tried with share = 0.1")
    assert statuses["foliage"].change == ""
    assert (statuses["moving_occlusion"].state == "little") == (rank_by == "expected_detections")


@pytest.mark.slow
def test_trees_and_long_trucks_call_for_their_effects(mini: Path, tmp_path: Path) -> None:
    crown = feature({"type": "Point", "coordinates": [12, 9]}, kind="tree_crown", height_m=5, base_m=1, radius_m=1.5)
    far = feature({"type": "Point", "coordinates": [900, 9]}, kind="tree_crown", height_m=5, base_m=1, radius_m=1.5)
    (mini / "statics.geojson").write_text(collection(crown, far))
    (mini / "truck.xml").write_text("<a><vType id='car' vClass='trailer' length='18' width='2.5' height='4'/></a>")
    text = (mini / "scenario.toml").read_text()
    kind = text[text.index("[[traffic.kinds]]") : text.index("[statics]")]
    (mini / "scenario.toml").write_text(text.replace(kind, "").replace('fcd.csv"', "fcd.csv\"\nvtypes = ['truck.xml']"))
    assert states(mini)["articulated"] == ("your choice", "the vtypes may have articulated vehicles of 16 m and more")
    egvs.run(egvs.load(mini), tmp_path / "out")
    statuses = tried_statuses(mini, tmp_path / "out")
    assert (statuses["foliage"].state, statuses["foliage"].why) == (
        "called for",
        "1 of 2 tree crowns may stand between a site and the region",
    )
    assert statuses["articulated"].state == "called for"
    assert statuses["articulated"].change.startswith("100.0 % of the boxes in the last run would be split into parts")


@pytest.mark.slow
def test_effects_are_not_tried_with_traffic_of_another_scenario(mini: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    code, printed, _ = run_egvs("effects", mini, "--out", out)
    assert (code, out.exists()) == (0, False)
    assert f"to measure the expected changes, first run: egvs run {mini} --out {out}" in printed
    assert "--set 'effects.moving_occlusion={}' --set 'effects.divergence={}'" in printed
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert "to measure the expected changes" not in run_egvs("effects", mini, "--out", out)[1]
    assert "to measure the expected changes" in run_egvs("effects", mini, "--out", out, "--set", "traffic.frames=20")[1]
    (out / "trajectories.parquet").unlink()
    assert "to measure the expected changes" in run_egvs("effects", mini, "--out", out)[1]


def test_named_effect_is_on_with_its_parameters(mini: Path) -> None:
    state, why = states(mini, "effects.rain.rate_mm_h=20")["rain"]
    assert state == "on"
    assert "rate_mm_h = 20" in why


@pytest.mark.slow
def test_effect_without_consequence_is_skipped_and_reported(mini: Path, tmp_path: Path, run_egvs) -> None:
    named = ("effects.rain.rate_mm_h=0", "effects.foliage.leaf_area_density=1")
    statuses = states(mini, *named)
    assert statuses["rain"][0] == statuses["foliage"][0] == "skipped"
    assert "the result is the same without it" in statuses["foliage"][1]
    plain, skipped = tmp_path / "plain", tmp_path / "skipped"
    assert run_egvs("run", mini, "--out", plain)[0] == 0
    code, _, errors = run_egvs(
        "run", mini, "--out", skipped, "--verbose", *(part for name in named for part in ("--set", name))
    )
    assert code == 0
    assert "rain" in errors and "foliage" in errors
    for name in ("scans.parquet", "scores.parquet", "tpog.parquet", "trajectories.parquet", "statics.ply"):
        assert (plain / name).read_bytes() == (skipped / name).read_bytes()


@pytest.mark.slow
def test_ablation_runs_each_effect_alone_and_all_together(mini: Path, tmp_path: Path, run_egvs) -> None:
    named = ("--set", "effects.rain.rate_mm_h=50", "--set", "effects.dropout.share=0.25")
    code, printed, errors = run_egvs("effects", mini, *named, "--ablation", "--out", tmp_path)
    assert code == 0, errors
    assert "rain" in printed and "dropout" in printed and "all" in printed
    changes = run_ablation(egvs.load(mini, named[1::2]), tmp_path)
    scores = {change.effect: dict(zip(change.sites, change.scores, strict=True)) for change in changes}
    assert list(scores) == ["none", "rain", "dropout", "all"]
    alone = tmp_path / "alone"
    egvs.run(egvs.load(mini, ["effects.rain.rate_mm_h=50"]), alone)
    for row in readers.read_scores(alone / "scores.parquet").to_pylist():
        assert scores["rain"][row["site"]] == row["egvs"]
        assert scores["all"][row["site"]] < scores["rain"][row["site"]] < scores["none"][row["site"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--ablation"], "without a scenario"), (["{mini}", "--ablation"], "has no effects")],
)
def test_rejects_ablation_without_effects(mini: Path, run_egvs, arguments: list[str], message: str) -> None:
    code, _, errors = run_egvs("effects", *(a.format(mini=mini) for a in arguments))
    assert code == 2
    assert message in errors


@pytest.mark.slow
def test_scenario_can_extend_another(mini: Path, tmp_path: Path, run_egvs) -> None:
    wet = tmp_path / "wet"
    wet.mkdir()
    (wet / "scenario.toml").write_text('extends = "../mini"\n\n[effects.rain]\nrate_mm_h = 20\n\n[score]\ngamma = 3\n')
    scenario = egvs.load(wet)
    assert (scenario.name, scenario.score.gamma, scenario.roi.voxel_m) == ("wet", 3, 0.5)
    assert scenario.effects.named == {"rain": RainParameters(rate_mm_h=20)}
    out = tmp_path / "out"
    assert run_egvs("run", wet, "--out", out)[0] == 0
    assert run_egvs("verify", out)[0] == 0
    (mini / "scenario.toml").write_text('extends = "../wet"\n' + (mini / "scenario.toml").read_text())
    code, _, errors = run_egvs("run", wet, "--out", out)
    assert (code, "extends itself" in errors) == (2, True)
    (wet / "scenario.toml").write_text('extends = "../nowhere"\n')
    assert run_egvs("run", wet, "--out", out)[0] == 2


def test_cost_of_effect_is_difference_with_and_without_it(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For named effects: the scenario less without it; for others: with it less the scenario."""
    scenario = egvs.load(mini, ["effects.rain.rate_mm_h=20"])
    rows = [
        {"setting": name, "seconds": seconds, "error": 0.1, "tau": 0.9, "loss_points": 0.0}
        for name, seconds in (("scenario", 5.0), ("without rain", 4.0), ("with divergence", 12.0), ("gamma 2", 5.0))
    ]
    metadata = {"inputs": files.hash_json(scenario_dependencies(scenario))}
    monkeypatch.setattr(effect_study, "read_accuracy", lambda _: (rows, metadata))
    statuses = effect_study.effect_costs(scenario, tmp_path)
    assert statuses is not None
    assert {name: price.seconds for name, price in statuses.items()} == {"rain": 1.0, "divergence": 7.0}


def test_effect_with_missing_input_is_refused(mini: Path) -> None:
    statuses = states(mini, "effects.range_limit={}", "effects.pedestrians_bicycles.pedestrians_per_h=100")
    assert statuses["range_limit"][0] == "refused"
    assert "rated_range_m is missing" in statuses["range_limit"][1]
    assert statuses["pedestrians_bicycles"][0] == "refused"
    assert "recorded traffic" in statuses["pedestrians_bicycles"][1]


@pytest.mark.slow
def test_effects_that_the_study_skipped_are_named(mini: Path, tmp_path: Path, run_egvs) -> None:
    words = ("--out", tmp_path / "out", "--set", "effects.rain.rate_mm_h=20")
    assert run_egvs("accuracy", mini, "--budget", "0.001s", *words)[0] == 0
    code, printed, _ = run_egvs("effects", mini, *words)
    assert code == 0
    assert "to measure the cost and effect of rain: egvs accuracy" in printed
