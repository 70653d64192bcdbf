"""Does the march count the voxels that a segment crosses, and no other, whatever the input?

Evidence: rational arithmetic (tests/oracles/march.py), on a corpus of hostile segments and on what Hypothesis makes up;
symmetries; steps that are bounded; the audit; and faults put into the kernel on purpose, each of which the corpus must
show."""

import json
import math
import re
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.numerics import march as hunt
from hypothesis import event, example, given, settings
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.kernels import traversal
from egvs.scoring.visibility import Beams, to_voxel_units
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose
from tests.oracles import march as oracle

CORPUS = json.loads((Path(__file__).parent / "data" / "hostile_segments.json").read_text())
SOUND = [entry for entry in CORPUS if not entry.get("refused")]
REFUSED = [entry for entry in CORPUS if entry.get("refused")]

FAR_M = 1e7
"""How far from the grid a segment may start."""

often = settings(derandomize=True, deadline=None, max_examples=600, database=None)
seldom = settings(often, max_examples=150)


def list_voxels(kernels, o, d, shape, voxel_m):
    """The voxels that ``walk`` lists, in order."""
    shape = np.asarray(shape, np.int64)
    cells, t_cells = np.empty(shape.sum() + 3, np.int64), np.empty((shape.sum() + 3, 2))
    o, d = np.array(o, float), np.array(d, float)
    times = kernels.crossing_buffer(shape)
    count, t_first, t_last = kernels.list_voxels(o, d, shape, voxel_m, cells, t_cells, times)
    assert count <= max(shape.sum() - 2, 0), "more voxels than planes between them"
    assert np.all(t_cells[:count, 0] < t_cells[:count, 1])
    assert np.all(t_cells[1:count, 0] >= t_cells[: max(count - 1, 0), 1])
    assert count == 0 or 0 <= t_first <= t_cells[0, 0] < t_cells[count - 1, 1] <= t_last <= 1
    assert np.all((cells[:count] >= 0) & (cells[:count] < shape.prod()))
    return [tuple(int(i) for i in np.unravel_index(c, tuple(shape))) for c in cells[:count]]


def count_voxels(kernels, o, d, shape, voxel_m):
    """Return the voxels that ``count_hits`` counts, none of them twice."""
    hits = np.zeros(int(np.prod(shape)), np.uint32)
    kernels.count_hits(np.array(o, float), np.array([d], float), np.asarray(shape, np.int64), voxel_m, hits)
    assert hits.max() <= 1
    return {tuple(int(i) for i in np.unravel_index(c, tuple(shape))) for c in np.flatnonzero(hits)}


def march_voxels(o, d, shape, voxel_m):
    """What both kernels say."""
    found = list_voxels(traversal, o, d, shape, voxel_m)
    assert count_voxels(traversal, o, d, shape, voxel_m) == set(found)
    assert len(set(found)) == len(found)
    return set(found)


def converted(site_m, beam_m, origin_m, voxel_m, shape):
    """Start and extent as the pipeline hands them to the kernel, from the world frame."""
    beams = Beams(Pose(*site_m), CATALOGUE["VLP-16"], np.array([beam_m], float), where="scans.parquet: site s")
    o, d, _ = to_voxel_units(beams, Grid(tuple(origin_m), voxel_m, tuple(shape)))
    return o, d[0]


def of_entry(entry, backwards=False):
    start, beam = ([float(x) for x in entry[key]] for key in ("start_m", "beam_m"))
    if backwards:
        start, beam = [s + b for s, b in zip(start, beam, strict=True)], [-b for b in beam]
    return start, beam, entry["origin_m"], entry["voxel_m"], entry["shape"]


def displaced_m(start, beam, origin):
    """How far rounding can displace a point of a beam on the way from the world frame: two roundings of each number.

    Within the grid only the rounding of the stretch up to there counts, but a bound is all that is wanted.
    """
    far = max(abs(s - z) for s, z in zip(start, origin, strict=True))
    return Fraction(4, 2**53) * (Fraction(far) + max(Fraction(abs(b)) for b in beam))


