"""Mixed returns: single cones by hand, and against a reference in plain Python."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.core.errors import InputError
from egvs.effects.merge import Cones
from egvs.effects.mixed_returns import MixedReturns
from egvs.sensors.scanner import Scanner
from tests.clouds.cloud_scenes import frame_of
from tests.conftest import collection, feature
from tests.effects.detect_helpers import make_effect

RESOLUTION_M = 0.749481145  # 5 ns times 299,792,458 m/s, there and back
SEVEN = [1 / 2, *[1 / 12] * 6]


def merge(range_m: list[float], surface: list[int], intensity: list[float] | float, **keys: object):
    """The return of one cone of 7 sub-beams: sub-beam, range and power."""
    effect = make_effect("mixed_returns", **keys)
    assert isinstance(effect, MixedReturns)
    levels = np.broadcast_to(np.asarray(intensity, dtype=np.float64), (1, 7))
    merged = effect.merge(Cones(np.array([range_m]), np.array([SEVEN]), levels, np.array([surface])))
    return int(merged.sub_beam[0]), float(merged.range_m[0]), float(merged.power[0])


def plate_and_wall(gap_m: float) -> tuple[list[float], list[int]]:
    """The middle and three of the ring (a share of 3/4) on a plate at 20 m, three on a wall behind it."""
    return [20.0] * 4 + [20.0 + gap_m] * 3, [1] * 4 + [2] * 3


def test_range_lies_between_plate_and_wall_by_power() -> None:
    """Gap 0.4 m: P = .75 / 400 and .25 / 416.16; r = (.75 / 20 + .25 / 20.4) / (P1 + P2) = 20.09706 m."""
    sub_beam, range_m, power = merge(*plate_and_wall(0.4), 0.24)
    assert sub_beam == 0 and range_m == pytest.approx(20.09706, abs=1e-5) and power == pytest.approx(1.0)


def test_surfaces_as_far_apart_as_the_pulse_resolves_are_separate() -> None:
    """5 ns are 0.7495 m; 10 ns are 1.499 m."""
    _, nearer, _ = merge(*plate_and_wall(RESOLUTION_M - 1e-6), 0.24)
    assert 20.1 < nearer < 20.2
    sub_beam, range_m, power = merge(*plate_and_wall(RESOLUTION_M + 1e-6), 0.24)
    assert (sub_beam, range_m) == (0, 20.0) and power == pytest.approx(0.75)
    assert 20.3 < merge(*plate_and_wall(1.49), 0.24, pulse_ns=10)[1] < 20.4


def test_reports_strongest_or_first_of_separate_echoes() -> None:
    """The plate is ten times darker: P = .75 x .024 / 400 = 4.5e-5 against .25 x .24 / 484 = 1.24e-4 of the wall."""
    cone = (*plate_and_wall(2.0), [0.024] * 4 + [0.24] * 3)
    assert merge(*cone)[:2] == (4, 22.0) and merge(*cone)[2] == pytest.approx(0.25)
    assert merge(*cone, returns="first")[:2] == (0, 20.0)


def test_label_is_that_of_the_stronger_surface_and_power_that_of_both() -> None:
    """In one echo the bright wall wins; the power is (.75 x .024 + .25 x .24) / .24 of a whole cone on it."""
    sub_beam, range_m, power = merge(*plate_and_wall(0.4), [0.024] * 4 + [0.24] * 3)
    assert sub_beam == 4 and power == pytest.approx(0.325)
    assert range_m == pytest.approx((0.018 / 20 + 0.06 / 20.4) / (0.018 / 400 + 0.06 / 416.16))


def test_cone_that_partly_misses_returns_the_surface_that_it_meets() -> None:
    sub_beam, range_m, power = merge([math.inf] * 4 + [22.0] * 3, [-1] * 4 + [2] * 3, 0.24)
    assert (sub_beam, range_m) == (4, 22.0) and power == pytest.approx(0.25)


def slow_return(range_m, weight, intensity, surface, pulse_ns, which):
    """Sub-beam, range and power of one cone: a list of echoes, each a list of sub-beams."""
    echoes: list[list[int]] = []
    for i in sorted((i for i in range(len(range_m)) if range_m[i] < math.inf), key=lambda i: range_m[i]):
        if echoes and range_m[i] - range_m[echoes[-1][-1]] < 299_792_458e-9 * pulse_ns / 2:
            echoes[-1].append(i)
        else:
            echoes.append([i])
    power = [w * level / r**2 for r, w, level in zip(range_m, weight, intensity, strict=True)]
    echo = echoes[0] if which == "first" else max(echoes, key=lambda echo: math.fsum(power[i] for i in echo))
    by_object = {surface[i]: math.fsum(power[j] for j in echo if surface[j] == surface[i]) for i in sorted(echo)}
    label = max(by_object, key=lambda number: by_object[number])
    main = max((i for i in sorted(echo) if surface[i] == label), key=lambda i: weight[i])
    merged_m = range_m[main]
    if len(by_object) > 1:
        merged_m = math.fsum(power[i] * range_m[i] for i in echo) / math.fsum(power[i] for i in echo)
    return main, merged_m, math.fsum(weight[i] * intensity[i] for i in echo) / intensity[main]


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.sampled_from(["strongest", "first"]), st.sampled_from([1.0, 5.0, 12.0]))
def test_agrees_with_slow_reference(seed: int, which: str, pulse_ns: float) -> None:
    rng = np.random.default_rng(seed)
    shape = (20, 7)
    range_m = 20.0 + rng.uniform(0.0, 3.0, shape)
    range_m[rng.random(shape) < 0.2] = np.inf
    range_m[:, 3] = 21.0
    weight = np.tile(SEVEN, (20, 1))
    intensity, surface = rng.uniform(0.02, 0.6, shape), rng.integers(-3, 3, shape)
    effect = make_effect("mixed_returns", returns=which, pulse_ns=pulse_ns)
    assert isinstance(effect, MixedReturns)
    merged = effect.merge(Cones(range_m, weight, intensity, surface))
    for row in range(20):
        expected = slow_return(*(a[row].tolist() for a in (range_m, weight, intensity, surface)), pulse_ns, which)
        assert merged.sub_beam[row] == expected[0]
        assert (merged.range_m[row], merged.power[row]) == pytest.approx(expected[1:], rel=1e-12)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("pulse_ns=-1", "effects.mixed_returns.pulse_ns: expected a value greater than 0, got -1"),
        ("pulse_ns=0", "effects.mixed_returns.pulse_ns: expected a value greater than 0, got 0"),
        ("returns='last'", "effects.mixed_returns.returns: expected 'strongest' or 'first', got 'last'"),
        ("sub_beams=5", "effects.mixed_returns.sub_beams: expected 1, 7 or 19, got 5"),
    ],
)
def test_rejects_invalid_values(mini: Path, setting: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        egvs.load(mini, [f"effects.mixed_returns={{{setting}}}"])
    assert message in str(caught.value)


def test_acts_in_clouds_only_and_in_place_of_divergence(mini: Path) -> None:
    """Scans for scores are the same, row by row; clouds have one cone of 7, not 7 x 19 sub-beams."""
    site = egvs.build_scene(egvs.load(mini)).sites[0]
    clouds = []
    for others in ([], ["effects.divergence.sub_beams=19"]):
        plain = egvs.build_scene(egvs.load(mini, others))
        mixed = egvs.build_scene(egvs.load(mini, [*others, "effects.mixed_returns={}"]))
        rows = [Scanner(scene).scan_site(site).rows for scene in (plain, mixed)]
        assert rows[0].ends_m.tobytes() == rows[1].ends_m.tobytes()
        assert (rows[0].weight is None) == (rows[1].weight is None) == (not others)
        sweep = CloudSimulator.of_site(mixed, site).sweep(frame_of([]), sweep_rng(1, "here", 0)).sweep
        clouds.append(sweep.points.tobytes())
    assert clouds[0] == clouds[1]


def test_no_effect_on_beams_without_width(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(mini, ["effects.mixed_returns.divergence_mrad=[0, 0]"]))
    assert [effect.name for effect in scene.inactive_effects] == ["mixed_returns"]


def test_rejects_leaves_which_divide_pulses(mini: Path, run_egvs) -> None:
    tree = feature(
        {"type": "Polygon", "coordinates": [[[20, 3], [22, 3], [22, 6], [20, 6], [20, 3]]]},
        name="tree", kind="tree_crown", height_m=7, base_m=1,
    )  # fmt: skip
    (mini / "statics.geojson").write_text(collection(tree))
    scene = egvs.build_scene(egvs.load(mini, ["effects.mixed_returns={}", "effects.foliage={}"]))
    with pytest.raises(InputError, match="cannot act together with foliage"):
        CloudSimulator.of_site(scene, scene.sites[0])
    code, out, err = run_egvs("check", mini, "--set", "effects.mixed_returns={}", "--set", "effects.foliage={}")
    assert code == 2 and (out + err).count("cannot act together with foliage") == 1
