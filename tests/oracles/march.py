"""Which voxels does a segment cross, in rational arithmetic?

Slow and obvious: along each axis, the stretch of the segment inside each slab of voxels; for each voxel, what its three
stretches share. Every float64 is a rational number, so nothing here is rounded. Frame: the grid's own, in voxel units;
start ``o``, extent ``d``, both given as floats or fractions; shares of the segment are fractions from 0 to 1."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction

Number = float | Fraction
Voxel = tuple[int, int, int]

CHORD_M = Fraction(1, 10**6)
ON_PLANE_M = Fraction(1, 10**9)
MARGIN_M = Fraction(1, 10**8)
ZERO, ONE = Fraction(0), Fraction(1)


def in_world(site_m: Sequence[float], beam_m: Sequence[float], origin_m: Sequence[float], voxel_m: float):
    """Start and extent in voxel units of a beam that is given in the world frame, without rounding.

    Site, origin and voxel are the decimals that a person writes; the beam's end was computed. What is within 1 nm of a
    plane lies on it: a site, and a beam along an axis on which it stands so."""
    size = decimal(voxel_m)
    start, extent = [], []
    for s, b, z in zip(site_m, beam_m, origin_m, strict=True):
        at = (decimal(s) - decimal(z)) / size
        on_plane = min(at - at // 1, at // 1 + 1 - at) * size <= ON_PLANE_M
        start.append(Fraction(math.floor(at + Fraction(1, 2))) if on_plane else at)
        flat = start[-1].denominator == 1 and abs(Fraction(b)) <= ON_PLANE_M
        extent.append(ZERO if flat else Fraction(b) / Fraction(voxel_m))
    return start, extent


def decimal(value: float) -> Fraction:
    """The shortest decimal that stands for a float."""
    return Fraction(Decimal(repr(float(value))))


def slabs(o: Number, d: Number, n: int, grow: Fraction = ZERO) -> list[tuple[int, Fraction, Fraction]]:
    """(index, from, to) of each half-open slab [i - grow, i + 1 + grow) of one axis that the segment shares a stretch
    with."""
    start, extent = Fraction(o), Fraction(d)
    found = []
    for i in range(n):
        low, high = i - grow, i + 1 + grow
        if extent == 0:
            if low <= start < high:
                found.append((i, ZERO, ONE))
            continue
        ends = sorted(((low - start) / extent, (high - start) / extent))
        first, last = max(ends[0], ZERO), min(ends[1], ONE)
        if first < last:
            found.append((i, first, last))
    return found


def shares(
    o: Sequence[Number], d: Sequence[Number], shape: Sequence[int], grow: Fraction = ZERO
) -> dict[Voxel, Fraction]:
    """How much of the segment lies in each voxel that is ``grow`` larger on each side."""
    xs, ys, zs = (slabs(o[a], d[a], int(shape[a]), grow) for a in range(3))
    found = {}
    for i, x_first, x_last in xs:
        for j, y_first, y_last in ys:
            first, last = max(x_first, y_first), min(x_last, y_last)
            if first >= last:
                continue
            for k, z_first, z_last in zs:
                share = min(last, z_last) - max(first, z_first)
                if share > 0:
                    found[i, j, k] = share
    return found


def length2_m2(d: Sequence[Number], voxel_m: Number) -> Fraction:
    """Squared length of the segment."""
    return sum((Fraction(c) ** 2 for c in d), ZERO) * Fraction(voxel_m) ** 2


def longer(share: Fraction, length2: Fraction, bound_m: Fraction) -> bool:
    """Whether a share of the segment is longer than a bound; both sides squared, so that no root is taken."""
    return bound_m < 0 or share * share * length2 > bound_m * bound_m


def crossed(o: Sequence[Number], d: Sequence[Number], shape: Sequence[int], voxel_m: Number) -> set[Voxel]:
    """The voxels whose chord is longer than 1 micrometre."""
    length2 = length2_m2(d, voxel_m)
    return {voxel for voxel, share in shares(o, d, shape).items() if longer(share, length2, CHORD_M)}


def ambiguous(
    o: Sequence[Number], d: Sequence[Number], shape: Sequence[int], voxel_m: Number, margin_m: Fraction = MARGIN_M
) -> set[Voxel]:
    """The voxels whose chord lies within the margin of 1 micrometre: no program in float64 is held to those."""
    length2 = length2_m2(d, voxel_m)
    return {
        voxel
        for voxel, share in shares(o, d, shape).items()
        if longer(share, length2, CHORD_M - margin_m) and not longer(share, length2, CHORD_M + margin_m)
    }


def fragile(
    o: Sequence[Number], d: Sequence[Number], shape: Sequence[int], voxel_m: Number, moved_m: Number
) -> tuple[set[Voxel], set[Voxel]]:
    """The voxels that may change when either end moves by up to ``moved_m``: by their chord, and along a face plane.

    No point of the segment moves further than its ends, so a chord after the move is no longer than that of a voxel
    ``moved_m`` larger on each side, and no shorter than that of one smaller, give or take twice ``moved_m`` (the
    segment's length changes). A voxel is fragile where those two lie on either side of 1 micrometre.

    Returns
    -------
    by_chord, along_face
        Fragile voxels whose chord lies within 1e-8 m of the bound; the others. There the smaller and the larger voxel
        cut off pieces of more than 4e-9 m in all, so the segment runs within ``moved_m`` of a face plane for longer
        than that.
    """
    moved = Fraction(moved_m)
    grow, length2 = moved / Fraction(voxel_m), length2_m2(d, voxel_m)
    inner, outer = shares(o, d, shape, -grow), shares(o, d, shape, grow)
    found = {
        voxel
        for voxel, share in outer.items()
        if longer(share, length2, CHORD_M - 2 * moved)
        and not longer(inner.get(voxel, ZERO), length2, CHORD_M + 2 * moved)
    }
    by_chord = found & ambiguous(o, d, shape, voxel_m)
    return by_chord, found - by_chord
