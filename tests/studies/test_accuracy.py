"""A study reports the errors of its settings, recommends one that has the reported error, and can be continued.

Evidence: settings that are run again from the ``--set`` options that the study prints; studies that are repeated,
interrupted and cut short. Seconds are never compared.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_accuracy
from egvs.cli import study_tables
from egvs.core.errors import InputError, RunError
from egvs.core.progress import no_progress
from egvs.runs.run import lock_run_folder
from egvs.studies import accuracy, measurement, study_settings
from egvs.studies.accuracy import StudyOptions
from egvs.studies.measurement import SettingRunner
from egvs.studies.study_settings import SCENARIO_AS_IS
from tests.studies.short_studies import (
    FEW_VALUES,
    compared,
    count_progress,
    make_runner,
    override_values,
    run_study,
    shares,
)


def test_study_of_a_finished_file(mini: Path, tmp_path: Path) -> None:
    study = run_study(mini, [], tmp_path / "out", budget_s=300)
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
    table, metadata = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")
    assert table["setting"].to_pylist() == names
    assert metadata["reference_times"] == 1
    assert (tmp_path / "out" / "accuracy.png").read_bytes()[:4] == b"\x89PNG"
    assert all(row.repeats == 2 for row in study.rows)
    unchanged = study.rows[0]
    assert (unchanged.error, unchanged.tau, unchanged.regret, unchanged.best_kept, unchanged.best_three_kept) == (
        0.0,
        1.0,
        0.0,
        True,
        True,
    )
    recommended = [row for row in study.rows if row.recommended]
    assert recommended == [study.best]
    path = tmp_path / "out" / "accuracy.parquet"
    assert read_accuracy(path) is not None
    data = path.read_bytes()
    path.write_bytes(data[:99] + bytes([data[99] ^ 1]) + data[100:])
    with pytest.raises(InputError, match=r"accuracy\.parquet: does not match its checksum in accuracy\.sha256"):
        read_accuracy(path)
    again = shares(mini, override_values(recommended[0]), tmp_path / "again")
    against = shares(mini, [], tmp_path / "plain")
    assert np.abs(again / against - 1).max() == pytest.approx(recommended[0].error, abs=1e-12)
    assert recommended[0].error <= 0.02


@pytest.mark.slow
def test_recommended_setting_has_the_reported_error_with_sumo(
    junction: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = replace(
        FEW_VALUES,
        frames=(100,),
        traffic_factors=(2, 4),
        steps_s=(0.5,),
        grid_factors=(4,),
        grid_seconds=((None, 1.0), (0.5, 1.0)),
    )
    options = {"tolerance": 0.4, "seeds": 2, "repeats": 1, "max_reference_factor": 8, "values": values}
    study = run_study(junction, ["score.rank_by=egvs"], tmp_path / "out", **options)
    study_tables.print_study(study, f"egvs run {junction}")
    printed = capsys.readouterr().out
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


@pytest.mark.slow
def test_errors_are_deterministic_and_finished_study_runs_no_stage_again(mini: Path, tmp_path: Path) -> None:
    one = run_study(mini, [], tmp_path / "one", jobs=1)
    other = run_study(mini, [], tmp_path / "other", jobs=2)
    assert compared(one) == compared(other)
    calls: list[str] = []
    options = StudyOptions(0.02, 600.0, repeats=2, values=FEW_VALUES)
    again = accuracy.run_accuracy_study(mini, [], tmp_path / "one", options, progress=count_progress(calls))
    assert again.rows == one.rows  # with the measured seconds and the number of repeats
    assert calls == []  # nothing was warmed up either
    accuracy.run_accuracy_study(mini, ["seed=8"], tmp_path / "one", options, progress=count_progress(calls))
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
    reported: list[tuple[str, str]] = []
    rest = run_study(mini, [], tmp_path / "out", listener=lambda name, state, _: reported.append((name, state)))
    assert {name for name, state in reported if state == "kept"} == {"scenario", *finished}
    assert {state for _, state in reported} == {"kept", "done"}
    assert compared(rest) == compared(complete)
    assert not list((tmp_path / "out" / "accuracy").glob(".work-*"))


@pytest.mark.slow
def test_settings_beyond_the_budget_are_skipped_and_listed(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, errors = run_egvs("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert code == 0, errors
    line = next(line for line in printed.splitlines() if line.startswith("skipped, beyond the budget: "))
    assert {"voxel 1 m", "every 2nd azimuth"} <= set(line.partition(": ")[2].split("; "))
    rows = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")[0].to_pylist()
    assert [row["setting"] for row in rows] == ["scenario"]


@pytest.mark.slow
def test_standard_error_is_the_error_without_longer_reference(junction: Path, tmp_path: Path, capsys) -> None:
    study = run_study(junction, [], tmp_path / "out", budget_s=0.001)
    assert [row.setting for row in study.rows] == ["scenario"]
    assert (study.reference_factor, study.best) == (1, None)
    assert study.rows[0].judged == study.rows[0].error_se > study.tolerance
    study_tables.print_study(study, "egvs run junction")
    named = f"with error 0.00% and standard error {study.rows[0].error_se:.2%}: increase --budget"
    assert named in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_setting_whose_run_fails_is_skipped_with_its_message(mini: Path, tmp_path: Path) -> None:
    values = replace(FEW_VALUES, frame_periods_s=(0.3, 1.0))  # the file has a time step every 0.5 s
    study = run_study(mini, [], tmp_path / "out", values=values)
    (name,) = study.skipped
    assert name.endswith("every 0.3 s")
    assert "0.3" in study.skipped[name]
    assert len(study.rows) > 5
    again = run_study(mini, [], tmp_path / "out", values=values)
    assert (again.rows, again.skipped) == (study.rows, study.skipped)


@pytest.mark.slow
@pytest.mark.parametrize("standard_error", ["true", "false"])
def test_study_uses_the_score_that_ranks(mini: Path, tmp_path: Path, standard_error: str) -> None:
    sets = ["score.rank_by=seen_well", f"score.standard_error={standard_error}"]
    study = run_study(mini, sets, tmp_path / "out")
    assert {row.knob for row in study.rows} == {"", "period"}  # no gamma, no voxels, no beams that are weighted up
    egvs.run(egvs.load(mini, sets[:1]), tmp_path / "run")
    rows = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pydict()
    unchanged = make_runner(mini, tmp_path / "out", *sets).saved_scores(SCENARIO_AS_IS)
    assert unchanged is not None
    assert unchanged.shares == unchanged.scores == rows["seen_well"]
    assert unchanged.ses == pytest.approx(rows["seen_well_se"])
    assert unchanged.neighbours[0][2] == pytest.approx(rows["beats_next"][rows["rank"].index(1)])
    other = next(row for row in study.rows if row.knob == "period")
    egvs.run(egvs.load(mini, [*sets, *override_values(other)]), tmp_path / "other")
    settings = egvs.read_scores(tmp_path / "other" / "scores.parquet")["seen_well"].to_numpy()
    assert other.error == pytest.approx(np.abs(settings / rows["seen_well"] - 1).max())


def test_rejects_seeds_for_other_scores_than_egvs(junction: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--seeds: .*score\.rank_by is .seen_well"):
        run_study(junction, ["score.rank_by=seen_well"], tmp_path / "out", seeds=2)


@pytest.mark.slow
def test_invalid_setting_is_skipped_with_its_message(mini: Path, tmp_path: Path) -> None:
    study = run_study(mini, [], tmp_path / "out", values=replace(FEW_VALUES, gammas=(-1.0, 2.0)))
    assert "score.gamma: expected" in study.skipped["gamma -1"]
    assert "gamma 2" in {row.setting for row in study.rows}


class FastRunner(SettingRunner):
    """Reports 0.1 s for each stage."""

    def stage_times(self, name: str, key: str) -> measurement.StageTimes:
        return measurement.StageTimes((0.1,), (0.1,), 1.0, 1, 1)


@pytest.mark.parametrize(("frames", "budget_s", "factor"), [(200, 1e6, 32), (2_000_000, 1e5, 4), (2_000_000, 1.3, 2)])
def test_reference_is_shortened_to_a_valid_scenario_within_budget(
    junction: Path, tmp_path: Path, frames: int, budget_s: float, factor: int
) -> None:
    """A scenario has at most 10,000,000 frames; the reference takes at most a third of the budget."""
    runner = FastRunner(junction, [f"traffic.frames={frames}"], tmp_path, 1, no_progress)
    scores = measurement.SettingScores([], [], [], [], [], [], 1.0, [], {"traffic": "t", "tpog": "t"})
    assert accuracy.reference_factor(runner, scores, StudyOptions(0.02, budget_s)) == factor


@pytest.mark.slow
def test_settings_beyond_the_budget_are_not_warmed_up(mini: Path, tmp_path: Path) -> None:
    first = run_study(mini, [], tmp_path / "out", budget_s=0.001)
    assert [row.setting for row in first.rows] == ["scenario"]
    calls: list[str] = []
    options = StudyOptions(0.02, 1e-9, repeats=2, values=FEW_VALUES)
    study = accuracy.run_accuracy_study(mini, [], tmp_path / "out", options, progress=count_progress(calls))
    assert study.rows == first.rows
    assert calls == []


@pytest.mark.slow
def test_effects_command_prints_costs_and_changes_of_a_study(mini: Path, tmp_path: Path, run_egvs) -> None:
    """The change equals that of runs with and without the effect."""
    sets = ["--set", "effects.rain.rate_mm_h=90"]
    code, printed, _ = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)
    assert code == 0
    assert "egvs accuracy" in printed
    run_study(mini, sets[1:], tmp_path / "out")
    code, printed, errors = run_egvs("effects", mini, "--out", tmp_path / "out", *sets)
    assert code == 0, errors
    assert "egvs accuracy" not in printed
    dry, wet = shares(mini, [], tmp_path / "dry"), shares(mini, sets[1:], tmp_path / "wet")
    assert f"scores by up to {np.abs(dry / wet - 1).max():.1%}" in " ".join(printed.split())
    code, printed, _ = run_egvs("effects", mini, "--out", tmp_path / "out", "--set", "effects.rain.rate_mm_h=91")
    assert "egvs accuracy" in printed  # that study was of another scenario
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    assert (
        "egvs accuracy" in run_egvs("effects", mini, "--out", tmp_path / "out", *sets)[1]
    )  # and that one of other sites


def test_second_study_in_the_same_folder_is_rejected(mini: Path, tmp_path: Path) -> None:
    with lock_run_folder(tmp_path / "out"), pytest.raises(RunError, match="another run is using this folder"):
        run_study(mini, [], tmp_path / "out")


DAMAGED_FILES = {
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
@pytest.mark.parametrize("case", DAMAGED_FILES)
def test_damaged_intermediate_file_is_named(mini: Path, junction: Path, tmp_path: Path, run_egvs, case: str) -> None:
    pattern, content = DAMAGED_FILES[case]
    scenario = junction if pattern == "study.json" else mini  # a study whose traffic is simulated keeps a note
    words = ("accuracy", scenario, "--out", tmp_path / "out", "--budget", "0.001s")
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


def shares_are(text: str) -> Callable[[str], str]:
    return lambda comparable: re.sub(r'"shares": \[[^\]]*\]', f'"shares": {text}', comparable)


ALTERED_SCORES = {
    "too few shares": ("[0-9a-f]*.json", shares_are("[0.5]")),
    "words for shares": ("[0-9a-f]*.json", shares_are('["a", null]')),
    "another share": (
        "[0-9a-f]*.json",
        lambda comparable: re.sub(r'("shares": \[\s*)0', r"\g<1>1", comparable, count=1),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", ALTERED_SCORES)
def test_altered_intermediate_scores_are_rejected(mini: Path, tmp_path: Path, run_egvs, case: str) -> None:
    pattern, change = ALTERED_SCORES[case]
    words = ("accuracy", mini, "--out", tmp_path / "out", "--budget", "0.001s")
    assert run_egvs(*words)[0] == 0
    for path in (tmp_path / "out" / "accuracy").glob(pattern):
        path.write_text(change(path.read_text(errors="replace")))
    code, printed, errors = run_egvs(*words)
    assert code == 2
    assert "was changed after the study wrote it" in errors
    assert "Traceback" not in errors + printed


@pytest.mark.slow
def test_study_with_another_seed_continues_in_the_same_folder(mini: Path, tmp_path: Path) -> None:
    run_study(mini, ["seed=9"], tmp_path, budget_s=0.5)
    assert run_study(mini, ["seed=10"], tmp_path).repeated > 0


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


def test_settings_as_long_as_the_reference_are_not_compared_with_it(junction: Path, tmp_path: Path) -> None:
    runner = make_runner(junction, tmp_path)
    settings = study_settings.list_settings(runner.scenario(SCENARIO_AS_IS))
    longest = study_settings.reference_setting(runner.scenario(SCENARIO_AS_IS), 4)
    comparable = {s.name for s in settings if accuracy.is_shorter(runner, s, longest)}
    assert {"400 frames", "200 frames every 1 s", "scenario"} <= comparable
    assert not {"800 frames", "1600 frames", "400 frames every 1 s"} & comparable


@pytest.mark.slow
def test_tables_fit_the_terminal(mini: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    study = run_study(mini, [], tmp_path / "out")
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
def test_recommends_nothing_if_every_score_is_0(mini: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far = ["roi.center_m=[5000, 5000, 2.5]", "sensors.small.range_m=20000"]
    study_tables.print_study(run_study(mini, far, tmp_path / "out"), "egvs run mini")
    printed = capsys.readouterr().out
    assert "every score is 0" in printed
    assert "inf frames" not in printed


@pytest.mark.slow
def test_missing_or_damaged_cached_stages_run_again(
    mini: Path, tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = run_study(mini, [], tmp_path / "out", budget_s=0.001)
    (tmp_path / "out" / "accuracy" / ".work-left").mkdir()
    for path in (tmp_path / "out" / "accuracy" / "times").glob("tpog-*"):
        path.unlink()
    for path in store.glob("traffic-*"):
        shutil.rmtree(path)
    for path in store.glob("tpog-*/tpog.parquet"):
        path.write_bytes(b"bad")
    again = run_study(mini, [], tmp_path / "out", budget_s=0.001)
    assert compared(again) == compared(study)
    assert "the cached tpog is damaged" in capsys.readouterr().err
    assert not (tmp_path / "out" / "accuracy" / ".work-left").exists()


@pytest.mark.slow
def test_front_contains_no_setting_that_another_dominates(mini: Path, tmp_path: Path) -> None:
    rows = [row for row in run_study(mini, [], tmp_path / "out").rows if row.kind in ("approximates", "scenario")]
    for row in rows:
        beaten = any(
            other.seconds <= row.seconds
            and other.judged <= row.judged
            and (other.seconds, other.judged) != (row.seconds, row.judged)
            for other in rows
        )
        assert row.front != beaten


@pytest.mark.slow
def test_one_block_gives_no_standard_errors(junction: Path, mini: Path, tmp_path: Path, run_egvs, capsys) -> None:
    """It is rejected if SUMO runs; for a finished file the errors are unknown, not 0."""
    code, _, errors = run_egvs("accuracy", junction, "--out", tmp_path / "out", "--set", "tpog.blocks=1")
    assert code == 2
    assert "tpog.blocks: standard errors need at least 2 blocks" in errors
    study_tables.print_study(run_study(mini, ["tpog.blocks=1"], tmp_path / "finished"), "egvs run mini")
    printed = capsys.readouterr().out
    assert "standard error unknown" in printed
    assert "nan" not in printed


BAD = {
    ("--tolerance", "0"): "--tolerance: expected 1e-6 to 1, got 0",
    ("--tolerance", "inf"): "got inf",
    ("--tolerance", "1e-300"): "got 1e-300",
    ("--budget", "1_0s"): "--budget: expected a time above 0, got '1_0s'",
    ("--seeds", "3"): "--seeds: the traffic is a finished file",
    ("--budget", "soon"): "--budget: expected a time above 0, got 'soon'",
    ("--budget", "-3s"): "--budget: expected a time above 0, got '-3s'",
    ("--budget", ""): "--budget: expected a time above 0, got ''",
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
