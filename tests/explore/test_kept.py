"""Poses are kept without spoiling a user's file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import egvs
from egvs.core.errors import InputError
from egvs.explore.view_state import SAVED_SITES, save_pose, unused_file_name
from egvs.sensors import sites
from egvs.sensors.sites import Pose, Site

MOVED = Pose(9.125, 12.5, 3.75, 20.25, -4.5, 1.0)
SITE = Site("pole_a", MOVED, "small")
CANDIDATES = ("pole_a", "pole_b")


def test_kept_poses_are_a_file_of_sites(mini: Path) -> None:
    assert save_pose(mini / SAVED_SITES, SITE, CANDIDATES) == "pole_a-1"
    assert save_pose(mini / SAVED_SITES, replace(SITE, pose=replace(MOVED, z_m=1 / 3)), CANDIDATES) == "pole_a-2"
    kept = sites.candidate_sites(egvs.load(mini, [f"sites.file='{SAVED_SITES}'"]))
    assert [site.name for site in kept] == ["pole_a-1", "pole_a-2"]
    assert [site.pose for site in kept] == [MOVED, replace(MOVED, z_m=1 / 3)]
    assert {site.sensor for site in kept} == {"small"}


@pytest.mark.parametrize("content", ["site,x_m,y_m,z_m\nmine,1,2,3\n", "", "\x00\xff", '"site'])
def test_a_file_of_the_users_own_stays(mini: Path, content: str) -> None:
    (mini / SAVED_SITES).write_text(content)
    with pytest.raises(InputError, match="was not written by egvs explore, and stays as it is"):
        save_pose(mini / SAVED_SITES, SITE, CANDIDATES)
    assert (mini / SAVED_SITES).read_text() == content
    assert unused_file_name(mini) == "kept_sites-2.csv"
    (mini / "kept_sites-2.csv").write_text("mine")
    assert unused_file_name(mini) == "kept_sites-3.csv"


def test_a_name_that_is_taken_is_not_taken_again(mini: Path) -> None:
    assert save_pose(mini / SAVED_SITES, SITE, (*CANDIDATES, "pole_a-1")) == "pole_a-2"
