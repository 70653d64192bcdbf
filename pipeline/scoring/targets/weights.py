"""How much each vehicle-frame counts by ``[score.weights]``: its kind times every zone that holds its centre."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.artefacts.traffic_frames import NO_VEHICLES
from pipeline.core.findings import Finding
from pipeline.scenario.models import FILE
from pipeline.scenario.score import WeightsModel
from pipeline.scoring.targets.record import Floats, TargetRecord


def people_of(wanted: WeightsModel) -> frozenset[str]:
    """The kinds of people that are to be seen: those on foot and on bicycles that have a weight."""
    return NO_VEHICLES & set(wanted.kinds)


def weights_of(wanted: WeightsModel, record: TargetRecord) -> Floats:
    """Of each vehicle-frame, (n,) float64; 1 where nothing is said of it. A centre on a zone's edge is in it."""
    import shapely

    by_kind = np.array([wanted.kinds.get(kind, 1.0) for kind in record.kinds])  # type: ignore[call-overload]
    weight: Floats = by_kind[record.kind] if len(by_kind) else np.ones(len(record))
    for zone in wanted.zones.values():
        inside = shapely.intersects_xy(shapely.Polygon(zone.polygon_m), record.boxes[:, 0], record.boxes[:, 1])
        weight = np.where(inside, weight * zone.weight, weight)
    return weight


def without_effect(wanted: WeightsModel, record: TargetRecord) -> Iterator[Finding]:
    """A warning for each weight that holds for no vehicle."""
    import shapely

    cure = "remove it, or look at its name and at the traffic"
    frames = f"in the {len(record.numbers)} frames looked at"
    for kind in wanted.kinds:
        if kind not in record.kinds:
            found = f"no {kind} has its centre in the region of interest {frames}"
            yield Finding("weights", f"{FILE}: score.weights.kinds.{kind}", found, cure)
    for name, zone in wanted.zones.items():
        if not shapely.intersects_xy(shapely.Polygon(zone.polygon_m), record.boxes[:, 0], record.boxes[:, 1]).any():
            found = f"no vehicle has its centre in it {frames}"
            yield Finding("weights", f"{FILE}: score.weights.zones.{name}", found, cure)
