"""Check that the entropy is correctly rounded, EGVS is the exact sum rounded once, and beams agree with 30 digits."""

from __future__ import annotations

from fractions import Fraction

import mpmath
import numpy as np

from benchmarks.numerics.row import Row
from egvs.core.grid import Grid
from egvs.scoring.egvs import EntropyField, binary_entropy
from egvs.sensors.sensor import CATALOGUE, Sensor

_LARGEST = 2**32 - 1


def rows(scale: float) -> list[Row]:
    """Run all checks; ``scale`` 1 takes some minutes."""
    rng = np.random.default_rng(20_240_502)
    return [
        _extreme_counts(scale),
        _random_counts(rng, scale),
        _sums(rng, scale),
        _order(rng, scale),
        _directions(scale),
    ]


def _true(count: int, frames: int) -> mpmath.mpf:
    """Return H in 50 digits, from its definition."""
    with mpmath.workdps(70):
        p = mpmath.mpf(count) / frames
        return (
            -p * mpmath.log(p, 2) - (1 - p) * mpmath.log1p(-p) / mpmath.log(2) if 0 < count < frames else mpmath.mpf(0)
        )


def _compare_entropy(case: str, pairs: list[tuple[int, int]]) -> Row:
    wrong, worst = 0, 0.0
    for count, frames in pairs:
        value, true = binary_entropy(count, frames), _true(count, frames)
        wrong += value != float(mpmath.nstr(true, 45)) or value != binary_entropy(frames - count, frames)
        worst = max(worst, float(abs(value - true) / true) if true else abs(value))
    return Row(
        case, "H correctly rounded, symmetric", "mpmath, 50 digits", len(pairs), 0, wrong, f"{worst:.2e} relative"
    )


def _extreme_counts(scale: float) -> Row:
    reach = max(5, round(1000 * scale))
    pairs = []
    for frames in (1, 2, 3, 10, 60, 5000, 10**6, 2**31 - 1, 2**31, _LARGEST):
        near = {c for k in range(reach) for c in (k, frames - k, frames // 2 + k, frames // 2 - k)}
        pairs += [(c, frames) for c in sorted(near) if 0 <= c <= frames]
    return _compare_entropy("H at both ends and the middle, T = 1 to 2^32 - 1", pairs)


def _random_counts(rng: np.random.Generator, scale: float) -> Row:
    pairs = []
    for _ in range(max(200, round(100_000 * scale))):
        frames = int(2 ** rng.uniform(0, 32)) if rng.random() < 0.9 else _LARGEST
        frames = min(max(frames, 1), _LARGEST)
        pairs.append((int(rng.integers(0, frames + 1)), frames))
    return _compare_entropy("H of random counts and T", pairs)


def _case(rng: np.random.Generator) -> tuple[list[int], int, list[int], float]:
    frames = int(rng.choice([1, 2, 60, 5000, _LARGEST]))
    n = int(rng.integers(1, 200))
    counts = rng.integers(0, frames + 1, n)
    hits = np.where(rng.random(n) < 0.9, rng.integers(0, 40, n), rng.integers(0, _LARGEST + 1, n))
    gamma = float(rng.choice([0.0, 0.1, 2.5, 10.0, rng.random() * 100, 1e9, np.inf]))
    return counts.tolist(), frames, hits.tolist(), gamma


def _field(counts: list[int], frames: int) -> EntropyField:
    return EntropyField.of(
        np.array(counts, dtype=np.int64).reshape(-1, 1, 1), frames, Grid((0.0, 0.0, 0.0), 1.0, (len(counts), 1, 1))
    )


def _sums(rng: np.random.Generator, scale: float) -> Row:
    cases, wrong, worst = max(50, round(5000 * scale)), 0, 0.0
    for _ in range(cases):
        counts, frames, hits, gamma = _case(rng)
        total = sum(
            (
                Fraction(binary_entropy(c, frames)) * (Fraction(h) if h <= gamma else Fraction(gamma))
                for c, h in zip(counts, hits, strict=True)
            ),
            Fraction(0),
        )
        value = _field(counts, frames).score(np.array(hits, dtype=np.uint32), gamma).egvs
        wrong += value != float(total)
        worst = max(worst, abs(value - float(total)))
    return Row(
        "EGVS of random fields, gamma 0 to infinity",
        "the exact sum, rounded once",
        "rational arithmetic",
        cases,
        0,
        wrong,
        f"{worst:.1e} bits",
    )


def _order(rng: np.random.Generator, scale: float) -> Row:
    cases, wrong = max(50, round(5000 * scale)), 0
    for _ in range(cases):
        counts, frames, hits, gamma = _case(rng)
        turn = rng.permutation(len(counts))
        first = _field(counts, frames).score(np.array(hits, dtype=np.uint32), gamma)
        again = _field([counts[i] for i in turn], frames).score(np.array(hits, dtype=np.uint32)[turn], gamma)
        wrong += first != again
    return Row(
        "EGVS with the voxels in another order",
        "the same bits",
        "itself",
        cases,
        0,
        wrong,
        "0" if not wrong else "differs",
    )


def _angles_of(sensor: Sensor, k: int) -> tuple[float, Fraction]:
    """Return elevation and azimuth of beam ``k``, degrees."""
    if sensor.table is not None:
        return float(sensor.table.elevation_deg[k]), Fraction(repr(float(sensor.table.azimuth_deg[k])))
    a, r = divmod(k, sensor.channels)
    first, step = Fraction(0), Fraction(360, sensor.azimuths)
    if sensor.azimuth_deg is not None:
        first, last = (Fraction(repr(angle)) for angle in sensor.azimuth_deg)
        step = (last - first) / (sensor.azimuths - 1)
    return sensor.elevations_deg[r], first + a * step + Fraction(repr(sensor.azimuth_offsets_deg[r]))


def _directions(scale: float) -> Row:
    """Compare upright beams of every sensor with 30 digits."""
    cases, wrong, worst = 0, 0, 0.0
    step = max(7, round(97 / max(scale, 1e-3) ** 0.5))
    for sensor in CATALOGUE.values():
        directions = sensor.directions()
        for k in range(0, sensor.beams, step):
            elevation, azimuth = _angles_of(sensor, k)
            with mpmath.workdps(30):
                az = mpmath.radians(mpmath.mpf(round(azimuth * 10**6)) / 10**6)
                el = mpmath.radians(mpmath.mpf(repr(elevation)))
                true = [
                    float(v) for v in (mpmath.cos(el) * mpmath.cos(az), mpmath.cos(el) * mpmath.sin(az), mpmath.sin(el))
                ]
            error = float(np.abs(directions[k] - true).max())
            cases, wrong, worst = cases + 1, wrong + (error > 1e-15), max(worst, error)
    return Row(
        "beams of the catalogue's sensors",
        "direction within 1e-15",
        "mpmath, 30 digits",
        cases,
        0,
        wrong,
        f"{worst:.1e}",
    )
