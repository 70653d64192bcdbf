"""Embree queried with sorted packets of beams gives the same hits as with single rays."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from egvs.core import platform
from egvs.kernels import embree
from egvs.kernels.embree import TriangleTree, coherent_order
from egvs.sensors.sensor import CATALOGUE


def random_triangles(count: int, seed: int = 4) -> np.ndarray:
    """Triangles of a metre or two round the origin, none of which comes near another's edge by intent."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-20, 20, (count, 1, 3)) + rng.uniform(-1, 1, (count, 3, 3))


def sensor_directions(azimuths: int, channels: int = 32) -> np.ndarray:
    """Unit vectors of a sensor in its firing order: all channels, shuffled, then the next azimuth."""
    elevation = np.random.default_rng(1).permutation(np.radians(np.linspace(-40, 40, channels)))
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(
        np.linspace(0, 2 * np.pi, azimuths, endpoint=False), elevation, indexing="ij"))  # fmt: skip
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def hits_one_by_one(triangles: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """What embreex says, one ray after the other."""
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    return scene.run(np.tile(o, (len(d), 1)).astype(np.float32), d.astype(np.float32))


def hits_in_packets(triangles: np.ndarray, o: np.ndarray, d: np.ndarray, beam: np.ndarray | None = None) -> np.ndarray:
    beam = np.arange(len(d), dtype=np.uint32) if beam is None else beam
    return TriangleTree(triangles).nearest(o, beam, d)


def test_beams_of_sensor_hit_the_same_as_one_by_one() -> None:
    triangles, o, d = random_triangles(3000), np.array([0.5, -0.25, 1.0]), sensor_directions(900)
    found, true = hits_in_packets(triangles, o, d), hits_one_by_one(triangles, o, d)
    assert 0.1 < (true >= 0).mean() < 0.99
    np.testing.assert_array_equal(found, true)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 511, 512, 513, 1029])
def test_any_number_of_beams(count: int) -> None:
    """A square on each side of the origin: which of the 12 triangles is met can be told by hand."""
    corners = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]) * 5.0
    squares = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]  # -x +x -y +y -z +z
    box = np.array([corners[list(three)] for a, b, c, d in squares for three in ((a, b, c), (a, c, d))])
    d = np.random.default_rng(count).normal(size=(2 * count, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    beam = np.arange(1, 2 * count, 2, dtype=np.uint32)  # every second one is cast
    axis = np.abs(d[beam]).argmax(axis=1)
    side = 2 * axis + (d[beam, axis] > 0)
    np.testing.assert_array_equal(hits_in_packets(box, np.zeros(3), d, beam) // 2, side)


def test_beams_without_hit_are_minus_one() -> None:
    d = sensor_directions(64)
    one = np.array([[[9.0, -1.0, -1.0], [9.0, 1.0, -1.0], [9.0, 0.0, 1.0]]])
    found = hits_in_packets(one, np.zeros(3), d)
    assert set(found) == {0, -1}
    assert (d[found == 0, 0] > 0.9).all()
    assert (hits_in_packets(one, np.array([20.0, 0.0, 0.0]), np.abs(d)) == -1).all()  # it is behind all of them


def test_hit_does_not_depend_on_other_beams_of_the_packet() -> None:
    triangles, o, d = random_triangles(500), np.zeros(3), sensor_directions(120)
    tree, beam = TriangleTree(triangles), np.arange(len(d), dtype=np.uint32)
    found = tree.nearest(o, beam, d)
    for other in (beam[::-1].copy(), np.random.default_rng(2).permutation(beam), beam[::7].copy()):
        np.testing.assert_array_equal(tree.nearest(o, other, d), found[other])


@pytest.mark.parametrize("tilt", [[0, 1, 2], [2, 0, 1], [1, 2, 0]])
def test_beams_of_a_channel_share_packets(tilt: list[int]) -> None:
    """32 channels that fire in a shuffled order, upright or lying on a side, 16 azimuths in a block."""
    d, beam = sensor_directions(900)[:, tilt], np.arange(900 * 32, dtype=np.uint32)
    order = coherent_order(beam, d)
    np.testing.assert_array_equal(np.sort(order), beam)
    for block in np.split(order[: 512 * 56], 56):
        assert block.max() - block.min() == 511
        channels = (block % 32).reshape(-1, 8)
        assert (channels == channels[:, :1]).all(axis=1).mean() > 0.8 or np.ptp(
            d[block], axis=0
        ).argmax() != tilt.index(2)


def ball() -> np.ndarray:
    """A closed surface round the origin, 10 m away."""
    return trimesh.creation.icosphere(subdivisions=3, radius=10.0).triangles


@pytest.mark.parametrize("tiny", [-9e-19, -8.67e-19, -1e-19, -1e-30, -1e-44, -5e-324, -0.0, 0.0, 1e-19, -1.1e-18])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tiny_component_of_direction_hides_no_hit(tiny: float, axis: int) -> None:
    """What rounding leaves of a turned sensor's 0: Embree takes it for positive here, for negative there."""
    d = np.random.default_rng(axis).normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    d[::8, axis] = tiny
    assert (hits_in_packets(ball(), np.zeros(3), d) >= 0).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_nan_direction_does_not_affect_other_beams(bad: float) -> None:
    d = sensor_directions(90)
    rows = np.random.default_rng(6).choice(len(d), 300, replace=False)
    d[rows] = bad
    order = coherent_order(np.arange(len(d), dtype=np.uint32), d)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(d)))
    assert (np.delete(hits_in_packets(ball(), np.zeros(3), d), rows) >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "angles_deg"),
    [("RS-Ruby Plus", (15.0, -1.0, -90.0)), ("Pandar XT-32", (195.0, 89.0, 180.0)), ("VLP-32C", (90.0, 90.0, 0.0))],
)
def test_no_beam_of_rotated_sensor_leaves_closed_room(sensor: str, angles_deg: tuple[float, float, float]) -> None:
    d = CATALOGUE[sensor].directions(*angles_deg)
    assert (hits_in_packets(ball(), np.array([0.5, -0.25, 1.0]), d) >= 0).all()


