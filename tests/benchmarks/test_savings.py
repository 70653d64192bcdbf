"""Does what nobody can see stay unseen: are the bytes the same when the work that is saved is done after all?"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import egvs
from egvs.artefacts.frame_boxes import FrameBoxes
from egvs.kernels import ray_triangle
from egvs.scoring.occupancy import count_occupancy
from egvs.sensors.scanner import Scanner


def take_all(o, directions, size, range_m, beam) -> int:
    beam[:] = np.arange(len(directions))
    return len(directions)


def test_beams_that_cannot_meet_the_region_are_not_cast_and_would_change_nothing(mini: Path, monkeypatch) -> None:
    scene = egvs.build_scene(egvs.load(mini))
    lean = [Scanner(scene).scan_site(site).rows for site in scene.sites]
    monkeypatch.setattr(ray_triangle, "select_beams", take_all)
    for site, few in zip(scene.sites, lean, strict=True):
        every = Scanner(scene).scan_site(site).rows
        assert len(few.beam) < len(every.beam)
        same = np.isin(every.beam, few.beam)
        assert every.ends_m[same].tobytes() == few.ends_m.tobytes()
        assert every.returned[same].tobytes() == few.returned.tobytes()


def test_flat_boxes_take_the_flat_path_and_count_the_same() -> None:
    grid = egvs.load(Path(__file__).resolve().parents[2] / "scenarios" / "nishishinjuku").roi.grid
    rng, n = np.random.default_rng(3), 300
    values = np.column_stack(
        [rng.uniform(0, 100, n), rng.uniform(0, 50, n), np.full(n, 0.75), rng.uniform(-3, 3, n), np.zeros(n),
         np.tile([4.5, 1.75, 1.5], (n, 1))]
    )  # fmt: skip
    flat = count_occupancy(FrameBoxes(np.arange(n) // 10, values), grid, 30)
    values[:, 4] = 1e-15  # so little that no voxel can tell, but not the flat path
    assert np.array_equal(flat, count_occupancy(FrameBoxes(np.arange(n) // 10, values), grid, 30))
