"""How far sensors may move: each kind of place, each range, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.core.errors import InputError
from egvs.placement.refinement import Freedom, sensor_freedoms
from egvs.scenario.score_config import RefinementConfig
from egvs.sensors.sites import Pose, Site
from egvs.sensors.sites import candidate_sites as sites_of

LINE = "[[sites.along]]\nline_m = [[0, 12], [10, 12], [10, 20]]\nspacing_m = 4\nheights_m = [3, 5]\n"


def site(name: str, x_m: float, y_m: float, z_m: float = 3.0, **more: float) -> Site:
    """A pole with one sensor."""
    return Site(name, Pose(x_m, y_m, z_m, **more), "small", pole=name)


def free(
    folder: Path, wanted: RefinementConfig, *sites: Site, stay: tuple[bool, ...] = ()
) -> tuple[Freedom | None, ...]:
    """What sensors may do, every candidate of them part of the plan."""
    return sensor_freedoms(egvs.load(folder), wanted, sites, sites, stay or tuple(False for _ in sites))


def one(folder: Path, wanted: RefinementConfig, *sites: Site) -> Freedom:
    """What the first of them may do."""
    found = free(folder, wanted, *sites)[0]
    assert found is not None
    return found


def along(folder: Path) -> Path:
    """The same scenario with its sites along a line with a corner."""
    text = (folder / "scenario.toml").read_text().replace('[sites]\nfile = "sites.csv"\n', "[sites]\n")
    (folder / "scenario.toml").write_text(text + "\n" + LINE)
    return folder


def test_a_pole_keeps_its_place_and_its_sensor_turns_and_tilts(mini: Path) -> None:
    freedom = one(mini, RefinementConfig(), site("a", 10, 12), site("b", 30, -12, 5.0))
    assert [(axis.name, axis.low, axis.high) for axis in freedom.axes] == [
        ("z_m", 3.0, 5.0),
        ("yaw_deg", -180.0, 180.0),
        ("pitch_deg", -30.0, 10.0),
    ]
    assert not freedom.moves_pole
    assert freedom.ends == ([0.0, None, 0.0], [1.0, None, 1.0])
    assert freedom.pose_at(np.array([0.5, 1.75, 0.25])) == Pose(10, 12, 4.0, 90.0, -20.0, 0.0)


def test_a_pose_beyond_the_ranges_begins_at_the_nearest_end(mini: Path) -> None:
    tilted = site("a", 10, 12, pitch_deg=-45.0, yaw_deg=270.0)
    freedom = one(mini, RefinementConfig(), tilted, site("b", 30, -12, 5.0))
    assert freedom.point(tilted.pose).tolist() == [0.0, 0.25, 0.0]


def test_a_pole_on_a_line_moves_by_half_the_spacing_and_not_beyond_its_ends(mini: Path) -> None:
    folder = along(mini)
    places = sites_of(egvs.load(folder))
    assert [site.name for site in places][:2] == ["a01@3m", "a01@5m"]
    first, corner = places[0], places[4]  # at 0 m and at 8 m of 18 m
    start, round_it = free(folder, RefinementConfig(), first, corner)
    assert start is not None and round_it is not None
    assert (start.axes[0].low, start.axes[0].high) == (0.0, 2.0)
    assert (round_it.axes[0].low, round_it.axes[0].high) == (6.0, 10.0)
    assert round_it.pose_at(np.array([0.75, 0.25, 0.0])) == Pose(9.0, 12.0, 3.0, -90.0, -30.0)
    wide = one(folder, RefinementConfig(radius_m=3.5), corner)
    turned = wide.pose_at(np.array([1.0, 0.5, 0.75]))  # 11.5 m along: 1.5 m round the corner
    assert turned == Pose(10.0, 13.5, 3.0, 0.0, 0.0)
    assert wide.point(turned).tolist() == pytest.approx([1.0, 0.5, 0.75])
    kept = one(folder, RefinementConfig(radius_m=0.0), corner)
    assert not kept.moves_pole


@given(st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_a_pole_stays_in_its_circle(tmp_path_factory: pytest.TempPathFactory, shares: list[float]) -> None:
    from tests.conftest import write_mini

    folder = tmp_path_factory.mktemp("circle") / "mini"
    write_mini(folder)
    freedom = one(folder, RefinementConfig(radius_m=2.0), site("a", 10.25, 12.125))
    pose = freedom.pose_at(np.array(shares))
    assert pose is not None
    assert math.hypot(pose.x_m - 10.25, pose.y_m - 12.125) <= 2.0
    assert -30 <= pose.pitch_deg <= 10 and -180 <= pose.yaw_deg <= 180
    assert all(round(value, 3) == value for value in pose.position_m)


def test_a_pole_that_stands_in_a_polygon_may_be_anywhere_in_it(mini: Path) -> None:
    triangle = ((8.0, 10.0), (16.0, 10.0), (8.0, 18.0))
    inside, outside = free(mini, RefinementConfig(within_m=(triangle,)), site("a", 10, 12), site("b", 30, -12))
    assert inside is not None and outside is not None
    assert not outside.moves_pole
    assert inside.pose_at(np.array([0.25, 0.25, 0.5, 0.5])) == Pose(10.0, 12.0, 3.0, 0.0, -10.0)
    assert inside.pose_at(np.array([0.75, 0.75, 0.5, 0.5])) is None


def test_a_pole_of_several_sensors_keeps_its_place(mini: Path) -> None:
    upper = Site("a@5m", Pose(10, 12, 5.0), "small", pole="a")
    found = free(mini, RefinementConfig(radius_m=2.0), site("a", 10, 12), upper, site("b", 30, -12))
    assert [freedom is not None and freedom.moves_pole for freedom in found] == [False, False, True]
    held = free(mini, RefinementConfig(radius_m=2.0), site("a", 10, 12), upper, stay=(True, False))
    assert held[0] is None and held[1] is not None and not held[1].moves_pole


def test_a_measured_scan_stays(mini: Path) -> None:
    measured = Site("m", Pose(10, 12, 3.0), "small", points="scan.ply", pole="m")
    assert free(mini, RefinementConfig(), measured, site("b", 30, -12))[0] is None


def test_a_freedom_that_is_none_is_refused(mini: Path) -> None:
    with pytest.raises(InputError, match=r"placement\.refine: no sensor of the plan can move"):
        free(mini, RefinementConfig(yaw_deg=(0, 0), pitch_deg=(0, 0)), site("a", 10, 12))


def test_a_polygon_without_a_candidate_is_refused_before_anything_runs(mini: Path, run_egvs) -> None:
    polygons = "[[[9, 11], [11, 11], [11, 13]], [[0, 0], [1, 0], [0, 1]]]"
    code, _, told = run_egvs("place", mini, "--count", 1, "--out", mini / "run", "--set",
                         f"placement.refine.within_m={polygons}")  # fmt: skip
    assert code == 2
    assert "scenario.toml: placement.refine.within_m: polygon 1: no candidate" in told
    assert not (mini / "run" / "trajectories.parquet").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("heights_m=[5, 3]", "expected the lower limit first, got 5 and 3"),
        ("pitch_deg=[-100, 0]", "greater than or equal to -90"),
        ("evaluations=5", "greater than or equal to 20"),
        ("within_m=[[[0, 0], [1, 1], [2, 2]]]", "expected a polygon that encloses an area"),
        ("radius_m=-1", "greater than or equal to 0"),
    ],
)
def test_wrong_keys_are_refused(mini: Path, setting: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"placement\.refine\.{setting.partition('=')[0]}.*{message}"):
        egvs.load(mini, [f"placement.refine.{setting}"])
