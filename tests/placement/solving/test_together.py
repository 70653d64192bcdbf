"""What a set sees together: gains, values, rows, against plain Python."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from egvs.kernels.submodular import CAPPED, LOGARITHM, SATURATING
from egvs.placement.problem import CoverageState, VisibilityMatrixBuilder, VisibilityRow
from tests.placement.solving.instances import sight_of, term_of, worth

HITS = np.array([[3, 0, 1, 0], [0, 2, 5, 0], [1, 1, 1, 0]])
WEIGHT = np.array([1.0, 2.0, 0.5, 9.0])


def test_the_joint_egvs_of_two_sensors_by_hand() -> None:
    """gamma 4: 1 * min(4, 3) + 2 * min(4, 2) + .5 * min(4, 1 + 5) = 3 + 4 + 2."""
    term = term_of("", sight_of(HITS), WEIGHT, scale=4.0)
    seen = CoverageState([term], [0])
    assert seen.value(term) == 3.5
    assert seen.gains(term, np.array([1, 2])).tolist() == [2 * 2 + 0.5 * 3, 1 + 2 + 0.5]
    seen.add(1)
    assert seen.value(term) == 9.0


@pytest.mark.parametrize("each_once", [False, True])
@pytest.mark.parametrize("curve", [CAPPED, LOGARITHM, SATURATING])
@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_a_gain_is_what_the_value_rises_by(curve: int, scale: float, each_once: bool) -> None:
    term = term_of("", sight_of(HITS), WEIGHT, curve=curve, scale=scale, each_once=each_once)
    for others in ((), (0,), (1, 2)):
        rest = [i for i in range(3) if i not in others]
        seen = CoverageState([term], others)
        gains = seen.gains(term, np.array(rest))
        for i, gain in zip(rest, gains, strict=True):
            rows = (HITS[[*others, i]] > 0) if each_once else HITS[[*others, i]]
            value = sum(w * worth(curve, scale, int(t)) for w, t in zip(WEIGHT, rows.sum(axis=0), strict=True))
            assert gain == pytest.approx(value - seen.value(term), abs=1e-12)
            assert seen.value_with(term, term.visibility.row(i)) == pytest.approx(value, abs=1e-12)


def test_the_order_of_sensors_and_the_threads_make_no_difference() -> None:
    rng = np.random.default_rng(3)
    hits = rng.integers(0, 9, (200, 50))
    term = term_of("", sight_of(hits), rng.random(50), scale=300.0)
    values = {CoverageState([term], order).value(term) for order in itertools.permutations((3, 50, 7, 120))}
    assert len(values) == 1
    every = np.arange(200)
    one, two = (CoverageState([term], (3, 50), threads).gains(term, every) for threads in (1, 2))
    assert one.tobytes() == two.tobytes()


def test_who_leaves_takes_everything_along() -> None:
    term = term_of("", sight_of(HITS), WEIGHT)
    seen = CoverageState([term], [2, 0, 1])
    seen.remove(0)
    assert seen.value(term) == CoverageState([term], [1, 2]).value(term)
    with pytest.raises(ValueError, match="not in list"):
        seen.remove(0)


def test_rows_that_do_not_fit_into_memory_are_read_from_a_file() -> None:
    rng = np.random.default_rng(1)
    hits = rng.integers(0, 3, (40, 30))
    held, spilled = sight_of(hits), VisibilityMatrixBuilder(30, max_bytes=100)
    for row in hits:
        spilled.add(VisibilityRow.of(row, 2**62))
    whole = spilled.build()
    assert isinstance(whole.cells, np.memmap)
    assert not isinstance(held.cells, np.memmap)
    assert all((getattr(whole, name) == getattr(held, name)).all() for name in ("starts", "cells", "amounts"))
    term, other = (term_of("", sight, np.ones(30)) for sight in (held, whole))
    assert CoverageState([term], [1, 5]).value(term) == CoverageState([other], [1, 5]).value(other)


def test_more_hits_than_count_are_kept_as_so_many() -> None:
    row = VisibilityRow.of(np.array([0, 70_000, 3]), 5)
    assert row.cells.tolist() == [1, 2]
    assert (row.amounts.tolist(), row.amounts.dtype) == ([5, 3], np.uint16)
    assert VisibilityRow.of(np.array([70_000]), 2**40).amounts.tolist() == [70_000]
    counted = VisibilityRow.of(
        np.array([0, 2, 3], dtype=np.uint32), 2**62
    )  # as scans are counted, with a cap of infinity
    assert (counted.amounts.tolist(), counted.amounts.dtype) == ([2, 3], np.int64)
