"""Overlap of boxes against shapely, also where boxes touch, coincide or have no area."""

import math

import numpy as np
import pytest
import shapely

from egvs.extensions.validation.detection_metrics import paired_overlap

PAIRS = 10_000


def box(x=0.0, y=0.0, z=0.0, length=4.0, width=2.0, height=1.5, yaw=0.0):
    return np.array([x, y, z, length, width, height, yaw])


def pair(a, b):
    return paired_overlap(a[None], b[None])[:, 0]


def polygons(boxes):
    """Return the boxes as shapely polygons, with corners rotated here."""
    unit = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    local = unit * boxes[:, None, 3:5]
    c, s = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    x = boxes[:, 0, None] + c * local[..., 0] - s * local[..., 1]
    y = boxes[:, 1, None] + s * local[..., 0] + c * local[..., 1]
    return shapely.polygons(np.stack([x, y], axis=-1))


def by_shapely(a, b):
    area = shapely.area(shapely.intersection(polygons(a), polygons(b)))
    plan = [boxes[:, 3] * boxes[:, 4] for boxes in (a, b)]
    tops, bottoms = ([boxes[:, 2] + sign * boxes[:, 5] / 2 for boxes in (a, b)] for sign in (1, -1))
    volume = area * np.clip(np.minimum(*tops) - np.maximum(*bottoms), 0.0, None)
    solid = plan[0] * a[:, 5] + plan[1] * b[:, 5] - volume
    return np.stack([area / (plan[0] + plan[1] - area), volume / solid])


def hostile_pairs(count):
    """Half at random; half on a raster of places, sizes and angles, where sides touch, coincide and contain."""
    rng = np.random.default_rng(5)
    boxes = np.empty((2, count, 7))
    half = count // 2
    boxes[:, :half, :3] = rng.uniform(-3, 3, (2, half, 3))
    boxes[:, :half, 3:6] = rng.uniform(0.2, 6, (2, half, 3))
    boxes[:, :half, 6] = rng.uniform(-7, 7, (2, half))
    boxes[:, half:, :3] = rng.integers(-2, 3, (2, count - half, 3)) * 0.5
    boxes[:, half:, 3:6] = rng.integers(1, 5, (2, count - half, 3)) * 0.5
    boxes[:, half:, 6] = rng.integers(-4, 5, (2, count - half)) * (math.pi / 4)
    same = rng.random(count) < 0.05
    boxes[1, same] = boxes[0, same]
    near = rng.random(count) < 0.05
    boxes[1, near] = boxes[0, near] + rng.normal(0, 1e-9, (near.sum(), 7))
    thin = rng.random(count) < 0.05
    boxes[0, thin, 4] = 1e-4
    tiny = rng.random(count) < 0.03
    boxes[:, tiny, :2] *= 1e-5
    boxes[:, tiny, 3:5] *= 1e-5
    return boxes


@pytest.mark.slow
def test_overlap_equals_shapely():
    a, b = hostile_pairs(PAIRS)
    overlap, expected = paired_overlap(a, b), by_shapely(a, b)
    assert (expected > 0).sum() > PAIRS  # of both views: most pairs meet
    np.testing.assert_allclose(overlap, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(paired_overlap(b, a), overlap, rtol=0, atol=1e-9)


def test_overlap_does_not_depend_on_position():
    a, b = hostile_pairs(2000)
    shift = np.array([400_000.0, 3_900_000.0, 100.0, 0, 0, 0, 0])
    exact = np.round(np.stack([a, b]) * 1024) / 1024  # moved without loss of a digit
    exact[..., 6] = np.stack([a, b])[..., 6]
    np.testing.assert_array_equal(paired_overlap(*exact), paired_overlap(*(exact + shift)))


@pytest.mark.parametrize(
    ("a", "b", "bev", "solid"),
    [
        (box(), box(), 1.0, 1.0),
        (box(), box(yaw=math.pi), 1.0, 1.0),
        (box(yaw=0.3), box(yaw=0.3 + 2 * math.pi), 1.0, 1.0),
        (box(), box(x=2.0), 1 / 3, 1 / 3),  # 4 of 8 m2 each: 4 / (8 + 8 - 4)
        (box(), box(yaw=math.pi / 2), 1 / 3, 1 / 3),  # a cross: 2 x 2 of 8 each
        (box(), box(length=2, width=1), 0.25, 0.25),  # contained: 2 / 8
        (box(), box(z=0.75), 1.0, 1 / 3),  # half the height: .75 / (1.5 + 1.5 - .75)
        (box(), box(z=1.5), 1.0, 0.0),  # one on the other
        (box(), box(x=4.0), 0.0, 0.0),  # end to end
        (box(), box(y=2.0), 0.0, 0.0),  # side by side
        (box(), box(x=4.0, y=2.0), 0.0, 0.0),  # corner to corner
        (box(), box(x=100.0), 0.0, 0.0),
        (box(), box(length=0.0), 0.0, 0.0),  # a line
        (box(length=0, width=0), box(length=0, width=0), 0.0, 0.0),
        (box(height=0), box(height=0), 1.0, 0.0),  # no volume at all
        # a square turned by 45 degrees in a square of the same sides: an octagon of 2 (sqrt 2 - 1) of the area
        (box(length=2, width=2), box(length=2, width=2, yaw=math.pi / 4), 1 / math.sqrt(2), 1 / math.sqrt(2)),
    ],
)
def test_by_hand(a, b, bev, solid):
    np.testing.assert_allclose(pair(a, b), [bev, solid], atol=1e-12)
    np.testing.assert_allclose(pair(b, a), [bev, solid], atol=1e-12)


def test_no_pairs():
    assert paired_overlap(np.empty((0, 7)), np.empty((0, 7))).shape == (2, 0)
