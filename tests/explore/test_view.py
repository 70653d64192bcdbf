"""A link brings back what was shown, to the last digit; what is not there is named."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.explore.session import Session
from egvs.explore.settings import Settings, open_session
from egvs.explore.view_state import LAYERS, Camera, View, decode_view, encode_view
from egvs.sensors.sites import Pose
from tests.conftest import write_mini
from tests.explore.test_session import in_periods


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Over the small scenario, with two periods."""
    folder = tmp_path_factory.mktemp("view")
    return open_session(in_periods(write_mini(folder / "mini")), (), folder / "run")


finite = st.floats(-1e6, 1e6, allow_nan=False)


@given(
    pose=st.builds(Pose, finite, finite, finite, finite, finite, finite),
    gamma=st.none() | st.floats(0, 1e9) | st.just(float("inf")),
    layer=st.sampled_from(sorted(LAYERS)),
    ring=st.integers(0, 200),
    frame=st.integers(0, 10**6),
    is_dark=st.booleans(),
)
def test_a_link_brings_it_all_back(
    session: Session, pose: Pose, gamma: float | None, layer: str, ring: int, frame: int, is_dark: bool
) -> None:
    opened = View.of(session)
    site = replace(session.candidates["pole_a"].site, pose=pose, sensor="VLP-16")
    settings = Settings(gamma, "points_on_target", frozenset({"divergence"}))
    view = View(site, settings, "night", layer, ring, frame, "pole_b", is_dark)
    assert decode_view(encode_view(view, opened), session, opened, "link") == (view, None)


def test_what_was_opened_is_short(session: Session) -> None:
    opened = View.of(session)
    text = encode_view(opened, opened)
    assert text == "site=pole_b&pose=30.5,-12,3,0,0,0&sensor=small"
    assert decode_view(text, session, opened, "link") == (opened, None)
    assert decode_view("", session, opened, "link") == (opened, None)
    camera = Camera((1.5, 2.0, 100.0), (20.0, 0.0, 0.25))
    assert decode_view(f"?{encode_view(opened, opened, camera)}", session, opened, "link") == (opened, camera)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("site=nobody", r"link: site: 'nobody'; one of pole_a, pole_b"),
        ("pose=1,2,3", r"link: pose: '1,2,3'; x,y,z,yaw,tilt,roll"),
        ("pose=1,2,3,4,5,nan", r"link: pose: '1,2,3,4,5,nan'; x,y,z,yaw,tilt,roll"),
        ("pose=1,2,3,4,5,up", r"link: pose: 'up'; x,y,z,yaw,tilt,roll"),
        ("sensor=nothing", r"link: sensor: .*nothing"),
        ("gamma=many", r"link: gamma: 'many'; a number from 0"),
        ("gamma=-1", r"link: score\.gamma: -1\.0; input should be greater than or equal to 0"),
        ("score=best", r"link: score\.rank_by: 'best'"),
        ("effects=hail", r"link: effects: 'hail'; one of range_limit, rain"),
        ("period=noon", r"link: period: 'noon'; one of day, night"),
        ("layer=sky", r"link: layer: 'sky'; one of none, traffic, seen"),
        ("ring=-1", r"link: ring: -1; a whole number from 0"),
        ("frame=1.5", r"link: frame: '1.5'; a whole number from 0"),
        ("beside=nobody", r"link: beside: 'nobody'; one of pole_a, pole_b"),
        ("camera=1,2", r"link: camera: '1,2'; x,y,z,x,y,z: from where, and at what"),
        ("sity=pole_a", r"link: unknown 'sity'; one of beside, camera, dark"),
    ],
)
def test_what_is_not_there_is_named(session: Session, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        decode_view(text, session, View.of(session), "link")
