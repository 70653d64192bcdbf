"""Estimate the fleet of a new scenario from recorded vehicles: kinds, sizes, desired speeds, gaps and headways.

A value from fewer than :data:`egvs.statistics.intervals.MIN_OBSERVATIONS` vehicles of a kind is left at SUMO's
default.
Gaps need recorded sizes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.tracks import demand as track_demand
from egvs.extensions.tracks.cleaning import CleanTracks
from egvs.extensions.tracks.demand import Follower
from egvs.extensions.tracks.matching import MatchedTracks
from egvs.extensions.tracks.recorded_tracks import MOTOR_CLASSES
from egvs.scenario.traffic_config import TrafficConfig, VehicleKind
from egvs.statistics import intervals
from egvs.traffic.class_sizes import CLASS_SIZES

VEHICLE_CLASSES = (*sorted(MOTOR_CLASSES), "motorcycle")
"""Classes of road users that become the fleet."""

IMPERFECTION = 0.5
"""SUMO's default sigma."""

_STEP_S = float(TrafficConfig.model_fields["step_s"].default)
_SAME_SIZE_TRACKS = 3
"""So many vehicles of one class with exactly the same size were hardly measured."""


@dataclass(frozen=True)
class CarFollowing:
    """SUMO's defaults of a vClass: acceleration and deceleration in m/s^2, and minimum gap."""

    acceleration_m_s2: float
    deceleration_m_s2: float
    min_gap_m: float = 2.5

    @property
    def dawdling_m_s(self) -> float:
        """By how much its drivers dawdle on average."""
        return IMPERFECTION * self.acceleration_m_s2 * _STEP_S / 2.0


CAR_FOLLOWING = {
    "car": CarFollowing(2.6, 4.5), "van": CarFollowing(2.6, 4.5), "truck": CarFollowing(1.3, 4.0),
    "bus": CarFollowing(1.2, 4.0), "motorcycle": CarFollowing(6.0, 10.0),
}  # fmt: skip
"""https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html"""


@dataclass(frozen=True)
class KindEstimate:
    """A kind of the fleet.

    Attributes
    ----------
    kind
        Its keys.
    comments
        Where they come from, with intervals.
    has_default_size
        Whether length and width are no measurements.
    """

    kind: VehicleKind
    comments: tuple[str, ...]
    has_default_size: bool


@dataclass(frozen=True, eq=False)
class _Behaviour:
    """How vehicles drive: speed factors and standing gaps by track, and followers in queues."""

    factors: Mapping[int, float]
    gaps_m: Mapping[int, float]
    followers: Sequence[Follower]
    limit_m_s: float


@dataclass
class _KindAttributes:
    """Attributes of a vType, and sentences about them."""

    values: dict[str, str | float] = field(default_factory=dict)
    comments: list[str] = field(default_factory=list)
    defaults: dict[str, int] = field(default_factory=dict)

    def all_comments(self) -> list[str]:
        """Return the sentences, and one on the attributes that keep SUMO's defaults."""
        if not self.defaults:
            return self.comments
        texts = ", ".join(f"{name} ({number})" for name, number in self.defaults.items())
        few = f"fewer than {intervals.MIN_OBSERVATIONS} vehicles show another value"
        return [*self.comments, f"SUMO's default, since {few}: {texts}"]


def estimate_fleet(tracks: CleanTracks, members: Sequence[int], matched: MatchedTracks) -> tuple[KindEstimate, ...]:
    """Estimate the kinds of vehicles, the most frequent first.

    Parameters
    ----------
    tracks
        The recorded tracks.
    members
        Tracks of the vehicles that passed the junction; their shares and sizes count.
    matched
        All vehicles on lanes; they show how a kind drives.
    """
    leaders = track_demand.find_leaders(matched)
    length_m = tracks.size_m[:, 0]
    behaviour = _Behaviour(
        track_demand.free_speed_factors(matched, leaders),
        track_demand.standing_gaps_m(matched, leaders, length_m),
        track_demand.queue_followers(matched, leaders, length_m, _STEP_S),
        float(np.median([lane.speed_m_s for lane in matched.lanes if not lane.is_inside])),
    )
    fleet = Counter(tracks.classes[track] for track in members)
    return tuple(_kinds(tracks, members, fleet, behaviour))


