"""Settings are valid scenarios, in which only one thing changes; all traffic is lengthened by the same factor."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.runs.stage_registry import RANKING_STAGES
from egvs.scenario.model import Scenario
from egvs.studies import study_settings
from tests.studies.short_studies import ROOT, make_runner, settings_by_name, shares

TRAFFIC = """[traffic]
network = "net.net.xml"
frames = 400
warmup_s = 10

[[traffic.periods]]
name = "day"
vehicles = 4

[[traffic.periods]]
name = "7.30 h"
vehicles = 2
length_s = 800
"""


@pytest.fixture
def split(mini: Path) -> Path:
    """The small scenario with two periods on a network: 400 frames, and a length of its own of 800 frames."""
    file, text = mini / "scenario.toml", (mini / "scenario.toml").read_text()
    head, rest = text.split("[traffic]", 1)
    file.write_text(head + TRAFFIC.replace("7.30 h", "7.30h") + "\n[statics]" + rest.split("[statics]", 1)[1])
    return mini


def frames_of(scenario: Scenario) -> list[int | None]:
    return [alone.traffic.frames for alone in scenario.by_period().values()]


@pytest.mark.parametrize(
    ("times", "period_s", "overrides", "frames"),
    [
        (1, 1.0, (), [400, 800]),
        (4, 1.0, ("traffic.frames=1600", "traffic.periods.1.length_s=3200.0"), [1600, 3200]),
        (1, 2.0, ("traffic.frames=200",), [200, 400]),
        (0.1, 1.0, ("traffic.frames=40", "traffic.periods.1.length_s=80.0"), [40, 80]),
    ],
)
def test_scaling_lengthens_each_period(
    split: Path, times: float, period_s: float, overrides: tuple[str, ...], frames: list[int]
) -> None:
    assert study_settings.traffic_length_overrides(egvs.load(split), times, period_s) == (sum(frames), overrides)
    period = [f"traffic.frame_period_s={period_s}"]
    assert frames_of(egvs.load(split, [*overrides, *period])) == frames


def test_periods_of_finished_files_are_not_scaled(mini: Path) -> None:
    file = mini / "scenario.toml"
    day, night = ('name = "a"\nlength_s = 12\n', 'name = "b"\nbegin_s = 12\nlength_s = 8\n')
    rows = f"[[traffic.periods]]\n{day}\n[[traffic.periods]]\n{night}"
    file.write_text(file.read_text().replace("[[traffic.kinds]]", f"{rows}\n[[traffic.kinds]]", 1))
    scenario = egvs.load(mini)
    assert scenario.is_recorded
    assert study_settings.counted_frames(scenario) == 24 + 16
    assert study_settings.traffic_length_overrides(scenario, 2, 0.5) == (0, ())
    assert study_settings.traffic_length_overrides(scenario, 1, 0.5) == (40, ())
    assert not {s.knob for s in study_settings.list_variants(scenario)} & {"period", "step"}


def test_parameters_of_other_effect_method_are_not_varied(mini: Path) -> None:
    sets = ['effects.moving_occlusion.method="independent"']
    names = {s.name for s in study_settings.list_variants(egvs.load(mini, sets))}
    assert not {name for name in names if name.startswith("moving_occlusion")}
    assert "without moving_occlusion" in names


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["VLP-32C", "OS1-64", "RS-M1"])
def test_thinned_catalogue_sensor_has_a_subset_of_its_beams(mini: Path, sensor: str) -> None:
    from egvs.sensors.sensor import CATALOGUE, resolve_sensor

    complete = CATALOGUE[sensor]
    for setting in study_settings.list_variants(egvs.load(mini, [f"sites.sensor={sensor}"])):
        if setting.knob not in ("azimuth", "channels"):
            continue
        thin = resolve_sensor(sensor, egvs.load(mini, [f"sites.sensor={sensor}", *setting.overrides]).sensors, "")
        assert thin.beams * setting.weight == complete.beams
        every = {tuple(ray) for ray in complete.directions(30.0).tolist()}
        assert {tuple(ray) for ray in thin.directions(30.0).tolist()} <= every


@pytest.mark.slow
def test_effects_are_left_out_and_their_quality_is_varied(mini: Path, tmp_path: Path) -> None:
    sets = ["effects.moving_occlusion.frames=500"]
    settings = settings_by_name(mini, *sets)
    assert settings["without moving_occlusion"].kind == study_settings.MEASURES
    assert settings["moving_occlusion frames 0"].kind == study_settings.APPROXIMATES
    assert "moving_occlusion frames 50" in settings
    assert "moving_occlusion frames 500" not in settings
    with make_runner(mini, tmp_path / "out", *sets).open_run(
        settings["without moving_occlusion"], RANKING_STAGES
    ) as work:
        bare = egvs.read_scores(work.folder.scores).to_pandas()
    assert (bare["egvs"] / bare["egvs_limit"]).tolist() == pytest.approx(shares(mini, [], tmp_path / "plain"))


def test_tries_unnamed_effects_that_act_in_the_scene(mini: Path) -> None:
    """Divergence needs no parameter; rain does; articulated vehicles do not occur."""
    with_ = {
        s.name: s
        for s in study_settings.list_variants(egvs.load(mini))
        if s.name.startswith(study_settings.WITH_PREFIX)
    }
    assert {"with divergence", "with moving_occlusion"} <= with_.keys()
    assert not {"with rain", "with articulated", "with slope", "with range_limit"} & with_.keys()
    rated = study_settings.list_variants(
        egvs.load(mini, ["sites.sensor=VLP-16"])
    )  # it has a rated range, the scenario's sensor has none
    assert "without range_limit" in {s.name for s in rated}, "it acts by itself"
    off = study_settings.list_variants(egvs.load(mini, ["sites.sensor=VLP-16", "effects.range_limit=false"]))
    assert "with range_limit" in {s.name for s in off}
    assert all(
        egvs.load(mini, s.overrides).effects.named.keys() == {s.name.removeprefix(study_settings.WITH_PREFIX)}
        for s in with_.values()
    )
    named = {s.name for s in study_settings.list_variants(egvs.load(mini, ["effects.divergence={}"]))}
    assert {"without divergence", "divergence sub_beams 19"} <= named
    assert "with divergence" not in named


def test_measured_scans_are_not_thinned(mini: Path) -> None:
    (mini / "points.csv").write_text("x_m,y_m,z_m\n12,5,0.5\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,points.csv\npole_b,30.5,-12,3,\n")
    assert not {"azimuth", "channels"} & {s.knob for s in study_settings.list_variants(egvs.load(mini))}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nishishinjuku", "ingolstadt", "roundabout"])
def test_settings_are_valid_scenarios(name: str) -> None:
    folder = ROOT / "scenarios" / name
    settings = study_settings.list_variants(egvs.load(folder))
    assert len({s.name for s in settings}) == len(settings)
    for setting in settings:
        assert egvs.load(folder, setting.overrides)
