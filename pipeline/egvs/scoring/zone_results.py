r"""What share of the road users is found in each zone of ``[score] zones``, by class: ``zones.parquet``.

A road user is in a zone while the centre of its box is in the zone's area or on its edge; it may be in several zones.
Articulated vehicles count once for each part. All road users count, pedestrians and bicycles included, whether or not
they have a weight in ``[score.weights]``, and all count alike.

The share found is the mean probability of detection, as in the score ``expected_detections``. Detectors of pedestrians
and bicycles have no model; they are expected by points: it is the share of observations with at least 20 points
(:func:`egvs.scoring.target_scores.expected_by_points`).

With several sensors, a road user is found when at least one of them finds it, each independently of the others:

.. math:: p = 1 - \prod_s (1 - p_s)

Standard errors are those of a ratio of sums over independent road users, as for blind spots.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.readers import ALL_USERS
from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import list_first, number_of
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.scoring.blindspots import SpotVisibility, VehicleSpots
from egvs.scoring.road_locations import RoadLocation
from egvs.scoring.target_scores import DETECTORS, TARGET_SCORES
from egvs.scoring.targets import TargetRecord, VisibleTargets
from egvs.scoring.zones import REPORTED_KEY

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from egvs.world.carriageway import Carriageway

PEDESTRIAN = "pedestrian"
"""Class of people on foot."""

CLASSES: Mapping[str, frozenset[str]] = {
    "car": frozenset(
        {
            "passenger",
            "private",
            "hov",
            "taxi",
            "evehicle",
            "emergency",
            "authority",
            "army",
            "vip",
            "custom1",
            "custom2",
        }
    ),
    "truck": frozenset({"truck", "trailer", "delivery"}),
    "bus": frozenset({"bus", "coach"}),
    "rail": frozenset({"tram", "rail_urban", "subway", "rail", "rail_electric", "rail_fast", "cable_car"}),
    "two-wheeler": frozenset({"bicycle", "scooter", "moped", "motorcycle"}),
    PEDESTRIAN: frozenset({"pedestrian", "wheelchair"}),
}
"""Classes of road users: SUMO's vClasses of each, in the order of the artefact."""

OTHER = "other"
"""Class of the vClasses that :data:`CLASSES` leaves out."""

_MAX_NAMED = 3
"""Zones that a warning names."""

ZONES, PLAN_ZONES = "zones", "plan_zones"
"""Names of the artefacts."""


def road_user_class(kind: str) -> str:
    """Return the class of a SUMO vClass.

    Examples
    --------
    >>> road_user_class("coach"), road_user_class("bicycle"), road_user_class("ship")
    ('bus', 'two-wheeler', 'other')
    """
    return next((name for name, kinds in CLASSES.items() if kind in kinds), OTHER)


