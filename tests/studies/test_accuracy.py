"""The accuracy study tells the truth about its settings, and what it recommends holds.

Evidence: settings that are run again by themselves, from the ``--set`` line that the study prints; plain twins of what
is compared (tau from pairs, hits weighted up by hand); a study that is repeated, resumed and cut short. Seconds are
never asserted.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_accuracy
from egvs.cli import study_tables
from egvs.core import files, runtime
from egvs.core.errors import InputError, RunError
from egvs.runs import stages
from egvs.runs.run import lock_run_folder
from egvs.runs.store import Store
from egvs.scoring.scorer import Scorer
from egvs.stages.inputs import get_scene, open_folder
from egvs.stages.site_scans import empty_scans
from egvs.studies import accuracy, measurement, score_errors, study_settings
from egvs.studies.accuracy import AccuracyStudy
from egvs.studies.measurement import SettingRunner
from egvs.studies.score_errors import SettingResult

ROOT = Path(__file__).resolve().parents[2]
MEASURED = {
    "seconds",
    "seconds_spread",
    "busy_s",
    "repeats",
    "statics_s",
    "scan_s",
    "traffic_s",
    "tpog_s",
    "score_s",
    "peak_mb",
}
RESTED = MEASURED | {"front", "recommended"}
"""Columns that the clock has a say in."""


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A study of a few settings."""
    monkeypatch.setattr(study_settings, "VOXELS_M", (1.0,))
    monkeypatch.setattr(study_settings, "GAMMAS", (2.0,))
    monkeypatch.setattr(study_settings, "PERIODS_S", (1.0,))
    monkeypatch.setattr(study_settings, "_others", lambda _: iter(()))
    monkeypatch.setattr(accuracy, "REPEATS", 2)


@pytest.fixture
def junction(tmp_path: Path) -> Path:
    """The shipped junction, shortened: SUMO runs in it."""
    folder = tmp_path / "junction"
    shutil.copytree(ROOT / "scenarios" / "nishishinjuku", folder)
    text = (folder / "scenario.toml").read_text()
    for long, short in (
        ("frames = 5000", "frames = 200"),
        ("warmup_s = 300", "warmup_s = 50"),
        ("vehicles = 50", "vehicles = 20"),
        ("voxel_m = 0.25", "voxel_m = 0.5"),
        ("VLP-32C", "VLP-16"),
    ):
        assert long in text
        text = text.replace(long, short)
    (folder / "scenario.toml").write_text(text)
    return folder


def study_of(
    path: Path, sets: list[str], out: Path, tolerance: float = 0.02, budget_s: float = 600.0, **more: Any
) -> AccuracyStudy:
    return accuracy.run_accuracy_study(path, sets, out, tolerance=tolerance, budget_s=budget_s, **more)


def words(row: SettingResult) -> list[str]:
    """The values after each ``--set``."""
    return shlex.split(row.overrides)[1::2]


def shares(path: Path, sets: list[str], out: Path, weight: float = 1.0) -> np.ndarray:
    """Scores as shares of their limit, from an ordinary run."""
    egvs.run(egvs.load(path, sets), out)
    table = egvs.read_scores(out / "scores.parquet")
    return table["egvs"].to_numpy() / table["egvs_limit"].to_numpy()


def test_study_of_a_finished_file(mini: Path, tmp_path: Path, few: None) -> None:
    study = study_of(mini, [], tmp_path / "out", budget_s=300)
    names = [row.setting for row in study.rows]
    assert names[0] == "scenario"
    assert {
        "every 2nd azimuth",
        "every 4th azimuth",
        "every 2nd channel",
        "gamma 2",
        "voxel 1 m",
        "voxel 1 m, gamma 16",
    } <= set(names)
    assert len(set(names)) == len(names)
    assert not study.skipped
    table, about = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")
    assert table["setting"].to_pylist() == names
    assert about["reference_times"] == 1
    assert (tmp_path / "out" / "accuracy.png").read_bytes()[:4] == b"\x89PNG"
    assert all(row.repeats == 2 for row in study.rows)
    own = study.rows[0]
    assert (own.error, own.tau, own.regret, own.best_kept, own.best_three_kept) == (0.0, 1.0, 0.0, True, True)
    recommended = [row for row in study.rows if row.recommended]
    assert recommended == [study.best]
    path = tmp_path / "out" / "accuracy.parquet"
    assert read_accuracy(path) is not None
    data = path.read_bytes()
    path.write_bytes(data[:99] + bytes([data[99] ^ 1]) + data[100:])
    with pytest.raises(InputError, match=r"accuracy\.parquet: does not match its checksum in accuracy\.sha256"):
        read_accuracy(path)
    again = shares(mini, words(recommended[0]), tmp_path / "again")
    against = shares(mini, [], tmp_path / "plain")
    assert np.abs(again / against - 1).max() == pytest.approx(recommended[0].error, abs=1e-12)
    assert recommended[0].error <= 0.02


