"""A study prices the choice of a pole, recommends a setting that can be typed, and can be continued.

Evidence: scores of the study against those of ordinary runs; studies that are repeated, interrupted and cut short.
Seconds are never compared.
"""

from __future__ import annotations

import math
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_accuracy
from egvs.cli import accuracy_table
from egvs.core.errors import InputError, RunError
from egvs.results.studies import Tolerance
from egvs.runs.run import lock_run_folder
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.studies import accuracy
from egvs.studies.accuracy import StudyOptions
from tests.studies.short_studies import FEW_VALUES, compared, count_progress, run_study


@pytest.mark.slow
def test_thinned_beams_are_reweighted_where_gamma_is_infinite(mini: Path, tmp_path: Path) -> None:
    """Half of the beams have half of the hits; without the weight of 2, the error would be 0.5."""
    study = run_study(mini, ["score.gamma=inf"], tmp_path / "out", budget_s=300)
    (error,) = (row.error for row in study.rows if row.setting == "every 2nd azimuth")
    assert error < 0.1


@pytest.mark.slow
def test_study_of_a_finished_file(mini: Path, tmp_path: Path) -> None:
    study = run_study(mini, [], tmp_path / "out", budget_s=300)
    names = [row.setting for row in study.rows]
    assert names[0] == "scenario"
    assert {"8 frames", "20 frames", "every 2nd azimuth", "gamma 2", "voxel 1 m", "voxel 1 m, gamma 16"} <= set(names)
    assert len(set(names)) == len(names)
    assert (study.units, study.is_recorded, study.needed) == (4, True, None)
    assert study.best_pole.name in ("pole_a", "pole_b")
    table, metadata = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")
    assert table["setting"].to_pylist() == names
    assert (metadata["tolerance"], metadata["score_tolerance"]) == (1.0, None)
    assert (tmp_path / "out" / "accuracy.png").read_bytes()[:4] == b"\x89PNG"
    by_name = {row.setting: row for row in study.rows}
    assert by_name["8 frames"].draws == 4  # each part of the recording is judged by the others
    assert (by_name["scenario"].draws, by_name["scenario"].frames) == (0, 40)
    assert [row for row in study.rows if row.recommended] == [study.recommended]
    path = tmp_path / "out" / "accuracy.parquet"
    assert read_accuracy(path) is not None
    data = path.read_bytes()
    path.write_bytes(data[:99] + bytes([data[99] ^ 1]) + data[100:])
    with pytest.raises(InputError, match=r"accuracy\.parquet: does not match its checksum in accuracy\.sha256"):
        read_accuracy(path)


@pytest.mark.slow
@pytest.mark.parametrize("rank_by", ["expected_detections", pytest.param("egvs", marks=pytest.mark.nightly)])
def test_study_of_simulated_traffic_judges_seeds_by_others(
    junction: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], rank_by: str
) -> None:
    values = replace(FEW_VALUES, voxels_m=(), gammas=(), thinning_factors=(), traffic_options=True)
    study = run_study(junction, [f"score.rank_by={rank_by}"], tmp_path / "out", values=values, seeds=6)
    rows = {row.setting: row for row in study.rows}
    assert (study.units, study.is_recorded) == (6, False)
    assert rows["scenario"].draws == 6
    assert rows["100 frames"].draws == 12  # two halves of each seed
    assert rows["400 frames"].draws == (6 if rank_by == "expected_detections" else 0)  # pairs of seeds, or the model
    assert rows["800 frames"].draws == 0
    assert math.isnan(rows["800 frames"].probability_se)
    assert rows["step 0.5 s, a frame every 0.5 s"].draws == 4
    assert rows["without sublanes"].kind == "approximates"
    assert rows["routes by traffic at departure"].kind == "measures"
    assert rows["100 frames"].traffic_s < rows["scenario"].traffic_s < rows["400 frames"].traffic_s
    assert all(0 <= row.probability <= 1 and row.loss_points >= 0 for row in study.rows)
    accuracy_table.print_study(study, f"egvs run {junction}")
    assert f"egvs run {junction} {study.recommended.overrides}".strip() in capsys.readouterr().out


@pytest.mark.slow
def test_choice_of_the_scenario_is_that_of_an_ordinary_run(junction: Path, tmp_path: Path) -> None:
    values = replace(FEW_VALUES, traffic_parts=(), traffic_factors=(), sampled_factors=(), steps_s=(), voxels_m=())
    values = replace(values, frame_periods_s=(), thinning_factors=())
    poles = []
    for seed in (1, 2, 3, 4):
        egvs.run(egvs.load(junction, [f"seed={seed}"]), tmp_path / f"run{seed}")
        table = egvs.read_scores(tmp_path / f"run{seed}" / "scores.parquet").to_pydict()
        poles.append(table["pole"][table["rank"].index(1)])
    row = run_study(junction, [], tmp_path / "out", values=values, seeds=4).scenario
    assert row.best == max(set(poles), key=poles.count)
    assert row.best_share == poles.count(row.best) / 4


