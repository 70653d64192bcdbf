"""Compare lists of labels of one place: of what one has, what does the other have?

Two sensors of one place are labelled, each by itself. A box of one list that also stands in the other, within
:data:`egvs.extensions.validation.measured.list_poses.NEAR_M` in plan, was noticed in the sweep of the other sensor. The
share of boxes that were noticed is an answer to "how many points does it take?" which no simulation gives. Detections
of one sensor take the place of the second list: then it is the share with a box of the detector.

Steps, for each list that is *tested* by the others: pair sweeps by time or name; place boxes of both lists above the
tested sensor; let boxes of the others, and those that only the tested list has, hide one another; count the points that
the simulation, with the losses of the sensor, puts on each box (on boxes, as scores count); compare the share that was
noticed with the curves of :mod:`egvs.scoring.noticed` and with the models of detectors, by group, range and points.

Vehicles are found by vehicles, people and bicycles by people and bicycles, all by boxes of no known class. Some boxes
are found by chance, in queues: the share that stands in the list 60 s later says how many. Places where the tested list
never has a box of a road user, although others have 20 different ones there, are not in its labelled area, and are left
out; a detector has none.

Errors come from leaving out 20 s at a time, or, of shorter recordings, one object at a time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.wording import number_of
from egvs.extensions.validation.measured import sensor_site, yaw_conventions
from egvs.extensions.validation.measured.comparison import (
    ENOUGH_OBJECTS,
    GROUPS,
    RANGES_M,
    return_model,
    visible_boxes,
)
from egvs.extensions.validation.measured.list_pairs import LabelList, PlacedPair, match_boxes, place_pairs
from egvs.extensions.validation.measured.list_poses import NEAR_M
from egvs.extensions.validation.measured.ratios import FEW_OBJECTS, Ratio, ratio_of_sums
from egvs.extensions.validation.measured.sensor_site import SensorSite
from egvs.formats.sweep_labels import (
    VCLASSES,
    LabelOptions,
    SweepLabels,
    read_labels,
)
from egvs.scenario.model import Scenario
from egvs.scoring.noticed import DATA_FILE, FARTHEST_M, noticed_chances
from egvs.scoring.target_scores import detection_chances
from egvs.sensors.return_model import ReturnModel

NEARER_M = 1.5
"""The share within this distance is printed, too."""

BLOCK_S = 20.0
"""Time that is left out at once."""

CHANCE_SHIFT_S = 60.0
"""Boxes that stand in the other list so much later match by chance."""

PLACE_M = 10.0
FEWEST_AT_PLACE = 20
"""A place of this size is left out if the list has no label there and beside it, where so many objects were."""

SCORES = (0.0, 0.3, 0.5, 0.7)
"""Lowest scores of detections for which shares are printed."""

_LATE_S = 5.0
_FEWEST_TO_SHIFT = 20
_MOST_TO_TURN = 100
"""Pairs of sweeps for which the level is computed in other conventions of headings."""


@dataclass(frozen=True)
class AgreementRequest:
    """What is compared.

    Attributes
    ----------
    labels
        File or folder of each list.
    detections
        File or folder of the detections of a detector in the sweeps of the only list of labels.
    sensors, sites
        Name of the sensor and of the site of each list, or one sensor for all; empty where unknown.
    yaw
        Convention of headings where it is not stated.
    columns
        Columns of tables, see :class:`egvs.formats.sweep_labels.LabelOptions`.
    """

    labels: tuple[Path, ...]
    detections: Path | None = None
    sensors: tuple[str, ...] = ()
    sites: tuple[str, ...] = ()
    yaw: str | None = None
    columns: dict[str, str] | None = None


@dataclass(frozen=True)
class AgreementRow:
    """Boxes of one group: what of them the tested list has, and what should be noticed.

    Attributes
    ----------
    group
        Name of the group.
    low, high
        Ranges in metres, or points; infinity where there is no upper bound.
    boxes, objects
        Their numbers.
    found, found_nearer
        Share with a box of the tested list within 3 m, and within 1.5 m.
    by_chance
        Share with such a box in the list 60 s later.
    people, detectors
        What people should notice, and what the models of detectors expect; None without a sensor, and the latter for
        people.
    difference
        People's level minus ``found``.
    """

    group: str
    low: float
    high: float
    boxes: int
    objects: int
    found: Ratio
    found_nearer: Ratio
    by_chance: Ratio
    people: Ratio | None
    detectors: Ratio | None
    difference: Ratio | None


@dataclass(frozen=True)
class ScoreRow:
    """Detections with at least some score.

    Attributes
    ----------
    score
        The lowest score.
    detections
        Their number.
    found, found_nearer
        Share of the cars with one within 3 m, and within 1.5 m.
    alone
        Detections in a sweep without a labelled road user within 1.5 m.
    """

    score: float
    detections: int
    found: Ratio
    found_nearer: Ratio
    alone: float


@dataclass(frozen=True)
class ComparedList:
    """One list, tested by the others.

    Attributes
    ----------
    name
        Of the list.
    others
        Names of the other lists.
    is_detections
        Whether the list is of a detector.
    sensor, losses
        Its sensor and its losses, if known.
    sweeps
        Number of pairs of sweeps.
    rows, point_rows
        By group and range, and by group and simulated points.
    score_rows
        By the score of detections; empty for labels.
    notes
        Sentences on what was assumed, left out or not told.
    """

    name: str
    others: tuple[str, ...]
    is_detections: bool
    sensor: str | None
    losses: ReturnModel | None
    sweeps: int
    rows: tuple[AgreementRow, ...]
    point_rows: tuple[AgreementRow, ...]
    score_rows: tuple[ScoreRow, ...]
    notes: tuple[str, ...]


def compare_lists(request: AgreementRequest, scenario: Scenario | None = None) -> list[ComparedList]:
    """Judge lists of labels of one place by one another, or detections by labels.

    Parameters
    ----------
    request
        The lists, and how to read them.
    scenario
        Static world, poses and losses; without one, only boxes hide other boxes.

    Raises
    ------
    InputError
        If a file cannot be read, sweeps do not belong together, frames do not fit, or a sensor or a site is unknown.
    """
    if request.detections is not None:
        (labels,) = (_read_list(request, number, scenario) for number in range(len(request.labels)))
        items = read_labels((request.detections,), LabelOptions(request.columns or {}))
        detections = replace(labels, path=request.detections, labels=_in_one_convention(request, items))
        return _with_boxes([_compare(detections, [labels], request, scenario, is_detections=True)], request)
    lists = [_read_list(request, number, scenario) for number in range(len(request.labels))]
    tested = []
    for number, item in enumerate(lists):
        tested.append(_compare(item, [*lists[:number], *lists[number + 1 :]], request, scenario))
    return _with_boxes(tested, request)


def _with_boxes(tested: list[ComparedList], request: AgreementRequest) -> list[ComparedList]:
    """Return the results; InputError if no box is of a known class and in reach."""
    if not any(item.rows for item in tested):
        problem = f"expected vehicles or people within {RANGES_M[-1][1]} m of the other sensor, got none"
        raise InputError(request.labels[0], problem, "Check classes, units (metres) and frames of the labels.")
    return tested


def _read_list(request: AgreementRequest, number: int, scenario: Scenario | None) -> LabelList:
    path = request.labels[number]
    items = read_labels((path,), LabelOptions(request.columns or {}))
    if not any(len(item) for item in items):
        raise InputError(path, "expected boxes of road users, got none", "Give labels with boxes.")
    labels = _in_one_convention(request, items)
    sensor = request.sensors[number if len(request.sensors) > 1 else 0] if request.sensors else None
    if request.sites and scenario is not None:
        site = sensor_site.in_scenario(scenario, request.sites[number], sensor)
        return LabelList(path, labels, site.pose, site, site.assumptions[0], is_in_scenario=True)
    pose, note = sensor_site.pose_above_boxes(labels)
    known = None
    if sensor is not None:
        known = sensor_site.in_the_open(sensor_site.find_sensor(sensor, scenario), pose, note)
    return LabelList(path, labels, pose, known, note, is_in_scenario=False)


def _in_one_convention(request: AgreementRequest, items: Sequence[SweepLabels]) -> tuple[SweepLabels, ...]:
    if request.yaw is None:
        return tuple(items)
    return tuple(yaw_conventions.in_convention(item, request.yaw) for item in items)


@dataclass(frozen=True, eq=False)
class _Sample:
    """Boxes of the other lists, n of them.

    Attributes
    ----------
    classes
        Class of each.
    boxes
        In the world of the tested list, (n, 7) float64.
    objects, blocks
        Object and block of time of each, (n,) int64.
    range_m
        From the tested sensor, in plan, (n,) float64.
    found, found_nearer
        Whether the tested list has it, within 3 m and 1.5 m, (n,) bool.
    by_chance
        Whether the tested list has one there 60 s later, (n,) float64; NaN where it does not last so long.
    points, people, detectors
        Simulated points with losses, and what follows, (n,) float64; NaN without a sensor.
    used
        Which are in the labelled area, (n,) bool.
    """

    classes: NDArray[np.str_]
    boxes: FloatArray
    objects: IntArray
    blocks: IntArray
    range_m: FloatArray
    found: BoolArray
    found_nearer: BoolArray
    by_chance: FloatArray
    points: FloatArray
    people: FloatArray
    detectors: FloatArray
    used: BoolArray


def _compare(
    tested: LabelList,
    others: Sequence[LabelList],
    request: AgreementRequest,
    scenario: Scenario | None,
    *,
    is_detections: bool = False,
) -> ComparedList:
    pairs: list[PlacedPair] = []
    names: list[str] = []
    notes = [f"{tested.pose_note[:1].upper()}{tested.pose_note[1:].removesuffix('.')}."]
    for number, other in enumerate(others):
        placed, of_pair = place_pairs(tested, other)
        notes += of_pair
        pairs += placed
        names += [f"{number} {name}" for pair in placed for name in pair.other.names]
    model = None if tested.site is None else return_model(tested.site, scenario)
    sample, block_note = _sample(tested, pairs, names, model)
    if is_detections:  # a detector has no labelled area
        sample = replace(sample, used=np.ones(len(sample.used), dtype=np.bool_))
    if not sample.found.any():
        notes.append(f"No box is within {NEAR_M:g} m of any of the others: the frames of the lists may differ.")
    notes += [*block_note, *_area_notes(sample), *_size_notes(sample, pairs)]
    if request.yaw is None and tested.site is not None:
        notes += _yaw_notes(tested.site, pairs, model)
    if tested.site is None:
        notes.append("Nothing is simulated, as the sensor is unknown: name it with --sensor.")
    elif model is None:
        notes.append(f"{tested.site.sensor.name} has no rated range, so no losses are simulated: add rated_range_m.")
    if any(not pair.other.has_tracks for pair in pairs):
        notes.append("Labels have no tracks: each box counts as an object of its own.")
    return ComparedList(
        name=tested.name,
        others=tuple(other.name for other in others),
        is_detections=is_detections,
        sensor=None if tested.site is None else tested.site.sensor.name,
        losses=model,
        sweeps=len(pairs),
        rows=tuple(_rows_by_range(sample)),
        point_rows=() if tested.site is None else tuple(_rows_by_points(sample)),
        score_rows=tuple(_score_rows(pairs, sample)) if is_detections else (),
        notes=tuple(notes),
    )


def _sample(
    tested: LabelList,
    pairs: Sequence[PlacedPair],
    names: Sequence[str],
    model: ReturnModel | None,
) -> tuple[_Sample, list[str]]:
    sizes = [len(pair.boxes) for pair in pairs]
    boxes = np.concatenate([pair.boxes for pair in pairs])
    objects = np.unique(np.array(names, dtype=np.str_), return_inverse=True)[1].astype(np.int64)
    found = np.concatenate([pair.matched(NEAR_M) for pair in pairs])
    blocks, notes = _blocks(pairs)
    unknown = np.full(len(boxes), np.nan)
    points, people, detectors = unknown, unknown, unknown
    if tested.site is not None:
        points, people, detectors = _levels(tested.site, pairs, model)
    by_box = np.repeat(blocks, sizes)
    if len(np.unique(by_box)) < FEW_OBJECTS:
        by_box = objects
        notes.append(
            f"The sweeps are of fewer than {FEW_OBJECTS} times {BLOCK_S:g} s: errors come from leaving out one object "
            "at a time, and are too small."
        )
    return _Sample(
        classes=np.array([name for pair in pairs for name in pair.other.classes], dtype=np.str_),
        boxes=boxes,
        objects=objects,
        blocks=by_box,
        range_m=np.hypot(*(boxes[:, :2] - np.asarray(tested.pose.position_m)[:2]).T),
        found=found,
        found_nearer=np.concatenate([pair.matched(NEARER_M) for pair in pairs]),
        by_chance=np.concatenate(list(_by_chance(pairs))),
        points=points,
        people=people,
        detectors=detectors,
        used=_in_labelled_area(boxes, objects, [pair.tested_boxes for pair in pairs]),
    ), notes


def _blocks(pairs: Sequence[PlacedPair]) -> tuple[IntArray, list[str]]:
    """Return the block of time of each pair, (pairs,) int64; without times, ten parts of the list."""
    times_s = np.array([pair.time_s for pair in pairs])
    if np.isfinite(times_s).all():
        return np.floor((times_s - times_s.min()) / BLOCK_S).astype(np.int64), []
    numbers = np.arange(len(pairs), dtype=np.int64)
    parts = min(10, len(pairs))
    return numbers * parts // len(pairs), [
        f"Files have no times: errors come from leaving out one of {parts} parts of the sweeps, in the order of names."
    ]


def _by_chance(pairs: Sequence[PlacedPair]) -> Iterator[FloatArray]:
    """Yield which boxes of each pair the tested list has 60 s later (or earlier); NaN if it has no such sweep."""
    times_s = np.array([pair.time_s for pair in pairs])
    timed = bool(np.isfinite(times_s).all())
    for number, pair in enumerate(pairs):
        later = None
        if timed:
            for shift_s in (CHANCE_SHIFT_S, -CHANCE_SHIFT_S):
                away_s = np.abs(times_s - times_s[number] - shift_s)
                nearest = int(np.argmin(away_s))
                if later is None and away_s[nearest] <= _LATE_S:
                    later = pairs[nearest]
        elif len(pairs) >= _FEWEST_TO_SHIFT:
            later = pairs[(number + len(pairs) // 2) % len(pairs)]
        if later is None:
            yield np.full(len(pair.boxes), np.nan)
        else:
            classes = later.tested.classes
            yield match_boxes(pair.boxes, pair.other.classes, later.tested_boxes, classes, NEAR_M).astype(np.float64)


def _in_labelled_area(boxes: FloatArray, objects: IntArray, tested: Sequence[FloatArray]) -> BoolArray:
    """Return which boxes are at places where the tested list has boxes, or few objects ever were, (n,)."""
    have_labels = set(_places(np.concatenate(tested)))
    places = _places(boxes)
    at_place: dict[tuple[int, int], set[int]] = {}
    for place, number in zip(places, objects.tolist(), strict=True):
        at_place.setdefault(place, set()).add(number)

    @cache
    def is_labelled(place: tuple[int, int]) -> bool:
        around = [(place[0] + i, place[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        if not have_labels.isdisjoint(around):
            return True
        return len(set[int]().union(*(at_place.get(other, ()) for other in around))) < FEWEST_AT_PLACE

    return np.array([is_labelled(place) for place in places], dtype=np.bool_)


def _places(boxes: FloatArray) -> list[tuple[int, int]]:
    """Return the place of each box, a square of :data:`PLACE_M`."""
    return [(x, y) for x, y in np.floor(boxes[:, :2] / PLACE_M).astype(int).tolist()]


def _frames(pairs: Sequence[PlacedPair]) -> list[TrafficFrame]:
    """Return the boxes of the other list of each pair, then the tested ones that it does not have."""
    frames = []
    for number, pair in enumerate(pairs):
        alone = pair.alone(NEAR_M)
        boxes = np.concatenate([pair.boxes, pair.tested_boxes[alone]])
        classes = [*pair.other.classes, *(pair.tested.classes[row] for row in np.flatnonzero(alone).tolist())]
        names = tuple(f"{row} {name}" for row, name in enumerate(classes))
        frames.append(
            TrafficFrame(number, names, tuple(VCLASSES[name] for name in classes), boxes, np.zeros(len(boxes)))
        )
    return frames


def _levels(
    site: SensorSite, pairs: Sequence[PlacedPair], model: ReturnModel | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points on the boxes of the other list, and what people notice and detectors find, (n,) float64 each."""
    frames = _frames(pairs)
    visible = visible_boxes(site, frames, model)
    total = sum(len(frame.boxes) for frame in frames)
    values = np.zeros((3, total))
    values[:, visible.record.row] = visible.points, noticed_chances(visible), detection_chances(visible)
    is_other = np.concatenate(
        [np.arange(len(frame.boxes)) < len(pair.boxes) for frame, pair in zip(frames, pairs, strict=True)]
    )
    points, people, detectors = values[:, is_other]
    return points, people, detectors


