"""A played-back frame shows the vehicles that were recorded, and returns that lie on them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from egvs.artefacts.traffic_frames import read_trajectories
from egvs.explore import session as session_module
from egvs.explore.session import Playback, Session
from egvs.explore.settings import open_session
from egvs.scoring.targets import SEEN_WELL_POINTS
from tests.conftest import write_mini


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Over the small scenario."""
    folder = tmp_path_factory.mktemp("playback")
    return open_session(write_mini(folder / "mini"), ["sites.sensor='VLP-32C'"], folder / "run")


def test_vehicles_are_those_of_the_record(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "FRAMES_PER_CHUNK", 7)
    played = Playback(session)
    rows = read_trajectories(session.work.path("trajectories.parquet")).to_pylist()
    assert played.frames == 40
    for number in (0, 6, 7, 39, 13, 12):
        frame = played.frame(number)
        recorded = [row for row in rows if row["frame"] == number]
        assert frame.vehicles == tuple(row["vehicle"] for row in recorded)
        assert frame.boxes[:, 0].tolist() == [row["x_m"] for row in recorded]
    assert played.frame(99).number == 39
    assert played.frame(-1).number == 0


def test_returns_of_a_vehicle_lie_on_it(session: Session) -> None:
    played, site = Playback(session), session.candidates["pole_a"].site
    noise_m = 6.0 * session.scene.sensor(site.sensor).range_sigma_m + 0.01
    of_vehicles = 0
    for number in (5, 10, 20):
        moment = played.moment(site, number)
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


def test_without_vehicles_the_returns_are_the_empty_scan(session: Session) -> None:
    played, site = Playback(session), session.candidates["pole_a"].site
    frame = replace(played.frame(0), boxes=np.empty((0, 7)), vehicles=(), kinds=(), pitch_rad=np.empty(0),
                    part=np.empty(0, dtype=np.int64))  # fmt: skip
    played._stretch = (0, [frame])
    found = played.moment(site, 0)
    ground = found.returns_m[np.abs(found.returns_m[:, 2]) < 0.1]
    empty = session.returns_m(site)
    assert (found.owner == -1).all()
    assert len(found.returns_m) >= len(empty)  # those that cannot meet the region too
    assert len(ground) > 1000


def test_the_same_frame_gives_the_same_returns(session: Session) -> None:
    played, site = Playback(session), session.candidates["pole_a"].site
    first = played.moment(site, 8)
    other = played.moment(replace(site, pose=replace(site.pose, z_m=4.0)), 8)
    again = played.moment(site, 8)
    assert np.array_equal(first.returns_m, again.returns_m)
    assert not np.array_equal(first.returns_m, other.returns_m)


def test_where_no_sensor_can_stand_there_are_vehicles_alone(session: Session) -> None:
    played, site = Playback(session), session.candidates["pole_a"].site
    inside = replace(site, pose=replace(site.pose, x_m=16.0, y_m=6.0))
    moment = played.moment(inside, 5)
    assert len(moment.frame.boxes) == 2
    assert not moment.is_visible.any()
    assert len(moment.returns_m) == 0
