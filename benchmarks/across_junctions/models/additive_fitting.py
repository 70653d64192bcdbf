r"""Fit an additive model (:mod:`benchmarks.across_junctions.models.additive_model`), with directions as bounds.

Each feature becomes ramps between neighbouring knots (quantiles of the training data), from 0 to 1. A piecewise linear
function is a sum of ramps; it rises if no coefficient is negative. The coefficients minimise the weighted mean of the
logistic loss, with every junction of equal weight, plus a ridge :math:`\lambda/2 \sum_j w_j^2`, by L-BFGS-B with
bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.across_junctions.models.additive_model import DIRECTIONS, AdditiveModel, TargetFeatures
from benchmarks.across_junctions.models.crowding import CLASSES
from egvs.core.errors import EgvsError
from egvs.core.special import expit

KNOTS = 6
"""Knots of each feature, before equal ones are merged."""

RIDGE = 1e-4
"""Lambda of the module's equation."""

DIGITS = 5
"""Significant digits of the parameters."""

MAX_ITERATIONS = 300

Floats = NDArray[np.float64]

_LIMITS: Mapping[int, tuple[float | None, float | None]] = {1: (0.0, None), -1: (None, 0.0), 0: (None, None)}


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """Vehicle-frames of one junction, as seen from all of its sites.

    Attributes
    ----------
    features
        Of the n vehicle-frames with points.
    hits
        Share of the two views in which each was found, (n,) float64.
    """

    features: TargetFeatures
    hits: Floats


def choose_knots(values: Floats, count: int = KNOTS) -> Floats:
    """Return quantiles of values, without equal ones; two that differ at least, unless all values are equal."""
    knots: Floats = np.unique(np.quantile(values, np.linspace(0.01, 0.99, count)))
    if len(knots) < 2:
        knots = np.unique([values.min(), values.max()])
    return knots


def ramps(values: Floats, knots: Floats) -> Floats:
    """Return the rise from 0 to 1 between each pair of neighbouring knots, (n, m - 1)."""
    return np.clip((values[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0)


def fit_additive(rows: Sequence[TrainingRows], names: Sequence[str], with_classes: bool = True) -> AdditiveModel:
    """Return the model of these junctions.

    Parameters
    ----------
    rows
        One for each junction.
    names
        Features to use, of :data:`benchmarks.across_junctions.models.additive_model.DIRECTIONS`. A feature that is the
        same everywhere is left out.
    with_classes
        Whether classes have offsets; the mean offset is 0 by the ridge.

    Raises
    ------
    EgvsError
        When the optimiser does not converge within :data:`MAX_ITERATIONS`.
    """
    weight = np.concatenate([np.full(len(each.hits), 1.0 / (len(rows) * len(each.hits))) for each in rows])
    hits = np.concatenate([each.hits for each in rows])
    columns = {name: np.concatenate([each.features.columns[name] for each in rows]) for name in names}
    knots = {name: choose_knots(values) for name, values in columns.items()}
    knots = {name: positions for name, positions in knots.items() if len(positions) > 1}
    blocks = [ramps(columns[name], positions).astype(np.float32) for name, positions in knots.items()]
    bounds: list[tuple[float | None, float | None]] = [(None, None)]
    for name, positions in knots.items():
        bounds += [_LIMITS[DIRECTIONS[name]]] * (len(positions) - 1)
    if with_classes:
        vehicle_class = np.concatenate([each.features.vehicle_class for each in rows])
        blocks.append((vehicle_class[:, None] == np.arange(len(CLASSES))).astype(np.float32))
        bounds += [(None, None)] * len(CLASSES)
    design = np.concatenate([np.ones((len(hits), 1), dtype=np.float32), *blocks], axis=1)

    def loss(coefficients: Floats) -> tuple[float, Floats]:
        logit = (design @ coefficients.astype(np.float32)).astype(np.float64)
        ridge = np.append(0.0, coefficients[1:])
        value = float((weight * (np.logaddexp(0.0, logit) - hits * logit)).sum() + 0.5 * RIDGE * (ridge**2).sum())
        slope = (weight * (expit(logit) - hits)).astype(np.float32) @ design
        return value, slope.astype(np.float64) + RIDGE * ridge

    start, options = np.zeros(len(bounds)), {"maxiter": MAX_ITERATIONS}
    result = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    if not result.success:
        raise EgvsError(f"the additive model of {', '.join(names)} was not fitted: L-BFGS-B: {result.message}")
    rounded = [float(f"{value:.{DIGITS}g}") for value in result.x]
    curves, at = {}, 1
    for name, positions in knots.items():
        steps = np.array(rounded[at : at + len(positions) - 1])
        at += len(steps)
        curves[name] = np.array([float(f"{p:.{DIGITS}g}") for p in positions]), np.append(0.0, np.cumsum(steps))
    offsets = np.array(rounded[at:]) if with_classes else np.zeros(len(CLASSES))
    return AdditiveModel(rounded[0], curves, offsets)
