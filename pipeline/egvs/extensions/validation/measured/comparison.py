"""Hold labelled sweeps against the simulation of the same boxes: points on vehicles, losses, levels.

Steps: pair sweeps with labels; find the convention of headings where it is not stated
(:mod:`egvs.extensions.validation.measured.yaw_conventions`); place the sensor
(:mod:`egvs.extensions.validation.measured.sensor_site`); let its beams meet the bodies of all boxes
(:class:`egvs.clouds.simulation.BodyCaster`), and count the beams that meet each, without losses, and the returns
expected with those of the sensor; count the measured points in each box; fit the losses to cars
(:mod:`egvs.extensions.validation.measured.return_fit`); compute what detectors and people are expected to find.

Both counts leave out the lowest part of a box (:data:`egvs.extensions.validation.measured.box_points.BOTTOM_M`), where
measured points are from the road, and so does the count on boxes beside them. Levels take the points that scores take:
all on boxes (:mod:`egvs.scoring.targets`).

Errors come from leaving out one object at a time, in all sweeps. They do not contain how far another place, another
unit or another person differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import BodyCaster, VehicleMeshes, builtin_bodies
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, Grid, IntArray
from egvs.effects.range_limit import RangeLimit
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation.detectors.base import make_detector
from egvs.extensions.validation.measured import return_fit, sensor_site, sweep_frame, yaw_conventions
from egvs.extensions.validation.measured.box_points import BOTTOM_M, points_in_boxes
from egvs.extensions.validation.measured.detection import DetectionRow, DetectorTask, detection_row
from egvs.extensions.validation.measured.ratios import Ratio, ratio_of_sums
from egvs.extensions.validation.measured.repetition import Repetition, measure_repetition
from egvs.extensions.validation.measured.return_fit import ReturnFit
from egvs.extensions.validation.measured.sensor_site import SensorSite
from egvs.formats import sweep_labels
from egvs.formats.recording_options import RecordingOptions
from egvs.formats.sweep_files import Sweep, read_sweeps
from egvs.formats.sweep_labels import LabelOptions, SweepLabels, match_labels, read_labels
from egvs.scenario.model import Scenario
from egvs.scoring.noticed import noticed_chances
from egvs.scoring.target_scores import MODELLED, chances_by_detector, detection_chances
from egvs.scoring.targets import TargetRecord, TargetVisibility, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.return_model import ReturnModel

RANGES_M = ((0, 20), (20, 30), (30, 40), (40, 60), (60, 80), (80, 120))

PEOPLE = ("pedestrian", "bicycle")
"""vClasses of labels that are no vehicles."""

ENOUGH_OBJECTS = 30
"""With fewer, a sentence says that the comparison is an anchor, not a validation."""

_SWEEP_KINDS = ("points", "sweeps")
_GRID_MARGIN_M = 10.0


@dataclass(frozen=True, eq=False)
class BoxPoints:
    """Points on the labelled boxes of all sweeps, one row for each box, n of them.

    Attributes
    ----------
    sweep
        Number of the sweep, (n,) int64.
    names, classes
        Object and class of each box.
    object
        Number of the object, (n,) int64.
    range_m
        From the sensor to the centre of the box in plan, (n,) float64.
    measured
        Measured points, (n,) int64.
    simulated, expected
        Beams that meet the body first; returns of them that are expected with the losses of the sensor, (n,) float64.
    on_box
        The same as ``expected`` on the box instead of the body, as scores count, (n,) float64; NaN for no target.
    """

    sweep: IntArray
    names: tuple[str, ...]
    classes: tuple[str, ...]
    object: IntArray
    range_m: FloatArray
    measured: IntArray
    simulated: FloatArray
    expected: FloatArray
    on_box: FloatArray

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.names)

    def of_class(self, name: str) -> BoolArray:
        """Return which boxes are of a class, (n,)."""
        return np.array([other == name for other in self.classes], dtype=np.bool_)


@dataclass(frozen=True)
class PointsRow:
    """Points on the boxes of one class at some ranges.

    Attributes
    ----------
    label
        The class.
    from_m, to_m
        The ranges; None for all.
    boxes, objects
        Their numbers.
    measured, simulated, expected
        Sums of points, as in :class:`BoxPoints`.
    without_losses, with_losses
        Simulated over measured, and expected over measured.
    """

    label: str
    from_m: int | None
    to_m: int | None
    boxes: int
    objects: int
    measured: int
    simulated: float
    expected: float
    without_losses: Ratio
    with_losses: Ratio


@dataclass(frozen=True)
class LevelRow:
    """What is expected to be found of the boxes of one group, mean over its boxes, 0 to 1, with standard errors.

    Attributes
    ----------
    group
        Name of the group.
    from_m, to_m
        The ranges; None for all.
    boxes, objects
        Their numbers.
    detectors, people
        What the models of detectors expect, and what people would notice, by the losses: "none", "sensor", "fitted",
        and with the "measured" points instead of simulated ones.
    """

    group: str
    from_m: int | None
    to_m: int | None
    boxes: int
    objects: int
    detectors: dict[str, Ratio]
    people: dict[str, Ratio]


@dataclass(frozen=True)
class Comparison:
    """Labelled sweeps beside their simulation.

    Attributes
    ----------
    site
        Pose, sensor and world.
    sweeps
        Names of the sweeps with labels.
    points
        Points on each box.
    rows
        By class and range.
    model
        Losses of the sensor as it is; None without a rated range.
    fit
        Losses fitted to cars; None with too few of them, beyond the tried values, or without a rated range.
    levels
        By group of road users.
    detections
        What detectors find of vehicles, by detector and group.
    convention
        Convention of headings that was found, and the points that boxes hold in each; None where it is stated.
    notes
        Sentences on what was assumed, left out or not told.
    """

    site: SensorSite
    sweeps: tuple[str, ...]
    points: BoxPoints
    rows: tuple[PointsRow, ...]
    model: ReturnModel | None
    fit: ReturnFit | None
    levels: tuple[LevelRow, ...]
    detections: tuple[DetectionRow, ...]
    convention: tuple[str, dict[str, int]] | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ComparisonRequest:
    """What is compared.

    Attributes
    ----------
    sweeps, labels
        Files or folders.
    sensor, site
        Name of the sensor, and of the site of the scenario; None where the scenario says them.
    yaw
        Convention of headings; None to find it where it is not stated.
    columns
        Columns of a table of labels, see :class:`egvs.formats.sweep_labels.LabelOptions`.
    recording
        What is read of recordings.
    detectors
        Names of detectors that run on the sweeps.
    """

    sweeps: tuple[Path, ...]
    labels: tuple[Path, ...]
    sensor: str | None = None
    site: str | None = None
    yaw: str | None = None
    columns: dict[str, str] | None = None
    recording: RecordingOptions | None = None
    detectors: tuple[str, ...] = ()


def compare_labelled(request: ComparisonRequest, scenario: Scenario | None = None) -> Comparison:
    """Hold labelled sweeps against the simulation.

    Parameters
    ----------
    request
        Sweeps, labels, and how to read them.
    scenario
        Static world, pose, sensor and losses; without one, the world is the ground plane of the sweeps.

    Raises
    ------
    InputError
        If a file cannot be read, labels and sweeps do not belong together, the sensor or the site is unknown, or the
        convention of headings is not clear.
    """
    sweeps = _read_sweeps(request)
    labels = read_labels(request.labels, LabelOptions(request.columns or {}), sweeps)
    pairs, notes = match_labels(sweeps, labels)
    convention = None
    if request.yaw is not None:
        pairs = [(sweep, yaw_conventions.in_convention(item, request.yaw)) for sweep, item in pairs]
    elif not all(item.states_yaw for _, item in pairs):
        convention = yaw_conventions.find_convention(pairs)
        pairs = [(sweep, yaw_conventions.in_convention(item, convention[0])) for sweep, item in pairs]
    if not any(len(item) for _, item in pairs):
        raise InputError(request.labels[0], "expected boxes of road users, got none", "Give labels with boxes.")

    site = _find_site(request, scenario, [sweep for sweep, _ in pairs])
    other_rings = sweep_frame.describe_other_rings(site, [sweep for sweep, _ in pairs])
    site, pairs = sweep_frame.stand_upright(site, pairs)
    model = return_model(site, scenario)
    frames = [site.frame(number, item) for number, (_, item) in enumerate(pairs)]
    hits = [BoxBeams.cast(site, frame) for frame in frames]
    visible = visible_boxes(site, frames, model)
    points = _count_points(pairs, site, hits, model)
    fit = None if model is None or other_rings else _fit_cars(points, hits, frames, model)
    levels = _levels(site, frames, points, model, fit)
    return Comparison(
        site=site,
        sweeps=tuple(sweep.name for sweep, _ in pairs),
        points=points,
        rows=tuple(point_rows(points)),
        model=model,
        fit=fit,
        levels=tuple(levels),
        detections=tuple(_detections(request.detectors, site, pairs, frames, points, visible, model)),
        convention=convention,
        notes=(
            *([f"{other_rings} No losses are fitted."] if other_rings else []),
            *site.assumptions,
            *notes,
            *_few_objects(points, pairs, fit, model, has_rings=not other_rings),
        ),
    )


def compare_unlabelled(request: ComparisonRequest, scenario: Scenario | None = None) -> Repetition:
    """Return which returns of several sweeps of one place repeat; parameters and errors as :func:`compare_labelled`."""
    sweeps = _read_sweeps(request)
    sensor = sensor_site.find_sensor(request.sensor, scenario)
    turned = sensor_site.is_inverted(request.sensor, scenario)
    return measure_repetition(sensor_site.on_ground_plane(sensor, sweeps, is_inverted=turned), sweeps)


def _read_sweeps(request: ComparisonRequest) -> list[Sweep]:
    sweeps = read_sweeps(sweep_labels.list_files(request.sweeps, *_SWEEP_KINDS), request.recording)
    if not sweeps:
        hint = "Give point clouds (PCD, PLY, LAS, CSV, E57, .bin, .npz) or recordings of ROS."
        raise InputError(request.sweeps[0], "expected sweeps, got none", hint)
    return sweeps


def _find_site(request: ComparisonRequest, scenario: Scenario | None, sweeps: Sequence[Sweep]) -> SensorSite:
    if scenario is not None and (request.site is not None or request.sensor is None):
        return sweep_frame.find_frame(sensor_site.in_scenario(scenario, request.site, request.sensor), sweeps)
    if request.site is not None:
        raise InputError("--site", "expected a scenario with this site, got none", "Name the scenario.")
    sensor = sensor_site.find_sensor(request.sensor, scenario)
    return sensor_site.on_ground_plane(sensor, sweeps, is_inverted=sensor_site.is_inverted(request.sensor, scenario))


def return_model(site: SensorSite, scenario: Scenario | None) -> ReturnModel | None:
    """Return the losses of the sensor, with the values that the scenario replaces; None without a rated range."""
    parameters = None
    if scenario is not None and scenario.effects.range_limit:
        parameters = scenario.effects.range_limit
    if site.sensor.rated_range_m is None and (parameters is None or parameters.rated_range_m is None):
        return None
    return ReturnModel.of(site.sensor, parameters)


@dataclass(frozen=True, eq=False)
class BoxBeams:
    """Beams that meet the bodies of a frame, above their lowest part.

    Attributes
    ----------
    owner
        Box that each meets, (k,) int64.
    range_m, weight
        Range, and share of its beam, (k,) float64.
    row
        Row of the empty scan, (k,) int64.
    """

    owner: IntArray
    range_m: FloatArray
    weight: FloatArray
    row: IntArray

    @classmethod
    def cast(cls, site: SensorSite, frame: TrafficFrame) -> BoxBeams:
        """Let the beams of a site meet the bodies of a frame."""
        caster = BodyCaster(site.directions, VehicleMeshes.from_parts(builtin_bodies()))
        hits = caster.cast(frame, site.pose.position_m, site.range_m.copy(), np.zeros(len(site.range_m)))
        row = np.flatnonzero(hits.owner >= 0)
        owner = hits.owner[row].astype(np.int64)
        z_m = site.pose.z_m + hits.range_m[row] * site.directions[row, 2]
        bottom_m = frame.boxes[owner, 2] - frame.boxes[owner, 5] / 2
        above = z_m >= bottom_m + BOTTOM_M
        row, owner = row[above], owner[above]
        return cls(owner, hits.range_m[row], site.weight[row], row)

    def probabilities(self, frame: TrafficFrame, model: ReturnModel | None) -> FloatArray:
        """Return the probability that each return is detected, by range and class, (k,) float64."""
        if model is None:
            return np.ones(len(self.range_m))
        reflectivity = np.array([model.target_reflectivity(kind) for kind in frame.kinds])
        return model.probability(self.range_m, reflectivity[self.owner])


def visible_boxes(site: SensorSite, frames: Sequence[TrafficFrame], model: ReturnModel | None) -> TargetVisibility:
    """Return what scores see of all boxes, people among them."""
    boxes = np.concatenate([frame.boxes for frame in frames])
    low = np.floor(boxes[:, :3].min(axis=0) - _GRID_MARGIN_M)
    shape = np.ceil(boxes[:, :3].max(axis=0) + _GRID_MARGIN_M - low).astype(int).tolist()
    grid = Grid((float(low[0]), float(low[1]), float(low[2])), 1.0, (shape[0], shape[1], shape[2]))
    record = TargetRecord.of(list(frames), grid, PEOPLE)
    weight = None if (site.weight == 1.0).all() else site.weight
    beams = Beams(site.pose, site.sensor, site.range_m[:, None] * site.directions, weight)
    losses = None if model is None else ReturnProbability((RangeLimit.of(model),), site.sensor)
    return visible_targets(record, beams, losses)


def _count_points(
    pairs: Sequence[tuple[Sweep, SweepLabels]],
    site: SensorSite,
    hits: Sequence[BoxBeams],
    model: ReturnModel | None,
) -> BoxPoints:
    names = tuple(name for _, item in pairs for name in item.names)
    boxes = np.concatenate([site.to_world(item.boxes) for _, item in pairs])
    without_bottom = []
    for number, (_, item) in enumerate(pairs):
        frame = site.frame(number, item)
        upper = frame.boxes + np.array([0.0, 0.0, 0.5 * BOTTOM_M, 0.0, 0.0, -BOTTOM_M, 0.0])
        upper[:, 5] = np.maximum(upper[:, 5], BOTTOM_M)
        without_bottom.append(replace(frame, boxes=upper))
    visible = visible_boxes(site, without_bottom, model)
    on_box = np.full(len(names), np.nan)
    on_box[visible.record.row] = visible.points
    simulated, expected = [], []
    for number, beams in enumerate(hits):
        frame = site.frame(number, pairs[number][1])
        count = len(frame.kinds)
        simulated.append(np.bincount(beams.owner, weights=beams.weight, minlength=count))
        returns = beams.weight * beams.probabilities(frame, model)
        expected.append(np.bincount(beams.owner, weights=returns, minlength=count))
    return BoxPoints(
        sweep=np.repeat(np.arange(len(pairs)), [len(item) for _, item in pairs]),
        names=names,
        classes=tuple(name for _, item in pairs for name in item.classes),
        object=np.unique(np.array(names, dtype=np.str_), return_inverse=True)[1].astype(np.int64),
        range_m=np.hypot(*(boxes[:, :2] - site.pose.position_m[:2]).T),
        measured=np.concatenate([points_in_boxes(sweep.points_m, item.boxes) for sweep, item in pairs]),
        simulated=np.concatenate(simulated),
        expected=np.concatenate(expected),
        on_box=on_box,
    )


def _fit_cars(
    points: BoxPoints, hits: Sequence[BoxBeams], frames: Sequence[TrafficFrame], model: ReturnModel
) -> ReturnFit | None:
    starts = np.cumsum([0, *(len(frame.kinds) for frame in frames)])
    owner = np.concatenate([beams.owner + start for beams, start in zip(hits, starts[:-1], strict=True)])
    range_m = np.concatenate([beams.range_m for beams in hits])
    weight = np.concatenate([beams.weight for beams in hits])
    cars = points.of_class("car")
    number = np.cumsum(cars) - 1
    on_cars = cars[owner]
    return return_fit.fit_returns(
        points.measured[cars], number[owner[on_cars]], range_m[on_cars], weight[on_cars], points.object[cars], model
    )


def point_rows(points: BoxPoints) -> list[PointsRow]:
    """Return the table of points by class and range; classes in the order of their numbers of boxes."""
    names = [name for name in dict.fromkeys(points.classes) if name != "other"]
    rows = []
    for name in sorted(names, key=lambda name: -points.classes.count(name)):
        for ranges_m, boxes in _by_range(points, points.of_class(name)):
            rows.append(_points_row(points, boxes, name, ranges_m))
    return rows


def _by_range(points: BoxPoints, boxes: BoolArray) -> Iterator[tuple[tuple[int, int] | tuple[None, None], BoolArray]]:
    """Yield all of some boxes (n,), and those in each of the ranges if they are in several."""
    yield (None, None), boxes
    for from_m, to_m in RANGES_M:
        within = boxes & (points.range_m >= from_m) & (points.range_m < to_m)
        if within.any() and within.sum() < boxes.sum():
            yield (from_m, to_m), within


def _points_row(
    points: BoxPoints, boxes: BoolArray, name: str, ranges_m: tuple[int, int] | tuple[None, None]
) -> PointsRow:
    measured, simulated, expected = points.measured[boxes], points.simulated[boxes], points.expected[boxes]
    objects = points.object[boxes]
    return PointsRow(
        label=name,
        from_m=ranges_m[0],
        to_m=ranges_m[1],
        boxes=int(boxes.sum()),
        objects=len(np.unique(objects)),
        measured=int(measured.sum()),
        simulated=float(simulated.sum()),
        expected=float(expected.sum()),
        without_losses=ratio_of_sums(simulated, measured, objects),
        with_losses=ratio_of_sums(expected, measured, objects),
    )


GROUPS = {
    "cars": ("car",),
    "larger vehicles": ("van", "truck", "trailer", "bus", "tram"),
    "people": ("pedestrian", "bicycle", "motorcycle"),
}
"""Groups of classes with a curve of people each (:mod:`egvs.scoring.noticed`)."""


def _levels(
    site: SensorSite,
    frames: Sequence[TrafficFrame],
    points: BoxPoints,
    model: ReturnModel | None,
    fit: ReturnFit | None,
) -> list[LevelRow]:
    views: dict[str, TargetVisibility] = {"none": visible_boxes(site, frames, None)}
    if model is not None:
        views["sensor"] = visible_boxes(site, frames, model)
    if model is not None and fit is not None:
        fitted = replace(model, rated_range_m=fit.rated_range_m, softness=fit.softness)
        views["fitted"] = visible_boxes(site, frames, fitted)
    last = views["sensor" if model is not None else "none"]
    views["measured"] = replace(last, points=points.measured[last.record.row].astype(np.float64))

    row_of_box = np.full(len(points), -1)
    row_of_box[last.record.row] = np.arange(len(last))
    rows = []
    for name, classes in GROUPS.items():
        of_group = np.isin(points.classes, classes)
        for (from_m, to_m), boxes in _by_range(points, of_group) if of_group.any() else ():
            members, objects = row_of_box[boxes], points.object[boxes]

            def means(
                chances: Callable[[TargetVisibility], FloatArray],
                members: IntArray = members,
                objects: IntArray = objects,
            ) -> dict[str, Ratio]:
                ones = np.ones(len(members))
                return {key: ratio_of_sums(chances(view)[members], ones, objects) for key, view in views.items()}

            detectors = {} if name == "people" else means(detection_chances)
            people, count = means(noticed_chances), len(np.unique(objects))
            rows.append(LevelRow(name, from_m, to_m, len(members), count, detectors, people))
    return rows


def _detections(
    names: Sequence[str],
    site: SensorSite,
    pairs: Sequence[tuple[Sweep, SweepLabels]],
    frames: Sequence[TrafficFrame],
    points: BoxPoints,
    visible: TargetVisibility,
    model: ReturnModel | None,
) -> Iterator[DetectionRow]:
    """Yield what detectors find of cars and of larger vehicles."""
    chosen = [make_detector(name) for name in names]
    if not chosen:
        return
    points_m = [sweep_frame.in_sensor_frame(site, sweep.points_m) for sweep, _ in pairs]
    task = DetectorTask.of(site, points_m, frames, model)
    for detector in chosen:
        found, chances = task.run(detector), None
        if detector.NAME in MODELLED:
            chances = np.zeros(len(points))
            chances[visible.record.row] = chances_by_detector(visible, [detector.NAME])[0]
        for group in ("cars", "larger vehicles"):
            of_group = np.isin(points.classes, GROUPS[group])
            for ranges_m, members in _by_range(points, of_group) if of_group.any() else ():
                yield detection_row(detector.NAME, (group, *ranges_m), found, members, points.object, chances)


def _few_objects(
    points: BoxPoints,
    pairs: Sequence[tuple[Sweep, SweepLabels]],
    fit: ReturnFit | None,
    model: ReturnModel | None,
    *,
    has_rings: bool,
) -> list[str]:
    """Return sentences on what these labels cannot tell; ``has_rings`` says whether the rings are the sensor's."""
    notes = []
    if not all(item.has_tracks for _, item in pairs) and len(pairs) > 1:
        notes.append("The labels have no tracks: each box counts as an object of its own, so errors are too small.")
    cars = points.of_class("car")
    objects = len(np.unique(points.object[cars]))
    if objects < ENOUGH_OBJECTS:
        notes.append(
            f"{objects} different cars in {len(pairs)} sweeps are an anchor, not a validation: the errors do not "
            "contain how far another place or unit differs."
        )
    if model is None:
        notes.append("The sensor has no rated range, so no losses are simulated or fitted: add rated_range_m.")
    elif not has_rings:
        pass
    elif fit is None and objects >= return_fit.MIN_OBJECTS and points.measured[cars].any():
        low_m, high_m = return_fit.LIMITS_M[[0, -1]]
        notes.append(
            f"Losses are not fitted: the points on cars put the range at which half of the returns are lost beyond "
            f"the tried {low_m:.0f} to {high_m:.0f} m."
        )
    elif fit is None:
        notes.append(f"Losses are not fitted: expected at least {return_fit.MIN_OBJECTS} different cars with points.")
    return notes