def _members(sample: _Sample, group: str) -> BoolArray:
    return np.isin(sample.classes, GROUPS[group]) & sample.used


def _rows_by_range(sample: _Sample) -> Iterator[AgreementRow]:
    for group in GROUPS:
        members = _members(sample, group)
        near = members & (sample.range_m <= FARTHEST_M)
        if near.any():
            yield _row(sample, group, near, 0.0, FARTHEST_M)
        for from_m, to_m in RANGES_M:
            within = members & (sample.range_m >= from_m) & (sample.range_m < to_m)
            if within.any():
                yield _row(sample, group, within, from_m, to_m)


def _rows_by_points(sample: _Sample) -> Iterator[AgreementRow]:
    bins = json.loads(DATA_FILE.read_text(encoding="utf-8"))["bins"]
    for group in GROUPS:
        members = _members(sample, group) & (sample.range_m <= FARTHEST_M)
        for low, top in bins:
            high = math.inf if top is None else float(top)
            within = members & (sample.points >= low) & (sample.points < high)
            if within.any():
                yield _row(sample, group, within, low, high)


def _row(sample: _Sample, group: str, rows: BoolArray, low: float, high: float) -> AgreementRow:
    blocks, count = sample.blocks[rows], int(rows.sum())
    known = rows & np.isfinite(sample.by_chance)

    def share(values: BoolArray | FloatArray) -> Ratio:
        return ratio_of_sums(values[rows].astype(np.float64), np.ones(count), blocks)

    simulated = bool(np.isfinite(sample.people[rows]).all())
    return AgreementRow(
        group=group,
        low=float(low),
        high=float(high),
        boxes=count,
        objects=len(np.unique(sample.objects[rows])),
        found=share(sample.found),
        found_nearer=share(sample.found_nearer),
        by_chance=ratio_of_sums(sample.by_chance[known], np.ones(int(known.sum())), sample.blocks[known]),
        people=share(sample.people) if simulated else None,
        detectors=share(sample.detectors) if simulated and group != "people" else None,
        difference=share(sample.people - sample.found) if simulated else None,
    )