@pytest.mark.slow
def test_recommended_setting_holds_where_sumo_runs(
    junction: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch, run_egvs
) -> None:
    monkeypatch.setattr(study_settings, "FRAMES", (100,))
    monkeypatch.setattr(study_settings, "LONGER", (2, 4))
    monkeypatch.setattr(study_settings, "STEPS_S", (0.5,))
    monkeypatch.setattr(study_settings, "GRID_LONGER", (4,))
    monkeypatch.setattr(study_settings, "GRID_WATCHED_S", ((None, 1.0), (0.5, 1.0)))
    monkeypatch.setattr(accuracy, "MAX_REFERENCE_FACTOR", 8)
    monkeypatch.setattr(accuracy, "REPEATS", 1)
    code, printed, said = run_egvs(
        "accuracy", junction, "--out", tmp_path / "out", "--budget", "10m", "--tolerance", 0.4, "--seeds", 2
    )
    assert code == 0, said
    rows = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")[0].to_pylist()
    longest, best = rows[1], next(row for row in rows if row["recommended"])
    assert (longest["setting"], longest["overrides"]) == ("reference", "--set traffic.frames=1600")
    assert f"{junction} {best['overrides']}".strip() in printed
    assert "independent runs" in printed
    assert "tell them apart" in printed
    again = shares(junction, shlex.split(best["overrides"])[1::2], tmp_path / "again")
    against = shares(junction, ["traffic.frames=1600"], tmp_path / "against")
    assert np.abs(again / against - 1).max() == pytest.approx(best["error"], abs=1e-12)
    assert max(best["error"], best["error_se"]) <= 0.4
    longer, short = (next(r for r in rows if r["setting"] == name) for name in ("800 frames", "100 frames"))
    assert longer["error_se"] < short["error_se"]


def compared(study: AccuracyStudy) -> list[tuple[object, ...]]:
    names = [f for f in SettingResult.__dataclass_fields__ if f not in RESTED]
    return sorted(tuple(getattr(row, name) for name in names) for row in study.rows)