@dataclass(frozen=True, eq=False)
class ZoneUsers:
    """The road users of a record in each zone, by class.

    Attributes
    ----------
    record
        Road users of recorded frames, pedestrians and bicycles included.
    spots
        One spot for each zone and class with a road user; its location has the class as ``by`` and the zone as
        ``name``.
    empty
        Zones without a road user.
    for_pedestrians
        Those of them that no lane for vehicles leads through, in traffic without pedestrians: nobody can be there.
    detectors
        Detectors whose probabilities are averaged.
    is_recorded
        Whether the traffic is finished, so that no pedestrians can be simulated.
    """

    record: TargetRecord
    spots: VehicleSpots
    empty: tuple[str, ...]
    for_pedestrians: tuple[str, ...] = ()
    detectors: tuple[str, ...] = DETECTORS
    is_recorded: bool = False

    @classmethod
    def of(
        cls,
        record: TargetRecord,
        areas: Mapping[str, BaseGeometry],
        weight: FloatArray,
        period: IntArray,
        carriageway: Carriageway | None = None,
        detectors: Sequence[str] = DETECTORS,
    ) -> ZoneUsers:
        """Find the zones of the vehicle-frames of a record.

        Parameters
        ----------
        record
            Road users of recorded frames.
        areas
            Area of each zone by name, world frame, metres.
        weight
            Weight of each vehicle-frame in a mix of periods, (n,) float64; 1 without a mix.
        period
            Period of each vehicle-frame, (n,) int64.
        carriageway
            The lanes for vehicles, where no pedestrians are simulated; None if pedestrians may be anywhere.
        detectors
            Detectors whose probabilities are averaged.
        """
        import shapely

        of_kind = np.array([road_user_class(kind) for kind in record.kinds], dtype=object)
        classes: NDArray[Any] = of_kind[record.kind] if len(record) else np.empty(0, dtype=object)
        locations: list[RoadLocation] = []
        rows: list[IntArray] = []
        empty = []
        for name, area in areas.items():
            inside = shapely.intersects_xy(area, record.boxes[:, 0], record.boxes[:, 1])
            if not inside.any():
                empty.append(name)
                continue
            for user_class in (ALL_USERS, *CLASSES, OTHER):
                of_class = inside if user_class == ALL_USERS else inside & (classes == user_class)
                if of_class.any():
                    locations.append(RoadLocation(user_class, name, "", (0.0, 0.0)))
                    rows.append(np.flatnonzero(of_class))
        row = np.concatenate([np.empty(0, dtype=np.int64), *rows])
        spot = np.repeat(np.arange(len(rows)), [len(spot_rows) for spot_rows in rows])
        spots = VehicleSpots.at_locations(record, locations, row, spot, weight, period)
        for_pedestrians = []
        if carriageway is not None and PEDESTRIAN not in classes:
            lanes = shapely.union_all([shapely.LineString(lane.shape_m[:, :2]) for lane in carriageway.lanes])
            for_pedestrians = [name for name in empty if not shapely.intersects(areas[name], lanes)]
        return cls(record, spots, tuple(empty), tuple(for_pedestrians), tuple(detectors))

    def visibility(self, visible: VisibleTargets) -> SpotVisibility:
        """Return what one site sees in each zone of each class; ``visible`` is of the same record."""
        return self.spots.visibility(visible.points, detection_probabilities(visible, self.detectors))

    def together(self, sensors: Sequence[VisibleTargets]) -> SpotVisibility:
        """Return what several sensors see together in each zone of each class."""
        missed, points = np.ones(len(self.record)), np.zeros(len(self.record))
        for visible in sensors:
            missed = missed * (1.0 - detection_probabilities(visible, self.detectors))
            points = points + visible.points
        return self.spots.visibility(points, 1.0 - missed)

    def columns(self, visibility: SpotVisibility) -> dict[str, Any]:
        """Return the columns of the artefacts for one site or plan."""
        return {
            "zone": [location.name for location in self.spots.locations],
            "class": [location.by for location in self.spots.locations],
            "road_users": self.spots.vehicles,
            "observations": self.spots.vehicle_frames,
            "share_found": visibility.share,
            "share_found_se": visibility.se,
            "with_points": visibility.with_points,
        }

    def warn_empty(self) -> Iterator[Diagnostic]:
        """Warn about zones without a road user, except those for pedestrians in traffic without any."""
        names = [name for name in self.empty if name not in self.for_pedestrians]
        if not names:
            return
        frames = number_of(len(self.record.numbers), "frame")
        problem = f"no road user has its centre in {list_first(names, _MAX_NAMED)} in the {frames} examined"
        hint = "Check these zones and the traffic; pedestrians need [effects.pedestrians_bicycles]."
        if self.is_recorded:
            hint = "Check these zones and the tracks; nobody was recorded there."
        yield Diagnostic("zones", f"{SCENARIO_FILE}: {REPORTED_KEY}", problem, hint)

    def describe_for_pedestrians(self) -> str:
        """Return a sentence on the zones that are left out because there are no pedestrians; empty without such."""
        if not self.for_pedestrians:
            return ""
        zones = number_of(len(self.for_pedestrians), "zone")
        names = list_first(self.for_pedestrians, _MAX_NAMED)
        reason = "the traffic has no pedestrians ([effects.pedestrians_bicycles])"
        if self.is_recorded:
            reason = "no pedestrians were recorded"
        return f"no results for {zones} beside the lanes, since {reason}: {names}"


def detection_probabilities(visible: VisibleTargets, detectors: Sequence[str]) -> FloatArray:
    """Return the probability that each vehicle-frame is found, averaged over detectors, 0 to 1, (n,) float64."""
    return TARGET_SCORES[DEFAULT_SCORE](visible, detectors)


def write_zones(
    path: Path, users: ZoneUsers, sites: Sequence[tuple[str, SpotVisibility]], metadata: Mapping[str, Any]
) -> None:
    """Write ``zones.parquet``.

    Parameters
    ----------
    path
        The file.
    users
        Road users in the zones.
    sites
        Name of each site, and what it sees, in the order of the sites.
    metadata
        Metadata of the stage.
    """
    with parquet.artefact_writer(path, ZONES) as file:
        for name, visibility in sites:
            columns = users.columns(visibility)
            file.write({"site": [name] * len(columns["zone"]), **columns})
        file.describe(dict(metadata))