@pytest.mark.slow
def test_prices_are_deterministic_and_finished_study_runs_no_stage_again(mini: Path, tmp_path: Path) -> None:
    one = run_study(mini, [], tmp_path / "one", jobs=1)
    other = run_study(mini, [], tmp_path / "other", jobs=2)
    assert compared(one) == compared(other)
    calls: list[str] = []
    options = StudyOptions(Tolerance(1.0), 600.0, values=FEW_VALUES)
    again = accuracy.run_accuracy_study(mini, [], tmp_path / "one", options, progress=count_progress(calls))
    assert [row.seconds for row in again.rows] == [row.seconds for row in one.rows]
    assert compared(again) == compared(one)
    assert calls == []  # nothing was warmed up either
    accuracy.run_accuracy_study(mini, ["score.gamma=8"], tmp_path / "one", options, progress=count_progress(calls))
    assert calls


@pytest.mark.slow
def test_interrupted_study_continues(mini: Path, tmp_path: Path) -> None:
    complete = run_study(mini, [], tmp_path / "complete")
    finished: list[str] = []

    def interrupt(name: str, _state: str, _details: object) -> None:
        finished.append(name)
        if len(finished) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(mini, [], tmp_path / "out", listener=interrupt)
    assert compared(run_study(mini, [], tmp_path / "out")) == compared(complete)
    assert not list((tmp_path / "out" / "accuracy").glob(".work-*"))


@pytest.mark.slow
def test_settings_beyond_the_budget_are_skipped_and_listed(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, errors = run_egvs("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert code == 0, errors
    line = next(line for line in printed.splitlines() if line.startswith("skipped, beyond the budget: "))
    assert {"voxel 1 m", "every 2nd azimuth"} <= set(line.partition(": ")[2].split("; "))
    rows = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")[0].to_pylist()
    assert {row["setting"] for row in rows} == {"scenario", "8 frames", "20 frames", f"ranked by {DEFAULT_SCORE}"}
    assert "Recommended: " in printed


@pytest.mark.slow
def test_setting_whose_run_fails_is_skipped_with_its_message(mini: Path, tmp_path: Path) -> None:
    values = replace(FEW_VALUES, frame_periods_s=(0.3, 1.0))  # the file has a time step every 0.5 s
    study = run_study(mini, [], tmp_path / "out", values=values)
    assert "0.3" in study.skipped["a frame every 0.3 s"]
    assert len(study.rows) > 5


@pytest.mark.slow
def test_invalid_setting_is_skipped_with_its_message(mini: Path, tmp_path: Path) -> None:
    study = run_study(mini, [], tmp_path / "out", values=replace(FEW_VALUES, gammas=(-1.0, 2.0)))
    assert "score.gamma: expected" in study.skipped["gamma -1"]
    assert "gamma 2" in {row.setting for row in study.rows}


@pytest.mark.slow
def test_score_over_vehicles_tries_frames_and_models_of_detectors(mini: Path, tmp_path: Path) -> None:
    values = replace(FEW_VALUES, detectors=True, sampled_factors=(0.5, 2.0, 9.0))
    sets = ["score.rank_by=expected_detections", "score.sampled_frames=8"]
    study = run_study(mini, sets, tmp_path / "out", values=values)
    rows = {row.setting: row for row in study.rows}
    assert rows["4 frames for detection"].overrides == "--set score.sampled_frames=4"
    assert rows["16 frames for detection"].sampled_frames == 16
    assert "no more frames" in study.skipped["40 frames for detection"]  # the reference has three times 8
    assert rows["model of cluster alone"].kind == "measures"
    assert not any(row.knob == "gamma" for row in study.rows)
    assert rows["voxel 1 m"].loss_points == rows["scenario"].loss_points  # voxels do not matter to vehicles


@pytest.mark.slow
def test_effects_command_prints_costs_and_changes_of_a_study(mini: Path, tmp_path: Path, run_egvs) -> None:
    sets = ["--set", "effects.rain.rate_mm_h=90"]
    code, printed, _ = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)
    assert code == 0
    assert "egvs accuracy" in printed
    study = run_study(mini, sets[1:], tmp_path / "out")
    code, printed, errors = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)
    assert code == 0, errors
    assert "egvs accuracy" not in printed
    without = next(row for row in study.rows if row.setting == "without rain")
    assert f"scores by up to {100 * without.error:.1f} %" in " ".join(printed.split())
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    printed = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)[1]
    assert "egvs accuracy" in printed  # that study is of other sites


def test_second_study_in_the_same_folder_is_rejected(mini: Path, tmp_path: Path) -> None:
    with lock_run_folder(tmp_path / "out"), pytest.raises(RunError, match="another run is using this folder"):
        run_study(mini, [], tmp_path / "out")


