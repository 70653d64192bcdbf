"""Stages of a setting run once, and their times are measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import checksums
from egvs.core import files
from egvs.core.errors import RunError
from egvs.core.resource_usage import measure_usage
from egvs.runs import stage_keys, stage_registry
from egvs.runs.run_context import open_folder
from egvs.scoring.scorer import Scorer
from egvs.stages.site_scoring import empty_scans
from egvs.studies import measurement, study_settings
from egvs.studies.study_settings import SCENARIO_AS_IS
from tests.studies.short_studies import (
    make_runner,
    shares,
)


def test_repeat_with_other_bytes_is_an_error(mini: Path, tmp_path: Path) -> None:
    runner = make_runner(mini, tmp_path)
    original = SCENARIO_AS_IS
    keys = runner.run_stages(original)
    cost = tmp_path / "accuracy" / "times" / f"tpog-{keys['tpog'][:16]}.json"
    times = json.loads(cost.read_text().replace('"tpog.parquet": "', '"tpog.parquet": "0'))
    cost.write_text(files.to_json_text(checksums.add_checksum(times)))
    with pytest.raises(RunError, match="wrote bytes that differ"):
        runner.time_again("tpog", original, keys["tpog"])


def test_thinned_beams_score_as_if_each_hit_counted_twice(mini: Path, tmp_path: Path) -> None:
    thin = next(s for s in study_settings.list_variants(egvs.load(mini)) if s.name == "every 2nd azimuth")
    scenario = egvs.load(mini, thin.overrides)
    thinned_shares = shares(mini, list(thin.overrides), tmp_path / "out")
    tpog = egvs.read_tpog(tmp_path / "out" / "tpog.parquet")
    p = tpog.p.ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = np.nan_to_num(-(p * np.log2(p) + (1 - p) * np.log2(1 - p)))
    work = open_folder(scenario, tmp_path / "out")
    scorer = Scorer(work.scene, tpog)
    for share, scan in zip(thinned_shares, empty_scans(work), strict=True):
        twice = np.minimum(4.0, 2.0 * scorer.hits(scan.beams).ravel())
        assert share == pytest.approx((entropy * twice).sum() / (4.0 * entropy.sum()), rel=1e-12)


@pytest.mark.slow
def test_cached_stages_count_with_their_original_time_until_they_are_measured(mini: Path, tmp_path: Path) -> None:
    record = egvs.run(egvs.load(mini), tmp_path / "run")
    runner = make_runner(mini, tmp_path / "out")
    keys = runner.run_stages(SCENARIO_AS_IS)
    assert keys == {name: record.stages[name].inputs for name in stage_registry.RANKING_STAGES}
    for name, key in keys.items():
        cached = runner.stage_times(name, key)
        assert (cached.repeats, cached.seconds) == (0, (record.stages[name].cost.seconds,))  # the stage did not run
    cached = runner.stage_times("tpog", keys["tpog"])
    runner.time_again("tpog", SCENARIO_AS_IS, keys["tpog"])
    timed = runner.stage_times("tpog", keys["tpog"])
    assert (timed.repeats, len(timed.seconds)) == (1, 1)
    assert timed.seconds != cached.seconds


@pytest.mark.slow
def test_stages_of_another_run_are_measured_again(mini: Path, tmp_path: Path) -> None:
    """The first run in a clone compiles: its times are not those of the scenario."""
    egvs.run(egvs.load(mini), tmp_path / "run")
    runner = make_runner(mini, tmp_path / "out")
    keys = runner.run_stages(SCENARIO_AS_IS)
    assert all(runner.stage_times(name, key).repeats == 0 for name, key in keys.items())
    seconds = runner.measure_stages(SCENARIO_AS_IS)
    for name, key in keys.items():
        times = runner.stage_times(name, key)
        assert (times.repeats, times.busy_s) == (1, (seconds[name],))
    assert runner.measure_stages(SCENARIO_AS_IS) == seconds  # measured once


def test_result_of_another_program_version_is_ignored(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = make_runner(mini, tmp_path / "out")
    runner.save_result(SCENARIO_AS_IS, {"frames": 2}, {"score": 1.5})
    assert make_runner(mini, tmp_path / "out").saved_result(SCENARIO_AS_IS, {"frames": 2}) == {"score": 1.5}
    assert runner.saved_result(SCENARIO_AS_IS, {"frames": 3}) is None
    original = stage_keys.source_digest
    monkeypatch.setattr(stage_keys, "source_digest", lambda *names: replace(original(*names), digest="another"))
    changed = make_runner(mini, tmp_path / "out")
    assert changed.saved_result(SCENARIO_AS_IS, {"frames": 2}) is None


def test_memory_is_freed_before_a_stage_is_measured(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    monkeypatch.setattr(measurement, "release_memory", lambda: done.append("freed"))
    original = measure_usage

    def noted() -> object:
        done.append("measured")
        return original()

    monkeypatch.setattr(stage_registry, "measure_usage", noted)
    make_runner(mini, tmp_path).run_stages(SCENARIO_AS_IS)
    assert done == ["freed", "measured"] * len(stage_registry.RANKING_STAGES)
