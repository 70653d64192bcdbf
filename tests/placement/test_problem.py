"""Joint scores: values, gains and visibility matrices, compared with plain Python."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from egvs.kernels.submodular import CAPPED, LOGARITHM, SATURATING
from egvs.placement.problem import CoverageState, VisibilityMatrixBuilder, VisibilityRow
from tests.placement.instances import curve_value, make_matrix, make_term

HITS = np.array([[3, 0, 1, 0], [0, 2, 5, 0], [1, 1, 1, 0]])
WEIGHT = np.array([1.0, 2.0, 0.5, 9.0])


def test_joint_egvs_of_two_sensors_by_hand() -> None:
    """gamma 4: 1 * min(4, 3) + 2 * min(4, 2) + .5 * min(4, 1 + 5) = 3 + 4 + 2."""
    term = make_term("", make_matrix(HITS), WEIGHT, scale=4.0)
    state = CoverageState([term], [0])
    assert state.value(term) == 3.5
    assert state.gains(term, np.array([1, 2])).tolist() == [2 * 2 + 0.5 * 3, 1 + 2 + 0.5]
    state.add(1)
    assert state.value(term) == 9.0


@pytest.mark.parametrize("each_once", [False, True])
@pytest.mark.parametrize("curve", [CAPPED, LOGARITHM, SATURATING])
@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_gain_is_increase_of_value(curve: int, scale: float, each_once: bool) -> None:
    term = make_term("", make_matrix(HITS), WEIGHT, curve=curve, scale=scale, each_once=each_once)
    for others in ((), (0,), (1, 2)):
        rest = [i for i in range(3) if i not in others]
        state = CoverageState([term], others)
        gains = state.gains(term, np.array(rest))
        for i, gain in zip(rest, gains, strict=True):
            rows = (HITS[[*others, i]] > 0) if each_once else HITS[[*others, i]]
            value = sum(w * curve_value(curve, scale, int(t)) for w, t in zip(WEIGHT, rows.sum(axis=0), strict=True))
            assert gain == pytest.approx(value - state.value(term), abs=1e-12)
            assert state.value_with(term, term.visibility.row(i)) == pytest.approx(value, abs=1e-12)


def test_order_and_threads_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    hits = rng.integers(0, 9, (200, 50))
    term = make_term("", make_matrix(hits), rng.random(50), scale=300.0)
    values = {CoverageState([term], order).value(term) for order in itertools.permutations((3, 50, 7, 120))}
    assert len(values) == 1
    candidates = np.arange(200)
    one, two = (CoverageState([term], (3, 50), threads).gains(term, candidates) for threads in (1, 2))
    assert one.tobytes() == two.tobytes()


def test_removed_sensor_leaves_nothing() -> None:
    term = make_term("", make_matrix(HITS), WEIGHT)
    state = CoverageState([term], [2, 0, 1])
    state.remove(0)
    assert state.value(term) == CoverageState([term], [1, 2]).value(term)
    with pytest.raises(ValueError, match="not in list"):
        state.remove(0)


def test_rows_beyond_memory_are_in_a_file() -> None:
    rng = np.random.default_rng(1)
    hits = rng.integers(0, 3, (40, 30))
    in_memory, builder = make_matrix(hits), VisibilityMatrixBuilder(30, max_bytes=100)
    for row in hits:
        builder.add(VisibilityRow.of(row, 2**62))
    spilled = builder.build()
    assert isinstance(spilled.cells, np.memmap)
    assert not isinstance(in_memory.cells, np.memmap)
    assert all((getattr(spilled, name) == getattr(in_memory, name)).all() for name in ("starts", "cells", "amounts"))
    term, other = (make_term("", visibility, np.ones(30)) for visibility in (in_memory, spilled))
    assert CoverageState([term], [1, 5]).value(term) == CoverageState([other], [1, 5]).value(other)


def test_hits_are_capped() -> None:
    row = VisibilityRow.of(np.array([0, 70_000, 3]), 5)
    assert row.cells.tolist() == [1, 2]
    assert (row.amounts.tolist(), row.amounts.dtype) == ([5, 3], np.uint16)
    assert VisibilityRow.of(np.array([70_000]), 2**40).amounts.tolist() == [70_000]
    # Scans are counted as uint32, and the cap may be infinite.
    uncapped = VisibilityRow.of(np.array([0, 2, 3], dtype=np.uint32), 2**62)
    assert (uncapped.amounts.tolist(), uncapped.amounts.dtype) == ([2, 3], np.int64)
