"""Compare models of detection on training junctions, each junction predicted by the models of the others.

    python -m benchmarks.detectability.comparison runs/queues --junction ingolstadt,hill --scenario worlds/queue

For each junction: sites of the study's grid (two locations with a sparser and a denser sensor too), frames of held-out
traffic, hits and AP of a detector. Then, from the simplest to the largest, each model of :data:`MODELS` is fitted on
all junctions but one and predicts that one: Spearman's rho of the expected detections with AP, rho among sites of one
height and sensor, and the logistic loss per vehicle-frame. Means over junctions, and differences from
``points_on_target``, have a standard error over junctions; a larger model is only better where the difference exceeds
it. ``--figure`` draws a reliability diagram of ``--model`` for every junction.

The shipped ``expected_detections`` was trained at some of these junctions. There its result is in-sample: the table
marks it, and leaves it out of the means.

Only for training junctions: what is chosen here may not be reported for them.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.across_junctions.protocol import read_protocol
from benchmarks.detectability import figures
from benchmarks.detectability.additive_fitting import TrainingRows, fit_additive
from benchmarks.detectability.additive_model import DIRECTIONS, TargetFeatures, target_features
from benchmarks.detectability.examples import AP, hits_of
from benchmarks.detectability.fitting import curve, fit_trees
from benchmarks.validity import junctions
from egvs.core import files
from egvs.core.errors import EgvsError, InputError
from egvs.scoring import target_scores
from egvs.scoring.target_scores import DetectabilityModel
from egvs.scoring.targets import TargetRecord, detection_probability, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.validation import detection_metrics
from egvs.validation.detection_metrics import ALL_OBJECTS
from egvs.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.validation.detectors import base
from egvs.validation.held_out_traffic import DEFAULT_SPACING_S, HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.sweeps import DetectedBoxes

POINTS = ("log_points",)
SHAPE = (*POINTS, "log_points_on_sides", "length_share", "width_share", "hole_m")
SHADOW = (*POINTS, "hidden_share", "log_spacing")
VIEW = ("depression_deg", "incidence_deg", "length_m", "range_m")
GAPS = ("front_gap_m", "behind_gap_m", "beside_gap_m", "link_gap")
SHIPPED = (*SHAPE, "gap_m", "depression_deg", "length_m", "range_m", "side")

Form = Literal["additive", "trees"]

MODELS: Mapping[str, tuple[Form, tuple[str, ...]]] = {
    "points": ("additive", POINTS),
    "points, hidden share, spacing": ("additive", SHADOW),
    "points, extent": ("additive", SHAPE),
    "points, extent, hidden share, spacing": ("additive", (*SHADOW, *SHAPE[1:])),
    "the same, view": ("additive", (*SHADOW, *SHAPE[1:], *VIEW)),
    "the same, view, gaps": ("additive", (*SHADOW, *SHAPE[1:], *VIEW, *GAPS)),
    "trees: as shipped": ("trees", SHIPPED),
    "trees: the same, hidden share, spacing": ("trees", (*SHIPPED, *SHADOW[1:])),
    "trees: the same, gaps": ("trees", (*SHIPPED, *SHADOW[1:], *GAPS)),
}
"""Form and features of each model. Additive models of at least 7 features also have an offset per class."""

COUNT_SCORE, SHIPPED_SCORE = "points_on_target", "expected_detections (shipped)"

OTHER_SENSORS = ("VLP-16", "OS1-128")
MIN_JUNCTIONS = 2

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SiteRows:
    """The vehicle-frames of a junction as seen from one site, n of them, and the detections from there.

    Attributes
    ----------
    group
        Height and sensor of the site.
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
        Spearman's coefficient with AP, over all sites; and the mean over groups of at least 4 sites of one height and
        sensor, weighted by sites, NaN without any.
    loss
        Mean logistic loss of vehicle-frames with points; NaN for a score that is no probability.
    """

    rho: float
    rho_in_group: float
    loss: float


def site_rows(
    name: str, folder: Path, home: Path, detector: str, frames: int, places: int, jobs: int | None
) -> list[SiteRows]:
    """Run a detector at the sites of a training junction, and return what each sees and finds.

    Parameters
    ----------
    name, folder
        The junction, and its scenario.
    home
        For what is computed.
    frames, places
        Of held-out traffic, and of the grid.
    """
    junction = junctions.ready(name, "training", folder, home / name / "world", places)
    junctions.check_unseen(junction.scenario)
    sites = list(junction.grid)
    for place, sensor in enumerate(OTHER_SENSORS, start=1):
        pole = f"g{2 * place:02d}"
        sites += [replace(s, name=f"{s.name}_{sensor}", sensor=sensor) for s in junction.grid if s.pole == pole]
    scenario = junctions.with_sites(junction.scenario, sites, home / name / "sites.csv")
    held_out = prepare_held_out_traffic(scenario, home / name / "unseen", frames, apart_s=DEFAULT_SPACING_S, jobs=jobs)
    record = TargetRecord.of(list(held_out.read()), scenario.roi.grid)
    if not len(record):
        raise InputError(f"{scenario.file}: roi", "no vehicle has its centre there", "Use traffic that passes it.")
    return [_site_rows(site, held_out, record, detector, jobs) for site in held_out.scene.sites]


def _site_rows(site: Site, held_out: HeldOutTraffic, record: TargetRecord, detector: str, jobs: int | None) -> SiteRows:
    task = SiteDetectionTask(held_out, {detector: base.make_detector(detector)})
    results = run_detectors([site], task, jobs=jobs)
    rows, _ = detection_metrics.measure_detection(list(held_out.read()), held_out.scene.roi, results)
    (ap,) = [row.measures[AP].value for row in rows if row.detector == detector and row.objects_of == ALL_OBJECTS]
    boxes = results[site.name][detector]
    assert isinstance(boxes, DetectedBoxes)
    beams = Beams.of(Scanner(held_out.scene).scan_site(site))
    visible = visible_targets(record, beams, detection_probability(held_out.scene, beams.sensor))
    shipped = target_scores.detection_chances(visible, models_for([detector]))
    group = f"{site.name.partition('h')[2].partition('_')[0]} m, {site.sensor}"
    hits = hits_of(record, [frame.boxes for frame in boxes.frames])
    return SiteRows(site.name, group, target_features(visible), hits, shipped, ap)


def models_for(detectors: Sequence[str]) -> tuple[str, ...]:
    """Return the detectors whose models stand for some detectors: their own, or all where one has none."""
    return tuple(detectors) if set(detectors) <= set(target_scores.DETECTORS) else target_scores.DETECTORS


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


def fit(rows: Sequence[TrainingRows], form: Form, names: tuple[str, ...]) -> ChanceModel:
    """Fit a model of :data:`MODELS`; all junctions have equal weight."""
    if form == "additive":
        return fit_additive(rows, names, with_classes=len(names) >= 7)
    x = np.column_stack([np.concatenate([each.features.columns[name] for each in rows]) for name in names])
    hits = np.concatenate([each.hits for each in rows])
    weight = np.concatenate([np.full(len(each.hits), len(hits) / (len(rows) * len(each.hits))) for each in rows])
    entry = fit_trees(x, hits, weight, [DIRECTIONS[name] for name in names])
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
        for title, (form, features) in MODELS.items():
            model = fit(others, form, features)
            results[title][name] = evaluate(sites, [chances_of(model, site) for site in sites])
    return results


def mean_and_error(values: Sequence[float]) -> str:
    """Return the mean of a value over junctions with its standard error, which needs two of them."""
    kept = np.array([value for value in values if not math.isnan(value)])
    if not len(kept):
        return ""
    error = kept.std(ddof=1) / math.sqrt(len(kept)) if len(kept) > 1 else math.nan
    return f"{kept.mean():.3f} ± {error:.3f}"


def shipped_training_junctions() -> frozenset[str]:
    """Return the junctions that the shipped ``expected_detections`` was trained at."""
    content = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))
    return frozenset(content["about"]["learnt_on"])


def table(
    results: Mapping[str, Mapping[str, ModelResult]], shipped_trained_at: Collection[str] | None = None
) -> Iterator[str]:
    """Yield a Markdown table: means over junctions, and the difference of rho from ``points_on_target``.

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
    yield f"| model | {' | '.join(f'rho {name}' for name in names)} | rho | minus points_on_target | in groups | loss |"
    yield f"|---|{'---:|' * (len(names) + 4)}"
    for title, by_junction in results.items():
        in_sample = trained_at if title == SHIPPED_SCORE else frozenset()
        cells = [f"{by_junction[name].rho:.3f}{' (in-sample)' if name in in_sample else ''}" for name in names]
        unseen = [name for name in names if name not in in_sample]
        cells += [mean_and_error([by_junction[name].rho for name in unseen])]
        cells += [mean_and_error([by_junction[name].rho - results[COUNT_SCORE][name].rho for name in unseen])]
        cells += [mean_and_error([by_junction[name].rho_in_group for name in unseen])]
        cells += [mean_and_error([by_junction[name].loss for name in unseen])]
        yield f"| {title} | {' | '.join(cells)} |"
    if marked := [name for name in names if name in trained_at]:
        yield ""
        yield f"In-sample: the shipped score was trained at {', '.join(marked)}; its means leave them out."


