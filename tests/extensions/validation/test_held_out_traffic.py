"""Held-out traffic: its seed, its frames, and its recording in the store."""

import numpy as np
import pytest

from egvs import load
from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.extensions.validation import held_out_traffic, validation_run


def test_held_out_traffic_has_other_seed_and_frame_spacing():
    scenario = load("scenarios/nishishinjuku")
    unseen = held_out_traffic.held_out_scenario(scenario, 250, 2.0)
    assert unseen.seed not in (scenario.seed, *(scenario.model_copy(update={"seed": n}).seed for n in range(100)))
    assert (unseen.traffic.frames, unseen.traffic.frame_period_s) == (250, 2.0)
    assert unseen.traffic.kinds == scenario.traffic.kinds
    assert held_out_traffic.held_out_scenario(scenario, 250, 2.0).seed == unseen.seed
    other = scenario.model_copy(update={"seed": 2})
    assert held_out_traffic.held_out_scenario(other, 250, 2.0).seed != unseen.seed


def test_frames_are_spread_over_recording(mini):
    scenario = load(mini)  # a finished file: 40 frames every 0.5 s, so that every fourth is 2 s apart
    assert held_out_traffic.held_out_scenario(scenario, 10, 2.0) is scenario
    np.testing.assert_array_equal(held_out_traffic.select_frame_numbers(scenario, 40, 10, 2.0), np.arange(0, 40, 4))
    np.testing.assert_array_equal(held_out_traffic.select_frame_numbers(scenario, 40, 3, 2.0), [0, 12, 24])
    with pytest.raises(InputError, match=r"--frames: expected at most 10 frames at least 2 s apart, got 11"):
        held_out_traffic.select_frame_numbers(scenario, 40, 11, 2.0)


def test_recording_is_stored_and_has_requested_frames(mini, tmp_path):
    scenario = load(mini)
    first = held_out_traffic.prepare_held_out_traffic(scenario, tmp_path / "a", 5, apart_s=2.0)
    made_at = first.trajectories.stat().st_mtime_ns
    again = held_out_traffic.prepare_held_out_traffic(scenario, tmp_path / "b", 5, apart_s=2.0)
    assert again.trajectories.stat().st_mtime_ns == made_at  # the same file, from the store
    assert again.keys == first.keys and first.frames == 5
    frames = list(first.read())
    np.testing.assert_array_equal([frame.number for frame in frames], [0, 8, 16, 24, 32])
    assert all(len(frame.boxes) == len(frame.vehicles) == len(frame.kinds) for frame in frames)
    assert first.scene.sites[0].name == "pole_a"


# --- spacing of the frames ------------------------------------------------------------------------------------------
def test_frames_are_7_s_apart_where_traffic_is_drawn():
    assert held_out_traffic.default_spacing_s(load("scenarios/nishishinjuku"), 250) == 7.0


@pytest.mark.parametrize(
    ("frames", "spacing_s"),
    [(2, 7.0), (3, 7.0), (4, 6.5), (5, 4.5), (10, 2.0), (11, 2.0)],
)
def test_frames_are_as_far_apart_as_a_finished_file_allows(mini, frames, spacing_s):
    assert held_out_traffic.default_spacing_s(load(mini), frames) == spacing_s  # 40 frames every 0.5 s


def test_frames_of_a_user_demand_stay_in_the_time_of_the_recording(mini):
    (mini / "net.net.xml").write_text("<net/>")
    (mini / "r.rou.xml").write_text("<routes/>")
    scenario = load(simulated(mini, 'routes = ["r.rou.xml"]'))
    assert held_out_traffic.default_spacing_s(scenario, 5) == 4.5
    assert held_out_traffic.default_spacing_s(scenario, 2) == 7.0


@pytest.mark.slow
def test_spacing_is_an_option_of_validate(run_egvs, mini, tmp_path):
    options = ("--frames", "10", "--detector", "points", "--jobs", "1", "--out", tmp_path / "out")
    code, _, error = run_egvs("validate", mini, *options, "--spacing", "3")
    assert code == 2 and "--frames: expected at most 7 frames at least 3 s apart, got 10" in error, error
    for spacing in ("0", "-1", "nan", "inf"):
        code, _, error = run_egvs("validate", mini, *options, "--spacing", spacing)
        assert code == 2 and f"--spacing: expected seconds above 0, got {float(spacing):g}" in error, error
    code, printed, error = run_egvs("validate", mini, *options, "--spacing", "0.5")
    assert code == 0, error
    assert printed.startswith("2 different vehicles in held-out traffic: ")
    assert "vehicles in 10 frames, at least 0.5 s apart" in printed.splitlines()[0]
    _, metadata = parquet.read_artefact(tmp_path / "out" / "detection.parquet", "detection")
    assert (metadata["apart_s"], metadata["vehicles"]) == (0.5, 2)


def test_same_id_in_two_periods_is_two_vehicles(mini, tmp_path):
    periods = ["traffic.periods=[{name='a', fcd='fcd.csv'}, {name='b', fcd='fcd.csv'}]"]
    record = held_out_traffic.prepare_held_out_traffic(load(mini, periods), tmp_path / "two", 20)
    single = held_out_traffic.prepare_held_out_traffic(load(mini), tmp_path / "one", 10)
    vehicles = single.vehicles_in_region(single.read())
    assert vehicles and len(record.vehicles_in_region(record.read())) == 2 * len(vehicles)


# --- vehicles that the held-out traffic and that of the TPOG have in common ------------------------------------------
@pytest.mark.slow
def test_warns_of_the_share_of_vehicles_that_both_have(run_egvs, mini, tmp_path):
    options = ("--frames", "10", "--detector", "points", "--jobs", "1", "--out", tmp_path / "out")
    code, printed, error = run_egvs("validate", mini, *options)
    assert code == 0, error
    assert "frames that the TPOG was computed from: 2 of 2 vehicles (100 %) are in both" in " ".join(printed.split())


def test_departures_that_cannot_be_redrawn_are_a_warning(mini):
    (mini / "net.net.xml").write_text("<net/>")
    (mini / "r.rou.xml").write_text("<routes><vehicle id='a' depart='1'/><vehicle id='b' depart='triggered'/></routes>")
    scenario = load(simulated(mini, 'routes = ["r.rou.xml"]'))
    (warning,) = validation_run._fixed_departure_warnings(scenario)
    assert "1 of 2 vehicles and flows (50 %) have departures that cannot be redrawn" in warning.problem
    assert held_out_traffic.held_out_scenario(scenario, 10, 2.0).traffic.redraw_departures


def test_random_trips_need_no_redrawn_departures(mini):
    (mini / "net.net.xml").write_text("<net/>")
    scenario = load(simulated(mini))
    assert not list(validation_run._fixed_departure_warnings(scenario))
    assert not held_out_traffic.held_out_scenario(scenario, 10, 2.0).traffic.redraw_departures


def simulated(mini, keys=""):
    """Replace the finished file by a network, and the fleet of the scenario by the default."""
    text = (mini / "scenario.toml").read_text()
    text = text.replace('fcd = "fcd.csv"', f'network = "net.net.xml"\n{keys}')
    kind = text[text.index("[[traffic.kinds]]") : text.index("[statics]")]
    (mini / "scenario.toml").write_text(text.replace(kind, ""))
    return mini
