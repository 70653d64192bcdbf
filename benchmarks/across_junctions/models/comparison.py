"""Compare models of detection on training junctions, each junction predicted by the models of the others.

From the simplest to the largest, each model of :data:`MODELS` is fitted on all junctions but one and predicts that one:
Spearman's rho of the expected detections with AP, rho within groups of sites, and the logistic loss per vehicle-frame.
Means over junctions, and differences from ``points_on_target`` and from the shipped form, have a standard error over
junctions; a larger model is only better where the difference exceeds it.

The shipped ``expected_detections`` was trained at some of these junctions. There its result is in-sample: the table
marks it, and leaves it out of the means.

Only for training junctions: what is chosen here may not be reported for them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.across_junctions.models import figures, fitting
from benchmarks.across_junctions.models.additive_fitting import TrainingRows, fit_additive
from benchmarks.across_junctions.models.additive_model import DIRECTIONS, TargetFeatures
from benchmarks.across_junctions.models.fitting import curve, equal_weights, fit_trees
from egvs.scoring import target_scores
from egvs.scoring.target_scores import FEATURES, DetectabilityModel

POINTS = ("log_points",)
SHAPE = (*POINTS, "log_points_on_sides", "length_share", "width_share", "hole_m")
SHADOW = (*POINTS, "hidden_share", "log_spacing")
VIEW = ("depression_deg", "incidence_deg", "length_m", "range_m")
GAPS = ("front_gap_m", "behind_gap_m", "beside_gap_m", "link_gap")
WITHOUT_SPACING = tuple(name for name in FEATURES if name != "log_spacing")


class ModelForm(NamedTuple):
    """Form and features of a model, and the size of its trees.

    Additive models of at least 7 features also have an offset per class.
    """

    form: Literal["additive", "trees"]
    features: tuple[str, ...]
    trees: int = fitting.TREES
    leaves: int = fitting.LEAVES


MODELS: Mapping[str, ModelForm] = {
    "points": ModelForm("additive", POINTS),
    "points, extent": ModelForm("additive", SHAPE),
    "points, extent, hidden share, spacing": ModelForm("additive", (*SHADOW, *SHAPE[1:])),
    "the same, view": ModelForm("additive", (*SHADOW, *SHAPE[1:], *VIEW)),
    "the same, view, gaps": ModelForm("additive", (*SHADOW, *SHAPE[1:], *VIEW, *GAPS)),
    "trees: without spacing": ModelForm("trees", WITHOUT_SPACING),
    "trees: as shipped": ModelForm("trees", FEATURES),
    "trees: the same, spacing of columns": ModelForm("trees", (*FEATURES, "log_column_spacing")),
    "trees: the same, hidden share": ModelForm("trees", (*FEATURES, "hidden_share")),
    "trees: the same, hidden share, gaps": ModelForm("trees", (*FEATURES, "hidden_share", *GAPS)),
    "trees: as shipped, 120 of 12 leaves": ModelForm("trees", FEATURES, 120, 12),
    "trees: as shipped, 150 of 24 leaves": ModelForm("trees", FEATURES, 150, 24),
}

COUNT_SCORE, SHIPPED_SCORE, SHIPPED_FORM = "points_on_target", "expected_detections (shipped)", "trees: as shipped"

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SiteRows:
    """The vehicle-frames of a junction as seen from one site, n of them, and the detections from there.

    Attributes
    ----------
    group
        Sites of one group are compared with each other: those of equal height.
    features, hits
        Of all vehicle-frames; the share of the two views in which each was found, (n,) float64.
    shipped
        Probability by the model of ``expected_detections`` for the same detector, (n,) float64.
    ap
        AP of the detector.
    """

    site: str
    group: str
    features: TargetFeatures
    hits: Floats
    shipped: Floats
    ap: float

    @property
    def has_points(self) -> NDArray[np.bool_]:
        """Which vehicle-frames have points, (n,)."""
        return self.features.columns["log_points"] > 0.0


@dataclass(frozen=True)
class ModelResult:
    """How well a model or score predicts a left-out junction.

    Attributes
    ----------
    rho, rho_in_group
        Spearman's coefficient with AP, over all sites; and the mean over groups of at least 4 sites, weighted by sites,
        NaN without any.
    loss
        Mean logistic loss of vehicle-frames with points; NaN for a score that is no probability.
    """

    rho: float
    rho_in_group: float
    loss: float


def models_for(detectors: Sequence[str]) -> tuple[str, ...]:
    """Return whose models stand for some detectors: their own, or those of the mean where one has none."""
    return tuple(detectors) if set(detectors) <= set(_shipped()["detectors"]) else target_scores.DETECTORS


def training_rows(sites: Sequence[SiteRows]) -> TrainingRows:
    """Return the vehicle-frames with points of all sites of a junction."""
    names = sites[0].features.columns
    columns = {name: np.concatenate([s.features.columns[name][s.has_points] for s in sites]) for name in names}
    classes = np.concatenate([s.features.vehicle_class[s.has_points] for s in sites])
    return TrainingRows(TargetFeatures(columns, classes), np.concatenate([s.hits[s.has_points] for s in sites]))


class ChanceModel(Protocol):
    """A fitted model."""

    def chances(self, features: TargetFeatures) -> Floats:
        """Return the probability of each vehicle-frame, (n,)."""


@dataclass(frozen=True, eq=False)
class TreeModel:
    """Boosted trees of the features ``names``."""

    names: tuple[str, ...]
    trees: DetectabilityModel

    def chances(self, features: TargetFeatures) -> Floats:
        """Return the probability of each vehicle-frame, (n,)."""
        return self.trees.chances(np.column_stack([features.columns[name] for name in self.names]))


def fit(rows: Sequence[TrainingRows], model: ModelForm) -> ChanceModel:
    """Fit a model; all junctions have equal weight."""
    names = model.features
    if model.form == "additive":
        return fit_additive(rows, names, with_classes=len(names) >= 7)
    x = np.column_stack([np.concatenate([each.features.columns[name] for each in rows]) for name in names])
    hits = np.concatenate([each.hits for each in rows])
    weight = equal_weights([len(each.hits) for each in rows])
    directions = [DIRECTIONS[name] for name in names]
    entry = fit_trees(x, hits, weight, directions, trees=model.trees, leaves=model.leaves)
    return TreeModel(names, DetectabilityModel.of(entry))


def chances_of(model: ChanceModel, site: SiteRows) -> Floats:
    """Return the probability of each vehicle-frame, (n,); 0 without points."""
    return np.where(site.has_points, model.chances(site.features), 0.0)


def evaluate(sites: Sequence[SiteRows], values: Sequence[Floats], is_chance: bool = True) -> ModelResult:
    """Return how well the mean of values (n,) of each site predicts its AP, and chances the hits."""
    score = np.array([value.mean() for value in values])
    ap = np.array([site.ap for site in sites])
    groups = [[i for i, site in enumerate(sites) if site.group == group] for group in {s.group: None for s in sites}]
    large = [group for group in groups if len(group) >= 4 and np.ptp(ap[group]) > 0.0 and np.ptp(score[group]) > 0.0]
    in_group = math.nan
    if large:
        rhos = [float(spearmanr(score[group], ap[group]).statistic) for group in large]
        in_group = float(np.average(rhos, weights=[len(group) for group in large]))
    loss = math.nan
    if is_chance:
        chance = np.concatenate([v[s.has_points] for v, s in zip(values, sites, strict=True)]).clip(1e-6, 1 - 1e-6)
        hits = np.concatenate([s.hits[s.has_points] for s in sites])
        loss = float(-(hits * np.log(chance) + (1.0 - hits) * np.log1p(-chance)).mean())
    return ModelResult(float(spearmanr(score, ap).statistic), in_group, loss)


def compare(by_junction: Mapping[str, Sequence[SiteRows]]) -> dict[str, dict[str, ModelResult]]:
    """Return the result of every score and model at every junction, predicted by the models of the others."""
    results: dict[str, dict[str, ModelResult]] = {name: {} for name in (COUNT_SCORE, SHIPPED_SCORE, *MODELS)}
    rows = {name: training_rows(sites) for name, sites in by_junction.items()}
    for name, sites in by_junction.items():
        counts = [site.features.columns["log_points"] for site in sites]
        results[COUNT_SCORE][name] = evaluate(sites, counts, is_chance=False)
        results[SHIPPED_SCORE][name] = evaluate(sites, [site.shipped for site in sites])
        others = [each for other, each in rows.items() if other != name]
        for title, form in MODELS.items():
            model = fit(others, form)
            results[title][name] = evaluate(sites, [chances_of(model, site) for site in sites])
    return results


def mean_and_error(values: Sequence[float]) -> str:
    """Return the mean of a value over junctions with its standard error, which needs two of them."""
    kept = np.array([value for value in values if not math.isnan(value)])
    if not len(kept):
        return ""
    error = kept.std(ddof=1) / math.sqrt(len(kept)) if len(kept) > 1 else math.nan
    return f"{kept.mean():.4f} ± {error:.4f}"


def shipped_training_junctions() -> frozenset[str]:
    """Return the junctions that the shipped ``expected_detections`` was trained at."""
    return frozenset(_shipped()["about"]["learnt_on"])


@cache
def _shipped() -> dict[str, Any]:
    """Return the content of the file of models."""
    content: dict[str, Any] = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))
    return content


def table(
    results: Mapping[str, Mapping[str, ModelResult]], shipped_trained_at: Collection[str] | None = None
) -> Iterator[str]:
    """Yield a Markdown table: means over junctions, differences from ``points_on_target`` and the shipped form.

    Parameters
    ----------
    results
        Score or model -> junction -> result.
    shipped_trained_at
        Junctions at which the shipped score was trained; those of its file when None. Its results there are marked,
        and not part of its means.
    """
    names = list(results[COUNT_SCORE])
    trained_at = shipped_training_junctions() if shipped_trained_at is None else frozenset(shipped_trained_at)
    summary = ("rho", "minus points_on_target", "minus as shipped", "in groups", "loss", "loss minus as shipped")
    yield f"| model | {' | '.join(f'rho {name}' for name in names)} | {' | '.join(summary)} |"
    yield f"|---|{'---:|' * (len(names) + len(summary))}"
    for title, by_junction in results.items():
        in_sample = trained_at if title == SHIPPED_SCORE else frozenset()
        cells = [f"{by_junction[name].rho:.3f}{' (in-sample)' if name in in_sample else ''}" for name in names]
        unseen = [name for name in names if name not in in_sample]
        found = [by_junction[name] for name in unseen]
        by_points = [results[COUNT_SCORE][name] for name in unseen]
        as_shipped = [results[SHIPPED_FORM][name] for name in unseen]
        cells += [mean_and_error([each.rho for each in found])]
        cells += [mean_and_error([each.rho - other.rho for each, other in zip(found, by_points, strict=True)])]
        cells += [mean_and_error([each.rho - other.rho for each, other in zip(found, as_shipped, strict=True)])]
        cells += [mean_and_error([each.rho_in_group for each in found])]
        cells += [mean_and_error([each.loss for each in found])]
        cells += [mean_and_error([each.loss - other.loss for each, other in zip(found, as_shipped, strict=True)])]
        yield f"| {title} | {' | '.join(cells)} |"
    if marked := [name for name in names if name in trained_at]:
        yield ""
        yield f"In-sample: the shipped score was trained at {', '.join(marked)}; its means leave them out."


def reliability(by_junction: Mapping[str, Sequence[SiteRows]], form: ModelForm) -> figures.Curves:
    """Return the calibration of each junction predicted by the others, of vehicle-frames with points."""
    each = {name: training_rows(sites) for name, sites in by_junction.items()}
    curves = {}
    for name, rows in each.items():
        model = fit([others for other, others in each.items() if other != name], form)
        curves[name] = curve(model.chances(rows.features), rows.hits)
    return curves