def _score_rows(pairs: Sequence[PlacedPair], sample: _Sample) -> Iterator[ScoreRow]:
    """Yield what detections with at least some score find of the cars."""
    if any(pair.tested.scores is None and len(pair.tested) for pair in pairs):
        return
    cars = _members(sample, "cars") & (sample.range_m <= FARTHEST_M)
    if not cars.any():
        return
    for score in SCORES:
        chosen = []
        for pair in pairs:
            scores = pair.tested.scores
            chosen.append(np.zeros(0, dtype=np.bool_) if scores is None else scores >= score)

        def share(within_m: float, chosen: Sequence[BoolArray] = chosen) -> Ratio:
            found = np.concatenate([pair.matched(within_m, rows) for pair, rows in zip(pairs, chosen, strict=True)])
            return ratio_of_sums(found[cars].astype(np.float64), np.ones(int(cars.sum())), sample.blocks[cars])

        alone = sum(int((pair.alone(NEARER_M) & rows).sum()) for pair, rows in zip(pairs, chosen, strict=True))
        detections = sum(int(rows.sum()) for rows in chosen)
        yield ScoreRow(score, detections, share(NEAR_M), share(NEARER_M), alone / len(pairs))


def _area_notes(sample: _Sample) -> Iterator[str]:
    if sample.used.all():
        return
    cars = np.isin(sample.classes, GROUPS["cars"]) & (sample.range_m <= FARTHEST_M)
    text = (
        f"{number_of(int((~sample.used).sum()), 'box', 'boxes')} at places where this list never has one, although "
        f"{FEWEST_AT_PLACE} or more different objects were there, are left out"
    )
    if cars.any():
        text += f"; with them, it has {100 * sample.found[cars].mean():.0f} % of the cars"
    yield f"{text}."


