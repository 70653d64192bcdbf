"""A session gives the numbers of `egvs score` for any pose, and keeps poses without spoiling a user's file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import readers
from egvs.artefacts.readers import read_scores, read_scores_by_period
from egvs.core.errors import InputError
from egvs.explore.session import Session
from egvs.explore.settings import open_session
from egvs.sensors.sites import Pose
from tests.conftest import feature, write_mini

EVERY = "score.others=['expected_detections','points_on_target','seen_well','coverage','expected_visibility']"
MOVED = Pose(9.125, 12.5, 3.75, 20.25, -4.5, 1.0)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session over the small scenario."""
    folder = tmp_path_factory.mktemp("explore")
    return open_session(write_mini(folder / "mini"), [EVERY], folder / "run")


def scored(folder: Path, *settings: str) -> dict[str, dict]:
    """What `egvs run` makes of a scenario, by site."""
    out = folder / "scored"
    egvs.run(egvs.load(folder, list(settings)), out)
    return {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}


def write_site(folder: Path, name: str, pose: Pose) -> None:
    """Move one site in the sites file."""
    rows = {"pole_a": Pose(10, 12, 3), "pole_b": Pose(30.5, -12, 3), name: pose}
    lines = [",".join(map(str, (site, *its.position_m, *its.angles_deg))) for site, its in rows.items()]
    (folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg", *lines]) + "\n")


def test_candidates_are_those_of_the_artefact_and_score_so_again(opened: Session) -> None:
    assert [its.site.name for its in opened.ranked] == ["pole_b", "pole_a"]
    for name, candidate in opened.candidates.items():
        again = opened.rate(name, candidate.site.pose)
        assert again.scores == candidate.scores
        assert (again.rank, again.findings) == (candidate.rank, ())


EFFECTS = (None, "effects.divergence={}", "effects.moving_occlusion={}", "effects.rain.rate_mm_h=20")


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_moved_sensor_has_the_score_of_a_run_with_its_site_there(tmp_path: Path, effect: str | None) -> None:
    settings = [EVERY, *([effect] if effect else [])]
    folder = write_mini(tmp_path / "mini")
    moved = open_session(folder, settings, tmp_path / "run").rate("pole_a", MOVED)
    write_site(folder, "pole_a", MOVED)
    row = scored(folder, *settings)["pole_a"]
    assert moved.scores == {name: row[name] for name in moved.scores}
    assert set(moved.scores) >= {"egvs", "entropy_seen", "expected_detections", "points_on_target", "coverage"}
    assert moved.rank == row["rank"]


@pytest.mark.slow
def test_an_effect_that_is_idle_until_a_sensor_moves_acts_then(tmp_path: Path) -> None:
    folder = write_mini(tmp_path / "mini")
    world = json.loads((folder / "statics.geojson").read_text())
    ring = [[[10, 14], [13, 14], [13, 17], [10, 17], [10, 14]]]  # no candidate looks through it at the region
    crown = feature({"type": "Polygon", "coordinates": ring}, name="leaves", kind="tree_crown", height_m=6)
    world["features"].append(crown)
    (folder / "statics.geojson").write_text(json.dumps(world))
    behind = Pose(11.5, 18.0, 3.0)
    session = open_session(folder, ["effects.foliage={}"], tmp_path / "run")
    assert session.scene.effects == ()
    moved = session.rate("pole_a", behind)
    assert moved.scores["egvs"] > open_session(folder, (), tmp_path / "opaque").rate("pole_a", behind).scores["egvs"]
    write_site(folder, "pole_a", behind)
    row = scored(folder, "effects.foliage={}")["pole_a"]
    assert (moved.scores["egvs"], moved.scores["entropy_seen"], moved.rank) == (
        row["egvs"], row["entropy_seen"], row["rank"]
    )  # fmt: skip


def test_a_sensor_of_which_an_effect_must_know_more_has_no_score(tmp_path: Path) -> None:
    other = "sensors.other={elevations_deg=[-15,5],channels=8,azimuth_step_deg=1.0,range_m=100}"
    settings = ["sensors.small.rated_range_m=40", other, "effects.range_limit={}"]
    session = open_session(write_mini(tmp_path / "mini"), settings, tmp_path / "run")
    there = session.candidates["pole_a"]
    assert session.rate("pole_a", there.site.pose).scores == there.scores
    unknown = session.rate("pole_a", there.site.pose, "other")
    assert not unknown.is_feasible
    assert "rated_range_m" in str(unknown.findings[-1])


def test_a_sensor_that_no_catalogue_has_is_refused(opened: Session) -> None:
    with pytest.raises(InputError, match="unknown sensor 'nothing'"):
        opened.rate("pole_a", MOVED, "nothing")


PERIODS = """
[[traffic.periods]]
name = "day"
weight = 2.5
length_s = 12

[[traffic.periods]]
name = "night"
begin_s = 12
length_s = 8

[[traffic.kinds]]"""


def in_periods(folder: Path) -> Path:
    """The small scenario, its first 24 frames by day and its last 16 by night."""
    file = folder / "scenario.toml"
    file.write_text(file.read_text().replace("[[traffic.kinds]]", PERIODS, 1))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("effect", [None, "effects.range_limit={rated_range_m=40,rated_reflectivity=0.1}"])
def test_a_moved_sensor_has_the_scores_of_each_period(mini: Path, tmp_path: Path, effect: str | None) -> None:
    settings = [EVERY, *([effect] if effect else [])]
    session = open_session(in_periods(mini), settings, tmp_path / "run")
    assert session.periods == ("day", "night")
    its = {period: session.in_period(period) for period in ("day", "night")}
    moved = {period: one.rate("pole_a", MOVED) for period, one in its.items()}
    for one in its.values():
        for name, candidate in one.candidates.items():
            assert one.rate(name, candidate.site.pose).scores == candidate.scores
    assert its["night"].in_period("").candidates == session.candidates
    write_site(mini, "pole_a", MOVED)
    scored(mini, *settings)
    rows = read_scores_by_period(mini / "scored" / "scores_by_period.parquet").to_pylist()
    for row in (row for row in rows if row["site"] == "pole_a"):
        found = moved[row["period"]]
        assert dict(found.scores) == {name: row[name] for name in found.scores}
        assert found.rank == row["rank"]
    assert moved["day"].scores != moved["night"].scores


def test_blind_spots_are_those_of_the_artefact(opened: Session, tmp_path: Path) -> None:
    for expected in readers.read_blindspots(opened.work.path("blindspots.parquet")):
        found = opened.blindspots(opened.candidates[expected.site].site)
        assert np.array_equal(found.share_missed, expected.share_missed, equal_nan=True)
        assert [replace(place, se=0.0) for place in found.locations] == [
            replace(its, se=0.0) for its in expected.locations
        ]
        assert np.array_equal(
            [its.se for its in found.locations], [its.se for its in expected.locations], equal_nan=True
        )
        assert (found.points, found.origin_m, found.cell_m) == (expected.points, expected.origin_m, expected.cell_m)
        assert found.in_words() == expected.in_words()


def test_beams_of_a_ring_lie_on_its_cone(opened: Session) -> None:
    site = opened.candidates["pole_a"].site
    for ring, elevation in ((0, -15.0), (2, -15.0 + 2 * 20.0 / 7), (99, 5.0)):
        lines = opened.beams_m(site, ring)
        along = np.diff(lines, axis=1)[:, 0]
        assert len(lines) > 0
        assert (lines[:, 0] == site.pose.position_m).all()
        assert np.allclose(np.degrees(np.arcsin(along[:, 2] / np.linalg.norm(along, axis=1))), elevation)


def test_the_rank_is_among_the_others(opened: Session) -> None:
    best, last = opened.ranked
    as_best = opened.rate(last.site.name, replace(best.site.pose, x_m=30.4))  # nearly where the best one hangs
    assert as_best.scores["egvs"] != best.scores["egvs"]
    assert as_best.rank == (1 if as_best.scores["egvs"] > best.scores["egvs"] else 2)
    assert opened.rate(last.site.name, best.site.pose).rank == 1  # equal scores share a rank
    assert opened.rate(best.site.name, last.site.pose).rank == 1  # its own candidate is no rival


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x_m": 16.0, "y_m": 6.0}, "(16, 6, 3) is inside house (building). Move it outside."),
        ({"z_m": -1.0}, "z_m = -1 is not above the ground (z = 0). Use a height above 0 m."),
        ({"x_m": 500.0}, "the site is 460.0 m from the region of interest. Move it within the range of small, 100 m."),
    ],
)
def test_where_none_can_stand_the_reason_is_told(opened: Session, change: dict[str, float], message: str) -> None:
    refused = opened.rate("pole_a", replace(Pose(10, 12, 3), **change))
    assert not refused.is_feasible
    assert (refused.rank, dict(refused.scores)) == (0, {})
    assert [str(finding) for finding in refused.findings] == [f"site pole_a: {message}"]


