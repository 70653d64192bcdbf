"""A link restores a view exactly; invalid links are rejected; saved poses never change a user's file."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.core.errors import InputError
from egvs.explore.session import Session
from egvs.explore.settings import Settings, open_session
from egvs.explore.view_state import (
    LAYERS,
    SAVED_SITES,
    Camera,
    View,
    decode_view,
    encode_view,
    save_pose,
    unused_file_name,
)
from egvs.sensors import sites
from egvs.sensors.sites import Pose, Site
from tests.conftest import write_mini
from tests.explore.test_session import in_periods
from tests.processes import Started


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session over the small scenario with two periods."""
    folder = tmp_path_factory.mktemp("view")
    return open_session(in_periods(write_mini(folder / "mini")), (), folder / "run")


finite = st.floats(-1e6, 1e6, allow_nan=False)
pitch = st.floats(-90, 90)


@pytest.mark.slow
@given(
    pose=st.builds(Pose, finite, finite, finite, finite, pitch, finite),
    gamma=st.none() | st.floats(1e-9, 1e9) | st.sampled_from((0.0, float("inf"))),
    layer=st.sampled_from(sorted(LAYERS)),
    ring=st.integers(0, 200),
    frame=st.integers(0, 10**6),
    is_dark=st.booleans(),
)
def test_link_restores_the_view(
    session: Session, pose: Pose, gamma: float | None, layer: str, ring: int, frame: int, is_dark: bool
) -> None:
    opened = View.from_session(session)
    site = replace(session.candidates["pole_a"].site, pose=pose, sensor="VLP-16")
    settings = Settings(gamma, "points_on_target", frozenset({"divergence"}))
    view = View(site, settings, "night", layer, ring, frame, "pole_b", is_dark)
    assert decode_view(encode_view(view, opened), session, opened, "link") == (view, None)


def test_link_to_initial_view_is_short(session: Session) -> None:
    opened = View.from_session(session)
    text = encode_view(opened, opened)
    assert text == "site=pole_b&pose=30.5,-12,3,0,0,0&sensor=small"
    assert decode_view(text, session, opened, "link") == (opened, None)
    assert decode_view("", session, opened, "link") == (opened, None)
    camera = Camera((1.5, 2.0, 100.0), (20.0, 0.0, 0.25))
    assert decode_view(f"?{encode_view(opened, opened, camera)}", session, opened, "link") == (opened, camera)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("site=nobody", r"link: site: expected one of pole_a, pole_b, got 'nobody'"),
        ("pose=1,2,3", r"link: pose: expected 6 numbers x,y,z,yaw,pitch,roll, got '1,2,3'"),
        ("pose=1,2,3,4,5,nan", r"link: pose: expected 6 numbers x,y,z,yaw,pitch,roll, got '1,2,3,4,5,nan'"),
        ("pose=1,2,3,4,5,up", r"link: pose: expected 6 numbers x,y,z,yaw,pitch,roll, got 'up'"),
        ("pose=1,2,1e9,4,5,6", r"link: z_m: expected a number from -1e\+08 to 1e\+08, got 1000000000\.0"),
        ("pose=1,2,3,4,91,6", r"link: pitch_deg: expected a number from -90 to 90, got 91\.0"),
        ("sensor=nothing", r"link: sensor: .*nothing"),
        ("gamma=many", r"link: gamma: expected a number of at least 0, got 'many'"),
        ("gamma=-1", r"link: score\.gamma: expected a value greater than or equal to 0 or 'auto', got -1\.0"),
        ("score=best", r"link: score\.rank_by: expected .*, got 'best'"),
        ("effects=hail", r"link: effects: expected effects out of range_limit, rain, .*, got 'hail'"),
        ("period=noon", r"link: period: expected one of day, night, got 'noon'"),
        ("layer=sky", r"link: layer: expected one of none, traffic, seen, .*, got 'sky'"),
        ("ring=-1", r"link: ring: expected a whole number of at least 0, got -1"),
        ("frame=1.5", r"link: frame: expected a whole number of at least 0, got '1.5'"),
        ("beside=nobody", r"link: beside: expected one of pole_a, pole_b, got 'nobody'"),
        ("camera=1,2", r"link: camera: expected 6 numbers x,y,z,x,y,z, got '1,2'"),
        ("sity=pole_a", r"link: unknown key 'sity'. Use only beside, camera, dark"),
    ],
)
def test_invalid_links_are_rejected(session: Session, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        decode_view(text, session, View.from_session(session), "link")


MOVED = Pose(9.125, 12.5, 3.75, 20.25, -4.5, 1.0)
SITE = Site("pole_a", MOVED, "small")
CANDIDATES = ("pole_a", "pole_b")


def test_saved_poses_are_a_file_of_sites(mini: Path) -> None:
    assert save_pose(mini / SAVED_SITES, SITE, CANDIDATES) == "pole_a-1"
    assert save_pose(mini / SAVED_SITES, replace(SITE, pose=replace(MOVED, z_m=1 / 3)), CANDIDATES) == "pole_a-2"
    saved = sites.candidate_sites(egvs.load(mini, [f"sites.file='{SAVED_SITES}'"]))
    assert [site.name for site in saved] == ["pole_a-1", "pole_a-2"]
    assert [site.pose for site in saved] == [MOVED, replace(MOVED, z_m=1 / 3)]
    assert {site.sensor for site in saved} == {"small"}


@pytest.mark.parametrize("content", ["site,x_m,y_m,z_m\nmine,1,2,3\n", "", "\x00\xff", '"site'])
def test_users_file_is_not_changed(mini: Path, content: str) -> None:
    (mini / SAVED_SITES).write_text(content)
    with pytest.raises(InputError, match="was not written by egvs explore, so it is not overwritten"):
        save_pose(mini / SAVED_SITES, SITE, CANDIDATES)
    assert (mini / SAVED_SITES).read_text() == content
    assert unused_file_name(mini) == "kept_sites-2.csv"
    (mini / "kept_sites-2.csv").write_text("mine")
    assert unused_file_name(mini) == "kept_sites-3.csv"


def test_poses_that_are_saved_at_once_are_all_in_the_file(mini: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        names = list(pool.map(lambda _: save_pose(mini / SAVED_SITES, SITE, CANDIDATES), range(40)))
    rows = (mini / SAVED_SITES).read_text().splitlines()[1:]
    assert sorted(row.split(",")[0] for row in rows) == sorted(names)
    assert len(set(names)) == 40
    assert not list(mini.glob(".*.lock"))


SAVE_POSES = """
import sys
from egvs.explore.view_state import SAVED_SITES, save_pose
from pathlib import Path
from egvs.scenario.loading import load
from egvs.sensors.sites import candidate_sites

folder = Path(sys.argv[1])
site = candidate_sites(load(folder))[0]
for _ in range(25):
    print(save_pose(folder / SAVED_SITES, site, (site.name,)))
"""


@pytest.mark.system
@pytest.mark.slow
def test_two_processes_that_save_poses_lose_no_row(mini: Path) -> None:
    started = [Started(SAVE_POSES, mini) for _ in range(2)]
    names = []
    for ended in [process.ended() for process in started]:
        assert ended.returncode == 0, ended.stderr
        names += ended.stdout.split()
    rows = (mini / SAVED_SITES).read_text().splitlines()[1:]
    assert sorted(row.split(",")[0] for row in rows) == sorted(names)
    assert len(set(names)) == 50


def test_saved_pose_gets_unused_name(mini: Path) -> None:
    assert save_pose(mini / SAVED_SITES, SITE, (*CANDIDATES, "pole_a-1")) == "pole_a-2"