def reliability(by_junction: Mapping[str, Sequence[SiteRows]], form: Form, names: tuple[str, ...]) -> figures.Curves:
    """Return the calibration of each junction predicted by the others: probability, share found, and number."""
    rows = {name: training_rows(sites) for name, sites in by_junction.items()}
    curves = {}
    for name, sites in by_junction.items():
        model = fit([each for other, each in rows.items() if other != name], form, names)
        chances = np.concatenate([chances_of(model, site) for site in sites])
        curves[name] = curve(chances, np.concatenate([site.hits for site in sites]))
    return curves


def main(given: Sequence[str] | None = None) -> int:
    """Compare the models, and return the exit code."""
    arguments = _parser().parse_args(given)
    try:
        _run(arguments)
    except EgvsError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for worlds, traffic and results")
    parser.add_argument("--junction", default="", metavar="NAME,NAME", help="of the shipped training junctions")
    parser.add_argument("--scenario", type=Path, action="append", default=[], help="another training junction")
    parser.add_argument("--detector", default="cluster", metavar="NAME,NAME")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--places", type=int, default=6)
    parser.add_argument("--jobs", type=int)
    parser.add_argument(
        "--model",
        choices=list(MODELS),
        default=list(MODELS)[-1],
        help="of the figure (default %(default)s)",
    )
    parser.add_argument("--figure", action="store_true", help="draw reliability diagrams of --model")
    return parser