def _size_notes(sample: _Sample, pairs: Sequence[PlacedPair]) -> Iterator[str]:
    cars = _members(sample, "cars") & (sample.range_m <= FARTHEST_M)
    objects = len(np.unique(sample.objects[cars]))
    if not cars.any():
        yield f"No car of the other list is within {FARTHEST_M:g} m: nothing is said about cars."
    elif objects < ENOUGH_OBJECTS:
        yield (
            f"{number_of(objects, 'car')} in {number_of(len(pairs), 'pair')} of sweeps are an anchor, not a "
            "validation: the errors do not contain how far another place or unit differs."
        )


def _yaw_notes(site: SensorSite, pairs: Sequence[PlacedPair], model: ReturnModel | None) -> Iterator[str]:
    """Yield how far the level depends on the convention of headings, where no file states it."""
    if all(pair.other.states_yaw for pair in pairs):
        return
    few = pairs[:: max(1, len(pairs) // _MOST_TO_TURN)]
    levels = []
    for convert in yaw_conventions.CONVENTIONS.values():
        turned = []
        for pair in few:
            boxes = pair.boxes.copy()
            boxes[:, 6] = convert(boxes[:, 6])
            turned.append(replace(pair, boxes=boxes))
        levels.append(float(_levels(site, turned, model)[1].mean()))
    apart = 100 * max(abs(level - levels[0]) for level in levels)
    yield (
        "Headings are taken as x-ccw, which the labels do not state; in another convention, the people's level would "
        f"differ by up to {apart:.1f} points (--yaw states it)."
    )
