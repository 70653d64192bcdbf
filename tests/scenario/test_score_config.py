"""The number that gamma = "auto" stands for, when it is kept, and where it is shown."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.score_config import default_gamma
from egvs.studies import study_settings
from egvs.studies.measurement import SettingRunner
from egvs.studies.run_comparison import compare_runs

OCCLUSION = "effects.moving_occlusion={}"


@pytest.fixture
def auto(mini: Path) -> Path:
    """The small scenario without a gamma of its own."""
    file = mini / "scenario.toml"
    file.write_text(file.read_text().replace("gamma = 4\n", ""))
    return mini


def test_default_gamma_matches_study() -> None:
    plain, hidden = (
        {voxel_m: default_gamma(voxel_m, moving_occlusion=occlusion) for voxel_m in (0.125, 0.25, 0.5, 1.0, 2.0)}
        for occlusion in (False, True)
    )
    assert plain == {0.125: 0.9, 0.25: 2.0, 0.5: 4.5, 1.0: 10.0, 2.0: 22.0}
    assert hidden == {0.125: 0.45, 0.25: 1.0, 0.5: 2.2, 1.0: 5.0, 2.0: 11.0}


@pytest.mark.slow
@given(st.floats(0.01, 100), st.booleans())
def test_default_gamma_rises_and_has_two_digits(voxel_m: float, occlusion: bool) -> None:
    gamma = default_gamma(voxel_m, moving_occlusion=occlusion)
    assert gamma == float(f"{gamma:.1e}")
    assert default_gamma(1.2 * voxel_m, moving_occlusion=occlusion) > gamma > 0


def test_gamma_of_scenario(auto: Path) -> None:
    def of(*overrides: str) -> float:
        return egvs.load(auto, overrides).gamma

    assert egvs.load(auto).score.gamma == "auto"
    assert (of(), of("roi.voxel_m=1"), of(OCCLUSION), of("score.gamma=7", OCCLUSION)) == (4.5, 10.0, 2.2, 7.0)
    assert of("score.gamma=inf") == float("inf")


@pytest.mark.parametrize("gamma", ["1e-300", "1e-10", "5e-324"])
def test_rejects_gamma_whose_squares_are_no_numbers(auto: Path, gamma: str) -> None:
    with pytest.raises(InputError, match=r"score\.gamma: expected 0, or at least 1e-09, got"):
        egvs.load(auto, [f"score.gamma={gamma}"])


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [1e-9, 1e12, 1e300])
def test_errors_of_smallest_and_largest_gamma_are_in_proportion(auto: Path, tmp_path: Path, gamma: float) -> None:
    """The smallest caps every voxel; the largest caps none."""
    relative = []
    for number, value in enumerate((gamma, 1e-3 if gamma < 1 else math.inf)):
        egvs.run(egvs.load(auto, [f"score.gamma={value}"]), tmp_path / str(number))
        table = egvs.read_scores(tmp_path / str(number) / "scores.parquet")
        relative.append(table["egvs_se"].to_numpy() / table["egvs"].to_numpy())
    assert relative[0] == pytest.approx(relative[1], rel=1e-9)
    assert min(relative[0]) > 0.01


def test_with_effects_keeps_gamma(auto: Path) -> None:
    """What an effect changes is seen with one gamma."""
    scenario = egvs.load(auto)
    assert scenario.with_effects(EffectsConfig.from_dict({"moving_occlusion": {}})).gamma == 4.5
    hidden = egvs.load(auto, [OCCLUSION])
    assert hidden.with_effects(hidden.effects.only()).gamma == 2.2


def test_study_settings_keep_gamma(auto: Path, tmp_path: Path) -> None:
    runner = SettingRunner(auto, [], tmp_path, 1, lambda *_: None)
    settings = {
        setting.name: setting
        for setting in study_settings.list_variants(runner.scenario(study_settings.SCENARIO_AS_IS))
    }
    gammas = {name: runner.scenario(setting).gamma for name, setting in settings.items()}
    assert gammas["scenario"] == gammas["voxel 1 m"] == gammas["with moving_occlusion"] == 4.5
    assert gammas["voxel 1 m, gamma 18"] == 18.0
    assert gammas["gamma 2"] == 2.0


@pytest.mark.slow
def test_run_with_auto_equals_run_with_number(auto: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    code, _, message = run_egvs("run", auto, "--out", tmp_path / "auto", "--verbose")
    assert code == 0
    assert "gamma 4.5 (auto)" in message
    assert "4.5 beams<small>per voxel; further beams add nothing; chosen for the voxel size (auto)" in (
        tmp_path / "auto" / "report.html"
    ).read_text(encoding="utf-8")
    assert run_egvs("run", auto, "--out", tmp_path / "number", "--set", "score.gamma=4.5")[0] == 0
    assert "(auto)" not in (tmp_path / "number" / "report.html").read_text(encoding="utf-8")
    first, second = (tmp_path / name / "scores.parquet" for name in ("auto", "number"))
    assert first.read_bytes() == second.read_bytes()
    assert parquet.read_metadata(first, "scores")["gamma"] == 4.5
    assert run_egvs("run", auto, "--out", tmp_path / "fine", "--set", "roi.voxel_m=0.25")[0] == 0
    compared = compare_runs([tmp_path / "auto", tmp_path / "number", tmp_path / "fine"])
    assert {d.what: d.values for d in compared.differences}["score.gamma"] == (4.5, 4.5, 2.0)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ('"Auto"', "score.gamma: expected a valid number or 'auto', got 'Auto'"),
        ("-1", "score.gamma: expected a value greater than or equal to 0 or 'auto', got -1"),
    ],
)
def test_rejects_invalid_gamma(mini: Path, run_egvs, value: str, message: str) -> None:  # type: ignore[no-untyped-def]
    code, _, message = run_egvs("check", mini, "--set", f"score.gamma={value}")
    assert code == 2
    assert message.count("score.gamma") == 1
    assert message in message
