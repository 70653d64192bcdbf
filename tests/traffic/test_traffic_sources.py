"""Sources of recorded traffic: found by entry points, and one message where none is installed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from egvs.core import plugins
from egvs.core.errors import MissingBackendError
from egvs.runs import stage_keys
from egvs.scenario.loading import load
from egvs.stages import check
from egvs.traffic import traffic_sources
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.shared_names import SharedNames
from egvs.traffic.traffic_sources import RecordedTraffic
from tests.installed import needs

TRACKS = 'tracks = ["tracks.csv"]'
MESSAGE = "needs the extension tracks"


class SmallSource:
    """A source of seven frames without vehicles that names one module."""

    KEYS = ("tracks",)
    shared_names = SharedNames()

    def files(self, scenario):  # type: ignore[no-untyped-def]
        return [scenario.find(name, "traffic.tracks") for name in scenario.traffic.tracks]

    def modules(self, scenario):  # type: ignore[no-untyped-def]
        return ("egvs.core.wording",)

    def frame_count(self, scenario):  # type: ignore[no-untyped-def]
        return 7

    def record(self, scenario, world):  # type: ignore[no-untyped-def]
        window = FrameWindow(7, 500, complete=True)
        return RecordedTraffic((), window, {}, frozenset(), {}, (), (), shared_names=self.shared_names)

    def for_new(self, options):  # type: ignore[no-untyped-def]
        raise NotImplementedError


@pytest.fixture
def no_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program without the extension."""
    names = plugins.plugin_names
    monkeypatch.setattr(plugins, "plugin_names", lambda group: [] if group == traffic_sources.GROUP else names(group))


def use_tracks(mini: Path) -> Path:
    """Replace the finished file of the small scenario by tracks."""
    (mini / "tracks.csv").write_text("track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width\n")
    text = (mini / "scenario.toml").read_text()
    (mini / "scenario.toml").write_text(text.replace('fcd = "fcd.csv"', TRACKS))
    return mini


@pytest.mark.usefixtures("no_source")
@pytest.mark.parametrize("command", ["check", "traffic", "run"])
def test_scenario_with_tracks_needs_the_extension(mini: Path, run_egvs, tmp_path: Path, command: str) -> None:
    """The message comes once, and nothing else is wrong."""
    out = [] if command == "check" else ["--out", tmp_path / "run"]
    code, printed, err = run_egvs(command, use_tracks(mini), *out)
    assert code == 2
    assert (printed + err).count(MESSAGE) == 1
    assert f"{mini / 'scenario.toml'}: traffic.tracks: {MESSAGE}" in re.sub(r"\s+", " ", printed + err)


@pytest.mark.usefixtures("no_source")
@pytest.mark.parametrize("option", ["--tracks", "--like", "--pedestrian-tracks", "--signals"])
def test_new_refuses_recordings_without_the_extension(tmp_path: Path, run_egvs, option: str) -> None:
    code, _, err = run_egvs("new", tmp_path / "new", "--from", tmp_path / "map.osm", option, tmp_path / "any.csv")
    assert code == 2
    assert f"{option}: {MESSAGE}" in err
    assert not (tmp_path / "new").exists()


@needs("tracks")
def test_help_hides_recordings_without_the_extension(run_egvs, request: pytest.FixtureRequest) -> None:
    options = ("--tracks", "--like", "--pedestrian-tracks", "--signals", "--track-columns", "--track-crs")
    shown = run_egvs("new", "--help")[1]
    assert all(option in shown for option in options)
    request.getfixturevalue("no_source")
    shown = run_egvs("new", "--help")[1]
    assert not any(option in shown for option in options)
    assert "--counts" in shown


def test_stages_name_the_modules_of_a_source(mini: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A changed extension makes the check and the traffic again."""
    from egvs.runs.run_context import open_folder

    monkeypatch.setattr(plugins, "load_plugin", lambda group, name: SmallSource())
    monkeypatch.setattr(plugins, "plugin_names", lambda group: ["small"] if group == traffic_sources.GROUP else [])
    scenario = load(use_tracks(mini))
    assert traffic_sources.source_of(scenario).frame_count(scenario) == 7
    context = open_folder(scenario, tmp_path / "run")
    for name in ("check", "traffic"):
        dependencies = stage_keys.stage_key(name, context).dependencies
        assert "egvs.core.wording" in dependencies.modules
        assert any("tracks.csv" in file for file in dependencies.files)
    assert check.check_scenario(scenario).errors == ()


def test_names_that_vehicles_share_are_an_error_of_any_source(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Above one in a hundred rows; the source counts them, since its rows have no such vehicles any more."""
    source = SmallSource()
    source.shared_names = SharedNames(rows=100, repeated=2, example="'a' at 3 s")
    monkeypatch.setattr(plugins, "load_plugin", lambda group, name: source)
    monkeypatch.setattr(plugins, "plugin_names", lambda group: ["small"] if group == traffic_sources.GROUP else [])
    (error,) = check.check_scenario(load(use_tracks(mini))).errors
    assert "got 2 others in 100 rows, in other places ('a' at 3 s)" in error.problem


def test_rejects_source_without_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    if not traffic_sources.is_installed():
        pytest.skip("no source is installed, whose entry point the message names")
    (name, *_) = plugins.plugin_names(traffic_sources.GROUP)
    monkeypatch.setattr(plugins, "load_plugin", lambda group, name: object())
    with pytest.raises(MissingBackendError, match="it has no KEYS, files, modules, frame_count, record, for_new"):
        traffic_sources.load_source(name)
