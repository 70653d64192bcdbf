r"""Completes what is seen of a road user to the nearest kind, away from the sensor.

Of each cluster every kind of the table is tried, with its length along either axis of the rectangle. Along an axis, the
end that faces the sensor stays where it was seen; where that end is no side of the body, but the edge of what hides the
rest, the other end does. The smallest cost wins:

.. math:: C = \sum_{ends} \Big(\frac{r\,\Delta\alpha}{\sigma_s}\Big)^2 + \sum_{axes} \Big(\frac{\max(e - s, 0)}
          {\sigma_o}\Big)^2 + \Big(\frac{\max(s - e, 0)}{\sigma_u}\Big)^2 + \Big(\frac{h - t}{\sigma_h}\Big)^2 - 2 \ln q

with the azimuth :math:`\Delta\alpha` by which the box ends elsewhere than the cluster, as far as nothing hides it; the
extent e that was seen and the box's size s along an axis; its height h, the highest point t, and the kind's share q of
the traffic. So a box that beams have passed through loses to one that they could not have met.

Where another sensor shows an end that this one does not, it stays as well; an axis of which both ends stay is as long
as it is seen, with :math:`\sigma_o` either way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.validation.detectors.cluster.hiding import Spans
from pipeline.validation.detectors.cluster.kinds import Kinds
from pipeline.validation.detectors.cluster.l_shape import Rectangles

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CORNERS = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])


@dataclass(frozen=True)
class Tolerances:
    """How far things may be off: standard deviations in metres, and what the range adds to them.

    Attributes
    ----------
    end_m, end_per_range
        Where a box ends, as the sensor sees it.
    over_m, under_m
        By how much more, and less, than the box's size is seen along an axis.
    height_m, height_per_range
        The highest point below the top of the box.
    """

    end_m: float = 0.15
    end_per_range: float = 0.003
    over_m: float = 0.2
    under_m: float = 3.0
    height_m: float = 0.15
    height_per_range: float = 0.006


@dataclass(frozen=True)
class Completed:
    """The boxes of clusters.

    Attributes
    ----------
    boxes
        (m, 7) float64, as :data:`pipeline.artefacts.traffic_frames.BOX`; from the sensor along the world's axes,
        z from the ground.
    kind
        Row of the table, (m,) int64.
    cost
        C above, (m,) float64.
    """

    boxes: Floats
    kind: Ints
    cost: Floats


def complete(
    found: Rectangles,
    hidden: NDArray[np.bool_],
    shown: NDArray[np.bool_],
    spans: Spans,
    top_m: Floats,
    kinds: Kinds,
    tolerances: Tolerances,
) -> Completed:
    """The best box of each cluster.

    Parameters
    ----------
    found, hidden, spans
        Its rectangle, which ends of it are no sides, (m, 2, 2), and where it ends as the sensor sees it.
    shown
        Which ends other sensors show to be sides, (m, 2, 2).
    top_m
        Its highest point, from the ground, (m,).
    """
    along = kinds.size_m[:, :2]
    size = np.stack([along, along[:, ::-1]])[None]  # (1, turned, kind, axis): the length along axis 0, or along axis 1
    fixed_m, way, whole = _fixed(found.ends_m, hidden, shown)
    centre = fixed_m[:, None, None, :] + 0.5 * way[:, None, None, :] * size
    extent = found.ends_m[..., 1] - found.ends_m[..., 0]
    range_m = np.hypot(*found.ends_m.mean(axis=2).T)
    cost = _end_cost(centre, size, found.yaw_rad, spans, range_m, tolerances)
    cost += _size_cost(size, extent, whole, tolerances)
    height_m = tolerances.height_m + tolerances.height_per_range * range_m
    cost += (((kinds.size_m[:, 2] - top_m[:, None]) / height_m[:, None]) ** 2)[:, None]
    cost -= 2.0 * np.log(kinds.share / kinds.share.sum())
    best = cost.reshape(len(cost), cost[0].size if len(cost) else 1).argmin(axis=1)
    turned, kind = np.divmod(best, len(kinds.share))
    rows = np.arange(len(cost))
    u, v = centre[rows, turned, kind].T
    c, s = np.cos(found.yaw_rad), np.sin(found.yaw_rad)
    place = c * u - s * v, s * u + c * v, 0.5 * kinds.size_m[kind, 2]
    boxes = np.column_stack([*place, kinds.size_m[kind], found.yaw_rad + turned * (0.5 * np.pi)])
    return Completed(boxes, kind, cost[rows, turned, kind])


def _fixed(
    ends_m: Floats, hidden: NDArray[np.bool_], shown: NDArray[np.bool_]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """What stays along each axis, which way the box goes on from there (0: both ways), whether both ends are sides that
    were seen; all (m, 2).

    The sensor is at 0 of both axes. One that is between the ends sees both; where both are hidden, neither is known.
    """
    low_m, high_m = ends_m[..., 0], ends_m[..., 1]
    low_seen = (~hidden[..., 0] & (low_m > 0.0)) | shown[..., 0]
    high_seen = (~hidden[..., 1] & (high_m < 0.0)) | shown[..., 1]
    low_stays = low_seen | (~hidden[..., 0] & hidden[..., 1])
    high_stays = high_seen | (~hidden[..., 1] & hidden[..., 0])
    one = np.where(low_stays, low_m, high_m)
    fixed_m = np.where(low_stays ^ high_stays, one, 0.5 * (low_m + high_m))
    return fixed_m, low_stays.astype(np.float64) - high_stays, low_seen & high_seen


def _size_cost(size: Floats, extent: Floats, whole: NDArray[np.bool_], tolerances: Tolerances) -> Floats:
    """What it costs that a box is smaller or larger than what is seen, (m, 2, kinds)."""
    larger = size - extent[:, None, None, :]
    off = np.where((larger < 0.0) | whole[:, None, None, :], larger / tolerances.over_m, larger / tolerances.under_m)
    cost: Floats = (off**2).sum(axis=3)
    return cost


def _end_cost(
    centre: Floats, size: Floats, yaw_rad: Floats, spans: Spans, range_m: Floats, tolerances: Tolerances
) -> Floats:
    """What it costs that a box ends elsewhere than its cluster and what hides it, (m, 2, kinds)."""
    corners = centre[..., None, :] + _CORNERS * size[..., None, :]
    middle = spans.middle_rad - yaw_rad
    c, s = np.cos(middle)[:, None, None, None], np.sin(middle)[:, None, None, None]
    azimuth = np.arctan2(corners[..., 1] * c - corners[..., 0] * s, corners[..., 0] * c + corners[..., 1] * s)
    right, left = -azimuth.min(axis=3), azimuth.max(axis=3)
    sigma_rad = tolerances.end_m / np.maximum(range_m, 1e-9) + tolerances.end_per_range
    cost = np.zeros(right.shape)
    for ends, seen, hidden in zip((right, left), (-spans.right_rad, spans.left_rad), spans.hidden_rad.T, strict=True):
        shown, most = seen[:, None, None], (seen + hidden)[:, None, None]
        off = np.maximum(ends - most, 0.0) + np.maximum(shown - ends, 0.0)
        cost += (off / sigma_rad[:, None, None]) ** 2
    return cost
