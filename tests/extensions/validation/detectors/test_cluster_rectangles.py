"""Rectangles of clusters: boxes visible from one corner, and a slow reference of the published algorithm."""

import numpy as np
import pytest

from egvs.extensions.validation.detectors import cluster


def corner_of(length, width, yaw, at, step=0.05):
    """Points on two sides of a rectangle that meet at ``at``, without noise."""
    along, across = np.arange(0, length + 1e-9, step), np.arange(0, width + 1e-9, step)
    uv = np.concatenate([np.column_stack([along, 0 * along]), np.column_stack([0 * across, across])])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * uv[:, 0] - s * uv[:, 1], s * uv[:, 0] + c * uv[:, 1]]) + at


def twin(xy):
    """Zhang et al. 2017, algorithms 2 and 4, as they are printed, in steps of one degree."""
    best = (-np.inf, None, None)
    for degree in range(90):
        theta = np.deg2rad(degree)
        c1 = xy @ np.array([np.cos(theta), np.sin(theta)])
        c2 = xy @ np.array([-np.sin(theta), np.cos(theta)])
        sides = []
        for c in (c1, c2):
            from_top, from_bottom = c.max() - c, c - c.min()
            sides.append(from_top if np.linalg.norm(from_top) < np.linalg.norm(from_bottom) else from_bottom)
        beta = sum(1.0 / max(min(d1, d2), cluster.ON_SIDE_M) for d1, d2 in zip(*sides, strict=True))
        if beta > best[0]:
            best = beta, degree, (c1.min(), c1.max(), c2.min(), c2.max())
    return best


@pytest.mark.parametrize("degrees", [0, 1, 17, 45, 89])
def test_rectangle_of_box_visible_from_one_corner(degrees):
    yaw = np.deg2rad(degrees)
    xy = corner_of(4.5, 1.8, yaw, (20.0, -7.0))
    rectangles = cluster.bounding_rectangles(xy, np.array([0, len(xy)]))
    np.testing.assert_allclose(rectangles.yaw_rad, [yaw], atol=1e-12)
    corner = rectangles.to_axes(0, np.array([[20.0, -7.0]]))[0]
    np.testing.assert_allclose(rectangles.ends_m[0, :, 0], corner, atol=1e-9)
    np.testing.assert_allclose(rectangles.ends_m[0, :, 1], corner + np.array([4.5, 1.8]), atol=1e-9)
    np.testing.assert_allclose(rectangles.closeness, [1.0])


def test_kernel_equals_published_algorithm():
    random = np.random.default_rng(3)
    clusters = [random.uniform(-3, 3, (int(n), 2)) + random.uniform(-50, 50, 2) for n in random.integers(1, 60, 20)]
    clusters += [corner_of(*size, yaw, (5.0, 9.0), 0.11) for size, yaw in (((4, 2), 0.3), ((10, 2.5), 1.2))]
    starts = np.cumsum([0, *map(len, clusters)])
    rectangles = cluster.bounding_rectangles(np.concatenate(clusters), starts)
    for k, xy in enumerate(clusters):
        beta, degree, ends = twin(xy)
        np.testing.assert_allclose(rectangles.closeness[k], beta * cluster.ON_SIDE_M / len(xy), rtol=1e-9)
        if len(xy) > 2:  # of one or two points many headings are as good
            assert rectangles.yaw_rad[k] == np.deg2rad(degree)
            np.testing.assert_allclose(rectangles.ends_m[k].ravel(), ends, atol=1e-9)


def test_no_clusters():
    rectangles = cluster.bounding_rectangles(np.empty((0, 2)), np.array([0]))
    assert rectangles.ends_m.shape == (0, 2, 2)
