r"""Published measures of point clouds that scores are compared with.

**Normalised uniformity coefficient** (``nuc``; Cai et al. 2023, arXiv 2211.15975, and the program PCSim that its
authors released): discs of 0.7 m radius, centred on returns that are drawn at random, 6000 of them or as many as there
are. With N the returns on road and sidewalk, :math:`n_i` those within disc i, and p the area of a disc as a share of
the area of road and sidewalk,

.. math:: NUC = \sqrt{\frac{1}{D} \sum_i \left( \frac{n_i}{N p} - \overline{n / (N p)} \right)^2}

With effects that lose returns, each return counts with its probability, as a centre too.
The released program takes a rectangle for the area, which scales the value of all sites of a junction alike. Not
stated: how returns are drawn where there are fewer than 6000 (here: each of them once). Labels of the surface come from
CARLA there. Here the road is where the TPOG has traffic; the sidewalk is what lies within ``sidewalk_m`` of it.

**Vehicle grid occupancy** (``vehicle_grid_occupancy``, after He et al. 2024, arXiv 2407.17942, who call their measure
PE-VGOP): the points on a vehicle, in its own frame, are projected on top, side and front; each view has a grid; the
share of occupied cells is taken as a probability P, and its entropy as the score. Abstract and summaries of the paper
state that much. Not stated there, and therefore tried (``sweep``): the size of a cell; whether each view has an entropy
or all three together; and which entropy, that of an event,
:math:`-P \log_2 P - (1 - P) \log_2 (1 - P)`, or its one term :math:`-P \log_2 P`. ``share`` is P itself, to tell what
the entropy adds. Another base of the logarithm multiplies all values by the same number, so it is not tried. Also not
stated: which vehicles. Here they are the vehicle-frames of all scores of vehicles, with occlusion by each other.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.special import entr

from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.validation.surrogates import SiteEvidence, SurrogateScore

# ---- normalised uniformity coefficient

DISCS, DISC_RADIUS_M = 6000, 0.7

_SEED = 0


def nuc(evidence: SiteEvidence, sidewalk_m: float) -> float:
    """Return the normalised uniformity coefficient of returns on road and sidewalk; NaN without such a return.

    Parameters
    ----------
    evidence
        Occupancy, returns and visible vehicles of the site.
    sidewalk_m
        Width of the sidewalk beside the road.
    """
    xy_m, weight, area_m2 = _returns_on_ground(evidence, sidewalk_m)
    total = math.fsum(weight)
    if not total > 0.0:
        return math.nan
    centres = np.random.default_rng(_SEED).permutation(len(xy_m))[:DISCS]
    share = _disc_weights(xy_m, weight, centres) / (total * (math.pi * DISC_RADIUS_M**2 / area_m2))
    of_centre = weight[centres]
    mean = math.fsum(of_centre * share) / math.fsum(of_centre)
    return math.sqrt(math.fsum(of_centre * (share - mean) ** 2) / math.fsum(of_centre))


def _disc_weights(xy_m: FloatArray, weight: FloatArray, centres: IntArray) -> FloatArray:
    """Return the weight of the returns in the disc around each centre, (discs,)."""
    tree = cKDTree(xy_m)
    if (weight == 1.0).all():
        counts: FloatArray = tree.query_ball_point(xy_m[centres], DISC_RADIUS_M, return_length=True).astype(np.float64)
        return counts
    return np.array([math.fsum(weight[rows]) for rows in tree.query_ball_point(xy_m[centres], DISC_RADIUS_M)])


def _returns_on_ground(evidence: SiteEvidence, sidewalk_m: float) -> tuple[FloatArray, FloatArray, float]:
    """Return the returns on road and sidewalk: position in the grid's frame (k, 2), weight (k,); and the area, m2.

    A return lies on the ground if it is not higher than the lowest layer that is ever occupied in the nearest column of
    the road.
    """
    grid = evidence.occupancy.tpog.grid
    lowest = evidence.occupancy.lowest
    no_returns = np.empty((0, 2)), np.empty(0), 0.0
    if not (lowest >= 0).any():
        return no_returns
    away, nearest = distance_transform_edt(lowest < 0, return_indices=True)
    is_ground = away * grid.voxel_m <= sidewalk_m + 1e-9
    layer = lowest[tuple(nearest)]
    position_m, weight = evidence.returns
    with np.errstate(invalid="ignore"):
        index = np.floor(position_m / grid.voxel_m)
    inside = ((index[:, :2] >= 0) & (index[:, :2] < grid.shape[:2])).all(axis=1) & (weight > 0.0)
    ix, iy = index[inside, :2].astype(np.int64).T
    on_ground = is_ground[ix, iy] & (index[inside, 2] <= layer[ix, iy])
    area_m2 = float(np.count_nonzero(is_ground)) * grid.voxel_m**2
    return position_m[inside][on_ground, :2], weight[inside][on_ground], area_m2


# ---- vehicle grid occupancy

VIEWS = {"top": (0, 1), "side": (0, 2), "front": (1, 2)}
"""Axes of a vehicle that each view shows: 0 length, 1 width, 2 height."""


def vehicle_grid_occupancy(evidence: SiteEvidence, cell_m: float, views: str, entropy: str) -> float:
    """Return the mean over vehicles and frames of the entropy of occupied cells, in bits; NaN without any vehicle.

    Parameters
    ----------
    evidence
        Occupancy, returns and visible vehicles of the site.
    cell_m
        Edge of a cell. The last cells of a row may extend beyond the vehicle.
    views
        ``"each"``: mean of the entropies of the three views; ``"together"``: entropy of the cells of all three.
    entropy
        ``"event"``, ``"term"``, or ``"share"`` for P itself.
    """
    size_m = evidence.vehicles.record.boxes[:, 3:6]
    if not len(size_m):
        return math.nan
    counts = [occupied_cells(evidence, axes, cell_m) for axes in VIEWS.values()]
    if views == "together":
        occupied, cells = np.sum(counts, axis=0)
        values = _entropy_bit(occupied / cells, entropy)
    else:
        values = np.mean([_entropy_bit(occupied / cells, entropy) for occupied, cells in counts], axis=0)
    return math.fsum(values) / len(values)


def occupied_cells(evidence: SiteEvidence, axes: tuple[int, int], cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Return the expected number of cells with a point, and of all cells, of each vehicle in one view, (n,) each.

    Points are detected independently of each other, so a cell is empty with the product of the probabilities that each
    of its points is lost.
    """
    size_m = evidence.vehicles.record.boxes[:, 3:6][:, axes]
    vehicle, at_m, probability = evidence.vehicle_points
    shape = np.maximum(np.ceil(size_m / cell_m - 1e-9), 1.0).astype(np.int64)
    cells = shape.prod(axis=1)
    first = np.append(0, np.cumsum(cells))
    index = np.floor((at_m[:, axes] + size_m[vehicle] / 2.0) / cell_m).astype(np.int64)
    index = np.clip(index, 0, shape[vehicle] - 1)
    cell = first[vehicle] + index[:, 0] * shape[vehicle, 1] + index[:, 1]
    with np.errstate(divide="ignore"):  # a point that is certain
        log_empty = np.bincount(cell, np.log1p(-probability), minlength=first[-1])
    occupied = 0.0 - np.expm1(log_empty)
    return np.add.reduceat(occupied, first[:-1]), cells.astype(np.float64)


def _entropy_bit(share: FloatArray, entropy: str) -> FloatArray:
    if entropy == "share":
        return share
    values: FloatArray = entr(share) / math.log(2.0)
    if entropy == "event":
        values = values + entr(1.0 - share) / math.log(2.0)
    return values


# ---- entry points

NUC = SurrogateScore(
    "nuc",
    "standard deviation of the share of returns in 6000 discs of 0.7 m on road and sidewalk, relative to even returns",
    "Cai et al. 2023, arXiv 2211.15975, and its program PCSim; surfaces from the TPOG",
    -1,
    nuc,
    ("returns",),
    {"sidewalk_m": (0.0, 3.0)},
)
VEHICLE_GRID_OCCUPANCY = SurrogateScore(
    "vehicle_grid_occupancy",
    "mean over vehicles and frames of the entropy of the share of occupied cells in three views of it, in bits",
    "after He, Cao, Su, Liu 2024, arXiv 2407.17942 (PE-VGOP), which does not state cells, entropy and views",
    1,
    vehicle_grid_occupancy,
    ("vehicles", "vehicle_points"),
    {"cell_m": (0.1, 0.2, 0.4), "views": ("each", "together"), "entropy": ("event", "term", "share")},
)