DAMAGED_FILES = {
    "a run's scores": ("[0-9a-f]*.json", '{"result": {"mounts": 3}}'),
    "a list for scores": ("[0-9a-f]*.json", "[1]"),
    "a stage's times": ("times/tpog-*.json", ""),
    "a list for times": ("times/tpog-*.json", "[]"),
    "no times": ("times/tpog-*.json", '{"made": {}, "measured": 3, "bytes": 1, "sha256": {}}'),
    "words for times": ("times/tpog-*.json", '{"measured": [{"seconds": "x"}], "bytes": 1, "sha256": {}}'),
    "words for a size": ("times/tpog-*.json", '{"measured": [{"seconds": 1}], "bytes": "x", "sha256": {}}'),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", DAMAGED_FILES)
def test_damaged_intermediate_file_is_named(mini: Path, tmp_path: Path, run_egvs, case: str) -> None:
    pattern, content = DAMAGED_FILES[case]
    words = ("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert run_egvs(*words)[0] == 0
    damaged = list((tmp_path / "out" / "accuracy").glob(pattern))
    assert damaged
    for path in damaged:
        path.write_text(content)
    code, printed, errors = run_egvs(*words)
    assert code == 2
    message = ": (was changed after the study wrote it|is not valid JSON)"
    assert re.search(pattern.replace("*", ".*") + message, errors), errors
    assert "Traceback" not in errors + printed


def replaced(key: str, text: str) -> Callable[[str], str]:
    return lambda content: re.sub(rf'"{key}": "[^"]*"', f'"{key}": {text}', content)


ALTERED_SCORES = {
    "too few numbers": replaced("voxel_scores", '"AAAA"'),
    "no base64": replaced("weight", '"???"'),
    "a number for scores": replaced("block", "3"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", ALTERED_SCORES)
def test_altered_intermediate_scores_are_rejected(mini: Path, tmp_path: Path, run_egvs, case: str) -> None:
    change = ALTERED_SCORES[case]
    words = ("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert run_egvs(*words)[0] == 0
    for path in (tmp_path / "out" / "accuracy").glob("[0-9a-f]*.json"):
        path.write_text(change(path.read_text()))
    code, printed, errors = run_egvs(*words)
    assert code == 2
    assert "was changed after the study wrote it" in errors
    assert "Traceback" not in errors + printed


@pytest.mark.slow
def test_recommended_command_can_be_typed(mini: Path, tmp_path: Path, run_egvs) -> None:
    """It contains the user's ``--set`` options, quoted."""
    folder = tmp_path / "a place with späce"
    shutil.copytree(mini, folder)
    sets = ("--set", "traffic.frames=20", "--set", "description=it's")
    code, printed, errors = run_egvs("accuracy", folder, "--out", tmp_path / "out", "--budget", "5s", *sets)
    assert code == 0, errors
    line = next(line.strip() for line in printed.splitlines() if line.strip().startswith("egvs run"))
    words = shlex.split(line)
    assert words[:7] == ["egvs", "run", str(folder), *sets]
    assert run_egvs(*words[1:], "--out", tmp_path / "again")[0] == 0


@pytest.mark.slow
def test_recommends_nothing_if_every_score_is_0(mini: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far = ["roi.center_m=[5000, 5000, 2.5]", "sensors.small.range_m=20000"]
    study = run_study(mini, far, tmp_path / "out", budget_s=0.001)
    accuracy_table.print_study(study, "egvs run mini")
    printed = capsys.readouterr().out
    assert "Every score is 0" in printed
    assert "Recommended" not in printed
    assert "nan" not in printed


def test_a_recording_needs_four_blocks(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, errors = run_egvs("accuracy", mini, "--out", tmp_path / "out", "--set", "tpog.blocks=2")
    assert code == 2
    assert "tpog.blocks: the traffic is a finished file, so a study needs at least 4 blocks, got 2" in errors


def test_rejects_fewer_than_four_seeds(junction: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--seeds: expected at least 4, got 3"):
        run_study(junction, [], tmp_path / "out", seeds=3)


BAD = {
    ("--tolerance", "-1"): "--tolerance: expected 0 to 100 percentage points, got -1",
    ("--tolerance", "inf"): "got inf",
    ("--tolerance", "nan"): "got nan",
    ("--score-tolerance", "0"): "--score-tolerance: expected 1e-6 to 1, got 0",
    ("--score-tolerance", "1e-300"): "got 1e-300",
    ("--budget", "1_0s"): "--budget: expected a time above 0, got '1_0s'",
    ("--seeds", "4"): "--seeds: the traffic is a finished file",
    ("--budget", "soon"): "--budget: expected a time above 0, got 'soon'",
    ("--budget", "-3s"): "--budget: expected a time above 0, got '-3s'",
    ("--budget", ""): "--budget: expected a value, got an empty text",
    ("--set", "roi.voxel_m=0.3"): "voxel",
}


@pytest.mark.parametrize(("words", "message"), BAD.items(), ids=[" ".join(words) for words in BAD])
def test_invalid_options_are_rejected(
    mini: Path, tmp_path: Path, run_egvs, words: tuple[str, str], message: str
) -> None:
    code, printed, errors = run_egvs("accuracy", mini, "--out", tmp_path / "out", *words)
    assert code == 2
    assert message in errors
    assert "Traceback" not in errors + printed
