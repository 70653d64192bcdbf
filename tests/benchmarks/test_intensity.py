"""The sweeps of the benchmark: the same points, with the intensities that the columns name."""

from __future__ import annotations

import numpy as np
from benchmarks.intensity import SWEEPS, sweeps_of

from egvs.clouds.sweeps import Sweep


def test_columns_differ_in_intensity_only() -> None:
    rng = np.random.default_rng(0)
    sweep = Sweep(rng.random((50, 4)).astype(np.float32), np.arange(50, dtype=np.uint32))
    made = dict(sweeps_of(sweep, rng))
    assert list(made) == list(SWEEPS)
    for column in made.values():
        np.testing.assert_array_equal(column.points[:, :3], sweep.points[:, :3])
    np.testing.assert_array_equal(made["simulated"].points, sweep.points)
    assert [set(made[name].points[:, 3].tolist()) for name in ("0", "0.5", "1")] == [{0.0}, {0.5}, {1.0}]
    assert np.isnan(made["unknown"].points[:, 3]).all()
    shuffled = made["shuffled"].points[:, 3]
    assert (shuffled != sweep.points[:, 3]).any()
    np.testing.assert_array_equal(np.sort(shuffled), np.sort(sweep.points[:, 3]))