def test_threads_share_a_tree() -> None:
    triangles, o, d = random_triangles(2000), np.zeros(3), sensor_directions(600)
    tree, beam = TriangleTree(triangles), np.arange(len(d), dtype=np.uint32)
    true, found = tree.nearest(o, beam, d), [np.empty(0)] * 4
    threads = [threading.Thread(target=lambda n=n: found.__setitem__(n, tree.nearest(o, beam, d))) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(each, true) for each in found)


@pytest.mark.slow
def test_released_tree_frees_its_memory() -> None:
    triangles = random_triangles(20_000)
    peak_mb = []
    for _ in range(15):
        TriangleTree(triangles)
        gc.collect()
        peak_mb.append(platform.peak_memory_mb())
    assert peak_mb[-1] - peak_mb[4] < 15  # 10 trees are 50


WITHOUT = """
import resource
import numpy as np
from egvs.kernels.embree import TriangleTree
small, large = np.random.default_rng(0).uniform(0, 10, (10, 3, 3)), np.zeros((2_000_000, 3, 3))
TriangleTree(small)
now = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
for more in (90, 150, 250):
    resource.setrlimit(resource.RLIMIT_AS, (now + (more << 20), resource.RLIM_INFINITY))
    try:
        TriangleTree(large)
    except MemoryError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    TriangleTree(small)
"""


@pytest.mark.system
@pytest.mark.slow
def test_error_without_memory_and_complete_tree_afterwards() -> None:
    done = run_python(WITHOUT)
    assert done.returncode == 0, done.stderr
    assert "72,000,000 bytes" in done.stdout


def test_tree_without_memory_is_never_partial(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(embree._library, "rtcSetNewGeometryBuffer", lambda *_: None)
        with pytest.raises(MemoryError, match="no room for 360 bytes"):
            TriangleTree(random_triangles(10))
    with monkeypatch.context() as patch:
        patch.setattr(embree._library, "rtcGetDeviceError", lambda _: 4)
        with pytest.raises(MemoryError, match="no tree of 10 triangles \\(error code 4\\)"):
            TriangleTree(random_triangles(10))


ENDS = """
import threading, time
import numpy as np
from egvs.kernels.embree import TriangleTree
rng = np.random.default_rng(0)
tree = TriangleTree(rng.uniform(-50, 50, (200_000, 1, 3)) + rng.uniform(-0.5, 0.5, (200_000, 3, 3)))
d = rng.normal(size=(2_000_000, 3))
d /= np.linalg.norm(d, axis=1)[:, None]
beam = np.arange(len(d), dtype=np.uint32)
tree.nearest(np.zeros(3), beam[:9], d)
def cast():
    while True:
        tree.nearest(np.zeros(3), beam, d)
threading.Thread(target=cast, daemon=True).start()
time.sleep(0.5)
"""


@pytest.mark.system
@pytest.mark.slow
def test_program_can_end_while_a_thread_casts() -> None:
    assert run_python(ENDS).returncode == 0


INTERPRETED = """
import numpy as np
from egvs.kernels.embree import TriangleTree
ahead = np.array([[[9.0, -1.0, -1.0], [9.0, 1.0, -1.0], [9.0, 0.0, 1.0]]])
d = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
print(TriangleTree(ahead).nearest(np.zeros(3), np.arange(2, dtype=np.uint32), d).tolist())
"""


@pytest.mark.slow
@pytest.mark.system
def test_same_hits_without_compiler() -> None:
    done = run_python(INTERPRETED, NUMBA_DISABLE_JIT="1")
    assert (done.stdout, done.returncode) == ("[0, -1]\n", 0), done.stderr


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A process of its own, in which no kernel was compiled."""
    around = {**os.environ, **environment}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=around, check=False)


def test_rejects_other_version_of_embree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embree._library, "rtcGetDeviceProperty", lambda *_: 5)
    with pytest.raises(RuntimeError, match="brings Embree 5"):
        embree._device.__wrapped__()
