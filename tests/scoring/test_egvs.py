"""Is the entropy correctly rounded, and is the score the exact sum, rounded once, in any order?"""

from decimal import Decimal, localcontext
from fractions import Fraction
from math import inf, nan

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.scoring import egvs
from egvs.scoring.egvs import EntropyField, binary_entropy

LARGEST = 2**32 - 1


def true_entropy(count, frames, digits=50):
    """H in ``digits`` digits, from its definition."""
    with mpmath.workdps(digits + 20):
        p = mpmath.mpf(count) / frames
        return (
            -p * mpmath.log(p, 2) - (1 - p) * mpmath.log1p(-p) / mpmath.log(2) if 0 < count < frames else mpmath.mpf(0)
        )


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 60, 999, 5000, 10**6, 2**31, 2**32 - 2, LARGEST])
def test_entropy_is_correctly_rounded(frames):
    ends = {
        c for k in (*range(6), 17, 1000) for c in (k, frames - k, frames // 2 - k, frames // 2 + k, frames // 3 + k)
    }
    for count in sorted(c for c in ends if 0 <= c <= frames):
        true = true_entropy(count, frames)
        found = binary_entropy(count, frames)
        assert found == float(mpmath.nstr(true, 45))  # a decimal string is rounded correctly by float()
        assert abs(found - true) <= 4e-16 * true


@pytest.mark.slow
@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.data())
def test_entropy_of_any_count(data):
    frames = data.draw(st.integers(1, LARGEST))
    count = data.draw(st.integers(0, frames))
    found = binary_entropy(count, frames)
    assert found == float(mpmath.nstr(true_entropy(count, frames), 45))
    assert found == binary_entropy(frames - count, frames)
    assert 0.0 <= found <= 1.0
    assert (found == 0.0) == (count in (0, frames))


@pytest.mark.parametrize("n", [*range(1, 400), 4999, 5000, 46_656, 49_999, 50_000, 50_001, LARGEST])
def test_logarithm_from_table_is_that_of_decimal(n):
    with localcontext() as context:
        context.prec = egvs._DIGITS
        assert egvs._ln(n) == Decimal(n).ln()


def test_entropy_by_hand():
    assert binary_entropy(1, 2) == 1.0
    assert binary_entropy(2500, 5000) == 1.0
    assert binary_entropy(1, 4) == pytest.approx(2 - 0.75 * np.log2(3), rel=3e-16)
    assert binary_entropy(0, 1) == binary_entropy(1, 1) == 0.0


@pytest.mark.parametrize(("count", "frames"), [(-1, 5), (6, 5), (0, 0), (1, 0), (0, -1)])
def test_rejects_invalid_counts(count, frames):
    with pytest.raises(ValueError, match=r"0 <= count <= frames"):
        binary_entropy(count, frames)


def grid_of(n):
    return Grid((0.0, 0.0, 0.0), 1.0, (n, 1, 1))


def field_of(counts, frames):
    counts = np.asarray(counts, dtype=np.int64)
    return EntropyField.of(counts.reshape(-1, 1, 1), frames, grid_of(len(counts)))


def true_score(counts, frames, hits, gamma):
    """The rational sum over voxels, rounded once."""
    total = Fraction(0)
    for count, hit in zip(counts, hits, strict=True):
        capped = Fraction(hit) if hit <= gamma else Fraction(gamma)
        total += Fraction(binary_entropy(count, frames)) * capped
    return float(total)


GAMMAS = st.one_of(st.sampled_from([0.0, 0.1, 1.0, 2.5, 10.0, 1e-300, 1e9, inf]), st.floats(0, 1e12))


