"""Options of the traffic: which are tried and which have no effect, their changes, and the spread of seeds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.cli import study_tables
from egvs.core.grid import Grid
from egvs.studies import traffic_options
from egvs.studies.score_errors import SettingResult
from egvs.studies.study_settings import TRAFFIC, SettingValues
from egvs.studies.traffic_options import SeedSpread
from tests.studies.short_studies import run_study
from tests.studies.test_score_errors import row

ONLY_TRAFFIC = SettingValues(
    frames=(),
    traffic_factors=(),
    frame_periods_s=(),
    steps_s=(),
    grid_factors=(),
    grid_seconds=(),
    thinning_factors=(),
    voxels_m=(),
    gammas=(),
    unnamed_effects=False,
)


def overrides_by_name(path: Path, *sets: str) -> dict[str, tuple[str, ...]]:
    settings = traffic_options.traffic_option_settings(egvs.load(path, sets), ONLY_TRAFFIC)
    return {setting.name: setting.overrides for setting in settings}


def reasons(path: Path, *sets: str) -> dict[str, str]:
    return traffic_options.options_without_effect(egvs.load(path, sets), ONLY_TRAFFIC)


def test_tries_other_seeds_steps_sublanes_and_routing_of_random_trips(junction: Path) -> None:
    seed = egvs.load(junction).seed
    assert overrides_by_name(junction, "traffic.frame_period_s=1") == {
        **{f"seed {seed + n}": (f"seed={seed + n}",) for n in (1, 2, 3)},
        "step 0.5 s": ("traffic.step_s=0.5",),
        "step 1 s": ("traffic.step_s=1.0",),
        "without sublanes": ("traffic.lateral_resolution_m=0.0",),
        "routes by traffic at departure": ("traffic.reroute_at_departure=true",),
    }
    assert reasons(junction) == {}


def test_tries_the_opposite_of_what_the_scenario_sets(junction: Path) -> None:
    city = ("traffic.step_s=1", "traffic.frame_period_s=1", "traffic.lateral_resolution_m=0")
    names = overrides_by_name(junction, *city, "traffic.reroute_at_departure=true")
    assert names["step 0.25 s"] == ("traffic.step_s=0.25",)
    assert names["sublanes of 0.8 m"] == ("traffic.lateral_resolution_m=0.8",)
    assert names["routes on empty streets"] == ("traffic.reroute_at_departure=false",)
    assert "step 1 s" not in names


def test_frames_are_as_far_apart_as_the_step_needs(junction: Path) -> None:
    names = overrides_by_name(junction)  # frames every 0.25 s
    assert names["step 1 s, a frame every 1 s"] == (
        "traffic.frames=50",
        "traffic.frame_period_s=1.0",
        "traffic.step_s=1.0",
    )


def test_every_option_is_a_valid_scenario(junction: Path) -> None:
    for overrides in overrides_by_name(junction).values():
        assert egvs.load(junction, overrides) != egvs.load(junction)


def test_finished_file_has_no_options(mini: Path) -> None:
    assert overrides_by_name(mini) == {}
    assert reasons(mini) == dict.fromkeys(("SUMO's step", "sublanes", "routing"), "the traffic is a finished file")


def test_given_routes_leave_out_routing_only(junction: Path) -> None:
    text = (junction / "scenario.toml").read_text()
    head, _, rest = text.partition("trips_per_s = 1.0")
    rest = rest[rest.index("[statics]") :]
    count = '[[traffic.counts]]\nedge = "WM_e_mid"\nper_hour = 300\n\n'
    (junction / "scenario.toml").write_text(head + "\n" + count + rest)
    assert reasons(junction) == {"routing": "counted traffic has routes of its own"}
    assert "without sublanes" in overrides_by_name(junction)
    assert not any("routes" in name for name in overrides_by_name(junction))


def test_tpog_change_by_hand() -> None:
    grid = Grid((0.0, 0.0, 0.0), 1.0, (2, 1, 1))

    def tpog(frames: int, *counts: int) -> Tpog:
        return Tpog(grid, frames, np.array(counts, dtype=np.int64).reshape(2, 1, 1))

    base = tpog(10, 4, 1)  # occupancy 0.4 and 0.1
    assert traffic_options.tpog_change(base, base) == 0.0
    assert traffic_options.tpog_change(tpog(10, 3, 2), base) == pytest.approx(0.2 / 0.5)
    assert traffic_options.tpog_change(tpog(20, 8, 2), base) == 0.0  # twice as long, the same shares
    assert math.isnan(traffic_options.tpog_change(base, tpog(10, 0, 0)))
    other = Tpog(Grid((1.0, 0.0, 0.0), 1.0, (2, 1, 1)), 10, base.counts)
    assert math.isnan(traffic_options.tpog_change(other, base))


def option(name: str, knob: str, tpog_change: float, error: float) -> SettingResult:
    return row(name, 1.0, knob=knob, tpog_change=tpog_change, error=error, kind=TRAFFIC)


SEEDS = [option(f"seed {n}", "seed", change, 0.5 * change) for n, change in enumerate((0.10, 0.11, 0.12))]


def test_spread_of_seeds_by_hand() -> None:
    spread = SeedSpread.from_rows(SEEDS)
    # mean 0.11, standard deviation 0.01, t of 2 degrees of freedom at 95 % is 2.92
    assert spread.seeds == 3
    assert spread.tpog == pytest.approx(0.11 + 2.919986 * 0.01 * math.sqrt(4 / 3), abs=1e-6)
    assert spread.score == pytest.approx(0.5 * spread.tpog)


@pytest.mark.parametrize(
    ("tpog_change", "error", "verdict"),
    [
        (0.13, 0.06, "within the spread of seeds"),
        (0.15, 0.06, "TPOG: beyond it"),
        (0.13, 0.08, "scores: beyond it"),
        (0.15, 0.08, "TPOG and scores: beyond it"),
        (math.nan, 0.06, "unknown"),
        (0.0, 0.0, "the same traffic"),
    ],
)
def test_options_are_compared_with_the_spread_of_seeds(tpog_change: float, error: float, verdict: str) -> None:
    changed = option("step 1 s", "step", tpog_change, error)
    assert SeedSpread.from_rows([*SEEDS, changed]).verdict(changed) == verdict


def test_one_seed_gives_no_spread() -> None:
    assert SeedSpread.from_rows(SEEDS[:1]).verdict(SEEDS[1]) == "unknown"


def test_seeds_alone_are_rarely_beyond_their_own_spread() -> None:
    """The prediction interval holds: about one in twenty further seeds is above it."""
    rng = np.random.default_rng(3)
    beyond = 0
    for changes in rng.normal(0.1, 0.01, (4000, 4)):
        seeds = [option("seed", "seed", change, change) for change in changes[:3]]
        further = option("step", "step", changes[3], changes[3])
        beyond += SeedSpread.from_rows(seeds).verdict(further) != "within the spread of seeds"
    assert 0.04 < beyond / 4000 < 0.06


@pytest.mark.slow
def test_study_prices_options_of_the_traffic_with_sumo(
    junction: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = replace(ONLY_TRAFFIC, traffic_seeds=2)
    study = run_study(junction, [], tmp_path / "out", values=values, max_reference_factor=1, repeats=1)
    options = {result.setting: result for result in study.rows if result.kind == TRAFFIC}
    assert len(options) == 2 + 2 + 1 + 1 and not study.skipped
    for result in options.values():
        assert result.tpog_change >= 0.0 and -1.0 <= result.tau <= 1.0 and result.best
        if result.knob in ("seed", "step", "sublanes"):
            assert result.tpog_change > 0.0 and result.error > 0.0
    table = parquet.read_artefact(tmp_path / "out" / "accuracy.parquet", "accuracy")[0]
    assert set(options) < set(table["setting"].to_pylist())
    study_tables.print_study(study, "egvs run junction")
    printed = capsys.readouterr().out
    assert "options of the traffic: another draw of it, compared with the scenario, beside other seeds" in printed
    assert "spread of 2 other seeds: up to TPOG" in printed
    seed = egvs.load(junction).seed + 1
    egvs.run(egvs.load(junction, [f"seed={seed}"]), tmp_path / "seeded")
    egvs.run(egvs.load(junction), tmp_path / "plain")
    tpogs = [read_tpog(tmp_path / name / "tpog.parquet") for name in ("seeded", "plain")]
    assert options[f"seed {seed}"].tpog_change == traffic_options.tpog_change(*tpogs)


def test_study_of_a_finished_file_names_what_is_left_out(mini: Path, tmp_path: Path) -> None:
    study = run_study(mini, [], tmp_path / "out", values=ONLY_TRAFFIC, repeats=1)
    assert study.skipped == dict.fromkeys(("SUMO's step", "sublanes", "routing"), "the traffic is a finished file")
