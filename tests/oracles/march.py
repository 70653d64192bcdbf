"""Which voxels does a segment cross, in rational arithmetic?

Slow and obvious: along each axis, the stretch of the segment inside each slab of voxels; for each voxel, what its three
stretches share. Every float64 is a rational number, so nothing here is rounded. Frame: the grid's own, in voxel units;
start ``o``, extent ``d``, both given as floats or fractions; shares of the segment are fractions from 0 to 1."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

Number = float | Fraction
Voxel = tuple[int, int, int]

CHORD_M = Fraction(1, 10**6)
MARGIN_M = Fraction(1, 10**8)
ZERO, ONE = Fraction(0), Fraction(1)


def in_world(site_m: Sequence[float], beam_m: Sequence[float], origin_m: Sequence[float], voxel_m: float):
    """Start and extent in voxel units of a beam that is given in the world frame, without rounding."""
    size = Fraction(voxel_m)
    o = [(Fraction(s) - Fraction(z)) / size for s, z in zip(site_m, origin_m, strict=True)]
    return o, [Fraction(b) / size for b in beam_m]


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


def doubtful(
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
    by_chord = found & doubtful(o, d, shape, voxel_m)
    return by_chord, found - by_chord
