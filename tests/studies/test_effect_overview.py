"""``egvs effects`` tells which effects a scene calls for, and what each changes."""

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


def test_every_effect_is_listed_with_its_source(run_egvs) -> None:
    code, printed, _ = run_egvs("effects")
    assert code == 0
    for call in effect_study.effect_catalogue():
        assert call.name in printed
        assert call.source
        assert call.why.endswith((".", "?"))  # the sentence that its module opens with


def advice(folder: Path, out: Path, *overrides: str) -> dict[str, effect_study.EffectStatus]:
    """What is said of each effect, tried on the run in ``out``."""
    return {call.name: call for call in effect_study.effect_statuses(egvs.load(folder, overrides), out)}


def test_a_plain_scene_is_told_what_it_has_and_what_only_its_user_knows(mini: Path) -> None:
    found = states(mini)
    assert set(found) == set(registry.effect_names())
    assert {name: state for name, (state, _) in found.items() if state != "off"} == {
        "rain": "your choice",
        "fog": "your choice",
        "dropout": "your choice",
        "mount_sway": "your choice",
        "moving_occlusion": "called for",
        "divergence": "called for",
    }
    assert found["rain"][1].startswith("the weather decides; by its formula, ")
    assert found["foliage"][1] == "not called for: there is no closed tree crown"
    assert "cannot act here: rated_range_m is missing" in found["range_limit"][1]
    assert "people cannot be added to a finished FCD file" in found["pedestrians_bicycles"][1]
    assert "no vehicle type has more than one part" in found["articulated"][1]
    assert "flat" in found["slope"][1] or "no network" in found["slope"][1] or "relief" in found["slope"][1]


def test_a_limit_beyond_the_region_is_of_little_effect_before_a_run_too(mini: Path) -> None:
    """Noticed to 3000 m and to 30 m, the region being 50 m wide."""
    for rated_m, state in ((3000, "little"), (30, "called for")):
        found = states(mini, f"sensors.small.rated_range_m={rated_m}")["range_limit"]
        assert found[0] == state
        assert ("100% of returns" in found[1]) == (state == "little")


