"""Losses of returns act alike in a run, a plan, what-if questions and the explorer; without a rated range, in none.

The city, comparisons and designs of sensors, and simulated clouds have such a test beside their other tests.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import egvs
from egvs.artefacts.readers import read_scores
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.results.ranking import Ranking
from egvs.runs import run
from egvs.studies import what_if
from egvs.studies.what_if import WhatIfRun, compare_runs, prepare_runs
from tests.conftest import write_mini

RATED = ("sensors.small.rated_range_m=30", "sensors.small.rated_reflectivity=0.1")
"""Half of the returns from cars are lost at 16 m."""

NAMED, OFF = "effects.range_limit={}", "effects.range_limit=false"


def shares(folder: Path, out: Path, *settings: str) -> list[float]:
    """Run the small scenario; return the share of vehicles found from each site."""
    egvs.run(egvs.load(folder, settings), out)
    table = read_scores(RunFolder(out).scores).to_pydict()
    return [float(share) for share in table["expected_detections"]]


@pytest.fixture
def by_itself(mini: Path, tmp_path: Path) -> list[float]:
    """Shares with the losses that act by themselves."""
    return shares(mini, tmp_path / "by_itself", *RATED)


@pytest.mark.slow
def test_run(mini: Path, tmp_path: Path, by_itself: list[float]) -> None:
    assert shares(mini, tmp_path / "named", *RATED, NAMED) == by_itself
    off = shares(mini, tmp_path / "off", *RATED, OFF)
    assert off == shares(mini, tmp_path / "unrated")
    assert all(a < b for a, b in zip(by_itself, off, strict=True))

    stages = RunRecord.read(tmp_path / "by_itself").stages
    assert stages["score"].summary["losses"] == {"on": ["small"], "negligible": [], "unrated": []}
    (note,) = stages["check"].summary["losses"]
    assert note.startswith("losses of returns are simulated for small (7 m)")
    assert "losses" not in RunRecord.read(tmp_path / "off").stages["check"].summary
    (note,) = RunRecord.read(tmp_path / "unrated").stages["check"].summary["losses"]
    assert note.endswith("Enter rated_range_m and rated_reflectivity under [sensors.small]")


@pytest.mark.slow
def test_sensor_whose_losses_cannot_matter_has_the_bytes_of_before(mini: Path, tmp_path: Path) -> None:
    far = ("sensors.small.rated_range_m=4000", "sensors.small.rated_reflectivity=0.1")
    shares(mini, tmp_path / "far", *far)
    shares(mini, tmp_path / "off", *far, OFF)
    artefacts = [path.name for path in (tmp_path / "far").iterdir() if path.suffix in {".parquet", ".ply"}]
    assert {"scans.parquet", "scores.parquet", "levels.parquet", "blindspots.parquet"} < set(artefacts)
    for name in artefacts:
        assert (tmp_path / "far" / name).read_bytes() == (tmp_path / "off" / name).read_bytes(), name
    assert "losses" not in RunRecord.read(tmp_path / "far").stages["check"].summary


@pytest.mark.slow
def test_all_sensors_have_losses_if_one_needs_them(mini: Path, tmp_path: Path) -> None:
    """Without them, it would gain on the other by its dropout."""
    text = (mini / "scenario.toml").read_text()
    table = text[text.index("[sensors.small]") :].partition("\n[")[0]
    (mini / "scenario.toml").write_text(f"{text}\n{table.replace('sensors.small', 'sensors.far')}\n")
    header, first, second = (mini / "sites.csv").read_text().split()
    (mini / "sites.csv").write_text(f"{header},sensor\n{first},small\n{second},far\n")
    far = ("sensors.far.rated_range_m=4000", "sensors.far.rated_reflectivity=0.1")
    off = shares(mini, tmp_path / "off", *far, *RATED, OFF)
    both = shares(mini, tmp_path / "both", *far, *RATED)
    assert shares(mini, tmp_path / "alone", *far) == off, "neither needs losses"
    assert all(0.0 < a < b for a, b in zip(both, off, strict=True))
    losses = RunRecord.read(tmp_path / "both").stages["score"].summary["losses"]
    assert losses == {"on": ["small", "far"], "negligible": [], "unrated": []}


@pytest.mark.slow
def test_plan(mini: Path, tmp_path: Path, by_itself: list[float]) -> None:
    placed = egvs.place(
        egvs.load(mini, [*RATED, "placement.count=1", "score.rank_by=expected_detections"]),
        tmp_path / "plan",
        exact=True,
    )
    off = egvs.place(
        egvs.load(mini, [*RATED, OFF, "placement.count=1", "score.rank_by=expected_detections"]),
        tmp_path / "off",
        exact=True,
    )
    assert placed.joint == pytest.approx(max(by_itself), abs=1e-6)
    assert off.joint > placed.joint


@pytest.mark.slow
def test_what_if(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mini.parent)
    lines = "\n".join(["", "[what_if.far]", "share = 0.5", 'vehicles = "parked.csv"', ""])
    (mini / "scenario.toml").write_text((mini / "scenario.toml").read_text() + lines)
    (mini / "parked.csv").write_text("x_m,y_m,yaw_deg,type\n120,60,0,car\n")

    def run_one(_number: int, one: WhatIfRun) -> None:
        run.run(one.scenario, one.folder)

    best = []
    for number, settings in enumerate((RATED, (*RATED, NAMED), (*RATED, OFF))):
        runs = prepare_runs(Path(mini.name), settings)
        runs = [what_if.replace(one, folder=tmp_path / f"{number}" / one.folder.name) for one in runs]
        compare_runs(runs, run_one)
        best.append([Ranking.read(RunFolder(one.folder).scores).best[0].score for one in runs])
    assert best[0] == best[1]
    assert all(with_losses < without for with_losses, without in zip(best[0], best[2], strict=True))


@pytest.mark.slow
def test_explorer(mini: Path, tmp_path: Path, by_itself: list[float]) -> None:
    pytest.importorskip("viser", reason="the extra egvs[explore] is not installed")
    from egvs.explore.settings import Settings, offered_effects, open_session

    session = open_session(mini, RATED, tmp_path / "session")
    for share, (name, candidate) in zip(by_itself, session.candidates.items(), strict=True):
        assert candidate.scores["expected_detections"] == share
        assert session.rate(name, candidate.site.pose).scores == candidate.scores
    assert "range_limit" not in offered_effects(session), "it acts by itself"
    named = egvs.load(mini, (*RATED, NAMED))
    without = replace(Settings.from_scenario(named), effects=frozenset())
    assert without.overrides(named) == (OFF,)
    assert without.apply(named).effects.range_limit is False
    other = replace(Settings.from_scenario(egvs.load(mini, (OFF,))), gamma=3.0)
    assert other.apply(egvs.load(mini, (OFF,))).effects.range_limit is False


@pytest.mark.slow
def test_explorer_gives_losses_to_a_sensor_that_moves_away(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="the extra egvs[explore] is not installed")
    from egvs.explore.settings import open_session
    from egvs.sensors.sites import Pose

    rated = ("sensors.small.rated_range_m=175", "sensors.small.rated_reflectivity=0.1")
    folder = write_mini(tmp_path / "mini")
    session = open_session(folder, rated, tmp_path / "run")
    plain = open_session(folder, (*rated, OFF), tmp_path / "off")
    assert session.scene.losses is not None and not session.scene.losses.acting
    away = Pose(-20.0, 12.0, 3.0)
    here = session.candidates["pole_a"].site.pose
    assert session.rate("pole_a", here).scores == plain.rate("pole_a", here).scores
    assert session.rate("pole_a", away).scores["egvs"] < plain.rate("pole_a", away).scores["egvs"]
    assert session.rate("pole_a", here).scores == plain.rate("pole_a", here).scores