def training_folders(names: Sequence[str], scenarios: Sequence[Path]) -> dict[str, Path]:
    """Return the scenario of each junction.

    Raises
    ------
    InputError
        For a junction that is not for training in one of the studies, for two of one name, or for fewer than two.
    """
    training = [name for name, role in junctions.SHIPPED.items() if role == "training"]
    by_name = {_junction_name(path): path for path in scenarios}
    given = [*names, *map(_junction_name, scenarios)]
    held_out = [junction.name for junction in read_protocol().junctions if junction.role != "training"]
    for name in given:
        if name in held_out or ((name in names or name in junctions.SHIPPED) and name not in training):
            problem = f"expected a training junction, got {name!r}"
            raise InputError("--junction", problem, f"Use some of {', '.join(training)}.")
    if len(set(given)) < max(MIN_JUNCTIONS, len(given)):
        problem = f"expected {MIN_JUNCTIONS} or more different junctions, got {', '.join(given) or 'none'}"
        raise InputError("--junction", problem, "Each is predicted by the models of the others.")
    folders = {name: path for name, _, path in junctions.shipped(names)} if names else {}
    return folders | by_name


def _junction_name(scenario: Path) -> str:
    """Return the name of a junction: of its folder, or of the one above it, as in the larger study."""
    folder = scenario.resolve()
    return folder.parent.name if folder.name == "scenario" else folder.name


def _run(arguments: argparse.Namespace) -> None:
    names = [name for name in arguments.junction.split(",") if name]
    folders = training_folders(names, arguments.scenario)
    for detector in arguments.detector.split(","):
        by_junction = {}
        for name, folder in folders.items():
            by_junction[name] = site_rows(
                name, folder, arguments.out, detector, arguments.frames, arguments.places, arguments.jobs
            )
            print(f"{name}: {detector} from {len(by_junction[name])} sites", flush=True)
        lines = [f"{detector}", "", *table(compare(by_junction)), ""]
        files.write_text(arguments.out / f"comparison_{detector}.md", "\n".join(lines))
        print("\n".join(lines))
        if arguments.figure:
            form, features = MODELS[arguments.model]
            path = arguments.out / f"reliability_{detector}.png"
            figures.draw_reliability(path, detector, reliability(by_junction, form, features))
            print(path)


if __name__ == "__main__":
    sys.exit(main())