@pytest.mark.slow
def test_the_change_that_is_expected_is_the_one_that_a_run_finds(mini: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    egvs.run(egvs.load(mini), plain)
    before = {row["site"]: row["egvs"] for row in readers.read_scores(plain / "scores.parquet").to_pylist()}
    found = advice(mini, plain)
    for name, words in (
        ("dropout", "share=0.1"),
        ("moving_occlusion", "method='frames'"),
        ("divergence", "sub_beams=7"),
    ):
        egvs.run(egvs.load(mini, [f"effects.{name}.{words}"]), tmp_path / name)
        rows = readers.read_scores(tmp_path / name / "scores.parquet").to_pylist()
        changes = sorted((row["egvs"] / before[row["site"]] - 1 for row in rows), key=abs)
        assert f"scores by {changes[0]:+.1%} to {changes[-1]:+.1%}" in found[name].change, name
        assert "measured on 2 of 2 sites, with the last run's traffic" in found[name].change
    assert found["dropout"].why.endswith("; tried with share = 0.1")
    assert found["foliage"].change == ""


@pytest.mark.slow
def test_trees_and_long_trucks_in_the_scene_are_seen(mini: Path, tmp_path: Path) -> None:
    crown = feature({"type": "Point", "coordinates": [12, 9]}, kind="tree_crown", height_m=5, base_m=1, radius_m=1.5)
    far = feature({"type": "Point", "coordinates": [900, 9]}, kind="tree_crown", height_m=5, base_m=1, radius_m=1.5)
    (mini / "statics.geojson").write_text(collection(crown, far))
    (mini / "truck.xml").write_text("<a><vType id='car' vClass='trailer' length='18' width='2.5' height='4'/></a>")
    text = (mini / "scenario.toml").read_text()
    kind = text[text.index("[[traffic.kinds]]") : text.index("[statics]")]
    (mini / "scenario.toml").write_text(text.replace(kind, "").replace('fcd.csv"', "fcd.csv\"\nvtypes = ['truck.xml']"))
    assert states(mini)["articulated"] == ("your choice", "the vtypes may have articulated vehicles of 16 m and more")
    egvs.run(egvs.load(mini), tmp_path / "out")
    found = advice(mini, tmp_path / "out")
    assert (found["foliage"].state, found["foliage"].why) == (
        "called for",
        "1 of 2 tree crowns may stand between a site and the region",
    )
    assert found["articulated"].state == "called for"
    assert found["articulated"].change.startswith("100.0% of the boxes in the last run get parts")


@pytest.mark.slow
def test_traffic_of_another_scenario_is_not_tried_on(mini: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    code, printed, _ = run_egvs("effects", mini, "--out", out)
    assert (code, out.exists()) == (0, False)
    assert f"to measure the expected changes, first: egvs run {mini} --out {out}" in printed
    assert "--set 'effects.moving_occlusion={}' --set 'effects.divergence={}'" in printed
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert "to measure the expected changes" not in run_egvs("effects", mini, "--out", out)[1]
    assert "to measure the expected changes" in run_egvs("effects", mini, "--out", out, "--set", "traffic.frames=20")[1]
    (out / "trajectories.parquet").unlink()
    assert "to measure the expected changes" in run_egvs("effects", mini, "--out", out)[1]


def test_a_named_effect_is_on_with_its_parameters(mini: Path) -> None:
    state, why = states(mini, "effects.rain.rate_mm_h=20")["rain"]
    assert state == "on"
    assert "rate_mm_h = 20" in why


@pytest.mark.slow
def test_an_effect_that_cannot_change_anything_is_skipped_and_the_run_says_so(
    mini: Path, tmp_path: Path, run_egvs
) -> None:
    named = ("effects.rain.rate_mm_h=0", "effects.foliage.leaf_area_density=1")
    found = states(mini, *named)
    assert found["rain"][0] == found["foliage"][0] == "skipped"
    assert "the result is the same without it" in found["foliage"][1]
    plain, skipped = tmp_path / "plain", tmp_path / "skipped"
    assert run_egvs("run", mini, "--out", plain)[0] == 0
    code, _, said = run_egvs("run", mini, "--out", skipped, *(part for name in named for part in ("--set", name)))
    assert code == 0
    assert "rain" in said and "foliage" in said
    for name in ("scans.parquet", "scores.parquet", "tpog.parquet", "trajectories.parquet", "statics.ply"):
        assert (plain / name).read_bytes() == (skipped / name).read_bytes()


@pytest.mark.slow
def test_ablation_runs_each_effect_alone_and_all_together(mini: Path, tmp_path: Path, run_egvs) -> None:
    named = ("--set", "effects.rain.rate_mm_h=50", "--set", "effects.dropout.share=0.25")
    code, printed, said = run_egvs("effects", mini, *named, "--ablation", "--out", tmp_path)
    assert code == 0, said
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
    [(["--ablation"], "without a scenario"), (["{mini}", "--ablation"], "names no effect")],
)
def test_an_ablation_of_nothing_is_refused(mini: Path, run_egvs, arguments: list[str], message: str) -> None:
    code, _, said = run_egvs("effects", *(a.format(mini=mini) for a in arguments))
    assert code == 2
    assert message in said


@pytest.mark.slow
def test_a_scenario_may_extend_another(mini: Path, tmp_path: Path, run_egvs) -> None:
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
    code, _, said = run_egvs("run", wet, "--out", out)
    assert (code, "extends itself" in said) == (2, True)
    (wet / "scenario.toml").write_text('extends = "../nowhere"\n')
    assert run_egvs("run", wet, "--out", out)[0] == 2


def test_what_an_effect_costs_is_with_less_without(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is named, the scenario's seconds less those without it; else those with it less the scenario's."""
    scenario = egvs.load(mini, ["effects.rain.rate_mm_h=20"])
    rows = [
        {"setting": name, "seconds": seconds, "error": 0.1, "tau": 0.9, "regret": 0.0}
        for name, seconds in (("scenario", 5.0), ("without rain", 4.0), ("with divergence", 12.0), ("gamma 2", 5.0))
    ]
    about = {"inputs": files.hash_json(scenario_dependencies(scenario))}
    monkeypatch.setattr(effect_study, "read_accuracy", lambda _: (rows, about))
    found = effect_study.effect_costs(scenario, tmp_path)
    assert found is not None
    assert {name: price.seconds for name, price in found.items()} == {"rain": 1.0, "divergence": 7.0}


def test_an_effect_that_lacks_something_is_refused(mini: Path) -> None:
    found = states(mini, "effects.range_limit={}", "effects.pedestrians_bicycles.pedestrians_per_h=100")
    assert found["range_limit"][0] == "refused"
    assert "rated_range_m is missing" in found["range_limit"][1]
    assert found["pedestrians_bicycles"][0] == "refused"
    assert "finished FCD file" in found["pedestrians_bicycles"][1]


@pytest.mark.slow
def test_effects_that_a_study_left_out_are_named(mini: Path, tmp_path: Path, run_egvs) -> None:
    words = ("--out", tmp_path / "out", "--set", "effects.rain.rate_mm_h=20")
    assert run_egvs("accuracy", mini, "--budget", "0.001s", *words)[0] == 0
    code, printed, _ = run_egvs("effects", mini, *words)
    assert code == 0
    assert "what rain cost and change: egvs accuracy" in printed