@pytest.mark.slow
def test_errors_are_deterministic_and_a_study_is_resumed(
    mini: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = study_of(mini, [], tmp_path / "one", jobs=1)
    other = study_of(mini, [], tmp_path / "other", jobs=2)
    assert compared(one) == compared(other)

    def refuse(*_: object) -> None:
        raise AssertionError("a stage ran again")

    monkeypatch.setattr(SettingRunner, "_make", refuse)
    monkeypatch.setattr(SettingRunner, "warm_up", refuse)
    assert study_of(mini, [], tmp_path / "one").rows == one.rows


@pytest.mark.slow
def test_an_interrupted_study_goes_on(mini: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = study_of(mini, [], tmp_path / "whole")
    run, done = SettingRunner.run, []

    def tired(runner: SettingRunner, setting: study_settings.Setting) -> measurement.SettingScores:
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(setting.name)
        return run(runner, setting)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(SettingRunner, "run", tired)
        study_of(mini, [], tmp_path / "out")
    told: list[tuple[str, str]] = []
    rest = study_of(mini, [], tmp_path / "out", listener=lambda name, state, _: told.append((name, state)))
    assert {name for name, state in told if state == "kept"} == set(done)
    assert compared(rest) == compared(whole)
    assert not list((tmp_path / "out" / "accuracy").glob(".work-*"))


@pytest.mark.slow
def test_a_budget_leaves_settings_out_and_names_them(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, said = run_egvs("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert code == 0, said
    line = next(line for line in printed.splitlines() if line.startswith("skipped, beyond the budget: "))
    assert {"voxel 1 m", "every 2nd azimuth"} <= set(line.partition(": ")[2].split("; "))
    rows = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")[0].to_pylist()
    assert [row["setting"] for row in rows] == ["scenario"]


@pytest.mark.slow
def test_without_a_longer_reference_simulated_traffic_is_judged_by_its_standard_error(
    junction: Path, tmp_path: Path, few: None
) -> None:
    study = study_of(junction, [], tmp_path / "out", budget_s=0.001)
    assert [row.setting for row in study.rows] == ["scenario"]
    assert (study.times, study.best) == (1, None)
    assert study.rows[0].judged == study.rows[0].error_se > study.tolerance


@pytest.mark.slow
def test_a_setting_that_fails_is_named_and_the_rest_goes_on(
    mini: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_settings, "LONGER", (2,))
    own = study_settings._traffic_settings
    monkeypatch.setattr(
        study_settings,
        "_traffic_settings",
        lambda s: [study_settings.Setting("80 frames", "approximates", "frames", ("traffic.frames=80",)), *own(s)],
    )
    study = study_of(mini, [], tmp_path / "out")
    assert "80" in study.skipped["80 frames"]
    assert len(study.rows) > 5
    again = study_of(mini, [], tmp_path / "out")
    assert (again.rows, again.skipped) == (study.rows, study.skipped)


@pytest.mark.slow
@pytest.mark.parametrize("standard_error", ["true", "false"])
def test_the_score_that_ranks_is_studied(mini: Path, tmp_path: Path, few: None, standard_error: str) -> None:
    sets = ["score.rank_by=seen_well", f"score.standard_error={standard_error}"]
    study = study_of(mini, sets, tmp_path / "out")
    assert {row.knob for row in study.rows} == {"", "period"}  # no gamma, no voxels, no beams that are weighted up
    egvs.run(egvs.load(mini, sets[:1]), tmp_path / "run")
    rows = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pydict()
    own = SettingRunner(mini, sets, tmp_path / "out", 1, lambda *_: None).known(study_settings.SCENARIO_AS_IS)
    assert own is not None
    assert own.shares == own.scores == rows["seen_well"]
    assert own.ses == pytest.approx(rows["seen_well_se"])
    assert own.neighbours[0][2] == pytest.approx(rows["beats_next"][rows["rank"].index(1)])
    other = next(row for row in study.rows if row.knob == "period")
    egvs.run(egvs.load(mini, [*sets, *words(other)]), tmp_path / "other")
    found = egvs.read_scores(tmp_path / "other" / "scores.parquet")["seen_well"].to_numpy()
    assert other.error == pytest.approx(np.abs(found / rows["seen_well"] - 1).max())


def test_seeds_are_for_the_egvs_alone(junction: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--seeds: score\.rank_by = 'seen_well'"):
        study_of(junction, ["score.rank_by=seen_well"], tmp_path / "out", seeds=2)


@pytest.mark.slow
def test_a_setting_that_is_no_scenario_is_named_and_the_rest_goes_on(
    mini: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_settings, "GAMMAS", (-1.0, 2.0))
    study = study_of(mini, [], tmp_path / "out")
    assert "score.gamma: -1.0" in study.skipped["gamma -1"]
    assert "gamma 2" in {row.setting for row in study.rows}


def test_a_reference_that_would_be_endless_is_made_shorter(
    junction: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reference that is no scenario is halved until it is one."""
    runner = SettingRunner(junction, [], tmp_path, 1, lambda *_: None)
    own = runner.scenario(study_settings.SCENARIO_AS_IS)
    trial = measurement.SettingScores([], [], [], [], [], [], 1.0, [], {"traffic": "t", "tpog": "t"})
    monkeypatch.setattr(SettingRunner, "times", lambda *_: measurement.StageTimes((0.1,), (0.1,), 1.0, 1, 1))
    assert accuracy._reference_factor(runner, own, trial, 1e6) == accuracy.MAX_REFERENCE_FACTOR
    frames = {32: 0, 16: 0, 8: 0, 4: 800}
    monkeypatch.setattr(
        study_settings,
        "reference_setting",
        lambda s, n: study_settings.Setting("r", "reference", "", (f"traffic.frames={frames[n]}",)),
    )
    assert accuracy._reference_factor(runner, own, trial, 1e5) == 4


def test_knobs_of_another_method_are_not_turned(mini: Path) -> None:
    sets = ['effects.moving_occlusion.method="independent"']
    names = {s.name for s in study_settings.list_settings(egvs.load(mini, sets))}
    assert not {name for name in names if name.startswith("moving_occlusion")}
    assert "without moving_occlusion" in names


@pytest.mark.slow
def test_a_study_goes_on_without_warming_up_for_what_it_cannot_afford(
    mini: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = study_of(mini, [], tmp_path / "out", budget_s=0.001)
    assert [row.setting for row in first.rows] == ["scenario"]

    def refuse(*_: object) -> None:
        raise AssertionError("warmed up")

    monkeypatch.setattr(SettingRunner, "warm_up", refuse)
    assert study_of(mini, [], tmp_path / "out", budget_s=1e-9).rows == first.rows


def test_a_repeat_that_writes_other_bytes_is_an_error(mini: Path, tmp_path: Path) -> None:
    runner = SettingRunner(mini, [], tmp_path, 1, lambda *_: None)
    own = study_settings.Setting("scenario", "scenario", "")
    trial = runner.run(own)
    cost = tmp_path / "accuracy" / "times" / f"tpog-{trial.stages['tpog'][:16]}.json"
    kept = json.loads(cost.read_text().replace('"tpog.parquet": "', '"tpog.parquet": "0'))
    cost.write_text(files.to_json_text(files.add_checksum(kept)))
    with pytest.raises(RunError, match="other bytes"):
        runner.time_again("tpog", own, trial)


def test_thinned_beams_score_as_if_each_counted_twice(mini: Path, tmp_path: Path) -> None:
    thin = next(s for s in study_settings.list_settings(egvs.load(mini)) if s.name == "every 2nd azimuth")
    scenario = egvs.load(mini, thin.overrides)
    found = shares(mini, list(thin.overrides), tmp_path / "out")
    tpog = egvs.read_tpog(tmp_path / "out" / "tpog.parquet")
    p = tpog.p.ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = np.nan_to_num(-(p * np.log2(p) + (1 - p) * np.log2(1 - p)))
    work = open_folder(scenario, tmp_path / "out")
    scorer = Scorer(get_scene(work), tpog)
    for share, scan in zip(found, empty_scans(work), strict=True):
        twice = np.minimum(4.0, 2.0 * scorer.hits(scan.beams).ravel())
        assert share == pytest.approx((entropy * twice).sum() / (4.0 * entropy.sum()), rel=1e-12)


def test_thinned_beams_are_weighted_up_without_a_cap_too(mini: Path, tmp_path: Path) -> None:
    runner = SettingRunner(mini, ["score.gamma=inf"], tmp_path / "out", 1, lambda *_: None)
    found = {
        s.name: s
        for s in study_settings.list_settings(runner.scenario(study_settings.Setting("scenario", "scenario", "")))
    }
    whole, thin = (np.array(runner.run(found[name]).shares) for name in ("scenario", "every 2nd azimuth"))
    assert np.abs(thin / whole - 1).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["VLP-32C", "OS1-64", "RS-M1"])
def test_a_thinned_catalogue_sensor_has_the_beams_of_the_whole_one(mini: Path, sensor: str) -> None:
    from egvs.sensors.sensor import CATALOGUE, resolve_sensor

    whole = CATALOGUE[sensor]
    for setting in study_settings.list_settings(egvs.load(mini, [f"sites.sensor={sensor}"])):
        if setting.knob not in ("azimuth", "channels"):
            continue
        thin = resolve_sensor(sensor, egvs.load(mini, [f"sites.sensor={sensor}", *setting.overrides]).sensors, "")
        assert thin.beams * setting.weight == whole.beams
        every = {tuple(ray) for ray in whole.directions(30.0).tolist()}
        assert {tuple(ray) for ray in thin.directions(30.0).tolist()} <= every


def test_effects_have_lines_of_their_own(mini: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from egvs.effects.rain import Rain

    monkeypatch.setattr(Rain, "QUALITY", {"rate_mm_h": (1.0, 5.0, 20.0)}, raising=False)
    sets = ["effects.rain.rate_mm_h=5.0"]
    found = {s.name: s for s in study_settings.list_settings(egvs.load(mini, sets))}
    assert found["without rain"].kind == study_settings.MEASURES
    assert found["rain rate_mm_h 20.0"].baseline == study_settings.SCENARIO
    assert found["rain rate_mm_h 1.0"].baseline == "rain rate_mm_h 20.0"
    assert "rain rate_mm_h 5.0" not in found
    runner = SettingRunner(mini, sets, tmp_path / "out", 1, lambda *_: None)
    bare = runner.run(found["without rain"])
    assert bare.shares == pytest.approx(shares(mini, [], tmp_path / "plain"))


def test_effects_that_are_not_named_are_tried_where_they_act(mini: Path) -> None:
    """Divergence needs no number of the user's; rain does, articulated has nothing to act on."""
    with_ = {
        s.name: s
        for s in study_settings.list_settings(egvs.load(mini))
        if s.name.startswith(study_settings.WITH_PREFIX)
    }
    assert {"with divergence", "with moving_occlusion"} <= with_.keys()
    assert not {"with rain", "with articulated", "with slope", "with range_limit"} & with_.keys()
    rated = study_settings.list_settings(
        egvs.load(mini, ["sites.sensor=VLP-16"])
    )  # its range is rated, the scenario's own sensor's is not
    assert "with range_limit" in {s.name for s in rated}
    assert all(
        egvs.load(mini, s.overrides).effects.named.keys() == {s.name.removeprefix(study_settings.WITH_PREFIX)}
        for s in with_.values()
    )
    named = {s.name for s in study_settings.list_settings(egvs.load(mini, ["effects.divergence={}"]))}
    assert {"without divergence", "divergence sub_beams 19"} <= named
    assert "with divergence" not in named


@pytest.mark.slow
def test_effects_say_what_they_cost_and_change(mini: Path, tmp_path: Path, few: None, run_egvs) -> None:
    """As a plain run with and without the effect says."""
    sets = ["--set", "effects.rain.rate_mm_h=90"]
    code, printed, _ = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)
    assert code == 0
    assert "egvs accuracy" in printed
    assert run_egvs("accuracy", mini, "--out", tmp_path / "out", *sets)[0] == 0
    code, printed, said = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)
    assert code == 0, said
    assert "egvs accuracy" not in printed
    dry, wet = shares(mini, [], tmp_path / "dry"), shares(mini, sets[1:], tmp_path / "wet")
    assert f"scores by up to {np.abs(dry / wet - 1).max():.1%}" in " ".join(printed.split())
    code, printed, _ = run_egvs("effects", mini, "--out", tmp_path / "out", "--set", "effects.rain.rate_mm_h=91")
    assert "egvs accuracy" in printed  # that study was of another scenario
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    assert (
        "egvs accuracy" in run_egvs("effects", mini, "--out", tmp_path / "out", *sets)[1]
    )  # and that one of other sites


def test_two_studies_keep_out_of_one_folder(mini: Path, tmp_path: Path) -> None:
    with lock_run_folder(tmp_path / "out"), pytest.raises(RunError, match="another run is at work"):
        study_of(mini, [], tmp_path / "out")


KEPT = {
    "the study's note": ("study.json", "{}x"),
    "a list for the note": ("study.json", "[1]"),
    "a setting's result": ("[0-9a-f]*.json", '{"scores": {"sites": 3}}'),
    "a stage's times": ("times/tpog-*.json", ""),
    "a list for times": ("times/tpog-*.json", "[]"),
    "no times": ("times/tpog-*.json", '{"made": {}, "measured": 3, "bytes": 1, "sha256": {}}'),
    "words for times": ("times/tpog-*.json", '{"measured": [{"seconds": "x"}], "bytes": 1, "sha256": {}}'),
    "words for a size": ("times/tpog-*.json", '{"measured": [{"seconds": 1}], "bytes": "x", "sha256": {}}'),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", KEPT)
def test_what_was_kept_and_damaged_is_named(
    mini: Path, junction: Path, tmp_path: Path, few: None, run_egvs, case: str
) -> None:
    pattern, content = KEPT[case]
    scenario = junction if pattern == "study.json" else mini  # a study whose traffic is simulated keeps a note
    words = ("accuracy", scenario, "--out", tmp_path / "out", "--budget", "0.001s")
    assert run_egvs(*words)[0] == 0
    damaged = list((tmp_path / "out" / "accuracy").glob(pattern))
    assert damaged
    for path in damaged:
        path.write_text(content)
    code, printed, said = run_egvs(*words)
    assert code == 2
    assert re.search(pattern.replace("*", ".*") + ": is not (as the study wrote it|valid JSON)", said), said
    assert "Traceback" not in said + printed


def shares_are(text: str) -> Callable[[str], str]:
    return lambda kept: re.sub(r'"shares": \[[^\]]*\]', f'"shares": {text}', kept)


SHARED = {
    "too few shares": ("[0-9a-f]*.json", shares_are("[0.5]")),
    "words for shares": ("[0-9a-f]*.json", shares_are('["a", null]')),
    "another share": ("[0-9a-f]*.json", lambda kept: re.sub(r'("shares": \[\s*)0', r"\g<1>1", kept, count=1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", SHARED)
def test_what_was_kept_and_has_another_shape_is_named(
    mini: Path, tmp_path: Path, few: None, run_egvs, case: str
) -> None:
    pattern, change = SHARED[case]
    words = ("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert run_egvs(*words)[0] == 0
    for path in (tmp_path / "out" / "accuracy").glob(pattern):
        path.write_text(change(path.read_text(errors="replace")))
    code, printed, said = run_egvs(*words)
    assert code == 2
    assert "is not as the study wrote it" in said
    assert "Traceback" not in said + printed


@pytest.mark.slow
def test_a_study_of_another_seed_goes_on_in_the_same_folder(mini: Path, tmp_path: Path, few: None) -> None:
    study_of(mini, ["seed=9"], tmp_path, budget_s=0.5)
    assert study_of(mini, ["seed=10"], tmp_path).repeated > 0


@pytest.mark.slow
def test_what_is_recommended_can_be_typed(mini: Path, tmp_path: Path, few: None, run_egvs) -> None:
    """With the user's own ``--set``, and quoted."""
    folder = tmp_path / "a place with späce"
    shutil.copytree(mini, folder)
    sets = ("--set", "traffic.frames=20", "--set", "description=it's")
    code, printed, said = run_egvs("accuracy", folder, "--out", tmp_path / "out", *sets)
    assert code == 0, said
    line = next(line.strip() for line in printed.splitlines() if line.strip().startswith("egvs run"))
    words = shlex.split(line)
    assert words[:7] == ["egvs", "run", str(folder), *sets]
    assert run_egvs(*words[1:], "--out", tmp_path / "again")[0] == 0


def test_nothing_that_is_as_long_as_the_reference_is_compared_with_it(junction: Path, tmp_path: Path) -> None:
    runner = SettingRunner(junction, [], tmp_path, 1, lambda *_: None)
    found = study_settings.list_settings(runner.scenario(study_settings.SCENARIO_AS_IS))
    longest = study_settings.reference_setting(runner.scenario(study_settings.SCENARIO_AS_IS), 4)
    kept = {s.name for s in found if accuracy._is_shorter(runner, s, longest)}
    assert {"400 frames", "200 frames every 1 s", "scenario"} <= kept
    assert not {"800 frames", "1600 frames", "400 frames every 1 s"} & kept


@pytest.mark.slow
def test_tables_fit_the_terminal(mini: Path, tmp_path: Path, few: None, capsys, monkeypatch) -> None:
    study = study_of(mini, [], tmp_path / "out")
    rows = [replace(row, front=row.kind != "measures", recommended=row.kind == "scenario") for row in study.rows]
    study = replace(study, rows=rows)  # the same marks whatever the seconds
    for width in (190, 120, 80):
        if width < 190:
            narrow = Console(width=width, highlight=False)
            monkeypatch.setattr(study_tables, "console", lambda _, narrow=narrow: narrow)
        study_tables.print_study(study, "egvs run mini")
        table = capsys.readouterr().out.partition("reference: ")[0]
        assert "…" not in table
        assert all(len(line) <= width for line in table.splitlines()), width
        assert "* " in table and "*= " in table
        assert all(f"{row.seconds:.2f}" in table for row in study.rows if row.kind != "measures"), width


@pytest.mark.slow
def test_where_every_score_is_0_nothing_is_recommended(mini: Path, tmp_path: Path, few: None, run_egvs) -> None:
    far = ("--set", "roi.center_m=[5000, 5000, 2.5]", "--set", "sensors.small.range_m=20000")
    code, printed, said = run_egvs("accuracy", mini, "--out", tmp_path / "out", *far)
    assert code == 0, said
    assert "every score is 0" in printed
    assert "inf frames" not in printed


@pytest.mark.slow
def test_what_was_kept_and_removed_or_damaged_is_made_again(
    mini: Path, tmp_path: Path, few: None, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(mini, [], tmp_path / "out", budget_s=0.001)
    (tmp_path / "out" / "accuracy" / ".work-left").mkdir()
    for path in (tmp_path / "out" / "accuracy" / "times").glob("tpog-*"):
        path.unlink()
    for path in store.glob("traffic-*"):
        shutil.rmtree(path)
    for path in store.glob("tpog-*/tpog.parquet"):
        path.write_bytes(b"bad")
    again = study_of(mini, [], tmp_path / "out", budget_s=0.001)
    assert compared(again) == compared(study)
    assert "the cached tpog is damaged" in capsys.readouterr().err
    assert not (tmp_path / "out" / "accuracy" / ".work-left").exists()


def test_what_runs_made_is_not_made_again_but_timed(
    mini: Path, tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stage that the store has counts with what it cost whoever made it, until the study has timed it."""
    record = egvs.run(egvs.load(mini), tmp_path / "run")
    runner = SettingRunner(mini, [], tmp_path / "out", 1, lambda *_: None)
    with monkeypatch.context() as patched:
        patched.setattr(SettingRunner, "_make", None)
        scores = runner.run(study_settings.SCENARIO_AS_IS)
    assert scores.stages == {name: record.stages[name].inputs for name in stages.RANKING_STAGES}
    fetched = runner.times("tpog", scores.stages["tpog"])
    assert (fetched.repeats, fetched.seconds) == (0, (record.stages["tpog"].cost.seconds,))
    plain = SettingRunner(mini, [], tmp_path / "other", 1, lambda *_: None)
    Store.default().prune(-1)
    made = plain.run(study_settings.SCENARIO_AS_IS)
    assert made == scores  # standard errors too, which a fetched stage does not hand over
    runner.time_again("tpog", study_settings.SCENARIO_AS_IS, scores)
    timed = runner.times("tpog", scores.stages["tpog"])
    assert (timed.repeats, len(timed.seconds)) == (1, 1)
    assert timed.seconds != fetched.seconds


def test_a_result_of_another_program_is_not_taken(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from egvs.runs import stages

    runner = SettingRunner(mini, [], tmp_path / "out", 1, lambda *_: None)
    runner.run(study_settings.SCENARIO_AS_IS)
    assert runner.known(study_settings.SCENARIO_AS_IS) is not None
    own = stages.source_digest
    monkeypatch.setattr(stages, "source_digest", lambda *names: replace(own(*names), digest="another"))
    changed = SettingRunner(mini, [], tmp_path / "out", 1, lambda *_: None)
    assert changed.known(study_settings.SCENARIO_AS_IS) is None


def test_a_weight_is_part_of_what_a_result_is_kept_under(mini: Path, tmp_path: Path) -> None:
    """With an endless gamma, the same overrides mean half as much where beams are not weighted up."""
    runner = SettingRunner(mini, ["score.gamma=inf"], tmp_path, 1, lambda *_: None)
    thin = next(
        s
        for s in study_settings.list_settings(runner.scenario(study_settings.SCENARIO_AS_IS))
        if s.name == "every 2nd azimuth"
    )
    plain = replace(thin, weight=1.0)
    assert np.array(runner.run(thin).shares) == pytest.approx(2 * np.array(runner.run(plain).shares))


def test_memory_is_let_go_before_a_stage_is_measured(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    monkeypatch.setattr(measurement, "release_memory", lambda: done.append("let go"))
    own = runtime.measure_usage

    def noted() -> object:
        done.append("measured")
        return own()

    monkeypatch.setattr(stages, "measure_usage", noted)
    SettingRunner(mini, [], tmp_path, 1, lambda *_: None).run(study_settings.SCENARIO_AS_IS)
    assert done == ["let go", "measured"] * len(stages.RANKING_STAGES)


@pytest.mark.slow
def test_memory_is_that_of_the_stage(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stage takes is measured above what the program holds."""
    from egvs.stages import tpog

    own = tpog.run

    def greedy(*args: object, **options: object) -> dict[str, object]:
        assert np.ones(50_000_000).sum() > 0  # 400 MB
        return own(*args, **options)

    runner, setting = (
        SettingRunner(mini, [], tmp_path, 1, lambda *_: None),
        study_settings.Setting("scenario", "scenario", ""),
    )
    held = np.ones(50_000_000)
    trial = runner.run(setting)
    plain = runner.times("tpog", trial.stages["tpog"]).peak_mb
    monkeypatch.setattr(tpog, "run", greedy)
    runner.time_again("tpog", setting, trial)
    assert plain < 200
    assert runner.times("tpog", trial.stages["tpog"]).peak_mb == pytest.approx(plain + 381, abs=60)
    assert held[0] == 1.0


def test_a_site_with_a_measured_scan_is_not_thinned(mini: Path) -> None:
    (mini / "points.csv").write_text("x_m,y_m,z_m\n12,5,0.5\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,points.csv\npole_b,30.5,-12,3,\n")
    assert not {"azimuth", "channels"} & {s.knob for s in study_settings.list_settings(egvs.load(mini))}


@pytest.mark.parametrize("name", ["nishishinjuku", "ingolstadt", "roundabout"])
def test_settings_are_sound_scenarios(name: str) -> None:
    folder = ROOT / "scenarios" / name
    found = study_settings.list_settings(egvs.load(folder))
    assert len({s.name for s in found}) == len(found)
    for setting in found:
        assert egvs.load(folder, setting.overrides)
        assert setting.baseline in {s.name for s in found}


def test_the_default_is_what_a_scenario_has_that_says_nothing() -> None:
    """The shipped junction names the paper's period of 0.25 s; a second apart is the program's own."""
    folder = ROOT / "scenarios" / "nishishinjuku"
    own = egvs.load(folder)
    found = [
        s.name
        for s in study_settings.list_settings(own)
        if study_settings.is_default(egvs.load(folder, s.overrides), own)
    ]
    assert found == ["5000 frames every 1 s"]
    assert study_settings.is_default(*[egvs.load(folder, ["traffic.frame_period_s=1.0"])] * 2)


def test_comparisons_with_ties() -> None:
    a, b = np.array([3.0, 3.0, 1.0, 2.0]), np.array([4.0, 3.0, 1.0, 2.0])
    pairs = [(i, j) for i in range(4) for j in range(i)]
    signs = [(np.sign(a[i] - a[j]), np.sign(b[i] - b[j])) for i, j in pairs]
    agree = sum(x * y for x, y in signs) / np.sqrt(sum(x != 0 for x, _ in signs) * sum(y != 0 for _, y in signs))
    assert score_errors.rank_agreement(a, b, "tau") == pytest.approx(agree)
    assert score_errors.rank_agreement(np.ones(3), np.ones(3), "rho") == 1.0
    assert score_errors.rank_agreement(np.ones(4), b, "tau") == 0.0
    assert score_errors.best_sites(a, 1) == {0, 1}
    assert score_errors.best_sites(b, 3) == {0, 1, 3}
    assert score_errors.regret(a, b) == pytest.approx(0.25)  # of two that tie, the worse
    assert score_errors.regret(b, a) == 0.0
    assert score_errors.relative_errors(np.array([0.0, 1.0]), np.array([0.0, 0.0])).tolist() == [0.0, np.inf]


@pytest.mark.slow
def test_front_holds_no_setting_that_another_beats(mini: Path, tmp_path: Path, few: None) -> None:
    rows = [row for row in study_of(mini, [], tmp_path / "out").rows if row.kind in ("approximates", "scenario")]
    for row in rows:
        beaten = any(
            other.seconds <= row.seconds
            and other.judged <= row.judged
            and (other.seconds, other.judged) != (row.seconds, row.judged)
            for other in rows
        )
        assert row.front != beaten


@pytest.mark.slow
def test_one_block_tells_nothing_of_errors(junction: Path, mini: Path, tmp_path: Path, few: None, run_egvs) -> None:
    """Refused where SUMO could watch longer; of a finished file the errors are unknown, not 0."""
    code, _, said = run_egvs("accuracy", junction, "--out", tmp_path / "out", "--set", "tpog.blocks=1")
    assert code == 2
    assert "tpog.blocks: 1, so that nothing tells" in said
    code, printed, said = run_egvs("accuracy", mini, "--out", tmp_path / "out", "--set", "tpog.blocks=1")
    assert code == 0, said
    assert "standard error unknown" in printed
    assert "nan" not in printed


BAD = {
    ("--tolerance", "0"): "--tolerance: 0",
    ("--tolerance", "inf"): "--tolerance: inf",
    ("--tolerance", "1e-300"): "--tolerance: 1e-300",
    ("--budget", "1_0s"): "--budget: expected a time above 0, got '1_0s'",
    ("--seeds", "3"): "--seeds: the traffic is a finished file",
    ("--budget", "soon"): "--budget: expected a time above 0, got 'soon'",
    ("--budget", "-3s"): "--budget: expected a time above 0, got '-3s'",
    ("--budget", ""): "--budget: expected a time above 0, got ''",
    ("--set", "roi.voxel_m=0.3"): "voxel",
}


@pytest.mark.parametrize(("words", "message"), BAD.items(), ids=[" ".join(words) for words in BAD])
def test_wrong_input_is_answered_in_words(
    mini: Path, tmp_path: Path, run_egvs, words: tuple[str, str], message: str
) -> None:
    code, printed, said = run_egvs("accuracy", mini, "--out", tmp_path / "out", *words)
    assert code == 2
    assert message in said
    assert "Traceback" not in said + printed
