"""Each score against a case small enough for paper.

A row of three voxels of 1 m, at x = 0..1, 1..2, 2..3. A sensor half a metre before it, at x = -0.5, sends two beams
along the row: one ends at x = 2.5, in the third voxel; the other at x = 1.5, in the second. Traffic is in the first
voxel in 0 of 4 frames, in the second in 1, in the third in 2:

    voxel      1     2     3
    p          0     1/4   1/2
    hits       2     2     1
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from egvs.artefacts.tpog import Tpog
from egvs.core.grid import Grid
from egvs.extensions.validation import surrogates
from egvs.extensions.validation.surrogates import Occupancy, SiteEvidence
from egvs.scoring.visibility import Beams
from egvs.sensors import sensor
from egvs.sensors.sites import Pose
from tests.scoring.target_scenes import by_range

LN2 = math.log(2.0)
H_QUARTER = 2.0 - 0.75 * math.log2(3.0)  # H(1/4) = 1/4 * 2 + 3/4 * (2 - log2 3), in bits
GRID = Grid((0.0, 0.0, 0.0), 1.0, (3, 1, 1))
ENDS = [[3.0, 0.0, 0.0], [2.0, 0.0, 0.0]]  # relative to the sensor


def evidence(counts=(0, 1, 2), hits=(2, 2, 1), ends=ENDS, returned=None, in_traffic_points=(), alone=(), **more):
    """The case above, or another one."""
    tpog = Tpog(more.pop("grid", GRID), 4, np.array(counts, dtype=np.int64).reshape(more.pop("shape", (3, 1, 1))))
    ends = np.array(ends, dtype=np.float64).reshape(-1, 3)
    beams = Beams(Pose(-0.5, 0.5, more.pop("z_m", 0.5)), sensor.CATALOGUE["VLP-16"], ends, more.pop("weight", None))
    counted = np.array(hits, dtype=np.uint32), 1
    vehicles = SimpleNamespace(
        points=np.array(in_traffic_points, dtype=np.float64), points_alone=np.array(alone, dtype=np.float64)
    )
    returned = np.ones(len(ends), dtype=np.bool_) if returned is None else np.array(returned)
    return SiteEvidence(Occupancy(tpog), beams, returned, lambda _: counted, lambda _: vehicles, **more)


@dataclass
class FakeVehicles:
    """Points on the vehicles of a record."""

    record: SimpleNamespace
    points: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


def value(name: str, given: SiteEvidence, **parameters: object) -> float:
    result = surrogates.load_score(name).function(given, **parameters)
    assert type(result) is float
    return result


@pytest.mark.parametrize(
    ("gamma", "expected"),
    [
        (1.0, H_QUARTER + 1.0),  # one beam of each counts
        (10.0, 2 * H_QUARTER + 1.0),  # two beams in the second voxel, one in the third, where H(1/2) = 1
        (math.inf, 2 * H_QUARTER + 1.0),
        (0.5, 0.5 * H_QUARTER + 0.5),
    ],
)
def test_egvs(gamma, expected):
    assert value("egvs", evidence(), gamma=gamma) == pytest.approx(expected, rel=1e-15)


def test_entropy_seen_is_share_of_crossed_entropy():
    assert value("entropy_seen", evidence()) == 1.0
    assert value("entropy_seen", evidence(hits=(2, 2, 0))) == pytest.approx(H_QUARTER / (H_QUARTER + 1.0))


def test_coverage_counts_voxels_with_traffic():
    assert value("coverage", evidence()) == 1.0
    assert value("coverage", evidence(hits=(2, 0, 7))) == 0.5  # of the second and third voxel, the third
    assert value("coverage", evidence(hits=(9, 0, 0))) == 0.0


def test_expected_visibility_weights_voxels_by_occupancy():
    assert value("expected_visibility", evidence(hits=(2, 0, 7))) == pytest.approx(0.5 / 0.75)
    assert value("expected_visibility", evidence(hits=(2, 1, 0))) == pytest.approx(0.25 / 0.75)


def test_s_mig_is_total_entropy_minus_that_of_crossed_voxels():
    # total h(1/4) + h(1/2); the first beam crosses both voxels, the second that of h(1/4): the rest is -h(1/4)
    assert value("s_mig", evidence()) == pytest.approx(-H_QUARTER * LN2)
    assert value("s_mig", evidence(hits=(0, 0, 0))) == pytest.approx((H_QUARTER + 1.0) * LN2)


def test_s_mig_counts_voxel_once_per_beam():
    h = {1: H_QUARTER * LN2, 2: LN2}  # of the second and the third voxel
    for beams in ([[0, 1, 2], [1]], [[2], [2], [2], [1]], [[0]]):  # the voxels that each crosses
        hits = [sum(v in crossed for crossed in beams) for v in range(3)]
        left = sum(h.values()) - sum(h.get(v, 0.0) for crossed in beams for v in crossed)
        assert value("s_mig", evidence(hits=hits)) == pytest.approx(left)


def test_m_sog_is_mean_over_crossed_voxels():
    # three are crossed; their entropies are 0, h(1/4), h(1/2)
    assert value("m_sog", evidence()) == pytest.approx(-(H_QUARTER + 1.0) * LN2 / 3)
    assert value("m_sog", evidence(hits=(5, 0, 1))) == pytest.approx(-LN2 / 2)
    assert math.isnan(value("m_sog", evidence(hits=(0, 0, 0))))


def divergence(p: float, q: float) -> float:
    """Of one voxel, as the formula is written; 0 ln 0 is 0."""
    return p * math.log(p / q) + ((1 - p) * math.log((1 - p) / (1 - q)) if p < 1 else 0.0)


def test_kl_obs_follows_beams_in_order():
    # the second voxel: free before it, q = p = 1/4, no divergence; the third: q = 1/2 * 3/4 = 3/8
    assert value("kl_obs", evidence()) == pytest.approx(divergence(0.5, 0.375) / 2)


def test_kl_obs_uses_best_beam_or_floor():
    # without the first beam nothing reaches the third voxel: q = 1e-6
    blind = value("kl_obs", evidence(ends=ENDS[1:]))
    assert blind == pytest.approx(divergence(0.5, 1e-6) / 2)
    # a beam from above, into the third voxel alone, adds q = p there
    above = [*ENDS, [3.0, 0.0, -0.1]]
    assert value("kl_obs", evidence(ends=above, z_m=0.5)) == pytest.approx(divergence(0.5, 0.375) / 2)
    assert value("kl_obs", evidence(counts=(2, 0, 2))) == pytest.approx(divergence(0.5, 0.25) / 2)


def test_kl_obs_behind_permanently_occupied_voxel():
    # p = 1 in the second voxel: certainly visible (q = 1, no divergence), and nothing of the third
    assert value("kl_obs", evidence(counts=(0, 4, 2))) == pytest.approx(divergence(0.5, 1e-6) / 2)
    assert value("kl_obs", evidence(counts=(4, 4, 4))) == pytest.approx((0 + 2 * divergence(1.0, 1e-6)) / 3)


def test_long_product_does_not_underflow():
    # 400 voxels, each free with chance 1/100: the product, 1e-800, is no float64
    grid = Grid((0.0, 0.0, 0.0), 1.0, (401, 1, 1))
    counts = np.full((401, 1, 1), 99, dtype=np.int64)
    tpog = Tpog(grid, 100, counts)
    beams = Beams(Pose(-0.5, 0.5, 0.5), sensor.CATALOGUE["VLP-16"], np.array([[450.0, 0.0, 0.0]]))
    none = SiteEvidence(Occupancy(tpog), beams, np.array([True]), None, None)
    np.testing.assert_allclose(none.log_reach, np.arange(401) * math.log(0.01), rtol=1e-12)


ROAD = Grid((0.0, 0.0, 0.0), 0.5, (4, 2, 2))  # 2 m x 1 m: two squares of four columns each


def road(ends, **more):
    """Traffic in all columns but those at x = 1.5..2 (6 of 8, 1.5 m2): in the upper layer at x = 0..0.5, else in the
    lower one. The sensor stands at (-0.5, 0.5, 3)."""
    counts = np.zeros((4, 2, 2), dtype=np.int64)
    counts[0, :, 1] = counts[1:3, :, 0] = 1
    return evidence(counts=counts, shape=(4, 2, 2), grid=ROAD, ends=ends, hits=np.zeros(16), z_m=3.0, **more)


AT = {"a": [0.75, 0.0, -3.0], "a too": [0.8, 0.3, -2.6], "upper": [0.75, -0.4, -2.1], "b": [1.75, 0.1, -3.0 - 1e-12]}
OFF = {"above": [1.75, 0.1, -2.4], "no traffic": [2.25, 0.1, -3.0], "outside": [2.75, 0.0, -3.0]}


def test_density_is_points_per_road_area():
    # 4 points on 1.5 m2; those above the lowest layer with traffic, beside the traffic and outside do not count
    assert value("density", road([*AT.values(), *OFF.values()])) == pytest.approx(4 / 1.5)
    assert value("density", road(list(OFF.values()))) == 0.0
    assert value("density", road(list(AT.values()), returned=[True, False, True, True])) == pytest.approx(3 / 1.5)
    assert value("density", road(list(AT.values()), weight=np.array([0.5, 1, 1, 1]))) == pytest.approx(3.5 / 1.5)
    quarter = by_range(lambda r: 0 * r + 0.25)
    assert value("density", road(list(AT.values()), detection_probability=quarter)) == pytest.approx(1 / 1.5)


def test_uniformity_is_spread_of_density_over_squares():
    # square 1: 1 m2; a, a too, upper lie at x = 0.25, 0.3, 0.25; square 2: 0.5 m2 of road, b at x = 1.25.
    # densities 3 and 2, mean 4 / 1.5 = 8/3: variance (1 * (1/3)^2 + 0.5 * (2/3)^2) / 1.5 = (1/9 + 2/9) / 1.5 = 2/9
    assert value("uniformity", road(list(AT.values()))) == pytest.approx(math.sqrt(2 / 9) / (8 / 3))
    assert math.isnan(value("uniformity", road(list(OFF.values()))))
    # two points a square metre in each square: even
    assert value("uniformity", road([AT["a"], AT["upper"], AT["b"]])) == pytest.approx(0.0, abs=1e-12)


def test_perception_entropy():
    # one point: AP = 0.659, sigma = 0.341 / 0.659; e^10 points: 0.152 * 10 + 0.659 > 0.999, so sigma = 0.001 / 0.999;
    # none: AP = 0.001, sigma = 999
    sigmas = [0.341 / 0.659, 0.001 / 0.999, 999.0]
    expected = sum(2 * math.log(s) + 1 + math.log(2 * math.pi) for s in sigmas) / 3
    points = (1.0, math.exp(10), 0.0)
    assert value("perception_entropy", evidence(alone=points), in_traffic=False) == pytest.approx(expected)
    assert value("perception_entropy", evidence(in_traffic_points=points), in_traffic=True) == pytest.approx(expected)
    # less than a point is expected: AP = 0.152 ln(0.01) + 0.659 = -0.041, held at 0.001
    assert value("perception_entropy", evidence(alone=(0.01,)), in_traffic=False) == pytest.approx(
        2 * math.log(999.0) + 1 + math.log(2 * math.pi)
    )


def test_points_on_target():
    assert value("points_on_target", evidence(in_traffic_points=(0.0, math.e - 1, math.e**3 - 1))) == pytest.approx(
        (0 + 1 + 3) / 3
    )


def test_noticed_is_a_mean_over_curves_of_each_group():
    """A car and a bus with 14.142 points, the node of 10 to 20 points, and a car without any."""
    record = SimpleNamespace(kinds=("passenger", "bus"), kind=np.array([0, 1, 0]))
    vehicles = FakeVehicles(record, np.array([math.sqrt(200.0), math.sqrt(200.0), 0.0]))
    given = replace(evidence(), count_points=lambda _: vehicles)
    assert value("noticed", given) == pytest.approx((0.6 + 0.8092 + 0.0) / 3, abs=1e-5)
    nobody = FakeVehicles(SimpleNamespace(kinds=(), kind=np.zeros(0, dtype=np.int64)), np.zeros(0))
    assert math.isnan(value("noticed", replace(evidence(), count_points=lambda _: nobody)))


@pytest.mark.parametrize(
    ("name", "without_traffic", "without_beams"),
    [
        ("egvs", 0.0, 0.0),
        ("entropy_seen", 0.0, 0.0),
        ("coverage", 0.0, 0.0),
        ("expected_visibility", 0.0, 0.0),
        ("s_mig", 0.0, (H_QUARTER + 1.0) * LN2),
        ("m_sog", 0.0, math.nan),
        ("kl_obs", 0.0, (divergence(0.25, 1e-6) + divergence(0.5, 1e-6)) / 2),
        ("density", math.nan, 0.0),
        ("uniformity", math.nan, math.nan),
        ("perception_entropy", math.nan, math.nan),
        ("points_on_target", math.nan, math.nan),
    ],
)
def test_values_without_traffic_or_beams_without_runtime_warnings(name, without_traffic, without_beams):
    parameters = {"egvs": {"gamma": 10.0}, "perception_entropy": {"in_traffic": True}}.get(name, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        empty = value(name, evidence(counts=(0, 0, 0)), **parameters)
        blind = value(name, evidence(hits=(0, 0, 0), ends=[]), **parameters)
    assert empty == pytest.approx(without_traffic, nan_ok=True)
    assert blind == pytest.approx(without_beams, nan_ok=True)


def test_permanent_traffic_has_no_entropy():
    always = evidence(counts=(4, 4, 4))
    assert value("egvs", always, gamma=10.0) == value("entropy_seen", always) == value("s_mig", always) == 0.0
    assert value("m_sog", always) == 0.0 and value("coverage", always) == value("expected_visibility", always) == 1.0


def test_every_builtin_score_has_source_and_sign():
    entries = surrogates.score_catalogue()
    assert [entry.problem for entry in entries] == [""] * len(entries)
    for entry in entries:
        score = entry.score
        assert score is not None and score.formula and score.source and score.sign in (1, -1) and score.needs