# --- the corpus -------------------------------------------------------------------------------------------------------


def is_near(entry, backwards):
    """Whether it starts in the range that the march promises; the end may be anywhere."""
    start, _, origin, _, _ = of_entry(entry, backwards)
    return max(abs(s - z) for s, z in zip(start, origin, strict=True)) <= 1.001 * FAR_M


BOTH_WAYS = [(entry, backwards) for entry in SOUND for backwards in (False, True) if is_near(entry, backwards)]


@pytest.mark.parametrize(("entry", "backwards"), BOTH_WAYS, ids=[f"{e['name']}{', back' * b}" for e, b in BOTH_WAYS])
def test_hard_segment(entry, backwards):
    start, beam, origin, voxel_m, shape = of_entry(entry, backwards)
    o, d = converted(start, beam, origin, voxel_m, shape)
    found = march_voxels(o, d, shape, voxel_m)
    wrong = found ^ oracle.crossed(o, d, shape, voxel_m)
    assert wrong <= oracle.ambiguous(o, d, shape, voxel_m)
    assert bool(oracle.ambiguous(o, d, shape, voxel_m)) == entry.get("excluded", False), (
        "excluded are those built to be"
    )
    exact_o, exact_d = oracle.in_world(start, beam, origin, voxel_m)
    if exact_o == [Fraction(x) for x in o] and exact_d == [Fraction(x) for x in d]:
        return
    # Rounded on the way from the world frame: only what so small a move can change may differ.
    in_world = found ^ oracle.crossed(exact_o, exact_d, shape, voxel_m)
    if in_world:
        assert in_world <= set.union(
            *oracle.fragile(exact_o, exact_d, shape, voxel_m, displaced_m(start, beam, origin))
        )


@pytest.mark.slow
def test_reversed_hard_segments_cross_same_voxels():
    turned = 0
    for entry in SOUND:
        start, beam, origin, voxel_m, shape = of_entry(entry)
        o, d = converted(start, beam, origin, voxel_m, shape)
        end = o + d
        if not is_near(entry, True) or [Fraction(e) for e in end] != [
            Fraction(a) + Fraction(b) for a, b in zip(o, d, strict=True)
        ]:
            continue  # turned round it would be another segment
        turned += 1
        assert march_voxels(end, -d, shape, voxel_m) ^ march_voxels(o, d, shape, voxel_m) <= oracle.ambiguous(
            o, d, shape, voxel_m
        ), entry["name"]
    assert turned > 60


@pytest.mark.parametrize("entry", REFUSED, ids=[entry["name"] for entry in REFUSED])
def test_rejects_nan_and_inf(entry):
    with pytest.raises(InputError, match=r"scans.parquet: site s: a beam has a non-finite end point"):
        converted(*of_entry(entry))


