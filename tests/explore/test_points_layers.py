"""Layers of points on target in the explorer: the numbers of the maps, for the current pose and the plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

import egvs
from egvs.explore import drawing
from egvs.explore.drawing import LayerContext
from egvs.explore.session import Playback, Session
from egvs.explore.settings import open_session
from egvs.explore.view_state import View
from egvs.placement import plan
from egvs.scoring.points_map import CLASS_LABELS, overlap_map
from egvs.sensors.sites import Pose
from tests.conftest import write_mini
from tests.scoring.test_points_map import NET

KEYS = ["traffic.roads='roads.net.xml'", "placement.count=2"]


class Scene:
    """Records the points that a layer draws."""

    def __init__(self) -> None:
        self.points: Any = None
        self.colours: Any = None

    def remove_by_name(self, _: str) -> None:
        self.points = self.colours = None

    def add_point_cloud(self, _: str, points: Any, colours: Any, **_options: object) -> None:
        self.points, self.colours = points, colours


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session over the small scenario with roads, and a plan of both its sites."""
    folder = write_mini(tmp_path_factory.mktemp("layers") / "mini")
    (folder / "roads.net.xml").write_text(NET)
    run = folder.parent / "run"
    egvs.run(egvs.load(folder, KEYS), run, jobs=1)
    plan.place(egvs.load(folder, KEYS), run, jobs=1)
    return open_session(folder, KEYS, run)


def draw(session: Session, layer: str, pose: Pose) -> tuple[Scene, str]:
    """Draw a layer for pole_a in a pose; return what was drawn, and the legend."""
    scene = Scene()
    rating = session.rate("pole_a", pose)
    view = replace(View.from_session(session), site=rating.site, layer=layer)
    context = LayerContext(cast(Any, scene), session, Playback(session), rating, view, None, (0, 0, 0), session.plan)
    return scene, drawing.draw_layer(context)


@pytest.mark.slow
def test_points_are_those_of_the_current_pose(session: Session) -> None:
    for pose in (Pose(10, 12, 3), Pose(25, 11, 4)):
        scene, legend = draw(session, "points_car", pose)
        points = session.points_map(session.rate("pole_a", pose).site, "car")
        assert points is not None
        assert len(scene.points) == points.on_surface.sum() > 100
        expected = drawing.colour_scale(points.classes[points.on_surface], 0.0, len(CLASS_LABELS) - 1)
        assert (scene.colours == expected).all()
        assert f"{100 * points.share_with(20):.1f} % of the surface with 20 points or more" in legend


def test_overlap_is_that_of_the_plan(session: Session) -> None:
    assert session.plan is not None
    scene, legend = draw(session, "overlap_pedestrian", Pose(10, 12, 3))
    maps = [session.points_map(site, "pedestrian") for site in session.plan.poses.sites]
    overlap = overlap_map([points for points in maps if points is not None])
    assert (scene.colours == drawing.colour_scale(overlap.values[overlap.on_surface], 0.0, 2.0)).all()
    assert len(scene.points) == overlap.on_surface.sum()
    assert "sensors of the plan with 20 points or more on a pedestrian" in legend


def test_layers_say_what_is_missing(session: Session, tmp_path: Path) -> None:
    without = open_session(write_mini(tmp_path / "mini"), [], tmp_path / "run")
    assert "does not come from one road network" in draw(without, "points_car", Pose(10, 12, 3))[1]
    rating = session.rate("pole_a", Pose(10, 12, 3))
    view = replace(View.from_session(session), site=rating.site, layer="overlap_car")
    context = LayerContext(cast(Any, Scene()), session, Playback(session), rating, view, None, (0, 0, 0))
    assert "there is no plan" in drawing.draw_layer(context)
