"""A scanner scans from any pose, shares nothing with its callers, and is cheap to build again elsewhere."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Pose

EFFECTS = ["effects.mount_sway.tilt_deg=0.5", "effects.divergence.sub_beams=7"]


@pytest.fixture
def scene(mini: Path) -> Scene:
    return egvs.build_scene(egvs.load(mini))


def same(one, other) -> bool:
    """Whether two scans have the same rows, bit for bit."""
    arrays = ("beam", "ends_m", "returned", "weight")
    return all(
        np.array_equal(getattr(one.rows, name), getattr(other.rows, name))
        if getattr(one.rows, name) is not None
        else getattr(other.rows, name) is None
        for name in arrays
    )


def test_a_site_s_pose_gives_the_site_s_scan(scene):
    scanner = Scanner(scene)
    for site in scene.sites:
        scan = scanner.scan(site.pose, scene.sensor(site.sensor))
        assert same(scan, scanner.scan_site(site)) and scan.beams == scan.sensor.beams and scan.returns > 0


@pytest.mark.parametrize("settings", [[], EFFECTS], ids=["plain", "weighted"])
def test_a_pose_that_is_no_site_s_gives_what_a_site_there_would(mini, settings):
    """The tree of triangles is cut for the sites; another pose must not miss what was left out for them."""
    pose = Pose(25.0, 30.0, 4.0, yaw_deg=200.0, pitch_deg=-8.0)
    scene = egvs.build_scene(egvs.load(mini, settings))
    moved = replace(scene, sites=(replace(scene.sites[0], pose=pose),))
    sensor = scene.sensor("small")
    free, named = Scanner(scene).scan(pose, sensor), Scanner(moved).scan(pose, sensor)
    assert same(free, named) and (free.rows.weight is not None) == bool(settings)


def test_a_scan_belongs_to_its_caller(scene):
    scanner, sensor = Scanner(scene), scene.sensor("small")
    first = scanner.scan(scene.sites[0].pose, sensor)
    kept = first.rows.ends_m.copy()
    scanner.scan(scene.sites[1].pose, sensor).rows.ends_m[:] = 0.0
    assert np.array_equal(first.rows.ends_m, kept)
    first.rows.ends_m[:] = np.nan
    assert np.array_equal(scanner.scan(scene.sites[0].pose, sensor).rows.ends_m, kept)


def test_threads_may_share_one(scene):
    scanner, sensor = Scanner(scene), scene.sensor("small")
    poses = [Pose(5.0 + i, 14.0, 3.0, yaw_deg=3.0 * i) for i in range(24)]
    alone = [Scanner(scene).scan(pose, sensor) for pose in poses]
    with ThreadPoolExecutor(8) as pool:
        shared = list(pool.map(lambda pose: scanner.scan(pose, sensor), poses))
    assert all(same(one, other) for one, other in zip(alone, shared, strict=True))


def test_no_more_mounts_are_remembered_than_it_is_told(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(mini))
    one, many = Scanner(scene, mounts=1), Scanner(scene)
    for yaw_deg in (0.0, 10.0, 20.0, 10.0):
        pose = Pose(10.0, 12.0, 3.0, yaw_deg)
        first, second = (scanner.scan(pose, scene.sensor("small")) for scanner in (one, many))
        assert np.array_equal(first.rows.ends_m, second.rows.ends_m)
        assert len(one._directions) == 1
    assert len(many._directions) == 3
    assert pickle.loads(pickle.dumps(one))._mounts == 1


def test_it_pickles_to_what_it_was_built_from(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(mini, EFFECTS))
    scanner = Scanner(scene)
    pose, sensor = scene.sites[0].pose, scene.sensor("small")
    again = pickle.loads(pickle.dumps(scanner))
    assert len(pickle.dumps(scanner)) < 100_000  # the scene alone, no tree
    assert same(scanner.scan(pose, sensor), again.scan(pose, sensor))


def test_one_bad_site_refuses_itself_alone(mini: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\ngood,10,12,3,\nwall,16,6,3,\ntypo,10,12,3,VLP-99\n")
    scene = egvs.build_scene(egvs.load(mini))
    scanner = Scanner(scene)
    assert scanner.scan_site(scene.site("good")).returns > 0
    with pytest.raises(InputError, match=r"site wall: \(16, 6, 3\) is inside house"):
        scanner.scan_site(scene.site("wall"))
    with pytest.raises(InputError, match=r"site typo: unknown sensor 'VLP-99'"):
        scanner.scan_site(scene.site("typo"))
    with pytest.raises(InputError, match=r"(?s)site wall.*\n.*site typo"):
        scanner.check(scene.sites)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (Pose(16, 6, 3), "is inside house"),
        (Pose(20, 0, -1), "is not above the ground"),
        (Pose(900, 0, 3), "from the region of interest"),
    ],
)
def test_where_no_sensor_can_stand_is_told_with_the_coordinates(scene, pose, message):
    with pytest.raises(InputError, match=message) as error:
        Scanner(scene).scan(pose, scene.sensor("small"))
    assert f"pose ({pose.x_m:g}, {pose.y_m:g}, {pose.z_m:g})" in str(error.value)


def test_a_mount_s_directions_are_kept_but_not_for_ever(scene):
    scanner, sensor = Scanner(scene), scene.sensor("small")
    for yaw in range(80):
        scanner.scan(Pose(10, 12, 3, yaw_deg=float(yaw)), sensor)
    assert len(scanner._directions) <= 32