def test_cases_where_other_implementations_fail():
    """Known answers, so that the oracle is held against something too."""
    by_name = {entry["name"]: entry for entry in CORPUS}

    def found(name):
        start, beam, origin, voxel_m, shape = of_entry(by_name[name])
        return march_voxels(*converted(start, beam, origin, voxel_m, shape), shape, voxel_m)

    first, second = found("fast_voxel_traversal 2"), found("fast_voxel_traversal 5")
    assert {(4, 3, 4), (9, 3, 6)} <= first  # the voxels of both ends, (0, 0-, 0) and (90, -16+, 45), 16 m each
    assert max(i for i, _, _ in first) == 9
    assert {(2, 0, 54), (69, 17, 1)} <= second
    assert found("axis x through cell centres") == {(i, 2, 2) for i in range(8)}
    assert found("along an edge in x, other components -0.0") == {(i, 2, 2) for i in range(8)}
    assert found("along the grid's own upper edge in x, other components -0.0 (outside)") == set()
    assert (7, 5, 4) in found("ends on the upper x border")
    assert found("lattice (0, 0, 0) to (4, 4, 4)") == {(i, i, i) for i in range(4)}
    assert found("lattice (0, 0, 0) to (8, 4, 2)") == {(i, i // 2, i // 4) for i in range(8)}


# --- made up by Hypothesis --------------------------------------------------------------------------------------------

SHAPE = (7, 5, 4)
VOXELS_M = (0.25, 0.1, 1.0, 16.0)


def ulps(value, n):
    for _ in range(abs(n)):
        value = math.nextafter(value, math.copysign(math.inf, n))
    return value


lattice = st.integers(-2, 9).map(float)
subnormal = st.sampled_from([5e-324, -5e-324, 1e-310, -1e-310, 2.2250738585072014e-308, 1e-300, -1e-300])
beside = st.builds(ulps, lattice, st.integers(-3, 3))
nearly = st.builds(lambda k, e, s: k + s * 10.0**e, lattice, st.floats(-12, -4), st.sampled_from([-1.0, 1.0]))
coordinate = st.one_of(
    lattice,
    beside,
    nearly,
    st.floats(-2, 9),
    st.integers(-8, 36).map(lambda q: q / 4),
    st.sampled_from([0.0, -0.0]),
    subnormal,
)
component = st.one_of(lattice, st.sampled_from([0.0, -0.0, 1.0, -1.0]), subnormal, st.floats(-12, 12), nearly)
point = st.tuples(coordinate, coordinate, coordinate)
voxel_size = st.sampled_from(VOXELS_M)
far = st.floats(-0.99 * FAR_M, 0.99 * FAR_M)


@st.composite
def segments(draw):
    """(o, d, voxel_m), in voxel units: between two points, with a made-up extent, or from or to 1e7 m away."""
    voxel_m = draw(voxel_size)
    o = draw(point)
    kind = draw(st.sampled_from(["between", "between", "extent", "from afar", "to afar"]))
    if kind == "extent":
        return o, draw(st.tuples(component, component, component)), voxel_m
    end = draw(point)
    if kind in ("from afar", "to afar"):
        away = tuple(draw(far) / voxel_m if draw(st.booleans()) else c for c in end)
        o, end = (away, o) if kind == "from afar" else (o, away)
        if draw(st.booleans()):
            return o, tuple(2 * (b - a) for a, b in zip(o, end, strict=True)), voxel_m
    return o, tuple(b - a for a, b in zip(o, end, strict=True)), voxel_m


@pytest.mark.slow
@often
@given(segments())
@example(((-3.0, -3.0, -3.0), (16.0, 16.0, 16.0), 0.25))
def test_random_segment_agrees_with_rational_arithmetic(segment):
    o, d, voxel_m = segment
    wrong = march_voxels(o, d, SHAPE, voxel_m) ^ oracle.crossed(o, d, SHAPE, voxel_m)
    if wrong:
        event("a chord within 1e-8 m of the bound")
    assert wrong <= oracle.ambiguous(o, d, SHAPE, voxel_m)


@pytest.mark.slow
@often
@given(
    st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
    st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
    point,
)
@example((1e308, 1e308, 1e308), (-1.7e308, -1.7e308, -1.7e308), (0.0, 0.0, 0.0))
@example((1e17, 1e17, 1e17), (-2e17, -2e17, -2e17), (0.0, 0.0, 0.0))
@example((5e-324, 5e-324, 5e-324), (-5e-324, 5e-324, 1e308), (0.0, 0.0, 0.0))
def test_any_finite_segment_terminates(o, d, near):
    """From anywhere: bounded, within the grid, nothing twice. From nearby, to anywhere: also correct."""
    march_voxels(o, d, SHAPE, 0.25)
    assert march_voxels(near, d, SHAPE, 0.25) ^ oracle.crossed(near, d, SHAPE, 0.25) <= oracle.ambiguous(
        near, d, SHAPE, 0.25
    )


@pytest.mark.slow
@often
@given(segments())
def test_reversed_segment_crosses_same_voxels(segment):
    o, d, voxel_m = segment
    end = [a + b for a, b in zip(o, d, strict=True)]
    back = [-x for x in d]
    exact = all(Fraction(e) == Fraction(a) + Fraction(b) for e, a, b in zip(end, o, d, strict=True))
    event("exact" if exact else "the end is rounded")
    if exact:
        assert march_voxels(o, d, SHAPE, voxel_m) ^ march_voxels(end, back, SHAPE, voxel_m) <= oracle.ambiguous(
            o, d, SHAPE, voxel_m
        )


@pytest.mark.slow
@often
@given(point, st.tuples(*[st.sampled_from([0.0, -0.0])] * 3), voxel_size)
def test_segment_without_length_crosses_nothing(o, d, voxel_m):
    assert march_voxels(o, d, SHAPE, voxel_m) == set()


moves = st.tuples(*[st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1))] * 3)


