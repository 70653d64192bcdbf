"""Does what nobody can see stay unseen: are the bytes the same when the work that is saved is done after all?"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pipeline
from pipeline.kernels import rays
from pipeline.sensing import scanner as survey
from pipeline.stages import statics, tpog


def test_beams_that_cannot_meet_the_region_are_not_cast_and_would_change_nothing(mini: Path, monkeypatch) -> None:
    scenario = pipeline.load(mini)
    world = statics.build(scenario)[0]
    lean = [survey.Survey(scenario, world).scan(site).scan for site in survey.Survey(scenario, world).sites]
    monkeypatch.setattr(rays, "can_meet", lambda o, ends, size, reaches: reaches.fill(True))
    surveyed = survey.Survey(scenario, world)
    for site, few in zip(surveyed.sites, lean, strict=True):
        every = surveyed.scan(site).scan
        assert len(few.beam) < len(every.beam)
        same = np.isin(every.beam, few.beam)
        assert every.ends_m[same].tobytes() == few.ends_m.tobytes()
        assert every.returned[same].tobytes() == few.returned.tobytes()


def test_flat_boxes_take_the_flat_path_and_count_the_same() -> None:
    grid = pipeline.load(Path(__file__).resolve().parents[2] / "scenarios" / "nishishinjuku").roi.grid
    rng, n = np.random.default_rng(3), 300
    values = np.column_stack(
        [rng.uniform(0, 100, n), rng.uniform(0, 50, n), np.full(n, 0.75), rng.uniform(-3, 3, n), np.zeros(n),
         np.tile([4.5, 1.75, 1.5], (n, 1))]
    )  # fmt: skip
    flat = tpog.count(tpog.Boxes(np.arange(n) // 10, values), grid, 30)
    values[:, 4] = 1e-15  # so little that no voxel can tell, but not the flat path
    assert np.array_equal(flat, tpog.count(tpog.Boxes(np.arange(n) // 10, values), grid, 30))