@pytest.mark.slow
@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.data(), st.sampled_from([1, 2, 7, 5000, LARGEST]), GAMMAS)
def test_score_is_the_exact_sum_rounded_once(data, frames, gamma):
    n = data.draw(st.integers(1, 40))
    counts = data.draw(st.lists(st.integers(0, min(frames, 50)) | st.integers(0, frames), min_size=n, max_size=n))
    hits = data.draw(st.lists(st.integers(0, 30) | st.integers(0, LARGEST), min_size=n, max_size=n))
    field, beams = field_of(counts, frames), np.array(hits, dtype=np.uint32)
    found = field.score(beams, gamma)
    assert found.egvs == true_score(counts, frames, hits, gamma)
    whole = true_score(counts, frames, [1] * n, 1.0)
    assert found.entropy_seen == (true_score(counts, frames, [int(h > 0) for h in hits], 1.0) / whole if whole else 0.0)
    turn = np.random.default_rng(n).permutation(n)
    again = field_of(np.array(counts)[turn], frames).score(beams[turn], gamma)
    assert again == found


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 5000), min_size=1, max_size=60), st.sampled_from([0.0, 0.5, 10.0, 1e6]))
def test_limit_is_gamma_in_every_voxel(counts, gamma):
    field = field_of(counts, 5000)
    assert field.limit(gamma) == true_score(counts, 5000, [LARGEST] * len(counts), gamma)
    assert field.limit(gamma) == field.score(np.full(len(counts), LARGEST, dtype=np.uint32), gamma).egvs


def test_gamma_at_its_ends():
    counts, hits = [1, 2, 3, 0, 4], np.array([0, 3, 9, 9, 1], dtype=np.uint32)
    field = field_of(counts, 4)
    assert field.score(hits, 0.0).egvs == 0.0
    assert field.limit(0.0) == 0.0
    assert field.score(hits, inf).egvs == true_score(counts, 4, hits.tolist(), inf)
    assert field.limit(inf) == inf
    assert field.score(hits, 1e308).egvs == field.score(hits, inf).egvs
    assert field.score(hits, 2.5).egvs == float(
        Fraction(1) * Fraction(5, 2) + Fraction(binary_entropy(3, 4)) * Fraction(5, 2)
    )


def test_limit_beyond_float64_is_infinite_and_no_crash():
    assert field_of([1, 1, 1, 1], 2).limit(1.7e308) == inf


def test_one_frame_no_voxel_and_only_static_voxels_have_no_entropy():
    for field in (field_of([0, 1, 1], 1), field_of([0, 0], 5000), field_of([5000, 5000], 5000)):
        assert len(field.cells) == 0
        for gamma in (0.0, 10.0, inf):
            score = field.score(np.full(3, 7, dtype=np.uint32)[: field.grid.shape[0]], gamma)
            assert (score.egvs, score.entropy_seen) == (0.0, 0.0)
            assert field.limit(gamma) == 0.0


def test_a_site_that_sees_nothing_scores_zero():
    score = field_of([1, 2, 3], 5).score(np.zeros(3, dtype=np.uint32), 10.0)
    assert (score.egvs, score.entropy_seen) == (0.0, 0.0)


def test_counters_at_the_limit_of_their_types():
    """2**32 - 1 beams in each of many voxels: a sum near 2**52, exact; 2**30 voxels, the most a grid has, stay below
    2**62."""
    n = 2**20
    field = field_of(np.ones(n, dtype=np.int64), 2)
    hits = np.full(n, LARGEST, dtype=np.uint32)
    assert field.score(hits, inf).egvs == float(n * LARGEST)
    assert 2**30 * LARGEST < 2**63


def test_rejects_counts_above_frames():
    with pytest.raises(InputError, match="occupied in 6 of 5 frames"):
        field_of([1, 6], 5)


def test_not_a_number_is_no_gamma():
    from pydantic import ValidationError

    from egvs.scenario.score_config import ScoreConfig

    for gamma in (nan, -1.0, -inf):
        with pytest.raises(ValidationError):
            ScoreConfig(gamma=gamma)
    assert ScoreConfig(gamma=inf).gamma == inf