@pytest.mark.slow
@often
@given(segments(), moves, moves)
def test_moving_ends_by_a_nanometre_changes_fragile_voxels_only(segment, by_start, by_end):
    o, d, voxel_m = segment
    if max(map(abs, (*o, *d))) > 1e6:
        return  # a nanometre is less than the last bit there
    before = march_voxels(o, d, SHAPE, voxel_m)
    reach = 1e-9 / voxel_m
    start = [a + reach * m / max(1.0, math.hypot(*by_start)) for a, m in zip(o, by_start, strict=True)]
    end = [a + b + reach * m / max(1.0, math.hypot(*by_end)) for a, b, m in zip(o, d, by_end, strict=True)]
    after = march_voxels(start, [b - a for a, b in zip(start, end, strict=True)], SHAPE, voxel_m)
    if before != after:
        by_chord, along_face = oracle.fragile(o, d, SHAPE, voxel_m, 1.01e-9)
        event(f"changed; along a face plane: {bool(along_face)}")
        # A voxel that float64 is not held to (a chord within 1e-8 m of the bound) may have been decided either way.
        assert before ^ after <= by_chord | along_face | oracle.ambiguous(o, d, SHAPE, voxel_m)


@pytest.mark.slow
def test_fragile_segments_are_those_constructed():
    """Counted: random segments have none; each built one has, and moving it by a nanometre does change a voxel."""
    rng = np.random.default_rng(1)
    fragile = 0
    for _ in range(300):
        o, end = rng.uniform(-2, 9, (2, 3))
        fragile += any(oracle.fragile(o, end - o, SHAPE, 0.25, 1e-9))
    assert fragile == 0
    nm = 1e-9 / 0.25
    built = {
        "by chord": [((0.5, 0.5, 0.5), (1e-6 / 0.25 + 0.5 * nm, 0.0, 0.0), (-nm, 0.0, 0.0))]
        + [((i + 0.5, 1.5, 2.25), (0.5 + 1e-6 / 0.25 + 0.5 * nm, 0.0, 0.0), (-nm, 0.0, 0.0)) for i in range(4)],
        "along a face": [((0.5, float(j), 0.5), (5.0, 0.0, 1.0), (0.0, -nm, 0.0)) for j in range(5)]
        + [((0.5, 2.0 + 0.5 * nm, 0.5), (5.0, 0.0, 1.0), (0.0, -nm, 0.0))]
        + [((0.5, 3.0 - 0.2 * nm, 0.5), (5.0, 0.1 * nm, 1.0), (0.0, nm, 0.0))],
    }
    counts = {}
    for kind, cases in built.items():
        for o, d, move in cases:
            by_chord, along_face = oracle.fragile(o, d, SHAPE, 0.25, 1e-9)
            assert along_face if kind == "along a face" else by_chord
            moved = (
                march_voxels(np.add(o, move), d, SHAPE, 0.25)
                if kind == "along a face"
                else march_voxels(o, np.add(d, move), SHAPE, 0.25)
            )
            assert moved != march_voxels(o, d, SHAPE, 0.25)
            counts[kind] = counts.get(kind, 0) + 1
    assert counts == {"by chord": 5, "along a face": 7}


