"""The clip of recorded traffic: which frames, who is hit, and what the recording draws."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import write_mini

pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

from egvs.core.progress import no_progress
from egvs.explore import recorded_traffic
from egvs.explore.drawing import linear_colours, vehicle_mesh
from egvs.explore.recorded_traffic import TrafficClip, body_mesh, frames_per_step
from egvs.explore.session import Playback, Session
from egvs.explore.settings import open_session
from egvs.scoring.targets import SEEN_WELL_POINTS


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The small scenario: 40 frames, every 0.5 s, two cars."""
    folder = tmp_path_factory.mktemp("clip")
    return open_session(write_mini(folder / "mini"), (), folder / "run")


def test_clip_has_all_frames_of_short_traffic(session: Session) -> None:
    playback, site = Playback(session), session.ranked[0].site
    clip = TrafficClip.of(playback, [site], no_progress)
    assert [frame.number for frame in clip.frames] == list(range(40))
    assert (clip.step_s, clip.duration_s, clip.has_returns) == (0.5, 20.0, True)
    for index in (0, 13):
        played = playback.simulate(site, playback.frame(index))
        counts = [int((played.owner == box).sum()) for box in range(len(played.frame.boxes))]
        assert clip.is_visible[index].tolist() == [count >= SEEN_WELL_POINTS for count in counts]
        assert len(clip.returns_m[index]) == sum(counts)


def test_clip_ends_after_a_minute(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_traffic, "CLIP_S", 3.0)
    clip = TrafficClip.of(Playback(session), [session.ranked[0].site], no_progress)
    assert (len(clip.frames), clip.duration_s) == (6, 3.0)


def test_several_sensors_hit_what_one_of_them_hits(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_traffic, "CLIP_S", 2.0)
    playback = Playback(session)
    sites = [candidate.site for candidate in session.ranked]
    both = TrafficClip.of(playback, sites, no_progress)
    alone = [TrafficClip.of(playback, [site], no_progress) for site in sites]
    for index in range(4):
        assert both.is_visible[index].tolist() == (alone[0].is_visible[index] | alone[1].is_visible[index]).tolist()
        assert len(both.returns_m[index]) == sum(len(clip.returns_m[index]) for clip in alone)


def test_share_counts_vehicles_in_the_region(session: Session) -> None:
    clip = TrafficClip.of(Playback(session), [session.ranked[0].site], no_progress)
    visible = total = 0
    for frame, is_visible in zip(clip.frames, clip.is_visible, strict=True):
        for row in frame.target_rows(session.scene.roi).tolist():
            total += 1
            visible += bool(is_visible[row])
    assert total > 0
    assert clip.share_visible(session.scene.roi) == visible / total


def test_only_every_kth_return_is_drawn(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = TrafficClip.of(Playback(session), [session.ranked[0].site], no_progress)
    count = sum(map(len, clip.returns_m))
    assert clip.returns_step == 1
    monkeypatch.setattr(recorded_traffic, "MAX_RETURNS", count - 1)
    assert clip.returns_step == 2


def test_body_scaled_to_its_box_is_the_vehicle_of_the_explorer(session: Session) -> None:
    playback = Playback(session)
    frame = playback.frame(0)
    kind = playback.kinds(frame)[0]
    mesh = body_mesh(playback.parts[kind])
    box = frame.boxes[0]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    scaled = mesh.points[mesh.faces].reshape(-1, 3) * box[3:6]
    x, y, z = scaled.T
    expected = np.column_stack([cos * x - sin * y, sin * x + cos * y, z]) + box[:3]
    selected = np.arange(len(frame.boxes)) == 0
    drawn = vehicle_mesh(frame, playback.kinds(frame), playback.parts, selected, (0.0, 0.0, 0.0))
    assert np.allclose(drawn.points[drawn.faces].reshape(-1, 3), expected, atol=1e-4)


@pytest.mark.parametrize(("period_s", "frames"), [(0.1, 2), (0.25, 1), (2.0, 1)])
def test_fast_frames_are_skipped(period_s: float, frames: int) -> None:
    assert frames_per_step(period_s) == frames


def test_linear_colours_are_those_of_the_srgb_table() -> None:
    """Known pairs: half of the light is 188 of 255; below 0.04045 the curve is straight, 1/12.92."""
    assert linear_colours(np.array([[0, 10, 188], [90, 181, 255]])).tolist() == [[0, 1, 128], [26, 118, 255]]
