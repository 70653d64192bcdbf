"""Is all of the traffic lengthened alike, periods with a length of their own included?

Evidence: lengths by hand, and what the program makes of the overrides."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.scenario.model import Scenario
from egvs.studies import study_settings

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
    """The small scenario with two periods on a network: 400 frames, and 800 of its own."""
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
def test_each_period_is_watched_so_many_times_as_long(
    split: Path, times: float, period_s: float, overrides: tuple[str, ...], frames: list[int]
) -> None:
    assert study_settings.scale_traffic(egvs.load(split), times, period_s) == (sum(frames), overrides)
    period = [f"traffic.frame_period_s={period_s}"]
    assert frames_of(egvs.load(split, [*overrides, *period])) == frames


def test_the_reference_lasts_as_many_times_as_long_in_every_period(split: Path) -> None:
    reference = study_settings.reference_setting(egvs.load(split), 8)
    assert frames_of(egvs.load(split, reference.overrides)) == [3200, 6400]
    names = {setting.name for setting in study_settings._traffic_settings(egvs.load(split))}
    assert {"240 frames", "2400 frames", "4800 frames, step 0.5 s"} <= names | {"240 frames"}
    assert "1200 frames" not in names


def test_periods_of_finished_files_are_neither_lengthened_nor_cut(mini: Path) -> None:
    file = mini / "scenario.toml"
    day, night = ('name = "a"\nlength_s = 12\n', 'name = "b"\nbegin_s = 12\nlength_s = 8\n')
    rows = f"[[traffic.periods]]\n{day}\n[[traffic.periods]]\n{night}"
    file.write_text(file.read_text().replace("[[traffic.kinds]]", f"{rows}\n[[traffic.kinds]]", 1))
    scenario = egvs.load(mini)
    assert study_settings.is_finished(scenario)
    assert study_settings.counted_frames(scenario) == 24 + 16
    assert study_settings.scale_traffic(scenario, 2, 0.5) == (0, ())
    assert study_settings.scale_traffic(scenario, 1, 0.5) == (40, ())
    assert list(study_settings._traffic_settings(scenario)) == []