metres = st.one_of(
    st.floats(-5, 30), st.integers(-20, 120).map(lambda q: q / 4), st.integers(-50, 300).map(lambda q: q / 10)
)
origins = st.sampled_from(
    [(0.0, 0.0, 0.0), (145.0, 205.0, 0.0), (-1.3, 2.7, 0.1), (393216.0, 3932160.0, 64.0), (389512.37, 3951207.11, 31.2)]
)


@pytest.mark.slow
@often
@given(origins, st.tuples(metres, metres, metres), st.tuples(metres, metres, metres), voxel_size)
def test_beams_in_the_world_frame(origin, start, beam, voxel_m):
    """From site, beam end, origin and voxel as floats: right but for what the rounding of the conversion can turn."""
    site = [z + s for z, s in zip(origin, start, strict=True)]
    found = march_voxels(*converted(site, beam, origin, voxel_m, SHAPE), SHAPE, voxel_m)
    o, d = oracle.in_world(site, beam, origin, voxel_m)
    wrong = found ^ oracle.crossed(o, d, SHAPE, voxel_m)
    if wrong:
        event("a face plane or the bound within the rounding of the conversion")
        assert wrong <= set.union(*oracle.fragile(o, d, SHAPE, voxel_m, displaced_m(site, beam, origin)))


@pytest.mark.slow
@seldom
@given(st.tuples(*[st.integers(-40, 400)] * 3), st.tuples(*[st.integers(-400, 400)] * 3))
def test_same_voxels_400_km_from_origin(start, beam):
    """Exactly representable shifts change nothing, bit for bit."""
    shift = (393216.0, 3932160.0, 64.0)
    site, ends = [s / 64 for s in start], [b / 64 for b in beam]
    here = converted(site, ends, (0.0, 0.0, 0.0), 0.25, SHAPE)
    there = converted([a + b for a, b in zip(site, shift, strict=True)], ends, shift, 0.25, SHAPE)
    assert np.array_equal(here[0], there[0])
    assert np.array_equal(here[1], there[1])


@pytest.mark.slow
def test_corners_of_long_grid_from_1e7_m():
    """Corner cuts of about 1 micrometre, 1e7 m from the start and behind hundreds of planes: an accumulated t is lost
    here."""
    rng = np.random.default_rng(3)
    shape, voxel_m, excluded = (800, 3, 2), 0.25, 0
    for _ in range(40):
        corner = np.array([rng.integers(600, 799), 1.0, 0.0])
        slope = rng.uniform(0.5, 1.5) / 800
        u = np.array([1.0, slope, 0.0]) / math.hypot(1.0, slope)
        aside = np.array([0.0, 1.0, 0.0]) * rng.uniform(0.9, 1.1) * 1e-6 / voxel_m * slope
        far = rng.uniform(0.9, 0.99) * FAR_M / voxel_m
        o = corner + aside + [0.0, 0.0, 0.5] - far * u
        d = 2 * far * u
        wrong = march_voxels(o, d, shape, voxel_m) ^ oracle.crossed(o, d, shape, voxel_m)
        ambiguous = oracle.ambiguous(o, d, shape, voxel_m)
        excluded += bool(ambiguous)
        assert wrong <= ambiguous
    assert excluded < 15


@pytest.mark.slow
def test_error_beyond_documented_range():
    """From 1e9 m away chords are good to 4 u R = 4.4e-7 m, not to 1e-8 m: the limit is real, and it is where it is said
    to be."""
    rng = np.random.default_rng(4)
    wrong = 0
    for _ in range(100):
        target, u = rng.uniform(0, 1, 3) * SHAPE, rng.normal(size=3)
        o = target - u / math.hypot(*u) * 1e9 / 0.25
        d = 2 * (target - o)
        differing = march_voxels(o, d, SHAPE, 0.25) ^ oracle.crossed(o, d, SHAPE, 0.25)
        assert differing <= oracle.ambiguous(o, d, SHAPE, 0.25, Fraction(45, 10**8))
        wrong += bool(differing - oracle.ambiguous(o, d, SHAPE, 0.25))
    assert wrong < 5