def _kinds(
    tracks: CleanTracks, members: Sequence[int], fleet: Counter[str], behaviour: _Behaviour
) -> Iterator[KindEstimate]:
    for name, number in fleet.most_common():
        sizes_m = tracks.size_m[[track for track in members if tracks.classes[track] == name]]
        size_origin, is_default = _size_origin(name, sizes_m, tracks)
        attributes = _attributes(name, tracks, behaviour, has_sizes=not is_default)
        low, high = intervals.share_interval(number, fleet.total())
        share = f"{number:,} of {fleet.total():,} vehicles (share 95 %: {low:.2f} to {high:.2f})"
        length_m, width_m, height_m = np.round(np.median(sizes_m, axis=0), 2).tolist()
        kind = VehicleKind(
            name=name, vclass=CLASS_SIZES[name].vclass, share=round(number / fleet.total(), 4), length_m=length_m,
            width_m=width_m, height_m=height_m, attributes=attributes.values,
        )  # fmt: skip
        yield KindEstimate(kind, (share, size_origin, *attributes.all_comments()), is_default)


def _attributes(name: str, tracks: CleanTracks, behaviour: _Behaviour, *, has_sizes: bool) -> _KindAttributes:
    """Return the attributes of a kind that enough vehicles show."""
    attributes, model = _KindAttributes(), CAR_FOLLOWING[name]
    factors = [factor for track, factor in behaviour.factors.items() if tracks.classes[track] == name]
    _add_speed_factor(attributes, factors, model.dawdling_m_s / behaviour.limit_m_s)

    queued = [follower for follower in behaviour.followers if tracks.classes[follower.track] == name]
    headway = intervals.median_of([follower.headway_s for follower in queued])
    if headway is not None and headway.is_usable:
        attributes.comments.append(f"headway at the stop line {headway.value:.2f} s ({headway.format(2, 's')})")
    if not has_sizes:
        attributes.comments.append("minGap and tau: SUMO's defaults, since they need recorded sizes")
        return attributes

    standing_m = [gap_m for track, gap_m in behaviour.gaps_m.items() if tracks.classes[track] == name]
    gap = intervals.median_of(standing_m)
    min_gap_m = model.min_gap_m
    if gap is not None and gap.is_usable and gap.value > 0:
        min_gap_m = attributes.values["minGap"] = round(gap.value, 2)
        attributes.comments.append(f"minGap {gap.format(2, 'm')}")
    else:
        attributes.defaults["minGap"] = len(standing_m)

    time_gaps_s = [
        follower.time_gap_s(min_gap_m, model.deceleration_m_s2, model.dawdling_m_s)
        for follower in queued
        if not math.isnan(follower.gap_m)
    ]
    time_gap = intervals.median_of(time_gaps_s)
    if time_gap is not None and time_gap.is_usable and time_gap.value > 0:
        attributes.values["tau"] = round(time_gap.value, 2)
        attributes.comments.append(f"tau {time_gap.format(2, 's')}")
    else:
        attributes.defaults["tau"] = len(time_gaps_s)
    return attributes


def _add_speed_factor(attributes: _KindAttributes, factors: Sequence[float], dawdling: float) -> None:
    """Add SUMO's speedFactor; ``dawdling`` is by how much drivers fall short of it, as a share of the limit."""
    mean, deviation = intervals.mean_of(factors), intervals.deviation_of(factors)
    if mean is None or deviation is None or not mean.is_usable:
        attributes.defaults["speedFactor"] = len(factors)
        return
    mean = mean._replace(value=mean.value + dawdling, low=mean.low + dawdling, high=mean.high + dawdling)
    attributes.values["speedFactor"] = f"normc({mean.value:.3f},{deviation.value:.3f},0.2,2)"
    attributes.comments.append(f"speedFactor mean {mean.format(3)}; deviation {deviation.format(3)}")


def _size_origin(name: str, sizes_m: FloatArray, tracks: CleanTracks) -> tuple[str, bool]:
    """Return where the size of a kind comes from, in words, and whether length and width are no measurements."""
    filled = tracks.report.filled_sizes
    number = tracks.report.classes.get(name, 0)
    height = "default height" if filled.get(f"{name}: height_m", 0) == number else "median height"
    if filled.get(f"{name}: length_m", 0) == number:
        return "default size, since none is recorded", True
    if len(sizes_m) >= _SAME_SIZE_TRACKS and not np.ptp(sizes_m[:, :2], axis=0).any():
        return f"length and width are equal in all tracks, so they are defaults of the recording; {height}", True
    return f"median length and width, {height}", False
