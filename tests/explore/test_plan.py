"""A plan that is moved is worth what the definition of the joint score says."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.explore.session import Session
from egvs.explore.settings import open_session
from egvs.sensors.sites import Pose, Site

SITES = "site,x_m,y_m,z_m\na,10,12,3\nb,30.5,-12,3\nc,2,-12,4\nd,38,12,4\n"


def joint_egvs(session: Session, *sites: Site) -> float:
    """E(S) by its definition."""
    hits = sum(session.hits(site) for site in sites)
    return math.fsum((session.entropy_bit * np.minimum(session.scenario.gamma, hits)).ravel())


@pytest.fixture
def planned(mini: Path, tmp_path: Path) -> tuple[Session, float]:
    """A session over a run that holds a plan of two, and the joint score that `egvs place` wrote."""
    (mini / "sites.csv").write_text(SITES)
    placed = egvs.place(egvs.load(mini, ["placement.count=2"]), tmp_path / "run")
    return open_session(mini, (), tmp_path / "run"), placed.joint


def test_a_plan_is_worth_what_egvs_place_says(planned: tuple[Session, float]) -> None:
    session, joint = planned
    plan = session.plan
    assert plan is not None
    assert plan.joint == joint
    assert math.isclose(joint, joint_egvs(session, *plan.sites.values()), rel_tol=1e-9)


def test_a_sensor_that_moves_takes_the_joint_score_along(planned: tuple[Session, float]) -> None:
    session, joint = planned
    plan = session.plan
    assert plan is not None
    name = next(iter(plan.sites))
    site = plan.sites[name]
    there = replace(site, pose=replace(site.pose, z_m=4.5, yaw_deg=20.0))
    moved = plan.moved(there, session.beams(there))
    others = [its for its in plan.sites.values() if its.name != name]
    assert math.isclose(moved.joint, joint_egvs(session, there, *others), rel_tol=1e-9)
    assert moved.joint != joint
    assert moved.moved(site, session.beams(site)).joint == joint


def test_the_best_for_one_more_gains_most(planned: tuple[Session, float]) -> None:
    session, _ = planned
    plan = session.plan
    assert plan is not None
    gains = {
        name: joint_egvs(session, *plan.sites.values(), its.site) - plan.joint
        for name, its in session.candidates.items()
        if name not in plan.sites
    }
    assert plan.best_next is not None
    assert plan.best_next[0] == max(gains, key=gains.__getitem__)
    assert math.isclose(plan.best_next[1], max(gains.values()), rel_tol=1e-9)


def test_a_refined_plan_stands_where_it_was_moved_to(mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text(SITES)
    scenario = egvs.load(mini, ["placement.count=2", "placement.refine.evaluations=20"])
    placed = egvs.place(scenario, tmp_path / "run", refine=True)
    plan = open_session(mini, (), tmp_path / "run").plan
    assert plan is not None
    for site, sensor in zip(plan.sites.values(), placed.sensors, strict=True):
        assert site.pose == Pose(sensor.x_m, sensor.y_m, sensor.z_m, sensor.yaw_deg, sensor.pitch_deg, sensor.roll_deg)
    assert plan.joint == placed.joint


def test_a_plan_of_other_settings_is_none(mini: Path, tmp_path: Path) -> None:
    assert open_session(mini, (), tmp_path / "bare").plan is None
    egvs.place(egvs.load(mini, ["placement.count=1"]), tmp_path / "run")
    assert open_session(mini, ["roi.voxel_m=1.0"], tmp_path / "run").plan is None