# --- the audit --------------------------------------------------------------------------------------------------------


def audited(kernels, o, d, shape=SHAPE, voxel_m=0.25):
    return kernels.audit_beams(
        np.array(o, float),
        np.array(d, float),
        np.asarray(shape, np.int64),
        voxel_m,
        np.zeros(np.prod(shape), np.uint32),
    )


def ordinary_beams(n=400, seed=5):
    rng = np.random.default_rng(seed)
    lattice_ends = rng.integers(-3, 10, (n, 3)).astype(float) - [2.0, 1.5, 1.0]
    random_ends = rng.uniform(-9, 9, (n, 3))
    return np.array([2.0, 1.5, 1.0]), np.concatenate([lattice_ends, random_ends])


@pytest.mark.slow
def test_audit_accepts_ordinary_beams():
    worst_sum, longest_gap_m, misplaced, doubled = audited(traversal, *ordinary_beams())
    assert worst_sum < 1e-12
    assert longest_gap_m < 3e-6
    assert (misplaced, doubled) == (0, 0)


@pytest.mark.slow
@seldom
@given(st.lists(segments().filter(lambda s: s[2] == 0.25 and max(map(abs, s[0])) < 1e6), min_size=1, max_size=5))
def test_audit_accepts_hard_beams(found):
    for o, d, voxel_m in found:
        worst_sum, longest_gap_m, misplaced, doubled = audited(traversal, o, [d], voxel_m=voxel_m)
        assert worst_sum < 1e-12
        assert longest_gap_m < 3.1e-6
        assert (misplaced, doubled) == (0, 0)


def with_fault(*replacements):
    """The kernel's source with some text replaced, as plain Python: not compiled, so a fault costs no compilation."""
    source = Path(traversal.__file__).read_text(encoding="utf-8")
    for old, new in replacements:
        assert old in source, f"the fault does not fit the source any more: {old}"
        source = source.replace(old, new)
    source = re.sub(r"^(_kernel|_inlined) = njit\(.*\)$", r"\1 = lambda function: function", source, flags=re.MULTILINE)
    namespace = {"__name__": "faulty"}
    exec(compile(source, "faulty march", "exec"), namespace)
    return SimpleNamespace(**namespace)


AUDIT_FAULTS = {
    "worst_sum": ("ty, path.step_y", "ty, path.step_z"),
    "longest_gap": ("count += t_next - t > min_share", "count += t_next - t > 1e5 * min_share"),
    "misplaced": ("ty, path.step_y", "ty, path.step_y + path.step_z"),
    "doubled": ("t, cell = t_next, cell + step", "t, cell = t_next, cell + (step >> np.uint64(1))"),
}


@pytest.mark.parametrize(("figure", "fault"), list(AUDIT_FAULTS.items()), ids=list(AUDIT_FAULTS))
def test_each_figure_of_audit_detects_its_fault(figure, fault):
    # Far from the upper border: a faulty index stays within the counters.
    o, d = np.array([1.1, 0.6, 0.7]), np.array([[3.0, 1.3, 0.9], [2.5, 0.2, 0.4], [1.5, 2.0, 0.1]])
    with np.errstate(all="ignore"):
        good, bad = audited(with_fault(), o, d), audited(with_fault(fault), o, d)
    at = list(AUDIT_FAULTS).index(figure)
    assert bad[at] > max(1e-3, good[at] * 1000)
    assert good[0] < 1e-12
    assert good[1] < 3e-6


