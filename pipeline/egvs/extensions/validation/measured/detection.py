"""Run detectors on measured sweeps and on simulated ones of the same boxes, and compare with what is expected.

Both kinds of sweeps are given to a detector as at any site: each measured point belongs to the beam of the sensor that
is nearest to its direction, and the background is the empty scan of the site. A vehicle is found if a box overlaps it
by more than :data:`MIN_IOU`, in the mean of the overlaps from above and in 3D, as models of detectors count; and is
found nearby if the centre of a box is within :data:`NEARBY_M`, whether or not the box fits.

Simulated sweeps have the losses of the sensor, drawn with a fixed seed; the ground loses none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import BodyCaster, VehicleMeshes, builtin_bodies
from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.extensions.validation.detection_metrics import paired_overlap
from egvs.extensions.validation.detectors.base import Detector, SiteDetector
from egvs.extensions.validation.measured.ratios import Ratio, ratio_of_sums
from egvs.extensions.validation.measured.sensor_site import SensorSite
from egvs.sensors.return_model import ReturnModel

MIN_IOU = 0.7
NEARBY_M = 1.5

FEWEST_OF_EACH = 5
"""Fewest vehicles found and not found with an AUC."""

FEWEST_IN_BINS = 40
"""Fewest vehicles that are divided into four bins by what is expected."""

_SEED = 57
_ROI_MARGIN_M = 10.0


@dataclass(frozen=True)
class DetectionRow:
    """What a detector finds of one group of vehicles.

    Attributes
    ----------
    detector, group
        Names.
    from_m, to_m
        Ranges of the boxes; None for all.
    boxes, objects
        Their numbers.
    expected
        What its model expects with the losses of the sensor; None without a model.
    simulated, measured
        Share found in simulated and in measured sweeps.
    simulated_nearby, measured_nearby
        Share with the centre of a box within :data:`NEARBY_M`.
    auc
        Probability that of a vehicle that was found in the measured sweeps and one that was not, the former has the
        larger expectation; NaN with too few of either.
    bins
        Expected and found in the measured sweeps, in four bins of equal size by the former; empty with too few.
    """

    detector: str
    group: str
    from_m: int | None
    to_m: int | None
    boxes: int
    objects: int
    expected: Ratio | None
    simulated: Ratio
    measured: Ratio
    simulated_nearby: Ratio
    measured_nearby: Ratio
    auc: float
    bins: tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class Found:
    """Which boxes of all sweeps a detector finds, and has a box near, (n,) bool each."""

    fits: BoolArray
    nearby: BoolArray


def site_view(site: SensorSite) -> SiteView:
    """Return what a detector knows about the site."""
    empty_m = np.full(site.sensor.beams, np.inf)
    empty_m[site.beam[site.returned]] = site.range_m[site.returned]
    return SiteView(site.name, site.pose, site.sensor, empty_m)


def measured_sweep(site: SensorSite, nominal: cKDTree, points_m: FloatArray) -> Sweep:
    """Return a measured sweep, points (n, 3) with NaN for missing returns, as detectors receive it."""
    points_m = points_m[np.isfinite(points_m[:, 0])]
    range_m = np.sqrt((points_m**2).sum(axis=1))
    _, beam = nominal.query(points_m / range_m[:, None])
    order = np.argsort(beam, kind="stable")
    points = np.column_stack([points_m, np.full(len(points_m), np.nan)]).astype(np.float32)
    return Sweep(points[order], beam[order].astype(np.uint32))


def simulated_sweep(site: SensorSite, frame: TrafficFrame, model: ReturnModel | None) -> Sweep:
    """Return the simulated sweep of a frame; returns from road users are drawn, those from the ground are all there."""
    rng = np.random.default_rng((_SEED, frame.number))
    caster = BodyCaster(site.directions, VehicleMeshes.from_parts(builtin_bodies()))
    hits = caster.cast(frame, site.pose.position_m, site.range_m.copy(), np.zeros(len(site.range_m)))
    on_body = hits.owner >= 0
    returned = on_body | site.returned
    if model is not None:
        reflectivity = np.array([model.target_reflectivity(kind) for kind in frame.kinds])
        probability = np.ones(len(returned))
        probability[on_body] = model.probability(hits.range_m[on_body], reflectivity[hits.owner[on_body]])
        returned &= rng.random(len(returned)) < probability
    returned &= rng.random(len(returned)) < site.weight
    rows = np.flatnonzero(returned)
    range_m = hits.range_m[rows] + site.sensor.range_sigma_m * rng.standard_normal(len(rows))
    points_m = site.sensor.directions()[site.beam[rows]] * range_m[:, None]
    points = np.column_stack([points_m, np.full(len(rows), np.nan)]).astype(np.float32)
    return Sweep(points, site.beam[rows].astype(np.uint32))


def find_boxes(detect: Callable[[Sweep], Detections], sweeps: Sequence[Sweep], boxes: Sequence[FloatArray]) -> Found:
    """Return which boxes (m, 7) of each sweep a detector finds; in the order of all sweeps."""
    fits, nearby = [], []
    for sweep, labelled in zip(sweeps, boxes, strict=True):
        detected = detect(sweep).boxes
        row, other = (index.ravel() for index in np.indices((len(labelled), len(detected))))
        overlap = paired_overlap(labelled[row], detected[other]).mean(axis=0)
        distance_m = np.hypot(*(labelled[row, :2] - detected[other, :2]).T)
        shape = len(labelled), len(detected)
        fits.append((overlap.reshape(shape) > MIN_IOU).any(axis=1))
        nearby.append((distance_m.reshape(shape) <= NEARBY_M).any(axis=1))
    return Found(np.concatenate(fits), np.concatenate(nearby))


def region(boxes: Sequence[FloatArray]) -> Roi:
    """Return a region around all boxes."""
    everything = np.concatenate(boxes)
    low = everything[:, :3].min(axis=0) - _ROI_MARGIN_M
    size = everything[:, :3].max(axis=0) + _ROI_MARGIN_M - low
    return Roi((float(low[0]), float(low[1]), float(low[2])), (float(size[0]), float(size[1]), float(size[2])))


@dataclass(frozen=True, eq=False)
class DetectorTask:
    """Sweeps of a site, measured and simulated, and the boxes in them in the world frame."""

    view: SiteView
    roi: Roi
    boxes: tuple[FloatArray, ...]
    measured: tuple[Sweep, ...]
    simulated: tuple[Sweep, ...]

    @classmethod
    def of(
        cls,
        site: SensorSite,
        points_m: Sequence[FloatArray],
        frames: Sequence[TrafficFrame],
        model: ReturnModel | None,
    ) -> DetectorTask:
        """Prepare the sweeps of a site for detectors."""
        boxes = tuple(frame.boxes for frame in frames)
        nominal = cKDTree(site.sensor.directions())
        measured = tuple(measured_sweep(site, nominal, points) for points in points_m)
        simulated = tuple(simulated_sweep(site, frame, model) for frame in frames)
        return cls(site_view(site), region(boxes), boxes, measured, simulated)

    def run(self, detector: Detector) -> tuple[Found, Found]:
        """Return what a detector finds in the measured and in the simulated sweeps."""
        at_site: SiteDetector = detector.at_site(self.view, self.roi)
        measured = find_boxes(at_site.detect, self.measured, self.boxes)
        return measured, find_boxes(at_site.detect, self.simulated, self.boxes)


def detection_row(
    detector: str,
    group_and_ranges: tuple[str, int | None, int | None],
    found: tuple[Found, Found],
    members: BoolArray,
    objects: IntArray,
    chances: FloatArray | None,
) -> DetectionRow:
    """Return what a detector finds of a group.

    Parameters
    ----------
    detector
        Its name.
    group_and_ranges
        Name of the group, and the ranges of its boxes in metres; None for all.
    found
        What it finds in the measured and in the simulated sweeps.
    members
        Which boxes are of the group, (n,) bool.
    objects
        Object of each box, (n,) int64.
    chances
        Probability by its model that each box is found, (n,) float64; None without a model.
    """
    measured, simulated = found
    ones = np.ones(int(members.sum()))

    def share(values: BoolArray | FloatArray) -> Ratio:
        return ratio_of_sums(values[members].astype(np.float64), ones, objects[members])

    auc, bins = math.nan, list[tuple[float, float]]()
    if chances is not None:
        auc = area_under_curve(chances[members], measured.fits[members])
        if len(ones) >= FEWEST_IN_BINS:
            for rows in np.array_split(np.argsort(chances[members], kind="stable"), 4):
                bins.append((float(chances[members][rows].mean()), float(measured.fits[members][rows].mean())))
    group, from_m, to_m = group_and_ranges
    return DetectionRow(
        detector=detector,
        group=group,
        from_m=from_m,
        to_m=to_m,
        boxes=len(ones),
        objects=len(np.unique(objects[members])),
        expected=None if chances is None else share(chances),
        simulated=share(simulated.fits),
        measured=share(measured.fits),
        simulated_nearby=share(simulated.nearby),
        measured_nearby=share(measured.nearby),
        auc=auc,
        bins=tuple(bins),
    )


def area_under_curve(values: FloatArray, found: BoolArray) -> float:
    """Return the AUC of values (n,) for what was found, (n,) bool; NaN with fewer than five of either."""
    hits, misses = values[found], values[~found]
    if min(len(hits), len(misses)) < FEWEST_OF_EACH:
        return math.nan
    above = (hits[:, None] > misses[None, :]).mean()
    return float(above + 0.5 * (hits[:, None] == misses[None, :]).mean())
