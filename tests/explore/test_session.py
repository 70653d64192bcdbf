"""Poses have the scores of `egvs score`, moved plans the joint score by definition; returns are on vehicles."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import readers
from egvs.artefacts.readers import read_scores, read_scores_by_period
from egvs.artefacts.traffic_frames import read_trajectories
from egvs.core.errors import InputError
from egvs.explore.session import Playback, Session
from egvs.explore.settings import open_session
from egvs.scoring.targets import SEEN_WELL_POINTS
from egvs.sensors.sites import Pose, Site
from tests.conftest import feature, write_mini

EVERY = "score.others=['expected_detections','points_on_target','seen_well','coverage','expected_visibility']"
MOVED = Pose(9.125, 12.5, 3.75, 20.25, -4.5, 1.0)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session over the small scenario."""
    folder = tmp_path_factory.mktemp("explore")
    return open_session(write_mini(folder / "mini"), [EVERY], folder / "run")


def scored(folder: Path, *settings: str) -> dict[str, dict]:
    """Return the scores of `egvs run`, by site."""
    out = folder / "scored"
    egvs.run(egvs.load(folder, list(settings)), out)
    return {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}


def write_site(folder: Path, name: str, pose: Pose) -> None:
    """Move one site in the sites file."""
    rows = {"pole_a": Pose(10, 12, 3), "pole_b": Pose(30.5, -12, 3), name: pose}
    lines = [",".join(map(str, (site, *other.position_m, *other.angles_deg))) for site, other in rows.items()]
    (folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg", *lines]) + "\n")


def test_candidates_have_the_scores_of_the_run(opened: Session) -> None:
    assert [other.site.name for other in opened.ranked] == ["pole_b", "pole_a"]
    for name, candidate in opened.candidates.items():
        again = opened.rate(name, candidate.site.pose)
        assert again.scores == candidate.scores
        assert (again.rank, again.findings) == (candidate.rank, ())


EFFECTS = (None, "effects.divergence={}", "effects.moving_occlusion={}", "effects.rain.rate_mm_h=20")


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_moved_sensor_has_the_score_of_a_run_with_that_site(tmp_path: Path, effect: str | None) -> None:
    settings = [EVERY, *([effect] if effect else [])]
    folder = write_mini(tmp_path / "mini")
    moved = open_session(folder, settings, tmp_path / "run").rate("pole_a", MOVED)
    write_site(folder, "pole_a", MOVED)
    row = scored(folder, *settings)["pole_a"]
    assert moved.scores == {name: row[name] for name in moved.scores}
    assert set(moved.scores) >= {"egvs", "entropy_seen", "expected_detections", "points_on_target", "coverage"}
    assert moved.rank == row["rank"]


@pytest.mark.slow
def test_inactive_effect_acts_after_a_sensor_moves(tmp_path: Path) -> None:
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


def test_sensor_without_property_that_an_effect_needs_has_no_score(tmp_path: Path) -> None:
    other = "sensors.other={elevations_deg=[-15,5],channels=8,azimuth_step_deg=1.0,range_m=100}"
    settings = ["sensors.small.rated_range_m=40", other, "effects.range_limit={}"]
    session = open_session(write_mini(tmp_path / "mini"), settings, tmp_path / "run")
    there = session.candidates["pole_a"]
    assert session.rate("pole_a", there.site.pose).scores == there.scores
    unknown = session.rate("pole_a", there.site.pose, "other")
    assert not unknown.is_feasible
    assert "rated_range_m" in str(unknown.findings[-1])


def test_rejects_unknown_candidate_and_names_those_there_are(opened: Session) -> None:
    with pytest.raises(InputError, match="no such candidate") as caught:
        opened.rate("pole_c", MOVED)
    assert "pole_a, pole_b" in str(caught.value)


def test_rejects_unknown_sensor(opened: Session) -> None:
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
def test_moved_sensor_has_the_scores_of_each_period(mini: Path, tmp_path: Path, effect: str | None) -> None:
    settings = [EVERY, *([effect] if effect else [])]
    session = open_session(in_periods(mini), settings, tmp_path / "run")
    assert session.periods == ("day", "night")
    other = {period: session.in_period(period) for period in ("day", "night")}
    moved = {period: one.rate("pole_a", MOVED) for period, one in other.items()}
    for one in other.values():
        for name, candidate in one.candidates.items():
            assert one.rate(name, candidate.site.pose).scores == candidate.scores
    assert other["night"].in_period("").candidates == session.candidates
    write_site(mini, "pole_a", MOVED)
    scored(mini, *settings)
    rows = read_scores_by_period(mini / "scored" / "scores_by_period.parquet").to_pylist()
    for row in (row for row in rows if row["site"] == "pole_a"):
        result = moved[row["period"]]
        assert dict(result.scores) == {name: row[name] for name in result.scores}
        assert result.rank == row["rank"]
    assert moved["day"].scores != moved["night"].scores


def test_blind_spots_equal_those_of_the_run(opened: Session, tmp_path: Path) -> None:
    for expected in readers.read_blindspots(opened.work.path("blindspots.parquet")):
        result = opened.blindspots(opened.candidates[expected.site].site)
        assert np.array_equal(result.share_missed, expected.share_missed, equal_nan=True)
        assert [replace(place, se=0.0) for place in result.locations] == [
            replace(other, se=0.0) for other in expected.locations
        ]
        assert np.array_equal(
            [other.se for other in result.locations], [other.se for other in expected.locations], equal_nan=True
        )
        assert (result.origin_m, result.cell_m) == (expected.origin_m, expected.cell_m)
        assert result.in_words() == expected.in_words()


def test_beams_of_a_ring_have_its_elevation(opened: Session) -> None:
    site = opened.candidates["pole_a"].site
    for ring, elevation in ((0, -15.0), (2, -15.0 + 2 * 20.0 / 7), (99, 5.0)):
        lines = opened.beams_m(site, ring)
        along = np.diff(lines, axis=1)[:, 0]
        assert len(lines) > 0
        assert (lines[:, 0] == site.pose.position_m).all()
        assert np.allclose(np.degrees(np.arcsin(along[:, 2] / np.linalg.norm(along, axis=1))), elevation)


def test_rank_is_among_the_other_candidates(opened: Session) -> None:
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
def test_impossible_pose_has_a_reason(opened: Session, change: dict[str, float], message: str) -> None:
    refused = opened.rate("pole_a", replace(Pose(10, 12, 3), **change))
    assert not refused.is_feasible
    assert (refused.rank, dict(refused.scores)) == (0, {})
    assert [str(finding) for finding in refused.findings] == [f"site pole_a: {message}"]


def test_warns_of_sensor_without_beams_in_the_region(opened: Session) -> None:
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


def test_run_folder_is_opened_with_its_settings(mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = open_session(mini, ["score.gamma=2"], out)
    again = open_session(out)
    assert again.scenario.gamma == 2
    assert again.candidates == first.candidates
    with pytest.raises(InputError, match="--set: cannot be used with a run folder"):
        open_session(out, ["score.gamma=3"])
    with pytest.raises(InputError, match="--out: cannot be used with a run folder"):
        open_session(out, out=tmp_path / "other")
    mini.rename(tmp_path / "gone")
    with pytest.raises(InputError, match=r"the scenario's folder .* does not exist. Give the scenario"):
        open_session(out)


def test_altered_artefact_is_computed_again(mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    before = open_session(mini, (), out).candidates
    (out / "scores.parquet").write_bytes(b"no table")
    assert open_session(mini, (), out).candidates == before


SITES = "site,x_m,y_m,z_m\na,10,12,3\nb,30.5,-12,3\nc,2,-12,4\nd,38,12,4\n"


def joint_egvs(session: Session, *sites: Site) -> float:
    """Return E(S) by its definition."""
    hits = sum(session.hits(site) for site in sites)
    return math.fsum((session.entropy_bit * np.minimum(session.scenario.gamma, hits)).ravel())


@pytest.fixture
def planned(mini: Path, tmp_path: Path) -> tuple[Session, float]:
    """A session over a run with a plan of two, and the joint score of `egvs place`."""
    (mini / "sites.csv").write_text(SITES)
    placed = egvs.place(egvs.load(mini, ["placement.count=2"]), tmp_path / "run")
    return open_session(mini, (), tmp_path / "run"), placed.joint


def test_plan_has_the_joint_score_of_egvs_place(planned: tuple[Session, float]) -> None:
    session, joint = planned
    plan = session.plan
    assert plan is not None
    assert plan.joint == joint
    assert math.isclose(joint, joint_egvs(session, *plan.sites.values()), rel_tol=1e-9)


def test_moved_sensor_changes_the_joint_score(planned: tuple[Session, float]) -> None:
    session, joint = planned
    plan = session.plan
    assert plan is not None
    name = next(iter(plan.sites))
    site = plan.sites[name]
    there = replace(site, pose=replace(site.pose, z_m=4.5, yaw_deg=20.0))
    moved = plan.with_moved(there, session.beams(there))
    others = [other for other in plan.sites.values() if other.name != name]
    assert math.isclose(moved.joint, joint_egvs(session, there, *others), rel_tol=1e-9)
    assert moved.joint != joint
    assert moved.with_moved(site, session.beams(site)).joint == joint


def test_best_additional_candidate_has_the_largest_gain(planned: tuple[Session, float]) -> None:
    session, _ = planned
    plan = session.plan
    assert plan is not None
    gains = {
        name: joint_egvs(session, *plan.sites.values(), other.site) - plan.joint
        for name, other in session.candidates.items()
        if name not in plan.sites
    }
    assert plan.best_next is not None
    assert plan.best_next[0] == max(gains, key=gains.__getitem__)
    assert math.isclose(plan.best_next[1], max(gains.values()), rel_tol=1e-9)


@pytest.mark.slow
@pytest.mark.system
def test_refined_plan_has_its_refined_poses(mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text(SITES)
    scenario = egvs.load(mini, ["placement.count=2", "placement.refine.evaluations=20"])
    placed = egvs.place(scenario, tmp_path / "run", refine=True)
    plan = open_session(mini, (), tmp_path / "run").plan
    assert plan is not None
    assert [site.pose for site in plan.sites.values()] == [
        Pose(s.x_m, s.y_m, s.z_m, s.yaw_deg, s.pitch_deg, s.roll_deg) for s in placed.sensors
    ]
    assert plan.joint == placed.joint


@pytest.mark.slow
def test_plan_of_other_settings_is_ignored(mini: Path, tmp_path: Path) -> None:
    assert open_session(mini, (), tmp_path / "bare").plan is None
    egvs.place(egvs.load(mini, ["placement.count=1"]), tmp_path / "run")
    assert open_session(mini, ["roi.voxel_m=1.0"], tmp_path / "run").plan is None


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session over the small scenario."""
    folder = tmp_path_factory.mktemp("playback")
    return open_session(write_mini(folder / "mini"), ["sites.sensor='VLP-32C'"], folder / "run")


def test_vehicles_are_those_of_the_recording(simulated: Session) -> None:
    played = Playback(simulated, frames_per_chunk=7)
    rows = read_trajectories(simulated.work.path("trajectories.parquet")).to_pylist()
    assert played.frames == 40
    for number in (0, 6, 7, 39, 13, 12):
        frame = played.frame(number)
        recorded = [row for row in rows if row["frame"] == number]
        assert frame.vehicles == tuple(row["vehicle"] for row in recorded)
        assert frame.boxes[:, 0].tolist() == [row["x_m"] for row in recorded]
    assert played.frame(99).number == 39
    assert played.frame(-1).number == 0


def test_returns_of_vehicles_are_inside_their_boxes(simulated: Session) -> None:
    played, site = Playback(simulated), simulated.candidates["pole_a"].site
    noise_m = 6.0 * simulated.scene.sensor(site.sensor).range_sigma_m + 0.01
    of_vehicles = 0
    for number in (5, 10, 20):
        moment = played.simulate(site, played.frame(number))
        for index, box in enumerate(moment.frame.boxes):
            away = moment.returns_m[moment.owner == index] - box[:3]
            cos, sin = math.cos(box[6]), math.sin(box[6])
            along, across = away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin
            half = box[3:6] / 2.0 + noise_m
            assert (np.abs(np.column_stack([along, across, away[:, 2]])) <= half).all()
            of_vehicles += len(away)
            assert moment.is_visible[index] == (len(away) >= SEEN_WELL_POINTS)
        assert len(played.kinds(moment.frame)) == len(moment.frame.boxes)
    assert of_vehicles > 500


def test_returns_without_vehicles_are_the_empty_scan(simulated: Session) -> None:
    played, site = Playback(simulated), simulated.candidates["pole_a"].site
    frame = replace(played.frame(0), boxes=np.empty((0, 7)), vehicles=(), kinds=(), pitch_rad=np.empty(0),
                    part=np.empty(0, dtype=np.int64))  # fmt: skip
    result = played.simulate(site, frame)
    ground = result.returns_m[np.abs(result.returns_m[:, 2]) < 0.1]
    empty = simulated.returns_m(site)
    assert (result.owner == -1).all()
    # those that cannot meet the region, too; a grazed road far away loses returns
    assert 0.8 * len(empty) < len(result.returns_m) < simulated.scene.sensor(site.sensor).beams
    assert len(ground) > 1000


def test_same_frame_gives_same_returns(simulated: Session) -> None:
    played, site = Playback(simulated), simulated.candidates["pole_a"].site
    first = played.simulate(site, played.frame(8))
    other = played.simulate(replace(site, pose=replace(site.pose, z_m=4.0)), played.frame(8))
    again = played.simulate(site, played.frame(8))
    assert np.array_equal(first.returns_m, again.returns_m)
    assert not np.array_equal(first.returns_m, other.returns_m)


def test_impossible_pose_has_vehicles_without_returns(simulated: Session) -> None:
    played, site = Playback(simulated), simulated.candidates["pole_a"].site
    inside = replace(site, pose=replace(site.pose, x_m=16.0, y_m=6.0))
    moment = played.simulate(inside, played.frame(5))
    assert len(moment.frame.boxes) == 2
    assert not moment.is_visible.any()
    assert len(moment.returns_m) == 0