FAULTS = {
    "none": (),
    "accumulates t": (
        ("t = (plane + step * counting[i] - o) / d", "t = times[i - 1] + step / d if i > 0 else (plane - o) / d"),
    ),
    "counts every visited voxel": (("count += t_next - t > min_share", "count += t_next > t"),),
    "multiplies by a stored reciprocal": (("- o) / d", "- o) * (1.0 / d)"),),
    "the upper side holds a plane": (("return np.floor(o), 0.0, 0.0", "return np.ceil(o) - 1.0, 0.0, 0.0"),),
    "the upper border is in the grid": (("if low <= o < high else", "if low <= o <= high else"),),
    "a chord as a share of the segment": (("return CHORD_M / voxel_m / length", "return CHORD_M"),),
    "a chord in voxels": (("return CHORD_M / voxel_m / length", "return CHORD_M / length"),),
    "squares overflow": (("if length < np.inf:", "if True:"),),
    "one plane too few": (
        ("count = np.int64(abs(last - plane)) + 2", "count = 1"),
        ("while times[count - 1] < np.inf:", "while False:"),
    ),
    "the last chord is forgotten": (
        ("return path.t_last, np.uint64(0), ix, iy, iz", "return np.inf, np.uint64(0), ix, iy, iz"),
    ),
    "ends at the border only": (("_clip(ox, dx, 0.0, nx, 0.0, 1.0)", "_clip(ox, dx, 0.0, nx, 0.0, np.inf)"),),
    "starts behind the sensor": (("_clip(ox, dx, 0.0, nx, 0.0, 1.0)", "_clip(ox, dx, 0.0, nx, -np.inf, 1.0)"),),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", list(FAULTS))
def test_detects_fault_in_march(fault):
    faulty = with_fault(*FAULTS[fault])
    shown = []
    for entry in SOUND:
        start, beam, origin, voxel_m, shape = of_entry(entry)
        o, d = np.subtract(start, origin) / voxel_m, np.array(beam) / voxel_m  # not moved to planes: more hostile
        try:
            with np.errstate(all="ignore"):
                wrong = set(list_voxels(faulty, o, d, shape, voxel_m)) ^ oracle.crossed(o, d, shape, voxel_m)
        except (IndexError, AssertionError, ValueError, OverflowError):
            shown.append(entry["name"])
            continue
        if not wrong <= oracle.ambiguous(o, d, shape, voxel_m):
            shown.append(entry["name"])
    assert bool(shown) == (fault != "none"), shown


# --- the long hunt, in short ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_random_search_finds_no_difference():
    rows = hunt.rows(1e-4)
    assert [row.case for row in rows if row.mismatches] == []
    assert all(row.cases > 0 for row in rows)


@pytest.mark.slow
def test_fast_answers_of_search_agree_with_oracle():
    """The hunt settles most segments in float64 with a margin, and asks the oracle about the rest; both must agree."""
    rng = np.random.default_rng(6)
    settled = 0
    for o, d in zip(*hunt.hostile(rng, 150, np.array(SHAPE), 0.25), strict=True):
        quick = hunt.settle(o, d, SHAPE, 0.25)
        if quick is not None:
            settled += 1
            assert quick == oracle.crossed(o, d, SHAPE, 0.25)
    assert settled > 75


@pytest.mark.slow
def test_fragile_count_of_search_agrees_with_oracle():
    rng = np.random.default_rng(7)
    shape = np.array(SHAPE, np.int64)
    for o, d in zip(*hunt.hostile(rng, 100, shape, 0.25), strict=True):
        if np.abs(o).max() > 1e3:
            continue
        exact = any(oracle.fragile(o, d, SHAPE, 0.25, 1e-9))
        quick = hunt.fragile(o, d, shape, 0.25, 1e-9)
        # Near the limit of being fragile itself float64 may err to either side; 1 % more or less settles it.
        if exact != quick:
            assert any(oracle.fragile(o, d, SHAPE, 0.25, 1.01e-9)) != any(oracle.fragile(o, d, SHAPE, 0.25, 0.99e-9))
