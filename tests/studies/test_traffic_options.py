"""Options of the traffic: which are tried, and which have no effect."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.studies import study_settings, traffic_options
from egvs.studies.study_settings import SettingValues
from tests.studies.short_studies import run_study

ONLY_TRAFFIC = SettingValues(
    traffic_parts=(),
    traffic_factors=(),
    sampled_factors=(),
    frame_periods_s=(),
    thinning_factors=(),
    voxels_m=(),
    gammas=(),
    detectors=False,
    unnamed_effects=False,
)


def overrides_by_name(path: Path, *sets: str) -> dict[str, tuple[str, ...]]:
    scenario = egvs.load(path, sets)
    settings = [
        *study_settings.list_variants(scenario, ONLY_TRAFFIC),
        *traffic_options.traffic_option_settings(scenario, ONLY_TRAFFIC),
    ]
    knobs = (study_settings.STEP_KNOB, study_settings.SUBLANES_KNOB, study_settings.ROUTING_KNOB)
    return {setting.name: setting.overrides for setting in settings if setting.knob in knobs}


def reasons(path: Path, *sets: str) -> dict[str, str]:
    return traffic_options.options_without_effect(egvs.load(path, sets), ONLY_TRAFFIC)


def test_tries_steps_sublanes_and_routing_of_random_trips(junction: Path) -> None:
    assert overrides_by_name(junction, "traffic.frame_period_s=1") == {
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
        "traffic.step_s=1.0",
        "traffic.frame_period_s=1.0",
    )


def test_every_option_is_a_valid_scenario(junction: Path) -> None:
    for overrides in overrides_by_name(junction).values():
        assert egvs.load(junction, overrides) != egvs.load(junction)


def test_finished_file_has_no_options(mini: Path) -> None:
    assert overrides_by_name(mini) == {}
    assert reasons(mini) == dict.fromkeys(("SUMO's step", "sublanes", "routing"), "the traffic was recorded")


def test_given_routes_leave_out_routing_only(junction: Path) -> None:
    text = (junction / "scenario.toml").read_text()
    head, _, rest = text.partition("trips_per_s = 1.0")
    rest = rest[rest.index("[statics]") :]
    count = '[[traffic.counts]]\nedge = "WM_e_mid"\nper_hour = 300\n\n'
    (junction / "scenario.toml").write_text(head + "\n" + count + rest)
    assert reasons(junction) == {"routing": "counted traffic has routes of its own"}
    assert "without sublanes" in overrides_by_name(junction)
    assert not any("routes" in name for name in overrides_by_name(junction))


@pytest.mark.slow
def test_study_of_a_finished_file_names_what_is_left_out(mini: Path, tmp_path: Path) -> None:
    study = run_study(mini, [], tmp_path / "out", values=ONLY_TRAFFIC)
    assert study.skipped == dict.fromkeys(("SUMO's step", "sublanes", "routing"), "the traffic was recorded")