def test_a_sensor_that_looks_away_is_warned_of(opened: Session) -> None:
    away = opened.rate("pole_a", Pose(10, 60, 40))
    assert [finding.rule for finding in away.findings] == ["beams beside the region"]
    assert (away.scores["egvs"], away.rank) == (0.0, 2)


def test_a_measured_scan_cannot_be_moved(tmp_path: Path) -> None:
    folder = write_mini(tmp_path / "mini")
    (folder / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,scan.csv\npole_b,30.5,-12,3,\n")
    (folder / "scan.csv").write_text("x_m,y_m,z_m\n12,2,0.5\n20,-2,1.0\n30,0,0.0\n")
    session = open_session(folder, (), tmp_path / "run")
    there = session.candidates["pole_a"]
    assert session.rate("pole_a", there.site.pose).scores == there.scores
    moved = session.rate("pole_a", replace(there.site.pose, z_m=4.0))
    assert not moved.is_feasible
    assert "its empty scan was measured" in str(moved.findings[0])


def test_a_run_is_opened_as_it_was_run(mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = open_session(mini, ["score.gamma=2"], out)
    again = open_session(out)
    assert again.scenario.gamma == 2
    assert again.candidates == first.candidates
    with pytest.raises(InputError, match="--set: with the folder of a run"):
        open_session(out, ["score.gamma=3"])
    with pytest.raises(InputError, match="--out: with the folder of a run"):
        open_session(out, out=tmp_path / "other")
    mini.rename(tmp_path / "gone")
    with pytest.raises(InputError, match=r"the scenario's folder .* is not there; name the scenario"):
        open_session(out)


def test_an_altered_artefact_is_made_again(mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    before = open_session(mini, (), out).candidates
    (out / "scores.parquet").write_bytes(b"no table")
    assert open_session(mini, (), out).candidates == before
